"""Register two epochs: coarse to fine, robust, and never silently wrong."""

from __future__ import annotations

import logging
from collections.abc import Callable

import numpy as np

from subiaco_change.geometry import Level
from subiaco_change.records import Registration
from subiaco_change.registration.checks import (
    Uncertainty,
    estimate_uncertainty,
    measure_quality,
)
from subiaco_change.registration.coarse import propose
from subiaco_change.registration.config import RegistrationConfig
from subiaco_change.registration.features import propose_by_features
from subiaco_change.registration.fitting import (
    Fit,
    Mask,
    Side,
    complaints,
    judge,
    prepare,
    refine,
    refine_coarsely,
)
from subiaco_change.registration.icp import (
    Target,
    make_target,
    pair_weights,
)
from subiaco_geo.clouds import PointCloud
from subiaco_geo.errors import InputError, RegistrationError
from subiaco_geo.frames import Floats, transform_points

_LOG = logging.getLogger(__name__)


def _apart(before: Side, after: Side) -> bool:
    """Tell whether the bounding boxes are disjoint as the frames are given."""
    boxes = [
        (side.centre + side.levels[0].xyz.min(axis=0), side.centre + side.levels[0].xyz.max(axis=0))
        for side in (before, after)
    ]
    return bool(np.any(np.maximum(boxes[0][0], boxes[1][0]) > np.minimum(boxes[0][1], boxes[1][1]) + 5.0))


def _from_identity(before: Side, after: Side, targets: list[Target], config: RegistrationConfig) -> Fit:
    """Refine from the frames as they are given; hopeless starts are given up after the coarsest NDT."""
    if _apart(before, after):
        raise RegistrationError("identity: the extents are disjoint")
    pose = np.eye(4)
    pose[:3, 3] = before.centre - after.centre
    rough = refine_coarsely(before, after, pose, config)
    quality = measure_quality(before.levels[0], targets[0], rough, config.tukey)
    if quality.overlap < config.min_overlap or (
        quality.n_standing >= 100 and quality.standing < 0.6 * config.min_standing
    ):
        raise RegistrationError(
            f"identity: after NDT only {quality.standing:.2f} of the walls in the overlap "
            f"({quality.overlap:.2f}) match"
        )
    return refine(before, after, targets, pose, "identity", config)


def _from_search(before: Side, after: Side, targets: list[Target], config: RegistrationConfig) -> Fit:
    """Refine the best of the proposed start poses."""
    coarsest = before.levels[0], after.levels[0]
    if config.coarse_method == "features":
        candidates = propose_by_features(*coarsest, config.features, config.seed)
    else:
        candidates = propose(*coarsest, config.coarse_pixel, config.coarse_candidates)
    if not candidates:
        raise RegistrationError("coarse: nothing in the clouds could fix a position; give --transform")
    poses = [candidate.pose for candidate in candidates]
    for cells in ((1.0,), (0.5,)):
        moved = [refine_coarsely(before, after, pose, config, cells) for pose in poses]
        poses, scores = _places(moved, before.levels[0], targets[0], config.tukey)
        _LOG.debug("coarse poses score %s", np.round(scores))
    if len(scores) > 1 and scores[1] > config.max_rival * scores[0]:
        raise RegistrationError(
            "coarse: the place is ambiguous: another pose fits "
            f"{scores[1] / max(scores[0], 1e-9):.2f} times as well (> {config.max_rival}); give --transform"
        )
    return refine(before, after, targets, poses[0], "coarse", config)


