"""Planes through the points of cubes of a grid, as pieces of walls."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from subiaco_geo.clouds import voxel_indices, voxel_keys
from subiaco_geo.frames import Floats, Ints


@dataclass(frozen=True)
class CubePlanes:
    """One plane for each cube that holds enough points.

    Parameters
    ----------
    key : (K,) int64
        Of the cube.
    count : (K,) int64
        Points in the cube.
    mean : (K, 3) float64
        Centroid [m].
    normal : (K, 3) float64
        Unit vectors; the sign is arbitrary.
    thickness, width : (K,) float64
        Standard deviation of the points along the normal, and along the narrower direction in the plane [m].
    """

    key: Ints
    count: Ints
    mean: Floats
    normal: Floats
    thickness: Floats
    width: Floats


def planes_in_cubes(xyz: Floats, edge: float, fewest: int) -> CubePlanes:
    """Fit a plane to the points of each cube by principal components.

    Parameters
    ----------
    xyz : (N, 3) float64
        Points [m].
    edge : float
        Edge of the cubes [m].
    fewest : int
        Smallest number of points that a plane is fitted to.

    Returns
    -------
    CubePlanes
    """
    cell = voxel_indices(xyz, edge)
    names, index, counts = np.unique(voxel_keys(cell), return_inverse=True, return_counts=True)
    centre = np.zeros((len(names), 3))
    centre[index] = (cell + 0.5) * edge
    inside = xyz - centre[index]
    mean = np.stack([np.bincount(index, inside[:, i]) for i in range(3)], axis=1) / counts[:, None]
    spread = np.empty((len(names), 3, 3))
    for i in range(3):
        for j in range(i, 3):
            product = np.bincount(index, inside[:, i] * inside[:, j]) / counts
            spread[:, i, j] = spread[:, j, i] = product - mean[:, i] * mean[:, j]
    many = counts >= fewest
    values, vectors = np.linalg.eigh(spread[many])
    sigmas = np.sqrt(np.maximum(values, 0.0))
    places = (mean + centre)[many]
    return CubePlanes(names[many], counts[many], places, vectors[:, :, 0], sigmas[:, 0], sigmas[:, 1])
