"""Robust point-to-plane ICP with analytic Jacobians and solution remapping."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from subiaco_change.geometry import ColumnIndex, Level, LocalPlanes, build_index, nearest
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.registration.ndt import about
from subiaco_change.registration.planes import PlanePairs, normal_equations
from subiaco_geo.frames import Floats, Ints, transform_points

_CURVATURES = np.array(NUMBERS.icp.curvature_kinds)  # between kinds of neighbourhoods
_LEAST = NUMBERS.icp.fewest_pairs
_AXES = ("roll", "pitch", "yaw", "x", "y", "z")


@dataclass(frozen=True)
class Target:
    """Points and planes of one level that can be searched."""

    level: Level
    index: ColumnIndex


def make_target(level: Level) -> Target:
    """Index a level for nearest-point searches up to two leaves away."""
    return Target(level, build_index(level.xyz, 2.0 * level.leaf))


@dataclass(frozen=True)
class Pairs:
    """Correspondences of one pose: transformed source points and the planes they should lie in.

    Parameters
    ----------
    points : (K, 3) float64
        Source points in the target frame [m].
    normals : (K, 3) float64
        Normals of the target.
    residuals : (K,) float64
        ``n . (p - q)`` [m].
    distances : (K,) float64
        Euclidean distance to the target point [m].
    source : (K,) int64
        Index of the source point.
    matched : float
        Share of the source points that found any target point in reach.
    curvature : (K,) float64, optional
        The larger curvature of the two neighbourhoods: 0 for planes, up to 1/3.
    """

    points: Floats
    normals: Floats
    residuals: Floats
    distances: Floats
    source: np.ndarray[tuple[int], np.dtype[np.int64]]
    matched: float
    curvature: Floats | None = None


def find_pairs(
    xyz: Floats, planes: LocalPlanes, target: Target, pose: Floats, reach: float, max_angle_cos: float = 0.7
) -> Pairs:
    """Pair source points with the nearest target points whose normals agree.

    Parameters
    ----------
    xyz : (N, 3) float64
        Source points in their own frame [m].
    planes : LocalPlanes
        Of the source.
    target : Target
    pose : (4, 4) float64
        ``T_target_source``.
    reach : float
        Largest distance of a pair [m].
    max_angle_cos : float
        Smallest |cosine| between the two normals.
    """
    moved = transform_points(pose, xyz)
    found, distance = nearest(target.index, moved, reach)
    normals_target = target.level.planes.normals[found]
    normals_source = planes.normals @ pose[:3, :3].T
    agree = np.abs(np.einsum("ni,ni->n", normals_target, normals_source)) >= max_angle_cos
    keep = np.flatnonzero((found >= 0) & agree)
    offset = moved[keep] - target.level.xyz[found[keep]]
    residual = np.einsum("ni,ni->n", normals_target[keep], offset)
    matched = float(np.mean(found >= 0)) if len(xyz) else 0.0
    curvature = np.maximum(planes.curvature[keep], target.level.planes.curvature[found[keep]])
    return Pairs(moved[keep], normals_target[keep], residual, distance[keep], keep, matched, curvature)


def pair_weights(pairs: Pairs, tukey: float, huber: float) -> Floats:
    """Tukey biweight of the residual times Huber weight of the distance (method B3)."""
    bounded = np.clip(1.0 - (pairs.residuals / tukey) ** 2, 0.0, None)
    return np.asarray(bounded**2 * np.minimum(1.0, huber / np.maximum(pairs.distances, 1e-9)))


@dataclass(frozen=True)
class Noise:
    """Spread of the residuals by the curvature of their neighbourhoods.

    Walls and ground lie within centimetres of their planes, leaves within decimetres. A pair weighs as
    the inverse of the variance of its kind, so that leaves count where nothing else fixes a direction,
    and hardly at all where walls do.

    Parameters
    ----------
    sigma : (7,) float64
        Robust standard deviation of every kind, flattest first [m].
    width : (7,) float64
        Width of the biweight of every kind [m].
    """

    sigma: Floats
    width: Floats

    def weights(self, pairs: Pairs, huber: float) -> Floats:
        """Return the weights (K,) of pairs."""
        kind = _kinds(pairs)
        bounded = np.clip(1.0 - (pairs.residuals / self.width[kind]) ** 2, 0.0, None)
        near = np.minimum(1.0, huber / np.maximum(pairs.distances, 1e-9))
        return np.asarray(bounded**2 * near * (self.sigma.min() / self.sigma[kind]) ** 2)


def _kinds(pairs: Pairs) -> Ints:
    curvature = np.zeros(len(pairs.residuals)) if pairs.curvature is None else pairs.curvature
    return np.asarray(np.searchsorted(_CURVATURES, curvature))


def measure_noise(pairs: Pairs, polish: float, narrowest: float, widest: float) -> Noise:
    """Measure the spread of every kind; biweights are ``polish`` times as wide, within limits [m]."""
    kind = _kinds(pairs)
    size = np.abs(pairs.residuals)
    sigma = np.full(len(_CURVATURES) + 1, 1.4826 * float(np.median(size)))
    for k in range(len(sigma)):
        own = size[kind == k]
        if len(own) >= _LEAST:
            sigma[k] = 1.4826 * float(np.median(own))
    sigma = np.maximum(np.maximum.accumulate(sigma), narrowest / max(polish, 1.0))
    return Noise(sigma, np.clip(polish * sigma, narrowest, widest))


def jacobian(pairs: Pairs, centre: Floats) -> Floats:
    """Return the derivative (K, 6) of the residuals by a left twist about a centre."""
    turning = np.cross(pairs.points - centre, pairs.normals)
    return np.hstack([turning, pairs.normals])


@dataclass(frozen=True)
class GaussNewtonStep:
    """One Gauss-Newton step and what the normal equations say about it."""

    twist: Floats
    hessian: Floats
    degenerate: tuple[str, ...]
    eigenvalues: Floats


def _name(vector: Floats) -> str:
    """Name a direction by its largest component, e.g. ``x``."""
    return _AXES[int(np.argmax(np.abs(vector)))]


def solve(
    pairs: Pairs,
    weights: Floats,
    centre: Floats,
    min_eigenvalue: float,
    turning: tuple[Floats, Floats] | None = None,
    fixing: Floats | None = None,
) -> GaussNewtonStep:
    """Solve the weighted normal equations, ignoring ill-conditioned directions.

    Rotations are scaled by the RMS distance of the pairs from the centre, so
    that all six eigenvalues of the information a unit weight are comparable;
    an update along an eigenvector below ``min_eigenvalue`` is rejected
    (solution remapping, Zhang et al. 2016) and reported. ``turning`` holds a
    further Hessian (3, 3) and gradient (3,) of the rotation [rad]; ``fixing``
    weights (K,) by which directions are ill-conditioned, where they are others.
    """
    length = max(float(np.sqrt(np.mean(np.sum((pairs.points - centre) ** 2, axis=1)))), 1e-6)
    scale = np.array([length] * 3 + [1.0] * 3)
    rows = jacobian(pairs, centre) / scale
    total = max(float(weights.sum()), 1e-12)
    information = (rows.T * weights) @ rows / total
    right = -(rows.T * weights) @ pairs.residuals / total
    deciding = information
    if fixing is not None:
        deciding = (rows.T * fixing) @ rows / max(float(fixing.sum()), 1e-12)
    values, vectors = np.linalg.eigh(deciding)
    basis = vectors[:, values >= min_eigenvalue]
    full = information.copy()
    if turning is not None:
        full[:3, :3] += turning[0] / (total * length**2)
        right[:3] -= turning[1] / (total * length)
    twist = basis @ np.linalg.solve(basis.T @ full @ basis, basis.T @ right) / scale
    hessian = information * total * np.outer(scale, scale)
    names = tuple(dict.fromkeys(_name(v) for v in vectors.T[values < min_eigenvalue]))
    return GaussNewtonStep(twist, hessian, names, values)


def _stands_still(twist: Floats) -> bool:
    """Tell whether a step (6,), rotation vector [rad] and shift [m], is too small for another one."""
    return bool(np.linalg.norm(twist[3:]) < 2e-4 and np.linalg.norm(twist[:3]) < 2e-6)


def align_icp(
    source: Level,
    target: Target,
    pose: Floats,
    *,
    tukey: float,
    huber: float,
    min_eigenvalue: float,
    max_iterations: int,
    reach: float,
    planes: PlanePairs | None = None,
    noise: Noise | None = None,
) -> tuple[Floats, Pairs, GaussNewtonStep | None]:
    """Iterate pairs and Gauss-Newton steps from a start pose; ``planes`` adds the plane-to-plane term.

    With ``noise`` every kind of neighbourhood has a weight and a biweight of its own.

    Returns
    -------
    pose : (4, 4) float64
    pairs : Pairs
        At the pose before the last step.
    step : GaussNewtonStep or None
        The last step; None when fewer than 50 pairs were found.
    """
    step = None
    pairs = find_pairs(source.xyz, source.planes, target, pose, reach)
    for _ in range(max_iterations):
        if len(pairs.residuals) < 50:
            return pose, pairs, None
        centre = pairs.points.mean(axis=0)
        turning = None if planes is None else normal_equations(planes, pose[:3, :3])
        plain = pair_weights(pairs, tukey, huber)
        weights = plain if noise is None else noise.weights(pairs, huber)
        step = solve(pairs, weights, centre, min_eigenvalue, turning, None if noise is None else plain)
        pose = about(centre, step.twist) @ pose
        if _stands_still(step.twist):
            break
        pairs = find_pairs(source.xyz, source.planes, target, pose, reach)
    return pose, pairs, step


def align_level(
    source: Level,
    target: Target,
    pose: Floats,
    *,
    tukey: float,
    huber: float,
    reach: float,
    max_iterations: int,
) -> Floats:
    """Fit height, roll and pitch alone, and leave east, north and yaw as they are."""
    free = np.array([0, 1, 5])
    for _ in range(max_iterations):
        pairs = find_pairs(source.xyz, source.planes, target, pose, reach)
        if len(pairs.residuals) < 50:
            break
        centre = pairs.points.mean(axis=0)
        rows = jacobian(pairs, centre)[:, free]
        weights = pair_weights(pairs, tukey, huber)
        twist = np.zeros(6)
        twist[free] = -np.linalg.lstsq((rows.T * weights) @ rows, (rows.T * weights) @ pairs.residuals)[0]
        pose = about(centre, twist) @ pose
        if _stands_still(twist):
            break
    return pose