def _places(
    poses: list[Floats], source: Level, target: Target, tolerance: float, count: int = 5, gap: float = 2.0
) -> tuple[list[Floats], list[float]]:
    """Return the best poses that place the points more than a gap [m] apart, best first, and their scores."""
    scores = [measure_quality(source, target, pose, tolerance).score for pose in poses]
    sample = source.xyz[:: max(len(source.xyz) // 100, 1)]
    placed = [transform_points(pose, sample) for pose in poses]
    kept: list[int] = []
    for i in np.argsort(scores, kind="stable")[::-1]:
        if all(np.linalg.norm(placed[i] - placed[k], axis=1).mean() > gap for k in kept):
            kept.append(int(i))
    return [poses[i] for i in kept[:count]], [scores[i] for i in kept[:count]]


def _attempt(
    before: Side, after: Side, start: Floats | None, georeferenced: bool, config: RegistrationConfig
) -> Fit:
    """Try the start poses that the inputs allow, and return the first fit that passes every check."""
    targets = [make_target(level) for level in after.levels]
    attempts: list[Callable[[], Fit]]
    if start is not None:
        attempts = [lambda: refine(before, after, targets, start, "earlier fit", config)]
    else:
        attempts = [lambda: _from_identity(before, after, targets, config)]
        if config.coarse == "always" or (config.coarse == "auto" and not georeferenced):
            attempts.append(lambda: _from_search(before, after, targets, config))
        attempts = attempts[1:] if config.coarse == "always" else attempts
    reasons = []
    for attempt in attempts:
        try:
            fit = attempt()
        except RegistrationError as error:
            reasons.append(str(error))
            continue
        failed = complaints(fit, georeferenced or start is not None, config)
        if not failed:
            return fit
        reasons.append(f"{fit.start}: " + "; ".join(failed))
    raise RegistrationError(
        "the epochs could not be registered: "
        + " | ".join(reasons)
        + ". Check that they show the same place, "
        "or give the transform (--transform F)"
    )


def _between(T_world: Floats, sides: tuple[Side, Side], origin: Floats) -> Floats:
    """Bring a world transform to the centred frames of two sides about one origin (3,)."""
    local = T_world.copy()
    centres = origin + sides[0].centre, origin + sides[1].centre
    local[:3, 3] = T_world[:3, :3] @ centres[0] + T_world[:3, 3] - centres[1]
    return local


def register(
    before: PointCloud,
    after: PointCloud,
    config: RegistrationConfig,
    exclude_before: Mask | None = None,
    exclude_after: Mask | None = None,
    start: Registration | None = None,
) -> Registration:
    """Find the rigid transform from *before* to *after*.

    Parameters
    ----------
    before, after : PointCloud
        At the working leaf, z roughly up.
    config : RegistrationConfig
    exclude_before, exclude_after : (N,) bool, optional
        Points that must not take part, e.g. what a first pass calls changed.
    start : Registration, optional
        An earlier fit of the same clouds, refined instead of searching anew.

    Returns
    -------
    Registration

    Raises
    ------
    RegistrationError
        No start pose leads to a fit that passes the checks.
    """
    after_here = after.rebased(before.origin)
    sides = (
        prepare(before, exclude_before, "before", config),
        prepare(after_here, exclude_after, "after", config),
    )
    georeferenced = before.crs is not None and after.crs is not None
    pose = None if start is None else _between(start.T_after_before, sides, before.origin)
    fit = _attempt(*sides, pose, georeferenced, config)
    return _report(fit, sides, before.origin, f"{fit.start} + NDT + point-to-plane ICP", config)


def given_registration(
    T_after_before: Floats,
    before: PointCloud,
    after: PointCloud,
    config: RegistrationConfig,
    method: str = "given",
) -> Registration:
    """Take a world transform (4, 4) as it is, and measure its fit and uncertainty.

    Raises
    ------
    RegistrationError
        The clouds do not overlap at this transform.
    """
    T_world = np.asarray(T_after_before, dtype=np.float64)
    rotation = T_world[:3, :3] if T_world.shape == (4, 4) else np.zeros((3, 3))
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6) or np.linalg.det(rotation) < 0:
        raise InputError(
            "transform: not rigid (rotation not orthonormal); give a rotation and a shift without scale"
        )
    origin = before.origin
    after_here = after.rebased(origin)
    sides = (prepare(before, None, "before", config), prepare(after_here, None, "after", config))
    local = _between(T_world, sides, origin)
    targets = [make_target(level) for level in sides[1].levels]
    try:
        fit = judge(sides[0], targets, local, local, method, config)
    except RegistrationError as error:
        raise RegistrationError(f"{error}; check the transform, or leave it out to register") from error
    if fit.quality.overlap < config.min_overlap:
        raise RegistrationError(
            f"the epochs do not overlap at the {method} transform (overlap {fit.quality.overlap:.2f} "
            f"< {config.min_overlap}); check its direction: it must map before to after"
        )
    return _report(fit, sides, origin, method, config)


def _report(
    fit: Fit, sides: tuple[Side, Side], origin: Floats, method: str, config: RegistrationConfig
) -> Registration:
    """Put a fit into world terms about the overlap centroid, with its uncertainty."""
    # The wide biweight: what changed widens the stated spread although it no longer pulls the fit.
    weights = pair_weights(fit.pairs, config.tukey, config.huber)
    centre = np.average(fit.pairs.points, axis=0, weights=weights)
    spread = estimate_uncertainty(
        fit.pairs, weights, centre, config.min_eigenvalue, config.block, config.draws, config.seed
    )
    centroid = centre + sides[1].centre
    rotation = fit.pose[:3, :3]
    T_local = fit.pose.copy()
    T_local[:3, 3] = sides[1].centre + fit.pose[:3, 3] + rotation @ (centroid - sides[0].centre) - centroid
    sigma = max(spread.sigma_hessian, spread.sigma_blocks, spread.block_bias, config.sigma_floor)
    inliers = float(np.mean(np.abs(fit.pairs.residuals) < config.tukey / 3.0)) * fit.pairs.matched
    std = np.maximum(spread.hessian_std, spread.block_std)
    warnings = tuple(f"{name} is not fixed by the geometry; the prior was kept" for name in fit.degenerate)
    return Registration(
        T_local, origin + centroid, sigma, fit.rmse, inliers, std, method,
        fit.degenerate, warnings, _details(fit, spread),
    )  # fmt: skip


def _details(fit: Fit, spread: Uncertainty) -> dict[str, float]:
    """Numbers behind the verdict, for registration.json."""
    return {
        "overlap": fit.quality.overlap,
        "standing_match": fit.quality.standing,
        "lying_match": fit.quality.lying,
        "ndt_icp_m": fit.disagreement,
        "ndt_icp_deg": fit.disagreement_deg,
        "smallest_eigenvalue": float(fit.eigenvalues.min()),
        "sigma_hessian_m": spread.sigma_hessian,
        "sigma_blocks_m": spread.sigma_blocks,
        "block_bias_m": spread.block_bias,
        "blocks": float(spread.blocks),
        "pairs": float(len(fit.pairs.residuals)),
    }
