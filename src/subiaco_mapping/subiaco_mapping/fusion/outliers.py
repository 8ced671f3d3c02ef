"""Radius outlier removal with a spacing that follows the range: rain, stray light, multipath echoes.

How far apart points of a real surface lie grows with the range from which it was seen. So neighbours are
looked for within some beam spacings at that range (dynamic radius outlier removal, Charron, Phillips and
Waslander 2018), and how far apart the beams are is read off the scans. One limit for the whole map would take
the far ground.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from subiaco_geo.clouds import extent_of, stable_order, voxel_indices, voxel_keys
from subiaco_geo.frames import Floats, Ints
from subiaco_mapping.fusion.config import FusionConfig
from subiaco_mapping.method_numbers import NUMBERS

_ENOUGH = NUMBERS.fusion.scan_returns


def beam_spacing(xyz: Floats, neighbours: int) -> float:
    """Return the angle [rad] within which a beam of a scan (N, 3), sensor at zero, has its neighbours.

    The median over returns; 0 where the scan has too few to tell.
    """
    reach = np.linalg.norm(xyz, axis=1)
    if neighbours == 0 or len(xyz) < max(_ENOUGH, neighbours + 1) or reach.min() == 0:
        return 0.0
    direction = xyz / reach[:, None]
    chord, _ = cKDTree(direction).query(direction, k=[neighbours + 1])
    return float(np.median(chord))


def isolated_points(
    xyz: Floats, reach: Floats, spacing: float, config: FusionConfig, threads: int = 1
) -> NDArray[np.bool_]:
    """Mark points with too few others near them.

    Parameters
    ----------
    xyz : (N, 3) float64
        A point a voxel [m].
    reach : (N,) float64
        From how far each was seen [m].
    spacing : float
        Of the beams, see :func:`beam_spacing` [rad].
    config : FusionConfig
    threads : int
    """
    neighbours = config.outlier_neighbours
    if neighbours == 0 or len(xyz) == 0:
        return np.zeros(len(xyz), dtype=np.bool_)
    near = np.maximum(config.outlier_spacings * spacing * reach, 2 * config.leaf)
    near = np.minimum(near, config.tile_overlap)  # no farther than a tile sees
    bound = np.nextafter(near.max(), np.inf)
    isolated = ~_surrounded(xyz, near, neighbours, 2 * config.leaf)
    ask = np.flatnonzero(isolated)
    tree = cKDTree(xyz, balanced_tree=False, compact_nodes=False)  # for few questions
    farthest, _ = tree.query(xyz[ask], k=[neighbours + 1], distance_upper_bound=bound, workers=threads)
    isolated[ask] = farthest[:, 0] > near[ask]
    return isolated


def _surrounded(xyz: Floats, near: Floats, enough: int, edge: float) -> NDArray[np.bool_]:
    """Tell which points (N, 3) have enough others within a distance (N,), in the cells around theirs.

    Most points of a map have, and are found without a tree.
    """
    keys = voxel_keys(voxel_indices(xyz - extent_of(xyz)[0], edge))
    order = stable_order(keys)
    surrounded = np.empty(len(xyz), dtype=np.bool_)
    surrounded[order] = _near_in_cells(keys[order], xyz[order], near[order], enough) >= enough
    return surrounded


@numba.njit(cache=True)
def _near_in_cells(keys: Ints, xyz: Floats, near: Floats, enough: int) -> Ints:
    """Count the others (N,) of sorted points within a distance (N,) in the 27 cells around, up to enough."""
    count = np.zeros(len(keys), dtype=np.int64)
    for column in (4, 0, 1, 2, 3, 5, 6, 7, 8):  # their own first: it suffices for most
        step, first = ((column // 3 - 1) << 42) + ((column % 3 - 1) << 21), 0
        for i in range(len(keys)):
            low = keys[i] + step - 1
            while first < len(keys) and keys[first] < low:
                first += 1
            j = first
            while count[i] < enough and j < len(keys) and keys[j] <= low + 2:
                dx, dy, dz = xyz[i, 0] - xyz[j, 0], xyz[i, 1] - xyz[j, 1], xyz[i, 2] - xyz[j, 2]
                count[i] += j != i and np.sqrt(dx * dx + dy * dy + dz * dz) <= near[i]
                j += 1
    return count
