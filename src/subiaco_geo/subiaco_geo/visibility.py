"""What a survey saw: hits and passes per voxel, the evidence for *gone* against *not seen*."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Iterator
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

_SMALL = 4096  # more than the header and the values of a corner take [bytes]
_LEVEL = 4  # of deflate; the usual 6, numpy's, takes five times as long for no fewer bytes here


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
    """

    origin: Floats
    voxel: float
    keys: Ints
    hits: NDArray[np.uint32]
    passes: NDArray[np.uint32]

    def lookup(self, world: Floats) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
        """Return hits and passes (N,) at world points (N, 3)."""
        index = voxel_indices(world - self.origin, self.voxel)
        near = packable(index)
        if len(self.keys) == 0 or not near.any():
            zeros = np.zeros(len(index), dtype=np.uint32)
            return zeros, zeros.copy()
        query = voxel_keys(np.where(near[:, None], index, 0))
        slot = np.minimum(np.searchsorted(self.keys, query), len(self.keys) - 1)
        found = near & (self.keys[slot] == query)
        return np.where(found, self.hits[slot], 0), np.where(found, self.passes[slot], 0)

    def observed(self, world: Floats, min_beams: int = 1) -> NDArray[np.bool_]:
        """Tell which world points (N, 3) lie where at least ``min_beams`` beams went."""
        hits, passes = self.lookup(world)
        return np.asarray(hits + passes >= min_beams)


def save_visibility(path: Path, grid: VisibilityGrid) -> None:
    """Write a grid as compressed npz (no pickle)."""
    arrays: dict[str, NDArray[Any]] = {"origin": grid.origin, "voxel": np.array(grid.voxel, np.float64)}
    arrays |= {"keys": grid.keys, "hits": grid.hits, "passes": grid.passes}
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
            with ExitStack() as stack:
                streams = [
                    stack.enter_context(archive.open(f"{name}.npy")) for name in ("keys", "hits", "passes")
                ]
                heads = [_head(stream) for stream in streams]
                count = heads[0][0]
                if any(head[0] != count for head in heads):
                    raise ValueError("its columns differ in length")
                for start in range(0, count, size):
                    rows = min(size, count - start)
                    keys, hits, passes = (
                        _rows(stream, kind, rows) for stream, (_, kind) in zip(streams, heads, strict=True)
                    )
                    yield VisibilityGrid(origin, voxel, keys, hits, passes)
    except (KeyError, ValueError, OSError, EOFError, BadZipFile, zlib.error) as error:
        raise InputError(f"{path}: not a visibility layer ({error}); rebuild the map") from error


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
    names = ("origin", "voxel", "keys", "hits", "passes")
    data = read_arrays(path, names, "a visibility layer", "rebuild the map")
    if not len(data["keys"]) == len(data["hits"]) == len(data["passes"]):
        raise InputError(f"{path}: not a visibility layer (its columns differ in length); rebuild the map")
    return VisibilityGrid(data["origin"], float(data["voxel"]), data["keys"], data["hits"], data["passes"])
