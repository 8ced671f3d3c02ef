"""The visibility layer: hits and passes of beams per voxel."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.array_files import ARRAY_FAULTS, read_array, read_array_head, read_arrays
from subiaco_geo.atomic import whole_file
from subiaco_geo.clouds import packable, voxel_indices, voxel_keys
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.observation_times import VoxelObservations

#: Probability that what returned from a voxel moved, where nothing is known of it.
NO_VERDICT = 255
#: The same of a thing that moved for certain; probabilities are stored in steps of 1/200.
SURELY_MOVED = 200

_PLACE = ("origin", "voxel")
_COUNTS = ("keys", "hits", "passes")
_CLOCK = ("window", "start_ns")
_LOOKS = ("hit_windows", "through_windows", "hit_runs", "first_hit", "last_hit", "look_edges")
_SMALL = 4096  # more than the header and the values of a corner take [bytes]
_LEVEL = 4  # of deflate; the usual 6, numpy's, takes five times as long for no fewer bytes here


#: Names of the columns of time in files: the fields of looks, and the verdict.
TIME_COLUMNS = (*_LOOKS, "moving")


@dataclass(frozen=True)
class TimeRecord:
    """When every voxel of a grid was hit and passed through.

    Parameters
    ----------
    window : float
        Length of a time window [s].
    start_ns : int
        UTC time at which window 1 begins; window ``w`` begins ``(w - 1) * window`` seconds later.
    looks : VoxelObservations
        Of M voxels.
    """

    window: float
    start_ns: int
    looks: VoxelObservations


@dataclass(frozen=True)
class VisibilityGrid:
    """Sparse voxel grid of beam counts; absent voxels were never seen.

    Parameters
    ----------
    origin : (3,) float64
        World coordinates of the corner of voxel (0, 0, 0) [m].
    voxel : float
        Edge [m].
    keys : (M,) int64
        Sorted packed voxel indices (:func:`subiaco_geo.clouds.voxel_keys`).
    hits, passes : (M,) uint32
        Beams that ended in the voxel, and that went through it.
    moving : (M,) uint8, optional
        Probability that what returned from the voxel moved while the survey was made, in steps of
        1/200; :data:`NO_VERDICT` where nothing returned (:mod:`subiaco_geo.movement`).
    times : TimeRecord, optional
        What that rests on. Layers that were made without time have neither.
    """

    origin: Floats
    voxel: float
    keys: Ints
    hits: NDArray[np.uint32]
    passes: NDArray[np.uint32]
    moving: NDArray[np.uint8] | None = None
    times: TimeRecord | None = None

    def slots(self, world: Floats) -> tuple[Ints, NDArray[np.bool_]]:
        """Return the voxel (N,) at world points (N, 3), and whether the grid holds it."""
        index = voxel_indices(world - self.origin, self.voxel)
        near = packable(index)
        if len(self.keys) == 0 or not near.any():
            return np.zeros(len(index), dtype=np.int64), np.zeros(len(index), dtype=np.bool_)
        query = voxel_keys(np.where(near[:, None], index, 0))
        slot = np.minimum(np.searchsorted(self.keys, query), len(self.keys) - 1)
        return slot, near & (self.keys[slot] == query)

    def lookup(self, world: Floats) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
        """Return hits and passes (N,) at world points (N, 3)."""
        slot, found = self.slots(world)
        if not found.any():
            zeros = np.zeros(len(slot), dtype=np.uint32)
            return zeros, zeros.copy()
        return np.where(found, self.hits[slot], 0), np.where(found, self.passes[slot], 0)

    def moved(self, world: Floats) -> NDArray[np.float32] | None:
        """Return the probability (N,) that what returned at world points (N, 3) moved.

        NaN where no voxel with returns was recorded; None for a grid without time.
        """
        if self.moving is None:
            return None
        slot, found = self.slots(world)
        if not found.any():
            return np.full(len(slot), np.nan, dtype=np.float32)
        code = np.where(found, self.moving[slot], NO_VERDICT)
        return np.where(code == NO_VERDICT, np.nan, code / SURELY_MOVED).astype(np.float32)

    def observed(self, world: Floats, min_beams: int = 1) -> NDArray[np.bool_]:
        """Tell which world points (N, 3) lie where at least ``min_beams`` beams went."""
        hits, passes = self.lookup(world)
        return np.asarray(hits + passes >= min_beams)


def save_visibility(path: Path, grid: VisibilityGrid) -> None:
    """Write a grid as compressed npz (no pickle)."""
    arrays: dict[str, NDArray[Any]] = {"origin": grid.origin, "voxel": np.array(grid.voxel, np.float64)}
    arrays |= {"keys": grid.keys, "hits": grid.hits, "passes": grid.passes}
    if grid.times is not None and grid.moving is not None:
        arrays |= {"window": np.array(grid.times.window), "start_ns": np.array(grid.times.start_ns)}
        arrays |= dict(zip(_LOOKS, grid.times.looks.columns(), strict=True)) | {"moving": grid.moving}
    with (
        whole_file(path) as temporary,
        zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED, compresslevel=_LEVEL) as archive,
    ):
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as stream:
                np.lib.format.write_array(stream, array, allow_pickle=False)


def visibility_parts(path: Path, size: int = 1 << 20) -> Iterator[VisibilityGrid]:
    """Read a grid written by :func:`save_visibility` in parts of up to ``size`` voxels, in order of keys.

    Raises
    ------
    InputError
        Missing, cut or damaged; found when the part is reached.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            timed = "window.npy" in archive.namelist()
            names = [*_COUNTS, *(TIME_COLUMNS if timed else ())]
            small = {name: _member(archive, name) for name in (*_PLACE, *(_CLOCK if timed else ()))}
            with ExitStack() as stack:
                streams = [stack.enter_context(archive.open(f"{name}.npy")) for name in names]
                heads = [_head(stream) for stream in streams]
                count = heads[0][0]
                if any(head[0] != count for head in heads):
                    raise ValueError("its columns differ in length")
                for start in range(0, count, size):
                    rows = min(size, count - start)
                    read = [_rows(s, kind, rows) for s, (_, kind) in zip(streams, heads, strict=True)]
                    yield _grid_of(small | dict(zip(names, read, strict=True)))
    except ARRAY_FAULTS as error:
        said = " ".join(str(error).split())[:300]
        raise InputError(f"{path}: not a visibility layer ({said}); rebuild the map") from error


