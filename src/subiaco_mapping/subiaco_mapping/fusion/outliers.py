"""Radius outlier removal with a spacing that follows the range: rain, stray light, multipath echoes.

How far apart points of a real surface lie grows with the range from which it was seen. So neighbours are
looked for within some beam spacings at that range (dynamic radius outlier removal, Charron, Phillips and
Waslander 2018), and how far apart the beams are is read off the scans. One limit for the whole map would take
the far ground.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from subiaco_geo.frames import Floats
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
    farthest, _ = cKDTree(xyz).query(xyz, k=[neighbours + 1], distance_upper_bound=bound, workers=threads)
    return np.asarray(farthest[:, 0] > near)
