"""Neighbours, eigenvalue features and normals of every point (method, part C1)."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
import pgeof
from numpy.typing import NDArray
from pydantic import Field

from subiaco_change.geometry import smallest_eigen
from subiaco_geo.config import StrictModel
from subiaco_geo.frames import Floats


class EigenFeatureConfig(StrictModel):
    """Neighbourhood of the eigen-features."""

    neighbours: int = Field(
        20, ge=4, le=64, description="Number of neighbours of a point in the k-nearest-neighbour graph"
    )
    radius: float = Field(
        0.6, gt=0, description="Radius of the neighbourhood from which eigenvalue features are computed [m]"
    )
    min_neighbours: int = Field(
        12,
        ge=3,
        description="Smallest number of neighbours for eigenvalue features; the radius grows where it "
        "contains fewer",
    )


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


def compute_features(xyz: Floats, config: EigenFeatureConfig) -> Features:
    """Compute eigen-features of points (N, 3) [m], best sorted spatially beforehand."""
    k = min(config.neighbours + 1, len(xyz))
    local = np.ascontiguousarray(xyz - xyz.mean(axis=0), dtype=np.float32)
    index, squared = pgeof.knn_search(local, local, k)
    neighbours = index.astype(np.int32)
    values, normals = neighbour_eigen(
        local.astype(np.float64), neighbours, squared, config.radius**2, config.min_neighbours
    )
    small, middle, large = np.maximum(values, 1e-10).T
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
def neighbour_eigen(
    xyz: Floats,
    neighbours: NDArray[np.int32],
    squared: NDArray[np.float32],
    radius_squared: float,
    min_neighbours: int,
) -> tuple[Floats, Floats]:
    """Ascending eigenvalues (N, 3) and upward normals (N, 3) of the neighbours in a radius.

    Of the nearest few where the radius holds fewer.
    """
    count, k = neighbours.shape
    values, normals = np.empty((count, 3)), np.empty((count, 3))
    for i in range(count):
        sx = sy = sz = xx = yy = zz = xy = xz = yz = 0.0
        used = 0
        for j in range(k):
            if squared[i, j] > radius_squared and used >= min_neighbours:
                break
            n = neighbours[i, j]
            dx, dy, dz = xyz[n, 0] - xyz[i, 0], xyz[n, 1] - xyz[i, 1], xyz[n, 2] - xyz[i, 2]
            used += 1
            sx, sy, sz = sx + dx, sy + dy, sz + dz
            xx, yy, zz = xx + dx * dx, yy + dy * dy, zz + dz * dz
            xy, xz, yz = xy + dx * dy, xz + dx * dz, yz + dy * dz
        sx, sy, sz = sx / used, sy / used, sz / used
        values[i] = smallest_eigen(
            xx / used - sx * sx, yy / used - sy * sy, zz / used - sz * sz,
            xy / used - sx * sy, xz / used - sx * sz, yz / used - sy * sz, normals[i],
        )  # fmt: skip
        if normals[i, 2] < 0:
            normals[i] *= -1.0
    return values, normals
