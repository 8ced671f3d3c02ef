"""What moved leaves the map: places that let beams through in many turns and returned them in a few.

A car that passes fills a voxel for some turns; before and after, beams go through it. Wires, poles, fences
and leaves let beams through too, but return some of them turn after turn. So passes are counted against
the *turns* that brought a return, not against the returns, and are averaged over the neighbours. The lowest
of a place stays: the road shares neighbours with the cars on it, but does not drive.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter
from scipy.spatial import cKDTree

from subiaco_geo.clouds import voxel_indices, voxel_keys
from subiaco_geo.frames import Floats, Ints
from subiaco_mapping.config import MovingConfig

#: Walked beams a turn up to which the limits of :class:`MovingConfig` hold; passes of more are scaled down.
REFERENCE_BEAMS = 4096.0
_CELL = 0.5  # in plan, within which and around which the lowest is looked for [m]


@numba.njit(cache=True)
def _first_of_turn(keys: Ints, seen: Ints) -> NDArray[np.bool_]:
    """Mark the keys (N,) that were not there before; ``seen`` is an empty table, a power of two long."""
    fresh = np.zeros(len(keys), dtype=np.bool_)
    mask = np.uint64(len(seen) - 1)
    for i in range(len(keys)):
        mixed = np.uint64(keys[i]) * np.uint64(0x9E3779B97F4A7C15)
        slot = (mixed ^ (mixed >> np.uint64(32))) & mask
        while seen[slot] != keys[i] and seen[slot] != -1:
            slot = (slot + np.uint64(1)) & mask
        fresh[i] = seen[slot] == -1
        seen[slot] = keys[i]
    return fresh


def turn_keys(xyz: Floats, voxel: float) -> Ints:
    """Return the keys of the voxels [m] that one turn's points (N, 3) are in, each once."""
    keys = voxel_keys(voxel_indices(xyz, voxel))
    table = np.full(1 << int(np.ceil(np.log2(2 * len(keys) + 2))), -1, dtype=np.int64)
    return keys[_first_of_turn(keys, table)]


def moving_points(xyz: Floats, passed: Floats, config: MovingConfig) -> NDArray[np.bool_]:
    """Mark what moved.

    Parameters
    ----------
    xyz : (N, 3) float64
        A point a voxel [m].
    passed : (N,) float64
        Beams that passed through the place for each turn that returned one.
    config : MovingConfig
    """
    if not config.enabled or len(xyz) < config.neighbours:
        return np.zeros(len(xyz), dtype=np.bool_)
    distance, index = cKDTree(xyz).query(
        xyz, k=config.neighbours, distance_upper_bound=config.reach, workers=1
    )
    near = np.isfinite(distance)
    index = np.where(near, index, 0)
    evidence = np.log(np.maximum(passed, 0.1))
    mean = (evidence[index] * near).sum(axis=1) / near.sum(axis=1)
    surest = np.where(near, mean[index], -np.inf).max(axis=1)
    return np.asarray((mean > np.log(config.touching)) & (surest > np.log(config.sure)))


def on_the_floor(xyz: Floats, height: float) -> NDArray[np.bool_]:
    """Mark points (N, 3) that lie less than ``height`` above the lowest around them [m]."""
    if len(xyz) == 0:
        return np.zeros(0, dtype=np.bool_)
    cell = np.floor(xyz[:, :2] / _CELL).astype(np.int64)
    cell -= cell.min(axis=0)
    lowest = np.full(cell.max(axis=0) + 1, np.inf)
    np.minimum.at(lowest, (cell[:, 0], cell[:, 1]), xyz[:, 2])
    around = minimum_filter(lowest, 3, mode="nearest")
    return np.asarray(xyz[:, 2] - around[cell[:, 0], cell[:, 1]] < height)
