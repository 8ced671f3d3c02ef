"""Distribution-to-distribution NDT: a wide basin of convergence, and a Hessian for free.

Stoyanov et al. 2012 (D2D-NDT); sufficient statistics per voxel, Gauss-Newton
with Levenberg damping.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from subiaco_geo.clouds import voxel_indices, voxel_keys
from subiaco_geo.frames import Floats, Ints, exp_se3

_D2 = 0.05  # width of the mixture component, Stoyanov et al. 2012


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
    [m2]; voxels with fewer than ``min_count`` points are left out.
    """
    keys = voxel_keys(voxel_indices(xyz, cell))
    order = np.argsort(keys, kind="stable")
    unique, starts = np.unique(keys[order], return_index=True)
    counts = np.diff(np.append(starts, len(keys)))
    points = xyz[order]
    centre = np.add.reduceat(points, starts, axis=0) / counts[:, None] if len(points) else points
    offset = points - np.repeat(centre, counts, axis=0)
    outer = np.einsum("ni,nj->nij", offset, offset).reshape(-1, 9)
    second = np.add.reduceat(outer, starts, axis=0) / counts[:, None] if len(points) else outer
    keep = counts >= min_count
    values, vectors = np.linalg.eigh(second[keep].reshape(-1, 3, 3))
    values = np.maximum(values, np.maximum(0.01 * values[:, 2:], noise**2))
    covariances = np.einsum("nij,nj,nkj->nik", vectors, values, vectors)
    return Distributions(cell, unique[keep], centre[keep], covariances, counts[keep])


@numba.njit(cache=True)
def _normal_equations(rotation, translation, centre, means, covs, keys, t_means, t_covs, cell):  # type: ignore[no-untyped-def]
    """Score, gradient (6,) and Gauss-Newton Hessian (6, 6) of the left perturbation about a centre."""
    limit = 1 << 20
    hessian = np.zeros((6, 6))
    gradient = np.zeros(6)
    score = 0.0
    jac = np.zeros((3, 6))
    for i in range(3):
        jac[i, 3 + i] = 1.0
    for s in range(len(means)):
        p = rotation @ means[s] + translation
        cov = rotation @ covs[s] @ rotation.T
        a = p - centre
        jac[0, 1], jac[0, 2] = a[2], -a[1]
        jac[1, 0], jac[1, 2] = -a[2], a[0]
        jac[2, 0], jac[2, 1] = a[1], -a[0]
        ix, iy, iz = int(np.floor(p[0] / cell)), int(np.floor(p[1] / cell)), int(np.floor(p[2] / cell))
        for neighbour in range(7):
            jx, jy, jz = ix, iy, iz
            if neighbour > 0:
                step = 1 if neighbour % 2 == 0 else -1
                if neighbour <= 2:
                    jx += step
                elif neighbour <= 4:
                    jy += step
                else:
                    jz += step
            key = ((jx + limit) << 42) | ((jy + limit) << 21) | (jz + limit)
            slot = np.searchsorted(keys, key)
            if slot >= len(keys) or keys[slot] != key:
                continue
            d = p - t_means[slot]
            info = np.linalg.inv(cov + t_covs[slot])
            bd = info @ d
            value = np.exp(-0.5 * _D2 * (d @ bd))
            score += value
            gradient += value * _D2 * (jac.T @ bd)
            hessian += value * _D2 * (jac.T @ info @ jac)
    return score, gradient, hessian


@dataclass(frozen=True)
class NdtResult:
    """Outcome of one NDT alignment; ``pose`` maps source to target."""

    pose: Floats
    score: float
    hessian: Floats
    iterations: int


def _score_at(pose: Floats, centre: Floats, source: Distributions, target: Distributions):  # type: ignore[no-untyped-def]
    return _normal_equations(
        np.ascontiguousarray(pose[:3, :3]), pose[:3, 3].copy(), centre, source.means, source.covariances,
        target.keys, target.means, target.covariances, target.cell,
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
    for iteration in range(1, max_iterations + 1):
        damped = hessian + damping * np.diag(np.maximum(np.diag(hessian), 1e-9))
        twist = -np.linalg.lstsq(damped, gradient, rcond=None)[0]
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
