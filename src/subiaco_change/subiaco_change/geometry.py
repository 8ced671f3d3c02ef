"""Neighbourhoods of points: column index, normals, nearest points, outliers, pyramid."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
import shapely
import small_gicp
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from shapely.geometry.base import BaseGeometry

from subiaco_geo.clouds import (
    PointCloud,
    extent_of,
    sort_spatially,
    voxel_downsample,
    voxel_indices,
    voxel_keys,
    within_box,
)
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, Ints

_MAX_COLUMNS = 1 << 24
_ROUNDING = 1e-6  # more than the coordinates of a column can be off by rounding [m]


def in_box_around(points: Floats, places: Floats, reach: float) -> NDArray[np.bool_]:
    """Tell which points (N, D) lie in the box around places (M, D), wider by ``reach`` [m] on every side."""
    low, high = extent_of(places)
    return within_box(points, low - reach, high + reach)


def in_outline_of(points: Floats, places: Floats, margin: float = 0.0) -> NDArray[np.bool_]:
    """Tell which places (M, 2) lie in the convex outline of points (N, 2), wider by a margin [m]."""
    outline = shapely.MultiPoint(points).convex_hull
    outline = outline.buffer(margin) if margin else outline
    return np.asarray(shapely.contains_xy(outline, places[:, 0], places[:, 1]))


def column_keys(xyz: Floats, cell: float) -> Ints:
    """Return the key (N,) of the column that every point (N, 3) stands in."""
    return voxel_keys(voxel_indices(xyz * (1.0, 1.0, 0.0), cell))


def outline_of_cells(cells: Ints, corner: Floats, edge: float) -> BaseGeometry:
    """Return the outline [m] of square cells (N, 2), counted east and north from a corner (2,) [m].

    The cells are distinct and share their edges exactly, so that no edges need be intersected.
    """
    low, high = (corner + step * edge for step in (cells, cells + 1))
    return shapely.coverage_union_all(shapely.box(low[:, 0], low[:, 1], high[:, 0], high[:, 1]))


def tree_for_few(points: Floats) -> cKDTree:
    """Return a k-d tree of points (N, D) for fewer queries: built in half the time, and as exact."""
    return cKDTree(points, balanced_tree=False, compact_nodes=False)


def lies_near(places: Floats, points: Floats, reach: float) -> NDArray[np.bool_]:
    """Tell which places (M, D) lie within ``reach`` [m] of points (N, D)."""
    near = points[in_box_around(points, places, reach)] if len(places) else points[:0]
    if len(near) == 0:
        return np.zeros(len(places), dtype=np.bool_)
    just_beyond = np.nextafter(reach, np.inf)
    return np.isfinite(tree_for_few(near).query(places, distance_upper_bound=just_beyond)[0])


@dataclass(frozen=True)
class ColumnIndex:
    """Points sorted by square column, and by height within it.

    A neighbourhood is a few columns, and in each of them one run of points
    found by bisection. Build it with :func:`build_index`.

    Parameters
    ----------
    xyz : (M, 3) float64
        Sorted points [m].
    order : (M,) int64
        Where each sorted point stands in the input.
    starts : (nx * ny + 1,) int64
        First point of every column.
    shape : (2,) int64
        nx, ny.
    corner : (2,) float64
        x and y of the outer corner [m].
    cell : float
        Edge of a column [m].
    """

    xyz: Floats
    order: Ints
    starts: Ints
    shape: Ints
    corner: Floats
    cell: float


def build_index(xyz: Floats, cell: float) -> ColumnIndex:
    """Index points (M, 3) by columns of an edge [m]; the edge grows if the area is vast."""
    if len(xyz) == 0 or not np.isfinite(xyz).all():
        raise InputError("points to index must be finite and not empty")
    corner, far = extent_of(xyz[:, :2])
    extent = far - corner
    while np.prod(np.floor(extent / cell) + 1) > _MAX_COLUMNS:
        cell *= 2
    shape = np.floor(extent / cell).astype(np.int64) + 1
    ij = np.minimum(((xyz[:, :2] - corner) / cell).astype(np.int64), shape - 1)
    column, columns = ij[:, 0] * shape[1] + ij[:, 1], int(np.prod(shape))
    starts = np.concatenate([[0], np.cumsum(np.bincount(column, minlength=columns))])
    order = _by_column_and_height(column, starts, xyz[:, 2])
    return ColumnIndex(np.ascontiguousarray(xyz[order]), order, starts, shape, corner, float(cell))


@numba.njit(cache=True)
def _by_column_and_height(column: Ints, starts: Ints, height: Floats) -> Ints:
    """Return the order (N,) of points by column, and by height within it; equal ones as they stand."""
    filled = starts.copy()
    order = np.empty(len(column), np.int64)
    for i in range(len(column)):
        order[filled[column[i]]] = i
        filled[column[i]] += 1
    for c in range(len(starts) - 1):
        low, high = starts[c], starts[c + 1]
        if high - low > 64:
            own = order[low:high].copy()
            order[low:high] = own[np.argsort(height[own], kind="mergesort")]
            continue
        for i in range(low + 1, high):  # few: sorted as they come
            moved, k = order[i], i
            while k > low and height[order[k - 1]] > height[moved]:
                order[k] = order[k - 1]
                k -= 1
            order[k] = moved
    return order


@numba.njit(cache=True, inline="always")
def first_above(points: Floats, low: int, high: int, z: float) -> int:
    """Return the first point in [low, high) whose height is at least z."""
    while low < high:
        middle = (low + high) // 2
        if points[middle, 2] < z:
            low = middle + 1
        else:
            high = middle
    return low


@numba.njit(cache=True, inline="always")
def column_range(low: float, high: float, corner: float, cell: float, count: int) -> tuple[int, int]:
    """Return the columns [first, last] that the interval [low, high] touches."""
    first = max(int(np.floor((low - corner) / cell)), 0)
    return first, min(int(np.floor((high - corner) / cell)), count - 1)


@numba.njit(cache=True, inline="always")
def column_gap(x: float, i: int, corner: float, cell: float) -> float:
    """Return how far a coordinate lies from those of column i, a little less rather than more."""
    low = corner + i * cell
    return max(low - x, x - low - cell, _ROUNDING) - _ROUNDING


@numba.njit(cache=True, inline="always")
def _nearest_in_column(
    points: Floats, start: int, end: int, x: float, y: float, z: float, bound: float
) -> float:
    """Return the squared distance of the nearest point of a column, or the bound if none is nearer."""
    middle = first_above(points, start, end, z)
    for step in (-1, 1):
        k = middle if step > 0 else middle - 1
        while start <= k < end and (points[k, 2] - z) ** 2 <= bound:
            dx, dy, dz = points[k, 0] - x, points[k, 1] - y, points[k, 2] - z
            bound = min(bound, dx * dx + dy * dy + dz * dz)
            k += step
    return bound


@numba.njit(cache=True)
def _nearest(
    points: Floats, starts: Ints, shape: Ints, corner: Floats, cell: float, queries: Floats, radius: float
) -> tuple[Ints, Floats]:
    """Return the sorted index of the nearest point within a radius, or -1, and the distance."""
    n = len(queries)
    index = np.full(n, -1, np.int64)
    distance = np.full(n, np.inf)
    for q in range(n):
        x, y, z = queries[q, 0], queries[q, 1], queries[q, 2]
        best = radius * radius
        i, j = int(np.floor((x - corner[0]) / cell)), int(np.floor((y - corner[1]) / cell))
        if 0 <= i < shape[0] and 0 <= j < shape[1]:  # a bound, so that little of the columns around is read
            column = i * shape[1] + j
            best = _nearest_in_column(points, starts[column], starts[column + 1], x, y, z, best)
        reach = np.sqrt(best) + _ROUNDING
        i0, i1 = column_range(x - reach, x + reach, corner[0], cell, shape[0])
        j0, j1 = column_range(y - reach, y + reach, corner[1], cell, shape[1])
        for i in range(i0, i1 + 1):
            across = column_gap(x, i, corner[0], cell) ** 2
            for j in range(j0, j1 + 1):
                room = best - across - column_gap(y, j, corner[1], cell) ** 2
                if room < 0.0:
                    continue
                reach = np.sqrt(room) + _ROUNDING
                end = starts[i * shape[1] + j + 1]
                k = first_above(points, starts[i * shape[1] + j], end, z - reach)
                while k < end and points[k, 2] <= z + reach:
                    dx, dy, dz = points[k, 0] - x, points[k, 1] - y, points[k, 2] - z
                    d2 = dx * dx + dy * dy + dz * dz
                    if d2 <= best:
                        best = d2
                        index[q] = k
                    k += 1
        if index[q] >= 0:
            distance[q] = np.sqrt(best)
    return index, distance


def nearest(index: ColumnIndex, queries: Floats, radius: float) -> tuple[Ints, Floats]:
    """Find the nearest indexed point within a radius.

    Parameters
    ----------
    index : ColumnIndex
    queries : (N, 3) float64
    radius : float
        Largest distance [m].

    Returns
    -------
    found : (N,) int64
        Position among the points given to :func:`build_index`, -1 for none.
    distance : (N,) float64
        Infinite where there is none [m].
    """
    slot, distance = _nearest(index.xyz, index.starts, index.shape, index.corner, index.cell, queries, radius)
    return np.where(slot >= 0, index.order[slot], -1), distance


def nearest_points(index: ColumnIndex, queries: Floats, radius: float) -> Floats:
    """Return the nearest indexed point (N, 3) of queries (N, 3); NaN where none lies within a radius [m]."""
    slot, _ = _nearest(index.xyz, index.starts, index.shape, index.corner, index.cell, queries, radius)
    found = np.full((len(queries), 3), np.nan)
    found[slot >= 0] = index.xyz[slot[slot >= 0]]
    return found


@numba.njit(cache=True)
def smallest_eigen(
    a: float, b: float, c: float, d: float, e: float, f: float, out: Floats
) -> tuple[float, float, float]:
    """Smallest eigenvector of [[a, d, e], [d, b, f], [e, f, c]] into out, and the eigenvalues.

    Closed form (Smith 1961); the vector is the longest cross product of two
    rows of A - l I. Returns ascending eigenvalues.
    """
    mean = (a + b + c) / 3.0
    a, b, c = a - mean, b - mean, c - mean
    p2 = (a * a + b * b + c * c + 2.0 * (d * d + e * e + f * f)) / 6.0
    p = np.sqrt(p2)
    out[0], out[1], out[2] = 0.0, 0.0, 1.0
    if p <= 1e-12:
        return mean, mean, mean
    half = (a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e)) / (2.0 * p * p2)
    angle = np.arccos(min(1.0, max(-1.0, half))) / 3.0
    high = 2.0 * p * np.cos(angle)
    low = 2.0 * p * np.cos(angle + 2.0 * np.pi / 3.0)
    a, b, c = a - low, b - low, c - low
    best = 0.0
    for k in range(3):
        if k == 0:
            u, v, w = d * f - e * b, e * d - a * f, a * b - d * d
        elif k == 1:
            u, v, w = d * c - e * f, e * e - a * c, a * f - d * e
        else:
            u, v, w = b * c - f * f, f * e - d * c, d * f - b * e
        length = u * u + v * v + w * w
        if length > best:
            best = length
            scale = 1.0 / np.sqrt(length)
            out[0], out[1], out[2] = u * scale, v * scale, w * scale
    return low + mean, mean - high - low, high + mean


@numba.njit(cache=True)
def _normals(
    points: Floats, asked: Ints, starts: Ints, shape: Ints, corner: Floats, cell: float,
    radius: float, min_count: int,
) -> tuple[Floats, Floats, Ints]:  # fmt: skip
    """Fit a plane to the ball around every sorted point that is asked for."""
    n = len(points)
    normals = np.zeros((n, 3))
    curvature = np.full(n, 1.0 / 3.0)
    count = np.zeros(n, np.int64)
    out = np.empty(3)
    for q in asked:
        x, y, z = points[q, 0], points[q, 1], points[q, 2]
        sx = sy = sz = xx = yy = zz = xy = xz = yz = 0.0
        m = 0
        i0, i1 = column_range(x - radius, x + radius, corner[0], cell, shape[0])
        j0, j1 = column_range(y - radius, y + radius, corner[1], cell, shape[1])
        for i in range(i0, i1 + 1):
            across = column_gap(x, i, corner[0], cell) ** 2
            for j in range(j0, j1 + 1):
                room = radius * radius - across - column_gap(y, j, corner[1], cell) ** 2
                if room < 0.0:
                    continue
                reach = np.sqrt(room) + _ROUNDING
                end = starts[i * shape[1] + j + 1]
                k = first_above(points, starts[i * shape[1] + j], end, z - reach)
                while k < end and points[k, 2] <= z + reach:
                    dx, dy, dz = points[k, 0] - x, points[k, 1] - y, points[k, 2] - z
                    k += 1
                    inside = (
                        1.0 if dx * dx + dy * dy + dz * dz <= radius * radius else 0.0
                    )  # no branch: faster
                    m += int(inside)
                    dx, dy, dz = inside * dx, inside * dy, inside * dz
                    sx, sy, sz = sx + dx, sy + dy, sz + dz
                    xx, yy, zz = xx + dx * dx, yy + dy * dy, zz + dz * dz
                    xy, xz, yz = xy + dx * dy, xz + dx * dz, yz + dy * dz
        count[q] = m
        if m < min_count:
            continue
        sx, sy, sz = sx / m, sy / m, sz / m
        low, middle, high = smallest_eigen(
            xx / m - sx * sx, yy / m - sy * sy, zz / m - sz * sz,
            xy / m - sx * sy, xz / m - sx * sz, yz / m - sy * sz, out,
        )  # fmt: skip
        normals[q] = out
        curvature[q] = max(low, 0.0) / max(low + middle + high, 1e-12)
    return normals, curvature, count


@dataclass(frozen=True)
class LocalPlanes:
    """Planes fitted around points.

    Parameters
    ----------
    normals : (N, 3) float64
        Unit, upward (z >= 0); zero where the neighbourhood is too small.
    curvature : (N,) float64
        Smallest eigenvalue over the sum of all: 0 for a plane, 1/3 for a ball.
    count : (N,) int64
        Points in the neighbourhood, the point itself included.
    """

    normals: Floats
    curvature: Floats
    count: Ints


def fit_planes(xyz: Floats, radius: float, min_count: int = 5, first: int | None = None) -> LocalPlanes:
    """Fit planes to balls of a radius [m] around points (N, 3), or around the ``first`` of them alone."""
    first = len(xyz) if first is None else first
    if len(xyz) == 0:
        return LocalPlanes(np.zeros((0, 3)), np.zeros(0), np.zeros(0, dtype=np.int64))
    index = build_index(xyz, radius)
    sorted_values = _normals(
        index.xyz, np.flatnonzero(index.order < first), index.starts, index.shape, index.corner, index.cell,
        radius, min_count,
    )  # fmt: skip
    normals, curvature, count = (np.empty_like(values) for values in sorted_values)
    for target, values in zip((normals, curvature, count), sorted_values, strict=True):
        target[index.order] = values
    normals[normals[:, 2] < 0] *= -1.0
    return LocalPlanes(normals[:first], curvature[:first], count[:first])


def estimate_normals(xyz: Floats, radius: float, first: int | None = None) -> Floats:
    """Return upward unit normals (N, 3) from balls of a radius [m]; zero where too few points.

    Those of the ``first`` points alone, if given: the others are their surroundings.
    """
    return fit_planes(xyz, radius, first=first).normals


def outlier_mask(xyz: Floats, neighbours: int = 10, sigmas: float = 3.0) -> NDArray[np.bool_]:
    """Flag points (N,) whose mean distance to their neighbours is out of the ordinary.

    Statistical outlier removal (Rusu et al. 2008): mean plus ``sigmas``
    standard deviations of the mean distance over the whole cloud.
    """
    if len(xyz) <= neighbours:
        return np.zeros(len(xyz), dtype=np.bool_)
    order = sort_spatially(xyz)
    points = small_gicp.PointCloud(xyz[order])
    tree = small_gicp.KdTree(points, num_threads=1)
    _, squared = tree.batch_knn_search(xyz[order], neighbours + 1, num_threads=1)
    distance = np.empty(len(xyz))
    distance[order] = np.sqrt(np.asarray(squared)).sum(axis=1) / neighbours
    return np.asarray(distance > distance.mean() + sigmas * distance.std())


def remove_outliers(cloud: PointCloud, neighbours: int = 10, sigmas: float = 3.0) -> PointCloud:
    """Return the cloud without the points of :func:`outlier_mask`."""
    return cloud.select(~outlier_mask(cloud.xyz, neighbours, sigmas))


@dataclass(frozen=True)
class Level:
    """One level of the pyramid: points (N, 3) at a leaf [m], and the planes around them."""

    leaf: float
    xyz: Floats
    planes: LocalPlanes


def build_pyramid(xyz: Floats, leaves: tuple[float, ...], radius: float = 0.8) -> list[Level]:
    """Downsample points to every leaf and fit planes with radius max(radius, 2.5 leaf) [m]."""
    levels = []
    for leaf in leaves:
        points = voxel_downsample(PointCloud(xyz), leaf).xyz
        levels.append(Level(leaf, points, fit_planes(points, max(radius, 2.5 * leaf))))
    return levels
