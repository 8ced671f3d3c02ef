"""What a survey saw: hits and passes per voxel, the evidence for *gone* against *not seen*."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.array_files import read_arrays
from subiaco_geo.atomic import whole_file
from subiaco_geo.clouds import packable, voxel_indices, voxel_keys
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.look_times import Looks

#: Probability that what returned from a voxel moved, where nothing is known of it.
NO_VERDICT = 255
#: The same of a thing that moved for certain; probabilities are stored in steps of 1/200.
SURELY_MOVED = 200

_COUNTS = ("keys", "hits", "passes")
_CLOCK = ("window", "start_ns")
_LOOKS = ("hit_windows", "through_windows", "hit_runs", "first_hit", "last_hit", "look_edges")
_SMALL = 4096  # more than the header and the values of a corner take [bytes]
_LEVEL = 4  # of deflate; the usual 6, numpy's, takes five times as long for no fewer bytes here


#: Names of the columns of time in files: the fields of looks, and the verdict.
TIME_COLUMNS = (*_LOOKS, "moving")


@dataclass(frozen=True)
class TimeRecord:
    """When every voxel of a grid was hit and looked through.

    Parameters
    ----------
    window : float
        Length of a time window [s].
    start_ns : int
        UTC time at which window 1 begins; window ``w`` begins ``(w - 1) * window`` seconds later.
    looks : Looks
        Of M voxels.
    """

    window: float
    start_ns: int
    looks: Looks


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
            small = {name: _member(archive, name) for name in ("origin", "voxel")}
            origin, voxel = small["origin"].astype(np.float64), float(small["voxel"])
            names, clock = [*_COUNTS], (0.0, 0)
            if "window.npy" in archive.namelist():
                names += TIME_COLUMNS
                clock = float(_member(archive, "window")), int(_member(archive, "start_ns"))
            with ExitStack() as stack:
                streams = [stack.enter_context(archive.open(f"{name}.npy")) for name in names]
                heads = [_head(stream) for stream in streams]
                count = heads[0][0]
                if any(head[0] != count for head in heads):
                    raise ValueError("its columns differ in length")
                for start in range(0, count, size):
                    rows = min(size, count - start)
                    read = [_rows(s, kind, rows) for s, (_, kind) in zip(streams, heads, strict=True)]
                    part = dict(zip(names, read, strict=True))
                    yield _grid_of(origin, voxel, clock, part)
    except (KeyError, ValueError, OSError, EOFError, BadZipFile, zlib.error) as error:
        raise InputError(f"{path}: not a visibility layer ({error}); rebuild the map") from error


def _grid_of(
    origin: Floats, voxel: float, clock: tuple[float, int], arrays: Mapping[str, NDArray[Any]]
) -> VisibilityGrid:
    moving, times = None, None
    if clock[0] > 0:
        times = TimeRecord(*clock, Looks(*(arrays[name] for name in _LOOKS)))
        moving = arrays["moving"]
    return VisibilityGrid(origin, voxel, arrays["keys"], arrays["hits"], arrays["passes"], moving, times)


def _member(archive: zipfile.ZipFile, name: str) -> NDArray[Any]:
    if archive.getinfo(f"{name}.npy").file_size > _SMALL:
        raise ValueError(f"{name} is no corner or edge")
    with archive.open(f"{name}.npy") as stream:
        return np.asarray(np.lib.format.read_array(stream, allow_pickle=False))


def _head(stream: IO[bytes]) -> tuple[int, np.dtype[Any]]:
    """Read the head of a column: its length and type."""
    version = np.lib.format.read_magic(stream)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, kind = read(stream)
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
    timed = _is_timed(path)
    names = _COUNTS + (_CLOCK + TIME_COLUMNS if timed else ())
    data = read_arrays(path, ("origin", "voxel", *names), "a visibility layer", "rebuild the map")
    columns = [data[name] for name in names if name not in _CLOCK]
    if any(len(column) != len(columns[0]) for column in columns):
        raise InputError(f"{path}: not a visibility layer (its columns differ in length); rebuild the map")
    clock = (float(data["window"]), int(data["start_ns"])) if timed else (0.0, 0)
    return _grid_of(data["origin"], float(data["voxel"]), clock, data)


def _is_timed(path: Path) -> bool:
    """Tell whether a file holds the columns of time; a damaged one does not."""
    try:
        with zipfile.ZipFile(path) as archive:
            return "window.npy" in archive.namelist()
    except (OSError, BadZipFile):
        return False
