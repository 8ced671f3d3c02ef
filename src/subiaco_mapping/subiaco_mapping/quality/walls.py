"""How thick walls are in the map, and how densely it is covered."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from subiaco_geo.clouds import PointCloud, voxel_indices
from subiaco_geo.frames import Floats, Ints

_PATCH = 1.0  # edge of a patch [m]
_STEEP = 0.2  # largest vertical part of a wall's normal
_LEAST = 8  # voxels in a patch
_POINTS = 3  # of a voxel, for its spread to be believed
_AGREE = 0.97  # mean |cosine| of a patch's normals: below is a hedge, not a wall


@dataclass(frozen=True)
class Walls:
    """Facade patches of a metre: centre (N, 3) [m], world, and thickness (N,) [m].

    Thickness is the standard deviation of all points about the patch's plane, range noise and the wall's
    own relief included.
    """

    centre: Floats
    thickness: Floats

    def described(self) -> dict[str, float]:
        """Return count, median and 95 %."""
        found: dict[str, float] = {"patches": len(self.thickness)}
        if len(self.thickness):
            median, high = np.quantile(self.thickness, [0.5, 0.95])
            found |= {"thickness_median_m": float(median), "thickness_p95_m": float(high)}
        return found


def wall_thickness(cloud: PointCloud) -> Walls:
    """Fit a plane to every facade patch of a fused map.

    Parameters
    ----------
    cloud : PointCloud
        With ``normals``, ``n`` and ``spread``; a patch has the voxels of a cubic metre that look one way,
        so that the two sides of a thin wall are two patches.
    """
    if not {"normals", "n", "spread"} <= set(cloud.fields):
        return Walls(np.zeros((0, 3)), np.zeros(0))
    normals, count = np.asarray(cloud.fields["normals"], np.float64), np.asarray(cloud.fields["n"])
    steep = np.flatnonzero((np.abs(normals[:, 2]) < _STEEP) & (count >= _POINTS))
    xyz, normals = cloud.xyz[steep], normals[steep]
    weight, spread = count[steep].astype(np.float64), np.asarray(cloud.fields["spread"], np.float64)[steep]
    facing = np.argmax(np.abs(normals[:, :2]), axis=1)
    facing = 2 * facing + (np.take_along_axis(normals, facing[:, None], axis=1)[:, 0] > 0)
    cells = np.column_stack([voxel_indices(xyz, _PATCH), facing])
    _, patch = np.unique(cells, axis=0, return_inverse=True)
    size = np.bincount(patch.ravel())
    return _fitted(cloud, xyz, normals, weight, spread, patch.ravel(), size)


def _fitted(
    cloud: PointCloud, xyz: Floats, normals: Floats, weight: Floats, spread: Floats, patch: Ints, size: Ints
) -> Walls:
    total = np.maximum(np.bincount(patch, weight), 1e-12)

    def mean(values: Floats) -> Floats:
        columns = values.reshape(len(values), -1)
        sums = [np.bincount(patch, weight * columns[:, k]) / total for k in range(columns.shape[1])]
        return np.stack(sums, axis=1) if sums else np.zeros((len(total), 0))

    centre = mean(xyz)
    off = xyz - centre[patch]
    between = mean(off[:, :, None] * off[:, None, :]).reshape(-1, 3, 3)
    variance, axes = np.linalg.eigh(between)
    plane = axes[:, :, 0]
    agree = mean(np.abs((normals * plane[patch]).sum(axis=1)))[:, 0]
    wide = variance[:, 1] > (0.2 * _PATCH) ** 2  # a strip says nothing about a plane
    kept = (size >= _LEAST) & wide & (np.abs(plane[:, 2]) < _STEEP) & (agree > _AGREE)
    thickness = np.sqrt(np.maximum(variance[:, 0], 0.0) + mean(spread**2)[:, 0])
    return Walls(centre[kept] + cloud.origin, thickness[kept])


@dataclass(frozen=True)
class Coverage:
    """Square metres in plan.

    Parameters
    ----------
    cell : (K, 2) int64
        West and south edge of the square metre, world [m].
    points : (K,) int64
        Points of the map.
    returns : (K,) int64
        Returns that they were fused from.
    """

    cell: Ints
    points: Ints
    returns: Ints

    def described(self) -> dict[str, float]:
        """Return area, and points and returns a square metre."""
        return {
            "area_m2": len(self.cell),
            "points_per_m2_median": float(np.median(self.points)),
            "returns_per_m2_median": float(np.median(self.returns)),
            "returns_per_m2_p5": float(np.quantile(self.returns, 0.05)),
        }


def coverage(cloud: PointCloud) -> Coverage:
    """Count points and returns in every square metre that holds any."""
    cells, of = np.unique(np.floor(cloud.world()[:, :2]).astype(np.int64), axis=0, return_inverse=True)
    points = np.bincount(of.ravel())
    n = cloud.fields.get("n")
    returns = points if n is None else np.bincount(of.ravel(), np.asarray(n, np.float64)).astype(np.int64)
    return Coverage(cells, points, returns)
