"""Level of detection of displacements, point by point (method, part B7)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numba
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from subiaco_change.geometry import (
    ColumnIndex,
    build_index,
    column_gap,
    column_range,
    estimate_normals,
    first_above,
)
from subiaco_change.method_numbers import NUMBERS
from subiaco_geo.clouds import PointCloud
from subiaco_geo.config import StrictModel
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, Ints

_Z95 = NUMBERS.displacement_lod.z95


class LodConfig(StrictModel):
    """Level of detection (method B7, Decision 4)."""

    radius: float = Field(
        1.0,
        gt=0,
        description="Radius of the cylinder along the normal of a point [m]; 2.4 times the point spacing "
        "where the spacing exceeds 0.36 m",
    )
    self_half_length: float = Field(
        0.5, gt=0, description="Half length of the cylinder that is evaluated first in both epochs [m]"
    )
    half_length: float = Field(
        1.0,
        gt=0,
        description="Half length of the cylinder in the other epoch where the shorter cylinder contains "
        "too few points [m]",
    )
    min_count: int = Field(
        8,
        ge=1,
        description="Number of points in the cylinder below which no change is claimed (infinite level of "
        "detection)",
    )
    normal_agreement: float = Field(
        0.5,
        ge=0,
        le=1,
        description="Smallest absolute cosine between the normals of points that count [1]; 0 accepts all "
        "points",
    )
    noise: float = Field(
        0.01,
        ge=0,
        description="Smallest value of s / sqrt(N) of an epoch, for the noise of sensor and map [m]; "
        "raise it for noisy maps",
    )
    combine: Literal["quadrature", "linear"] = Field(
        "quadrature",
        description="How sigma_reg enters the level of detection: quadrature (paper) or linear (M3C2)",
    )
    normal_radius: float = Field(
        0.8, gt=0, description="Radius in which normals are estimated where a cloud has none [m]"
    )


@dataclass(frozen=True)
class LodResult:
    """Level of detection and displacement at every point of one epoch.

    Parameters
    ----------
    lod95 : (N,) float32
        Level of detection at 95 % [m]; infinite where nothing is claimed.
    distance : (N,) float32
        Mean position of the other epoch minus that of the own one along the
        point's normal [m]; NaN where ``lod95`` is infinite.
    s_self, s_other : (N,) float32
        Roughness along the normal [m], NaN without points.
    n_self, n_other : (N,) int32
        Points in the cylinder.
    """

    lod95: NDArray[np.float32]
    distance: NDArray[np.float32]
    s_self: NDArray[np.float32]
    s_other: NDArray[np.float32]
    n_self: NDArray[np.int32]
    n_other: NDArray[np.int32]


@numba.njit(cache=True, inline="always")
def _put(
    mean: Floats, variance: Floats, count: Ints, row: int, q: int, total: float, squares: float, m: int
) -> None:
    count[row, q] = m
    if m > 0:
        mean[row, q] = total / m
        variance[row, q] = max(squares / m - mean[row, q] * mean[row, q], 0.0)


@numba.njit(cache=True, inline="always")
def _cylinder_sums(
    points: Floats, point_normals: Floats, starts: Ints, shape: Ints, corner: Floats, cell: float,
    query: Floats, normal: Floats, radius: float, half_length: float, short: float, agreement: float,
) -> tuple[float, float, int, float, float, int]:  # fmt: skip
    """Sum, squares and count of the steps along a normal in its cylinder; the same in a short one within."""
    (x, y, z), (a, b, c) = (query[0], query[1], query[2]), (normal[0], normal[1], normal[2])
    reach_x, reach_y, reach_z = (
        half_length * abs(a) + radius * np.sqrt(max(1.0 - a * a, 0.0)),
        half_length * abs(b) + radius * np.sqrt(max(1.0 - b * b, 0.0)),
        half_length * abs(c) + radius * np.sqrt(max(1.0 - c * c, 0.0)),
    )
    aside = (half_length * np.sqrt(a * a + b * b) + radius) ** 2
    i0, i1 = column_range(x - reach_x, x + reach_x, corner[0], cell, shape[0])
    j0, j1 = column_range(y - reach_y, y + reach_y, corner[1], cell, shape[1])
    total, squares, m, short_total, short_squares, short_m = 0.0, 0.0, 0, 0.0, 0.0, 0
    for i in range(i0, i1 + 1):
        room = aside - column_gap(x, i, corner[0], cell) ** 2
        for j in range(j0, j1 + 1):
            if column_gap(y, j, corner[1], cell) ** 2 > room:
                continue
            end = starts[i * shape[1] + j + 1]
            k = first_above(points, starts[i * shape[1] + j], end, z - reach_z)
            while k < end and points[k, 2] <= z + reach_z:
                dx, dy, dz = points[k, 0] - x, points[k, 1] - y, points[k, 2] - z
                along = a * dx + b * dy + c * dz
                across = dx * dx + dy * dy + dz * dz - along * along
                u, v, w = point_normals[k, 0], point_normals[k, 1], point_normals[k, 2]
                facing = (agreement <= 0.0) | (abs(a * u + b * v + c * w) >= agreement)
                near = facing & (across <= radius * radius)
                whole = 1.0 if near & (abs(along) <= half_length) else 0.0  # adding nothing beats a branch
                m += int(whole)
                total += whole * along
                squares += whole * (along * along)
                if short < half_length:  # else it is the whole
                    part = 1.0 if near & (abs(along) <= short) else 0.0
                    short_m += int(part)
                    short_total += part * along
                    short_squares += part * (along * along)
                k += 1
    if short < half_length:
        return total, squares, m, short_total, short_squares, short_m
    return total, squares, m, total, squares, m


@numba.njit(cache=True)
def _cylinders(
    points: Floats, point_normals: Floats, starts: Ints, shape: Ints, corner: Floats, cell: float,
    queries: Floats, normals: Floats, radius: float, half_length: float, short: float, agreement: float,
) -> tuple[Floats, Floats, Ints]:  # fmt: skip
    """Mean and variance along the normal, and count, of the points in cylinders around every query.

    Each (2, n): in the whole cylinder, and in the short one within it.
    """
    n = len(queries)
    mean, variance, count = np.zeros((2, n)), np.zeros((2, n)), np.zeros((2, n), np.int64)
    for q in range(n):
        if normals[q, 0] ** 2 + normals[q, 1] ** 2 + normals[q, 2] ** 2 < 0.5:
            continue
        total, squares, m, short_total, short_squares, short_m = _cylinder_sums(
            points, point_normals, starts, shape, corner, cell,
            queries[q], normals[q], radius, half_length, short, agreement,
        )  # fmt: skip
        _put(mean, variance, count, 0, q, total, squares, m)
        _put(mean, variance, count, 1, q, short_total, short_squares, short_m)
    return mean, variance, count


@dataclass(frozen=True)
class CylinderStats:
    """Mean [m], standard deviation [m] (population) and count, each (N,), along the normals of queries."""

    mean: Floats
    std: Floats
    count: Ints


@dataclass(frozen=True)
class Surface:
    """An epoch as cylinders meet it: points, normals (M, 3), and ``facing``, these in the index's order."""

    cloud: PointCloud
    normals: Floats
    index: ColumnIndex
    facing: Floats


