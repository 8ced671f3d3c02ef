"""Points of moving objects removed from the map, with the road below them kept.

The verdict on a voxel comes from :mod:`subiaco_geo.movement`. A voxel that holds road and the lower edge of
a vehicle was hit all the time, so its verdict is that of the road: points above the road there take the
verdict on the voxel above. The lowest points of a place stay.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter

from subiaco_geo.frames import Floats
from subiaco_mapping.method_numbers import NUMBERS

_SHARED = NUMBERS.fusion.floor_voxels
_CELL = NUMBERS.fusion.floor_cell


def moved_probability(
    xyz: Floats, above_floor: Floats, moved: Callable[[Floats], NDArray[np.float32]], voxel: float
) -> NDArray[np.float32]:
    """Return the probability (N,) that points moved; NaN where nothing is known.

    Parameters
    ----------
    xyz : (N, 3) float64
        One point a map voxel, z up [m].
    above_floor : (N,) float64
        Height above the lowest point around [m].
    moved : callable
        Probability by the voxel of a place (M, 3).
    voxel : float
        Edge of those voxels [m].
    """
    found = moved(xyz)
    low = np.flatnonzero(above_floor < _SHARED * voxel)
    raised = moved(xyz[low] + [0.0, 0.0, voxel])
    found[low] = np.fmax(found[low], raised)
    return found


def height_above_floor(xyz: Floats) -> Floats:
    """Return the height (N,) of points (N, 3) above the lowest point around them [m]."""
    if len(xyz) == 0:
        return np.zeros(0)
    cell = np.floor(xyz[:, :2] / _CELL).astype(np.int64)
    cell -= cell.min(axis=0)
    lowest = np.full(cell.max(axis=0) + 1, np.inf)
    np.minimum.at(lowest, (cell[:, 0], cell[:, 1]), xyz[:, 2])
    around = minimum_filter(lowest, 3, mode="nearest")
    return np.asarray(xyz[:, 2] - around[cell[:, 0], cell[:, 1]])