def _grid_of(arrays: Mapping[str, NDArray[Any]]) -> VisibilityGrid:
    """Make a grid of the arrays of a file; ValueError where they are none of a grid."""
    origin, voxel = arrays["origin"], _number(arrays, "voxel")
    if origin.shape != (3,) or origin.dtype.kind not in "fiu" or not np.isfinite(origin).all():
        raise ValueError(f"origin has shape {origin.shape} and type {origin.dtype}, or is not finite")
    if not 0.0 < voxel < np.inf:
        raise ValueError(f"voxel is {voxel} m")
    timed = "window" in arrays
    columns = {name: arrays[name] for name in (*_COUNTS, *(TIME_COLUMNS if timed else ()))}
    for name, column in columns.items():
        if column.shape != arrays["keys"].shape or column.ndim != 1 or column.dtype.kind not in "iu":
            raise ValueError(f"{name} has shape {column.shape} and type {column.dtype}")
    if (np.diff(columns["keys"]) <= 0).any():
        raise ValueError("its voxels are not in order")
    moving, times = None, None
    if timed:
        window, start_ns = _number(arrays, "window"), int(_number(arrays, "start_ns", "iu"))
        if not 0.0 < window < np.inf:
            raise ValueError(f"window is {window} s")
        times = TimeRecord(window, start_ns, VoxelObservations(*(columns[name] for name in _LOOKS)))
        moving = columns["moving"]
    keys, hits, passes = (columns[name] for name in _COUNTS)
    return VisibilityGrid(origin.astype(np.float64), float(voxel), keys, hits, passes, moving, times)


def _number(arrays: Mapping[str, NDArray[Any]], name: str, kinds: str = "fiu") -> Any:
    array = arrays[name]
    if array.shape != () or array.dtype.kind not in kinds:
        raise ValueError(f"{name} has shape {array.shape} and type {array.dtype}")
    return array.item()


def _member(archive: zipfile.ZipFile, name: str) -> NDArray[Any]:
    size = archive.getinfo(f"{name}.npy").file_size
    if size > _SMALL:
        raise ValueError(f"{name} is no corner or edge")
    with archive.open(f"{name}.npy") as stream:
        return read_array(stream, size)


def _head(stream: IO[bytes]) -> tuple[int, np.dtype[Any]]:
    """Read the head of a column: its length and type."""
    shape, _, kind = read_array_head(stream)
    if len(shape) != 1 or kind.kind not in "iu":
        raise ValueError(f"a column has shape {shape} and type {kind}")
    return int(shape[0]), kind


def _rows(stream: IO[bytes], kind: np.dtype[Any], count: int) -> NDArray[Any]:
    data = stream.read(count * kind.itemsize)
    if len(data) < count * kind.itemsize:
        raise EOFError("a column is cut")
    return np.frombuffer(data, dtype=kind)


def load_visibility(path: Path) -> VisibilityGrid:
    """Read a grid written by :func:`save_visibility`."""
    names = _PLACE + _COUNTS + (_CLOCK + TIME_COLUMNS if _is_timed(path) else ())
    arrays = read_arrays(path, names, "a visibility layer", "rebuild the map")
    try:
        return _grid_of(arrays)
    except ValueError as error:
        raise InputError(f"{path}: not a visibility layer ({error}); rebuild the map") from error


def _is_timed(path: Path) -> bool:
    """Tell whether a file holds the columns of time; a damaged one does not."""
    try:
        with zipfile.ZipFile(path) as archive:
            return "window.npy" in archive.namelist()
    except ARRAY_FAULTS:
        return False