def make_surface(cloud: PointCloud, config: LodConfig) -> Surface:
    """Index the points of an epoch for cylinders; normals are estimated where the field is missing."""
    normals = np.asarray(
        cloud.fields["normals"]
        if "normals" in cloud.fields
        else estimate_normals(cloud.xyz, config.normal_radius),
        dtype=np.float64,
    )
    index = build_index(cloud.xyz, config.radius)
    return Surface(cloud, normals, index, np.ascontiguousarray(normals[index.order]))


def cylinder_stats(
    queries: Floats, normals: Floats, surface: Surface, config: LodConfig, half_length: float, short: float
) -> tuple[CylinderStats, CylinderStats]:
    """Measure a surface in cylinders along the normals (N, 3) of queries (N, 3).

    Parameters
    ----------
    queries, normals : (N, 3) float64
        Axes of the cylinders [m]; a zero normal gives a count of 0.
    surface : Surface
    config : LodConfig
        ``radius`` of the cylinders; ``normal_agreement``.
    half_length, short : float
        Of the cylinders [m], and of shorter ones within them.

    Returns
    -------
    (CylinderStats, CylinderStats)
        Of the cylinders, and of the shorter ones.
    """
    index = surface.index
    mean, variance, count = _cylinders(
        index.xyz, surface.facing, index.starts, index.shape, index.corner, index.cell,
        queries, normals, config.radius, half_length, short, config.normal_agreement,
    )  # fmt: skip
    whole, shorter = (CylinderStats(mean[k], np.sqrt(variance[k]), count[k]) for k in (0, 1))
    return whole, shorter


