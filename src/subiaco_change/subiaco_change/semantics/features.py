"""Neighbours, eigen-features and normals of every point (method, part C1)."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
import pgeof
from numpy.typing import NDArray
from pydantic import Field

from subiaco_geo.config import StrictModel
from subiaco_geo.frames import Floats


class FeatureConfig(StrictModel):
    """Neighbourhood of the eigen-features."""

    neighbours: int = Field(20, ge=4, le=64, description="neighbours in the k-NN graph")
    radius: float = Field(0.6, gt=0, description="radius of the eigen-features [m]")
    min_neighbours: int = Field(12, ge=3, description="taken from farther away where the radius holds fewer")


@dataclass(frozen=True)
class Features:
    """Shape of the surroundings of N points.

    ``neighbours`` (N, k) int32 are indices with the point itself first;
    ``distances`` (N, k) float32 [m]; ``linearity``, ``planarity``, ``scatter`` (N,) as in the paper (of
    eigenvalues, not their roots); ``normals`` (N, 3) with z >= 0;
    ``roughness`` (N,) is the root of the smallest eigenvalue [m].
    """

    neighbours: NDArray[np.int32]
    distances: NDArray[np.float32]
    linearity: Floats
    planarity: Floats
    scatter: Floats
    normals: Floats
    roughness: Floats


def compute_features(xyz: Floats, config: FeatureConfig) -> Features:
    """Compute eigen-features of points (N, 3) [m], best sorted spatially beforehand."""
    k = min(config.neighbours + 1, len(xyz))
    local = np.ascontiguousarray(xyz - xyz.mean(axis=0), dtype=np.float32)
    index, squared = pgeof.knn_search(local, local, k)
    neighbours = index.astype(np.int32)
    covariance = neighbour_covariance(
        local.astype(np.float64), neighbours, squared, config.radius**2, config.min_neighbours
    )
    values, vectors = np.linalg.eigh(covariance)
    values = np.maximum(values, 1e-10)
    small, middle, large = values.T
    normals = vectors[:, :, 0] * np.where(vectors[:, 2:3, 0] < 0, -1.0, 1.0)
    return Features(
        neighbours,
        np.sqrt(squared),
        (large - middle) / large,
        (middle - small) / large,
        small / large,
        normals,
        np.sqrt(small),
    )


@numba.njit(cache=True)
def neighbour_covariance(
    xyz: Floats,
    neighbours: NDArray[np.int32],
    squared: NDArray[np.float32],
    radius_squared: float,
    min_neighbours: int,
) -> Floats:
    """Covariance (N, 3, 3) of the neighbours within a radius, or of the nearest few where it is empty."""
    count, k = neighbours.shape
    covariance = np.zeros((count, 3, 3))
    for i in range(count):
        total = np.zeros(3)
        products = np.zeros((3, 3))
        used = 0
        for j in range(k):
            if squared[i, j] > radius_squared and used >= min_neighbours:
                break
            d = xyz[neighbours[i, j]] - xyz[i]
            used += 1
            for a in range(3):
                total[a] += d[a]
                for b in range(a + 1):
                    products[a, b] += d[a] * d[b]
        for a in range(3):
            for b in range(a + 1):
                value = products[a, b] / used - total[a] * total[b] / used**2
                covariance[i, a, b] = value
                covariance[i, b, a] = value
    return covariance
