"""Trust in a fitted pose: shares of matching surfaces beyond chance, its Hessian, and blocks of residuals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from subiaco_change.geometry import Level, LocalPlanes, nearest
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.quantiles import median_and_spread
from subiaco_change.registration.icp import Pairs, Target, jacobian
from subiaco_geo.clouds import unique_cells, unique_keys
from subiaco_geo.frames import Floats, Ints, transform_points

_FLAT = NUMBERS.plausibility.flatness
_LEAST = NUMBERS.plausibility.fewest_neighbours
_STEEP = NUMBERS.plausibility.wall_normal
_LEVEL = NUMBERS.plausibility.ground_normal
_ALIKE = NUMBERS.plausibility.parallel
_NEAR = NUMBERS.plausibility.match_reach
_ASIDE = NUMBERS.plausibility.chance_shifts

#: Points that a neighbourhood needs before its flatness tells a surface from leaves.
PLANE_POINTS = NUMBERS.plausibility.plane_points


@dataclass(frozen=True)
class Quality:
    """Fit of *before* to *after* at one pose.

    Parameters
    ----------
    overlap : float
        Share of the smaller cloud's columns that the other occupies too.
    standing : float
        Share of the points of walls inside the overlap that lie in a plane
        of the other epoch with the same normal. Ground matches ground almost
        anywhere; walls do not. A wall needs :data:`PLANE_POINTS` neighbours.
    lying : float
        The same for planar points that lie (ground, flat roofs).
    rough : float
        Share of the points inside the overlap that belong to no plane
        (crowns, trunks, edges) and have a point of the other epoch near.
    n_standing, n_lying, n_rough : int
        Points inside the overlap.
    """

    overlap: float
    standing: float
    lying: float
    rough: float
    n_standing: int
    n_lying: int
    n_rough: int

    @property
    def score(self) -> float:
        """Matched minus a third of the unmatched structure: for choosing between poses."""
        shares = ((self.n_standing, self.standing), (self.n_rough, self.rough))
        return sum(n * (share - (1.0 - share) / 3.0) for n, share in shares)


@dataclass(frozen=True)
class _Matches:
    """Kind of every source point, whether it lies in the overlap, and whether it matches."""

    standing: NDArray[np.bool_]
    lying: NDArray[np.bool_]
    rough: NDArray[np.bool_]
    match: NDArray[np.bool_]
    overlap: float


def _columns(xyz: Floats, cell: float) -> Ints:
    """Return the number (N,) of the column of an edge [m] that each point stands in."""
    ij = np.floor(xyz[:, :2] / cell).astype(np.int64)
    return np.asarray((ij[:, 0] << 32) + ij[:, 1])


def planar(planes: LocalPlanes) -> NDArray[np.bool_]:
    """Tell which points (N,) lie in a plane that their neighbourhood is large enough to show."""
    return np.asarray((planes.curvature < _FLAT) & (planes.count >= PLANE_POINTS))


def _matches(source: Level, target: Target, pose: Floats, tolerance: float, cell: float) -> _Matches:
    moved = transform_points(pose, source.xyz)
    column = _columns(moved, cell)
    ours, theirs = unique_keys(column), unique_keys(_columns(target.level.xyz, cell))
    shared = np.intersect1d(ours, theirs, assume_unique=True)
    inside = np.isin(column, shared)
    flat = planar(source.planes)
    normals = source.planes.normals @ pose[:3, :3].T
    found, distance = nearest(target.index, moved, 2.0 * source.leaf)
    other = target.level.planes.normals[found]
    residual = np.abs(np.einsum("ni,ni->n", other, moved - target.level.xyz[found]))
    agree = np.abs(np.einsum("ni,ni->n", other, normals)) > _ALIKE
    in_plane = (found >= 0) & agree & (residual < tolerance)
    near = (found >= 0) & (distance < _NEAR * source.leaf)
    return _Matches(
        flat & inside & (np.abs(normals[:, 2]) < _STEEP),
        flat & inside & (np.abs(normals[:, 2]) > _LEVEL),
        ~flat & inside & (source.planes.count >= _LEAST),
        np.where(flat, in_plane, near),
        len(shared) / max(min(len(ours), len(theirs)), 1),
    )


def measure_quality(
    source: Level, target: Target, pose: Floats, tolerance: float, cell: float = 2.0
) -> Quality:
    """Judge a pose ``T_after_before`` on one level.

    Parameters
    ----------
    source : Level
    target : Target
    pose : (4, 4) float64
    tolerance : float
        Largest distance from a plane [m].
    cell : float
        Edge of the columns of the overlap [m].
    """
    m = _matches(source, target, pose, tolerance, cell)
    kinds = (m.standing, m.lying, m.rough)
    standing, lying, rough = (float(m.match[kind].mean()) if kind.any() else 0.0 for kind in kinds)
    n_standing, n_lying, n_rough = (int(kind.sum()) for kind in kinds)
    return Quality(m.overlap, standing, lying, rough, n_standing, n_lying, n_rough)


@dataclass(frozen=True)
class Support:
    """How far the match of structure exceeds what chance gives.

    Parameters
    ----------
    match : float
        Share of the structure (walls, and points of no plane) that matches.
    chance : float
        The same at poses 6 to 10 m aside, where only chance matches.
    error : float
        Standard error of ``match``, from squares of the ground.
    squares : int
        Squares with structure.
    """

    match: float
    chance: float
    error: float
    squares: int

    @property
    def excess(self) -> float:
        """Share of the structure that matches beyond chance: 0 by chance, 1 all of it."""
        return (self.match - self.chance) / max(1.0 - self.chance, 1e-6)

    @property
    def excess_error(self) -> float:
        """Standard error of ``excess``."""
        return self.error / max(1.0 - self.chance, 1e-6)


def measure_support(
    source: Level, target: Target, pose: Floats, tolerance: float, cell: float = 2.0, scale: float = 1.0
) -> Support:
    """Compare the match of structure at a pose with that at poses aside.

    Parameters
    ----------
    source, target, pose, tolerance, cell
        As for :func:`measure_quality`.
    scale : float
        Factor on lengths that follow the spacing of the clouds.
    """
    here = _matches(source, target, pose, tolerance, cell)
    structure = here.standing | here.rough
    if not structure.any():
        return Support(0.0, 0.0, 1.0, 0)
    match = float(here.match[structure].mean())
    places = transform_points(pose, source.xyz[structure])
    square = np.unique(_columns(places, 2.5 * cell), return_inverse=True)[1].ravel()
    surplus = np.bincount(square, here.match[structure] - match)
    squares = len(surplus)
    error = float(np.sqrt(np.sum(surplus**2) * squares / max(squares - 1, 1)) / structure.sum())
    matched = total = 0
    stretch = max(1.0, 0.5 * scale)
    for k in range(8):
        angle = np.pi / 4 * k
        aside = pose.copy()
        aside[:2, 3] += stretch * _ASIDE[k % 2] * np.array([np.cos(angle), np.sin(angle)])
        there = _matches(source, target, aside, tolerance, cell)
        kept = there.standing | there.rough
        matched, total = matched + int(there.match[kept].sum()), total + int(kept.sum())
    return Support(match, matched / max(total, 1), error, squares)


@dataclass(frozen=True)
class Uncertainty:
    """Pose uncertainty about a centre.

    Parameters
    ----------
    hessian_std : (6,) float64
        From the Hessian, as if residuals were independent [rad, m].
    block_std : (6,) float64
        From resampling blocks of residuals [rad, m].
    sigma_hessian, sigma_blocks : float
        RMS displacement along the normals that these cause at the pairs [m].
    block_bias : float
        Robust spread of the mean residuals of blocks: what a rigid motion
        cannot remove [m].
    blocks : int
    """

    hessian_std: Floats
    block_std: Floats
    sigma_hessian: float
    sigma_blocks: float
    block_bias: float
    blocks: int


def _normal_sigma(rows: Floats, weights: Floats, covariance: Floats) -> float:
    """RMS over pairs of the displacement along the normal that a pose covariance causes [m]."""
    variance = np.einsum("ni,ij,nj->n", rows, covariance, rows)
    return float(np.sqrt(max(np.average(variance, weights=weights), 0.0)))


def variance_along(pairs: Pairs, centre: Floats, covariance: Floats) -> Floats:
    """Variance (K,) [m2] along the normals of pairs that a pose covariance (6, 6) about a centre causes."""
    rows = jacobian(pairs, centre)
    return np.asarray(np.einsum("ni,ij,nj->n", rows, covariance, rows))


def estimate_uncertainty(
    pairs: Pairs, weights: Floats, centre: Floats, min_eigenvalue: float, block: float, draws: int, seed: int
) -> Uncertainty:
    """Estimate the pose uncertainty at a solution from its Hessian and from blocks of residuals.

    Residuals nearby are correlated, so the Hessian of a million of them
    promises far too much. Blocks of an edge ``block`` [m] are resampled with
    replacement ``draws`` times and the pose is solved again from their summed
    normal equations (block bootstrap, Decision 2).
    """
    keep = weights > 0
    rows, w, r = jacobian(pairs, centre)[keep], weights[keep], pairs.residuals[keep]
    points = pairs.points[keep]
    length = max(float(np.sqrt(np.mean(np.sum((points - centre) ** 2, axis=1)))), 1e-6)
    scale = np.array([length] * 3 + [1.0] * 3)
    scaled = rows / scale
    _, member = unique_cells(np.floor(points[:, :2] / block).astype(np.int64))
    count = int(member.max()) + 1
    hessians, gradients = np.zeros((count, 6, 6)), np.zeros((count, 6))
    for i in range(6):
        gradients[:, i] = np.bincount(member, w * r * scaled[:, i], count)
        for j in range(i + 1):
            hessians[:, i, j] = np.bincount(member, w * scaled[:, i] * scaled[:, j], count)
            hessians[:, j, i] = hessians[:, i, j]
    total = hessians.sum(axis=0)
    values, vectors = np.linalg.eigh(total / w.sum())
    good = values >= min_eigenvalue
    basis = vectors[:, good]
    variance = float(np.average(r**2, weights=w))
    hessian_cov = basis @ np.linalg.inv(basis.T @ total @ basis) @ basis.T * variance
    rng = np.random.default_rng(seed)
    drawn = rng.multinomial(count, np.full(count, 1.0 / count), size=draws).astype(np.float64)
    shifts = np.zeros((draws, 6))
    for k, times in enumerate(drawn):
        h = basis.T @ np.einsum("b,bij->ij", times, hessians) @ basis
        shifts[k] = -basis @ np.linalg.lstsq(h, basis.T @ (times @ gradients), rcond=None)[0]
    free = max(count - len(basis.T), 1)  # a few blocks fit their own residuals
    block_cov = shifts.T @ shifts / draws * (count / free)
    bias = _block_bias(points, pairs.normals[keep], w, r, block)
    return Uncertainty(
        np.sqrt(np.diag(hessian_cov)) / scale,
        np.sqrt(np.diag(block_cov)) / scale,
        _normal_sigma(scaled, w, hessian_cov),
        _normal_sigma(scaled, w, block_cov),
        bias,
        count,
    )


def _block_bias(points: Floats, normals: Floats, weights: Floats, residuals: Floats, block: float) -> float:
    """Robust spread (1.4826 MAD) of block means, taken by dominant axis of the normal."""
    axis = np.argmax(np.abs(normals), axis=1)
    sign = np.sign(np.take_along_axis(normals, axis[:, None], axis=1)[:, 0])
    cell = np.floor(points[:, :2] / block).astype(np.int64)
    _, member = unique_cells(np.column_stack([cell, axis]))
    total = np.bincount(member, weights)
    mean = np.bincount(member, weights * sign * residuals) / np.maximum(total, 1e-12)
    mean = mean[np.bincount(member) >= 100]
    if len(mean) < 3:
        return 0.0
    return median_and_spread(mean)[1]


def blocks_of(xyz: Floats, edge: float, smallest: float, groups: int) -> tuple[Ints, Ints]:
    """Blocks (K, 2) of an edge [m] and the block (N,) of every point.

    The edge is halved until every group has four blocks, so that each group sees the whole of a small site.
    """
    while True:
        block = np.floor(xyz[:, :2] / edge).astype(np.int64)
        names, member = unique_cells(block)
        if len(names) >= 4 * groups or edge < 2.0 * smallest:
            return names, member
        edge *= 0.5
