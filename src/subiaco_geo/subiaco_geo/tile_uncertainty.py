"""Uncertainty of every tile of a map, from the covariances of the poses near it."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from subiaco_geo.frames import Floats

#: Columns of ``tile_uncertainty.csv``: centre of a tile [m], standard deviations of a ground point there [m],
#: distance to the nearest pose [m].
TILE_COLUMNS = ("east", "north", "sigma_east", "sigma_north", "sigma_up", "nearest_pose")
_NEAREST = 8
_SOFT = 5.0  # keeps the nearest pose's weight finite [m]


def tile_uncertainty(centres: Floats, positions: Floats, covariances: Floats) -> Floats:
    """Interpolate pose covariances to tiles, the lever from pose to tile included.

    Parameters
    ----------
    centres : (K, 3) float64
        Centres of the tiles, world [m]; a NaN height is that of the nearest pose.
    positions : (M, 3) float64
        Of the poses, world [m]; M > 0.
    covariances : (M, 6, 6) float64
        Of the poses: rotation about the axes of the map, then translation [rad2, rad m, m2].

    Returns
    -------
    (K, 6) float64
        Columns of :data:`TILE_COLUMNS`. The eight nearest poses count by their inverse squared distance;
        their errors are taken as one and the same, as those of neighbours are.
    """
    count = min(_NEAREST, len(positions))
    distance, index = cKDTree(positions[:, :2]).query(centres[:, :2], k=count)
    distance, index = distance.reshape(-1, count), index.reshape(-1, count)
    places = np.where(np.isfinite(centres), centres, positions[index[:, 0]])
    lever = places[:, None] - positions[index]
    turn = np.zeros((*index.shape, 3, 6))  # d place / d (rotation, translation) = [-lever x, 1]
    turn[..., 3:] = np.eye(3)
    x, y, z = np.moveaxis(lever, -1, 0)
    turn[..., 0, 1], turn[..., 0, 2], turn[..., 1, 2] = z, -y, x
    turn[..., 1, 0], turn[..., 2, 0], turn[..., 2, 1] = -z, y, -x
    own = turn @ covariances[index] @ np.swapaxes(turn, -1, -2)
    weight = 1.0 / (distance**2 + _SOFT**2)
    mean = (weight[..., None, None] * own).sum(axis=1) / weight.sum(axis=1)[:, None, None]
    sigmas = np.sqrt(np.diagonal(mean, axis1=1, axis2=2))
    return np.column_stack([centres[:, :2], sigmas, distance[:, 0]])
