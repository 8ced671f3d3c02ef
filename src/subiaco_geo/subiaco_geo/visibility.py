"""What a survey saw: hits and passes per voxel, the evidence for *gone* against *not seen*."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.atomic import whole_file
from subiaco_geo.clouds import packable, voxel_indices, voxel_keys
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, Ints


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
    with whole_file(path) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(
            stream,
            origin=grid.origin,
            voxel=np.float64(grid.voxel),
            keys=grid.keys,
            hits=grid.hits,
            passes=grid.passes,
        )


def load_visibility(path: Path) -> VisibilityGrid:
    """Read a grid written by :func:`save_visibility`."""
    try:
        with np.load(path, allow_pickle=False) as data:
            return VisibilityGrid(
                data["origin"], float(data["voxel"]), data["keys"], data["hits"], data["passes"]
            )
    except (KeyError, ValueError, OSError, EOFError, BadZipFile, zlib.error) as error:
        raise InputError(f"{path}: not a visibility layer ({error}); rebuild the map") from error
