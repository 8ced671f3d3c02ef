"""Thickness of walls in the map, and the density of its points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.clouds import PointCloud, voxel_indices
from subiaco_geo.frames import Floats, Ints

_PATCH = 1.0  # edge of a patch [m]
_STEEP = 0.2  # largest vertical part of a wall's normal
_LEAST = 8  # voxels in a patch
_POINTS = 3  # of a voxel, for its spread to be believed
_AGREE = 0.97  # mean |cosine| of a patch's normals: below is a hedge, not a wall
_STACKED = 2  # patches above each other in a facade
_MOST = 4_000_000  # points beyond which walls are sampled by column
_CHUNK = 1 << 20
_HALF = 1 << 30


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
    """Fit a plane to every facade patch of a fused map; of a large map, to a fair share of them.

    Parameters
    ----------
    cloud : PointCloud
        With ``normals``, ``n`` and ``spread``. A patch has the voxels of a cubic metre that look one way,
        so that the two sides of a thin wall are two patches; a facade has two patches or more above each
        other, so that cars and kerbs are none.
    """
    if not {"normals", "n", "spread"} <= set(cloud.fields):
        return Walls(np.zeros((0, 3)), np.zeros(0))
    rows, cells = _steep(cloud)
    if len(rows) == 0:
        return Walls(np.zeros((0, 3)), np.zeros(0))
    found, patch = np.unique(cells, axis=0, return_inverse=True)
    kept, centre, thickness = _fitted(cloud, rows, patch.ravel())
    _, column, stacked = np.unique(found[kept][:, [0, 1, 3]], axis=0, return_inverse=True, return_counts=True)
    tall = stacked[column.ravel()] >= _STACKED
    return Walls(centre[kept][tall] + cloud.origin, thickness[kept][tall])


def _steep(cloud: PointCloud) -> tuple[Ints, Ints]:
    """Return well-seen points on steep surfaces (M,), and their patch (M, 4): cell, and where it looks."""
    share = max(len(cloud) // _MOST, 1)
    parts: list[tuple[Ints, Ints]] = [(np.zeros(0, np.int64), np.zeros((0, 4), np.int64))]
    for start in range(0, len(cloud), _CHUNK):
        chunk = slice(start, start + _CHUNK)
        normals, count = np.asarray(cloud.fields["normals"][chunk]), np.asarray(cloud.fields["n"][chunk])
        cell = voxel_indices(cloud.xyz[chunk], _PATCH)
        sampled = (7919 * cell[:, 0] + 104729 * cell[:, 1]) % share == 0  # whole columns
        steep = np.flatnonzero((np.abs(normals[:, 2]) < _STEEP) & (count >= _POINTS) & sampled)
        level = normals[steep, :2]
        axis = np.argmax(np.abs(level), axis=1)
        looks = 2 * axis + (np.take_along_axis(level, axis[:, None], axis=1)[:, 0] > 0)
        parts.append((steep + start, np.column_stack([cell[steep], looks])))
    return np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts])


def _fitted(cloud: PointCloud, rows: Ints, patch: Ints) -> tuple[NDArray[np.bool_], Floats, Floats]:
    """Fit planes to patches (M,) of points; return which are walls (P,), their centres and thickness."""
    xyz, normals = cloud.xyz[rows], np.asarray(cloud.fields["normals"][rows], np.float64)
    weight = np.asarray(cloud.fields["n"][rows], np.float64)
    spread = np.asarray(cloud.fields["spread"][rows], np.float64)
    total = np.bincount(patch, weight)

    def mean(values: Floats) -> Floats:
        return np.asarray(np.bincount(patch, weight * values) / total)

    centre = np.stack([mean(xyz[:, k]) for k in range(3)], axis=1)
    off = xyz - centre[patch]
    about = np.stack([mean(off[:, i] * off[:, j]) for i in range(3) for j in range(3)], axis=1)
    variance, axes = np.linalg.eigh(about.reshape(-1, 3, 3))
    plane = axes[:, :, 0]
    agree = mean(np.abs((normals * plane[patch]).sum(axis=1)))
    wide = variance[:, 1] > (0.2 * _PATCH) ** 2  # a strip says nothing about a plane
    kept = (np.bincount(patch) >= _LEAST) & wide & (np.abs(plane[:, 2]) < _STEEP) & (agree > _AGREE)
    return kept, centre, np.sqrt(np.maximum(variance[:, 0], 0.0) + mean(spread**2))


@dataclass(frozen=True)
class WallCoverage:
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


def coverage(cloud: PointCloud) -> WallCoverage:
    """Count points and returns in every square metre that holds any."""
    corner = np.floor(cloud.origin[:2])
    keys, points, returns = (np.zeros(0, np.int64) for _ in range(3))
    n = cloud.fields.get("n")
    for start in range(0, len(cloud), _CHUNK):
        chunk = slice(start, start + _CHUNK)
        at = np.floor(cloud.xyz[chunk, :2] + (cloud.origin[:2] - corner)).astype(np.int64) + _HALF
        own = (at[:, 0] << 32) | at[:, 1]
        count = np.ones(len(own), np.int64) if n is None else np.asarray(n[chunk], np.int64)
        of, place = np.unique(np.concatenate([keys, own]), return_inverse=True)
        points = np.bincount(place, np.append(points, np.ones(len(own)))).astype(np.int64)
        returns = np.bincount(place, np.append(returns, count)).astype(np.int64)
        keys = of
    cell = np.column_stack([keys >> 32, keys & 0xFFFFFFFF]) - _HALF
    return WallCoverage(cell + corner.astype(np.int64), points, returns)
