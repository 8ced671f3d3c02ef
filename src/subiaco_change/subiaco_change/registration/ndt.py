"""Distribution-to-distribution NDT: a wide basin of convergence, and a Hessian for free.

Stoyanov et al. 2012 (D2D-NDT); sufficient statistics per voxel, Gauss-Newton
with Levenberg damping.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from subiaco_change.method_numbers import NUMBERS
from subiaco_geo.clouds import VOXEL_LIMIT, stable_order, voxel_indices, voxel_keys
from subiaco_geo.frames import Floats, Ints, exp_se3

_D2 = NUMBERS.ndt.mixture_width
_FILLED = NUMBERS.ndt.filled
_LOOSE = NUMBERS.ndt.loose
#: From the key of a voxel to those of itself and its six face neighbours.
_STEPS = (0, -(1 << 42), 1 << 42, -(1 << 21), 1 << 21, -1, 1)

#: The products of coordinates that make up a covariance, and where each of them stands in it.
_PRODUCTS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_SYMMETRIC = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])


@dataclass(frozen=True)
class Distributions:
    """Gaussians of occupied voxels.

    Parameters
    ----------
    cell : float
        Voxel edge [m].
    keys : (M,) int64
        Sorted packed voxel indices.
    means : (M, 3) float64
    covariances : (M, 3, 3) float64
        Eigenvalues floored, see :func:`distributions`.
    counts : (M,) int64
    """

    cell: float
    keys: Ints
    means: Floats
    covariances: Floats
    counts: Ints


def distributions(xyz: Floats, cell: float, min_count: int = 6, noise: float = 0.02) -> Distributions:
    """Summarise points (N, 3) by one Gaussian a voxel of an edge [m].

    Eigenvalues are floored at 1 % of the largest and at ``noise`` squared
    [m2]; voxels with fewer than ``min_count`` points are left out. Along a
    direction in which the points fill the voxel, its walls have cut the
    surface: the mean says where the voxel is, not where the surface is. The
    variance is raised a hundredfold there, else the ground locks the two
    grids onto each other.
    """
    keys = voxel_keys(voxel_indices(xyz, cell))
    order = stable_order(keys)
    unique, starts = np.unique(keys[order], return_index=True)
    counts = np.diff(np.append(starts, len(keys)))
    points = xyz[order]
    centre = np.add.reduceat(points, starts, axis=0) / counts[:, None] if len(points) else points
    offset = points - np.repeat(centre, counts, axis=0)
    products = np.stack([offset[:, i] * offset[:, j] for i, j in _PRODUCTS], axis=1)
    second = np.add.reduceat(products, starts, axis=0) / counts[:, None] if len(points) else products
    keep = counts >= min_count
    values, vectors = np.linalg.eigh(second[keep][:, _SYMMETRIC])
    values = np.maximum(values, np.maximum(0.01 * values[:, 2:], noise**2))
    values = np.where(values > _FILLED * cell**2 / 12.0, _LOOSE * values, values)
    covariances = np.einsum("nij,nj,nkj->nik", vectors, values, vectors)
    return Distributions(cell, unique[keep], centre[keep], covariances, counts[keep])


@numba.njit(cache=True, inline="always")
def _key_at(x: float, y: float, z: float, cell: float) -> int:
    """Return the key of the voxel of a place [m]; -1 at the rim of what keys can name."""
    limit = VOXEL_LIMIT
    i, j, k = np.int64(np.floor(x / cell)), np.int64(np.floor(y / cell)), np.int64(np.floor(z / cell))
    if max(abs(i), abs(j), abs(k)) >= limit - 1:
        return -1
    return int(((i + limit) << 42) | ((j + limit) << 21) | (k + limit))


@numba.njit(cache=True, inline="always")
def _slot(keys: Ints, key: int) -> int:
    """Find the Gaussian of a voxel among the sorted keys; -1 for none."""
    low, high = 0, len(keys)
    while low < high:
        middle = (low + high) >> 1
        if keys[middle] < key:
            low = middle + 1
        else:
            high = middle
    return low if low < len(keys) and keys[low] == key else -1


@numba.njit(cache=True, inline="always")
def _invert(m: Floats, out: Floats) -> None:
    """Inverse of a symmetric 3x3 matrix by cofactors."""
    out[0, 0] = m[1, 1] * m[2, 2] - m[1, 2] * m[1, 2]
    out[0, 1] = m[0, 2] * m[1, 2] - m[0, 1] * m[2, 2]
    out[0, 2] = m[0, 1] * m[1, 2] - m[0, 2] * m[1, 1]
    out[1, 1] = m[0, 0] * m[2, 2] - m[0, 2] * m[0, 2]
    out[1, 2] = m[0, 1] * m[0, 2] - m[0, 0] * m[1, 2]
    out[2, 2] = m[0, 0] * m[1, 1] - m[0, 1] * m[0, 1]
    scale = 1.0 / (m[0, 0] * out[0, 0] + m[0, 1] * out[0, 1] + m[0, 2] * out[0, 2])
    for i in range(3):
        for j in range(i, 3):
            out[i, j] *= scale
            out[j, i] = out[i, j]


@numba.njit(cache=True, inline="always")
def _turn(rotation: Floats, cov: Floats, work: Floats, out: Floats) -> None:
    """R C R^T of 3x3 matrices without allocating."""
    for i in range(3):
        for j in range(3):
            work[i, j] = 0.0
            for k in range(3):
                work[i, j] += rotation[i, k] * cov[k, j]
    for i in range(3):
        for j in range(3):
            out[i, j] = 0.0
            for k in range(3):
                out[i, j] += work[i, k] * rotation[j, k]


@numba.njit(cache=True, inline="always")
def _along_twist(a: Floats, x: float, y: float, z: float, out: Floats) -> None:
    """Row (6,) of a vector times J = [-[a]x, I], without the products by zero."""
    out[0], out[1], out[2] = a[1] * z - a[2] * y, a[2] * x - a[0] * z, a[0] * y - a[1] * x
    out[3], out[4], out[5] = x, y, z


@numba.njit(cache=True)
def _normal_equations(  # noqa: C901, PLR0912, PLR0915
    rotation: Floats, translation: Floats, centre: Floats, means: Floats, covs: Floats,
    keys: Ints, t_means: Floats, t_covs: Floats, cell: float,
    width: float,
) -> tuple[float, Floats, Floats]:  # fmt: skip
    """Score, gradient (6,) and Gauss-Newton Hessian (6, 6) of the left perturbation about a centre.

    The blocks of J = [-[a]x, I] are used: with B = information and v = B d,
    the gradient is [a x v, v].
    """
    hessian, gradient = np.zeros((6, 6)), np.zeros(6)
    score = 0.0
    cov, work, both, info = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    p, a, d, v = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    rows, row = np.empty((3, 6)), np.empty(6)
    for s in range(len(means)):
        for i in range(3):
            p[i] = translation[i]
            for k in range(3):
                p[i] += rotation[i, k] * means[s, k]
            a[i] = p[i] - centre[i]
        turned = False
        key = _key_at(p[0], p[1], p[2], cell)
        if key < 0:
            continue
        for step in _STEPS:
            slot = _slot(keys, key + step)
            if slot < 0:
                continue
            if not turned:
                _turn(rotation, covs[s], work, cov)
                turned = True
            for i in range(3):
                d[i] = p[i] - t_means[slot, i]
                for j in range(3):
                    both[i, j] = cov[i, j] + t_covs[slot, i, j]
            _invert(both, info)
            squared = 0.0
            for i in range(3):
                v[i] = info[i, 0] * d[0] + info[i, 1] * d[1] + info[i, 2] * d[2]
                squared += v[i] * d[i]
            value = np.exp(-0.5 * width * squared)
            score += value
            weight = value * width
            if weight < 1e-9:
                continue
            _along_twist(a, v[0], v[1], v[2], row)
            for i in range(3):
                _along_twist(a, info[i, 0], info[i, 1], info[i, 2], rows[i])
            for m in range(6):
                gradient[m] += weight * row[m]
            for m in range(6):
                _along_twist(a, rows[0, m], rows[1, m], rows[2, m], row)
                for n in range(m + 1):
                    hessian[m, n] += weight * row[n]
    for m in range(6):
        for n in range(m):
            hessian[n, m] = hessian[m, n]
    return score, gradient, hessian


@dataclass(frozen=True)
class NdtResult:
    """Outcome of one NDT alignment; ``pose`` maps source to target."""

    pose: Floats
    score: float
    hessian: Floats
    iterations: int


def _score_at(
    pose: Floats, centre: Floats, source: Distributions, target: Distributions
) -> tuple[float, Floats, Floats]:
    return _normal_equations(
        np.ascontiguousarray(pose[:3, :3]), pose[:3, 3].copy(), centre, source.means, source.covariances,
        target.keys, target.means, target.covariances, target.cell, _D2,
    )  # fmt: skip


def about(centre: Floats, twist: Floats) -> Floats:
    """Pose (4, 4) of a twist (6,) [rad, m] that turns about a centre (3,) [m]."""
    pose = exp_se3(twist)
    pose[:3, 3] += centre - pose[:3, :3] @ centre
    return pose


def align_ndt(
    source: Distributions, target: Distributions, pose: Floats, max_iterations: int = 30
) -> NdtResult:
    """Maximise the overlap of two sets of Gaussians from a start pose (4, 4).

    A step that lowers the score is damped and tried again, so the score
    never falls. The score is a number of voxels, not a probability.
    """
    centre = pose[:3, :3] @ source.means.mean(axis=0) + pose[:3, 3]
    score, gradient, hessian = _score_at(pose, centre, source, target)
    damping, iteration = 1e-6, 0
    while iteration < max_iterations:
        iteration += 1
        damped = hessian + damping * np.diag(np.maximum(np.diag(hessian), 1e-9))
        twist = np.asarray(-np.linalg.lstsq(damped, gradient, rcond=None)[0], dtype=np.float64)
        trial = about(centre, twist) @ pose
        new_score, new_gradient, new_hessian = _score_at(trial, centre, source, target)
        if new_score < score:
            damping = max(damping * 10.0, 1e-4)
            if damping > 1e4:
                break
            continue
        pose, score, gradient, hessian = trial, new_score, new_gradient, new_hessian
        damping = max(damping / 10.0, 1e-9)
        if np.linalg.norm(twist[3:]) < 1e-4 and np.linalg.norm(twist[:3]) < 1e-6:
            break
    return NdtResult(pose, float(score), hessian, iteration)
