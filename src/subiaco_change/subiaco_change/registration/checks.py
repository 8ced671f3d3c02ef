"""How well two clouds fit at a pose, and how far that pose can be trusted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from subiaco_change.geometry import Level, nearest
from subiaco_change.registration.icp import Pairs, Target, jacobian
from subiaco_geo.frames import Floats, Ints, transform_points


@dataclass(frozen=True)
class Quality:
    """Fit of *before* to *after* at one pose.

    Parameters
    ----------
    overlap : float
        Share of the smaller cloud's 2 m columns that the other occupies too.
    standing : float
        Share of the planar standing points (walls, not ground) inside the
        overlap that lie in a plane of the other epoch with the same normal.
        Ground matches ground almost anywhere; walls do not.
    lying : float
        The same for planar points that lie (ground, flat roofs).
    n_standing : int
        Standing points inside the overlap.
    """

    overlap: float
    standing: float
    lying: float
    n_standing: int

    @property
    def score(self) -> float:
        """Matched minus a third of the unmatched standing points: for choosing between poses."""
        return self.n_standing * (self.standing - (1.0 - self.standing) / 3.0)


def _columns(xyz: Floats, cell: float) -> Ints:
    """Return the number (N,) of the column of an edge [m] that each point stands in."""
    ij = np.floor(xyz[:, :2] / cell).astype(np.int64)
    return np.asarray((ij[:, 0] << 32) + ij[:, 1])


def measure_quality(
    source: Level, target: Target, pose: Floats, tolerance: float, cell: float = 2.0
) -> Quality:
    """Judge a pose ``T_after_before`` on one level; ``tolerance`` is the largest residual [m]."""
    moved = transform_points(pose, source.xyz)
    column = _columns(moved, cell)
    ours, theirs = np.unique(column), np.unique(_columns(target.level.xyz, cell))
    shared = np.intersect1d(ours, theirs, assume_unique=True)
    overlap = len(shared) / max(min(len(ours), len(theirs)), 1)
    planar = (source.planes.curvature < 0.03) & np.isin(column, shared)
    normals = source.planes.normals @ pose[:3, :3].T
    found, _ = nearest(target.index, moved, 2.0 * source.leaf)
    other = target.level.planes.normals[found]
    residual = np.abs(np.einsum("ni,ni->n", other, moved - target.level.xyz[found]))
    agree = np.abs(np.einsum("ni,ni->n", other, normals)) > 0.9
    match = (found >= 0) & agree & (residual < tolerance)
    stands = planar & (np.abs(normals[:, 2]) < 0.5)
    lies = planar & (np.abs(normals[:, 2]) > 0.8)
    ratio = [float(match[mask].mean()) if mask.any() else 0.0 for mask in (stands, lies)]
    return Quality(overlap, ratio[0], ratio[1], int(stands.sum()))


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


def estimate_uncertainty(
    pairs: Pairs, weights: Floats, centre: Floats, min_eigenvalue: float, block: float, draws: int, seed: int
) -> Uncertainty:
    """Estimate the pose uncertainty at a solution from its Hessian and from blocks of residuals.

    Residuals nearby are correlated, so the Hessian of a million of them
    promises far too much. Blocks of an edge ``block`` [m] are resampled with
    replacement ``draws`` times and the pose is solved anew from their summed
    normal equations (block bootstrap, Decision 2).
    """
    keep = weights > 0
    rows, w, r = jacobian(pairs, centre)[keep], weights[keep], pairs.residuals[keep]
    points = pairs.points[keep]
    length = max(float(np.sqrt(np.mean(np.sum((points - centre) ** 2, axis=1)))), 1e-6)
    scale = np.array([length] * 3 + [1.0] * 3)
    scaled = rows / scale
    _, member = np.unique(np.floor(points[:, :2] / block).astype(np.int64), axis=0, return_inverse=True)
    member = member.ravel()
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
    _, member = np.unique(np.column_stack([cell, axis]), axis=0, return_inverse=True)
    member = member.ravel()
    total = np.bincount(member, weights)
    mean = np.bincount(member, weights * sign * residuals) / np.maximum(total, 1e-12)
    mean = mean[np.bincount(member) >= 100]
    if len(mean) < 3:
        return 0.0
    return float(1.4826 * np.median(np.abs(mean - np.median(mean))))
