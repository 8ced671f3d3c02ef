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
from scipy.spatial import cKDTree

from subiaco_geo.clouds import voxel_indices, voxel_keys
from subiaco_geo.frames import Floats
from subiaco_geo.voxel_components import connected_voxels
from subiaco_mapping.method_numbers import NUMBERS

_SHARED = NUMBERS.fusion.floor_voxels
_CELL = NUMBERS.fusion.floor_cell
_FRAGMENT_FLOOR = NUMBERS.fusion.fragment_floor
_FRAGMENT_REACH = NUMBERS.fusion.fragment_reach
_FRAGMENT_LENGTH = NUMBERS.fusion.fragment_length
_STOOD = NUMBERS.fusion.fragment_stood
Mask = NDArray[np.bool_]


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


def fragment_shares(
    xyz: Floats, above_floor: Floats, moved: Mask, stood: Callable[[Floats], Mask], voxel: float
) -> NDArray[np.float32]:
    """Return for every point (N,) which share of its group lies beside points that moved, 0 to 1.

    Groups are connected components of the voxels that hold points above the road that did not move. A
    fragment of a moving vehicle has a share near 1; a wall or a hedge beside traffic has not. Groups longer
    than a vehicle have 0; so the answer does not depend on how much of them a tile holds. So have groups most
    of which stood while they were seen: of a parked car, beams through windows and past its edges make a
    quarter of the voxels look as if they had moved, and the others lie beside these.

    Parameters
    ----------
    xyz : (N, 3) float64
        One point a map voxel, z up [m].
    above_floor : (N,) float64
        Height above the lowest point around [m].
    moved : (N,) bool
        Points that are removed.
    stood : callable
        Tells at which places (M, 3) something stood, by the times of beams.
    voxel : float
        Edge of the voxels that connect points [m].
    """
    shares = np.zeros(len(xyz), dtype=np.float32)
    rest = np.flatnonzero(~moved & (above_floor >= _FRAGMENT_FLOOR))
    if len(rest) == 0 or not moved.any():
        return shares
    keys, slot = np.unique(voxel_keys(voxel_indices(xyz[rest], voxel)), return_inverse=True)
    group = connected_voxels(keys)[slot]
    distance, _ = cKDTree(xyz[moved]).query(xyz[rest], distance_upper_bound=_FRAGMENT_REACH)
    beside = np.bincount(group, np.isfinite(distance)) / np.maximum(np.bincount(group), 1)
    low, high = np.full((2, len(beside), 3), np.inf)
    np.minimum.at(low, group, xyz[rest])
    np.minimum.at(high, group, -xyz[rest])
    beside[((-high - low) > _FRAGMENT_LENGTH).any(axis=1)] = 0.0
    asked = np.flatnonzero(beside[group] > 0)
    still = np.bincount(group[asked], stood(xyz[rest[asked]]), minlength=len(beside))
    beside[still >= _STOOD * np.bincount(group)] = 0.0
    shares[rest] = beside[group]
    return shares


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