def combine(variance: Floats, sigma_reg: Floats | float, how: str) -> Floats:
    """Join the variance of the mean displacement (N,) [m2] and sigma_reg [m] into LoD95 (N,) [m]."""
    sigma = np.asarray(sigma_reg, dtype=np.float64)
    if how == "linear":
        return _Z95 * (np.sqrt(variance) + sigma)
    return _Z95 * np.sqrt(variance + sigma**2)


@dataclass(frozen=True)
class Displacements:
    """Cylinder means of two epochs compared at every point of one; see :class:`LodResult`.

    ``variance`` (N,) [m2] is that of ``distance``, without registration and
    without floors, ``floored`` the same with each epoch's share not below
    ``noise^2``. NaN where nothing is claimed.
    """

    distance: Floats
    variance: Floats
    floored: Floats
    own: CylinderStats
    other: CylinderStats


def measure_displacements(
    cloud_self: PointCloud, cloud_other: PointCloud, config: LodConfig
) -> Displacements:
    """Measure displacement and its variance at every point of one epoch; see :func:`displacements`."""
    return displacements(make_surface(cloud_self, config), make_surface(cloud_other, config), config)


def displacements(
    own_side: Surface, other_side: Surface, config: LodConfig, first: int | None = None
) -> Displacements:
    """Measure displacement and its variance at every point of one epoch, or at its ``first`` points alone.

    Both epochs are looked at through the same short cylinder. Only where the
    other epoch has too little in it does its longer one count: a longer look in one epoch
    alone takes in what lies beside the surface, and calls that a displacement.

    Raises
    ------
    InputError
        The clouds have different origins.
    """
    if not np.array_equal(own_side.cloud.origin, other_side.cloud.origin):
        raise InputError("the two clouds have different origins; rebase them to one first")
    places, normals = own_side.cloud.xyz[:first], own_side.normals[:first]
    short, long = config.self_half_length, config.half_length
    own, _ = cylinder_stats(places, normals, own_side, config, short, short)
    other, near = cylinder_stats(places, normals, other_side, config, long, min(short, long))
    enough = (near.count >= config.min_count) | (4 * near.count >= own.count)
    other = CylinderStats(
        np.where(enough, near.mean, other.mean),
        np.where(enough, near.std, other.std),
        np.where(enough, near.count, other.count),
    )
    known = (own.count >= config.min_count) & (other.count >= config.min_count)
    shares = [s.std**2 / np.maximum(s.count, 1) for s in (own, other)]
    floored = [np.maximum(share, config.noise**2) for share in shares]
    return Displacements(
        np.where(known, other.mean - own.mean, np.nan),
        np.where(known, shares[0] + shares[1], np.nan),
        np.where(known, floored[0] + floored[1], np.nan),
        own,
        other,
    )


def lod_of(found: Displacements, sigma_reg: Floats | float, config: LodConfig) -> NDArray[np.float32]:
    """Return LoD95 (N,) [m] of measured displacements; infinite where nothing is claimed."""
    lod = combine(found.floored, sigma_reg, config.combine)
    return np.where(np.isfinite(lod), lod, np.inf).astype(np.float32)


def compare_epochs(
    cloud_self: PointCloud, cloud_other: PointCloud, sigma_reg: Floats | float, config: LodConfig
) -> LodResult:
    """Measure displacement and level of detection at every point of one epoch.

    Parameters
    ----------
    cloud_self, cloud_other : PointCloud
        Both in the frame of *after*, about one origin; normals are estimated
        where the field is missing.
    sigma_reg : float or (N,) float64
        Registration uncertainty [m], one value or one a point of ``cloud_self``.
    config : LodConfig

    Notes
    -----
    ``LoD95 = 1.96 sqrt(s1^2/N1 + s2^2/N2 + sigma_reg^2)`` (method B7), with s
    and N of the point's own cylinder and each ``s^2/N`` not below ``noise^2``
    (Decision 4).
    """
    found = measure_displacements(cloud_self, cloud_other, config)
    s_self, s_other = (
        np.where(s.count > 0, s.std, np.nan).astype(np.float32) for s in (found.own, found.other)
    )
    return LodResult(
        lod_of(found, sigma_reg, config), found.distance.astype(np.float32), s_self, s_other,
        found.own.count.astype(np.int32), found.other.count.astype(np.int32),
    )  # fmt: skip
