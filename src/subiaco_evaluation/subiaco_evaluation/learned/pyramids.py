"""Grids of a cloud from fine to coarse with the neighbours that convolutions need, and cylinders of them.

Neighbours are searched once for the whole survey. A cylinder takes the points inside it and drops
neighbours outside, as a search in the cropped cloud would.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from subiaco_evaluation.learned.config import PointNetworkConfig
from subiaco_geo.frames import Floats, Ints

Indices = NDArray[np.int32]
MISSING = -1


@dataclass(frozen=True)
class Level:
    """One grid of a cloud.

    Parameters
    ----------
    xyz : (N, 3) float64
        Mean of the points of every voxel, local to the survey or to the cylinder [m].
    neighbours : (N, P) int32
        Points of the same level near every point, nearest first, -1 where there are fewer.
    pooled : (N, P) int32
        Points of the next finer level near every point, -1 where there are fewer; (N, 0) at the finest.
    coarser : (N,) int32
        Nearest point of the next coarser level; (0,) at the coarsest.
    """

    xyz: Floats
    neighbours: Indices
    pooled: Indices
    coarser: Indices


@dataclass(frozen=True)
class Pyramid:
    """Levels of a cloud, finest first.

    ``member`` (M,) is the point of the finest level of every input point, ``features`` (N, F) describe the
    points of the finest level.
    """

    levels: tuple[Level, ...]
    member: Indices
    features: NDArray[np.float32]


@dataclass(frozen=True)
class Cylinder:
    """Levels cut out of a pyramid: ``xyz`` relative to the centre, ``picked`` (N,) counts in the pyramid.

    ``features`` (N, F) describe the points of the finest level.
    """

    levels: tuple[Level, ...]
    picked: Ints
    features: NDArray[np.float32]


def voxel_means(xyz: Floats, edge: float) -> tuple[Floats, Indices]:
    """Return the mean (N, 3) of the points of every voxel, and the voxel (M,) of every point."""
    key = np.floor(xyz / edge).astype(np.int64)
    key -= key.min(axis=0, initial=0)
    sizes = key.max(axis=0, initial=0) + 1
    flat = (key[:, 0] * sizes[1] + key[:, 1]) * sizes[2] + key[:, 2]
    _, member = np.unique(flat, return_inverse=True)
    count = np.bincount(member)
    means = np.column_stack([np.bincount(member, xyz[:, axis]) / count for axis in range(3)])
    return means, member.astype(np.int32)


def near(support: cKDTree, queries: Floats, count: int, radius: float) -> Indices:
    """Return up to ``count`` support points (N, count) within a radius, nearest first, -1 where fewer."""
    _, found = support.query(queries, k=np.arange(1, count + 1), distance_upper_bound=radius)
    return np.where(found == support.n, MISSING, found).astype(np.int32)


def build_pyramid(xyz: Floats, config: PointNetworkConfig) -> Pyramid:
    """Build the levels of a cloud (M, 3) [m] and search their neighbours."""
    edge, member = config.first_grid, np.zeros(0, dtype=np.int32)
    means: list[Floats] = []
    for index in range(config.levels):
        mean, voxel = voxel_means(means[-1] if means else xyz, edge * 2**index)
        member = member if means else voxel
        means.append(mean)
    trees = [cKDTree(mean) for mean in means]
    levels = []
    for index, mean in enumerate(means):
        reach, finer = config.search * edge * 2**index, max(index - 1, 0)
        pooled = near(trees[finer], mean, config.neighbours, reach / 2) if index else _none(mean)
        coarser = trees[index + 1].query(mean)[1] if index + 1 < len(means) else np.zeros(0)
        levels.append(
            Level(mean, near(trees[index], mean, config.neighbours, reach), pooled, coarser.astype(np.int32))
        )
    return Pyramid(tuple(levels), member, np.zeros((len(means[0]), 0), dtype=np.float32))


def _none(xyz: Floats) -> Indices:
    return np.zeros((len(xyz), 0), dtype=np.int32)


def cut_cylinder(pyramid: Pyramid, centre: Floats, radius: float) -> Cylinder | None:
    """Cut the points within a radius of the vertical axis through ``centre`` (3,); None where there are none.

    A coarser level keeps the points that are the nearest ones of a point that was kept.
    """
    first = pyramid.levels[0].xyz
    picked = np.flatnonzero(((first[:, :2] - centre[:2]) ** 2).sum(axis=1) <= radius**2)
    if not len(picked):
        return None
    chosen = [picked]
    for level in pyramid.levels[:-1]:
        chosen.append(np.unique(level.coarser[chosen[-1]]).astype(np.int64))
    places = [_places(rows, len(level.xyz)) for rows, level in zip(chosen, pyramid.levels, strict=True)]
    levels = []
    for index, (rows, level) in enumerate(zip(chosen, pyramid.levels, strict=True)):
        pooled = places[index - 1][level.pooled[rows]] if index else level.pooled[rows]
        coarser = places[index + 1][level.coarser[rows]] if index + 1 < len(chosen) else level.coarser
        levels.append(Level(level.xyz[rows] - centre, places[index][level.neighbours[rows]], pooled, coarser))
    return Cylinder(tuple(levels), picked, pyramid.features[picked])


def _places(rows: Ints, size: int) -> Indices:
    """Return the new place (size + 1,) of every old point, -1 where dropped; the last row answers for -1."""
    places = np.full(size + 1, MISSING, dtype=np.int32)
    places[rows] = np.arange(len(rows))
    return places


def nearest_across(reference: Cylinder, compared: Cylinder) -> tuple[Indices, ...]:
    """Return for every level the nearest reference point (N,) of every compared point.

    Both cylinders must be cut at the same centre.
    """
    pairs = zip(reference.levels, compared.levels, strict=True)
    return tuple(cKDTree(a.xyz).query(b.xyz)[1].astype(np.int32) for a, b in pairs)


def pyramid_arrays(pyramid: Pyramid, prefix: str) -> dict[str, NDArray[Any]]:
    """Return the arrays of a pyramid by name, for a file."""
    arrays: dict[str, NDArray[Any]] = {
        f"{prefix}_member": pyramid.member,
        f"{prefix}_features": pyramid.features,
    }
    for index, level in enumerate(pyramid.levels):
        arrays |= {f"{prefix}_{index}_{name}": value for name, value in vars(level).items()}
    return arrays


def pyramid_of_arrays(arrays: Mapping[str, NDArray[Any]], prefix: str, levels: int) -> Pyramid:
    """Return the pyramid that :func:`pyramid_arrays` wrote."""
    names = ("xyz", "neighbours", "pooled", "coarser")
    built = (Level(*(arrays[f"{prefix}_{index}_{name}"] for name in names)) for index in range(levels))
    return Pyramid(tuple(built), arrays[f"{prefix}_member"], arrays[f"{prefix}_features"])
