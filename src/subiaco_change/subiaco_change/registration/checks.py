"""Trust in a fitted pose: from its Hessian and from blocks of residuals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from subiaco_change.registration.icp import Pairs, jacobian
from subiaco_geo.clouds import unique_cells
from subiaco_geo.frames import Floats


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
    return float(1.4826 * np.median(np.abs(mean - np.median(mean))))
