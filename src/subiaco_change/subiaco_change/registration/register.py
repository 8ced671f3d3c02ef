"""Register two epochs: coarse to fine, robust, and never silently wrong."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from subiaco_change.method_numbers import NUMBERS
from subiaco_change.records import Registration
from subiaco_change.registration.coarse import propose, propose_shifts
from subiaco_change.registration.config import RegistrationConfig
from subiaco_change.registration.displaced_starts import twist_between
from subiaco_change.registration.fitting import (
    Fit,
    Mask,
    PreparedEpoch,
    column,
    complaints,
    density_note,
    difference,
    falls_short,
    fit_groups,
    judge,
    measure_pair,
    prepare_pair,
    refine,
    refine_coarsely,
)
from subiaco_change.registration.icp import (
    Target,
    make_target,
    pair_weights,
)
from subiaco_change.registration.keypoints import propose_by_features
from subiaco_change.registration.plausibility import (
    Uncertainty,
    estimate_uncertainty,
    measure_quality,
    variance_along,
)
from subiaco_geo.clouds import PointCloud
from subiaco_geo.errors import InputError, RegistrationError
from subiaco_geo.frames import Floats, invert_pose, transform_points

_LOG = logging.getLogger(__name__)
_NOTED = NUMBERS.registration_findings.noted_shift
_NOTED_LEVEL = NUMBERS.displaced_starts.noted_level


def _apart(before: PreparedEpoch, after: PreparedEpoch) -> bool:
    """Tell whether the bounding boxes are disjoint as the frames are given."""
    boxes = [
        (side.centre + side.levels[0].xyz.min(axis=0), side.centre + side.levels[0].xyz.max(axis=0))
        for side in (before, after)
    ]
    return bool(np.any(np.maximum(boxes[0][0], boxes[1][0]) > np.minimum(boxes[0][1], boxes[1][1]) + 5.0))


def _from_identity(
    before: PreparedEpoch, after: PreparedEpoch, targets: list[Target], config: RegistrationConfig
) -> Fit:
    """Refine from the frames as they are given; hopeless starts are given up after the coarsest NDT."""
    if _apart(before, after):
        raise RegistrationError("identity: the extents are disjoint")
    pose = np.eye(4)
    pose[:3, 3] = before.centre - after.centre
    rough = refine_coarsely(before, after, pose, config)
    least = 0.6 * config.min_standing
    quality = measure_pair(before, targets[0], 0, rough, least, config)
    if quality.overlap < config.min_overlap or falls_short(quality.standing, quality.n_standing, least):
        raise RegistrationError(
            f"identity: after NDT only {quality.standing:.2f} of the walls in the overlap "
            f"({quality.overlap:.2f}) match"
        )
    fit = refine(before, after, targets, pose, "identity", config)
    refuse_rivals(before, after, targets, fit, config)
    return fit


def refuse_rivals(
    before: PreparedEpoch, after: PreparedEpoch, targets: list[Target], fit: Fit, config: RegistrationConfig
) -> None:
    """Refuse a fit where a pose elsewhere fits better: a row of equal houses, shifted by one."""
    here = _score(before, targets, fit.pose, config)
    for candidate in propose_shifts(before.levels[0], after.levels[0], fit.pose, config.coarse_pixel):
        pose = refine_coarsely(before, after, candidate.pose, config)
        apart, _ = difference(pose, fit.pose, fit.pairs.points.mean(axis=0))
        there = _score(before, targets, pose, config)
        _LOG.debug("a pose %.1f m away scores %.0f, this one %.0f", apart, there, here)
        if apart > 2.0 * before.scale and there > config.max_rival_near * max(here, 1.0):
            raise RegistrationError(
                f"{fit.start}: a pose {apart:.1f} m away fits {there / max(here, 1.0):.2f} times as well "
                f"(> {config.max_rival_near})"
            )


def _score(before: PreparedEpoch, targets: list[Target], pose: Floats, config: RegistrationConfig) -> float:
    return measure_quality(before.levels[0], targets[0], pose, config.tukey, column(before)).score


def _from_search(
    before: PreparedEpoch, after: PreparedEpoch, targets: list[Target], config: RegistrationConfig
) -> Fit:
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
        poses, scores = _places(moved, before, targets[0], config.tukey)
        _LOG.debug("coarse poses score %s", np.round(scores))
    if len(scores) > 1 and scores[1] > config.max_rival * scores[0]:
        raise RegistrationError(
            "coarse: the place is ambiguous: another pose fits "
            f"{scores[1] / max(scores[0], 1e-9):.2f} times as well (> {config.max_rival}); give --transform"
        )
    return refine(before, after, targets, poses[0], "coarse", config)


def _places(
    poses: list[Floats], before: PreparedEpoch, target: Target, tolerance: float, count: int = 5
) -> tuple[list[Floats], list[float]]:
    """Return the best poses that place the points more than 2 m apart, best first, and their scores."""
    source, gap = before.levels[0], 2.0 * before.scale
    scores = [measure_quality(source, target, pose, tolerance, column(before)).score for pose in poses]
    sample = source.xyz[:: max(len(source.xyz) // 100, 1)]
    placed = [transform_points(pose, sample) for pose in poses]
    kept: list[int] = []
    for i in np.argsort(scores, kind="stable")[::-1]:
        if all(np.linalg.norm(placed[i] - placed[k], axis=1).mean() > gap for k in kept):
            kept.append(int(i))
    return [poses[i] for i in kept[:count]], [scores[i] for i in kept[:count]]


def _attempt(
    before: PreparedEpoch,
    after: PreparedEpoch,
    targets: list[Target],
    start: Floats | None,
    georeferenced: bool,
    config: RegistrationConfig,
) -> Fit:
    """Try the start poses that the inputs allow, and return the first fit that passes every check."""
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
        + density_note((before, after))
        + ". Check that they show the same place, "
        "or give the transform (--transform F)"
    )


def _between(T_world: Floats, sides: tuple[PreparedEpoch, PreparedEpoch], origin: Floats) -> Floats:
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
        An earlier fit of the same clouds, refined instead of searched again.

    Returns
    -------
    Registration

    Raises
    ------
    RegistrationError
        No start pose leads to a fit that passes the checks, or the clouds are too sparse for the checks.
    """
    after_here = after.rebased(before.origin)
    sides, config = prepare_pair(before, after_here, config, exclude_before, exclude_after)
    if max(side.spacing for side in sides) > config.max_spacing:
        raise RegistrationError(
            f"the clouds are too sparse to find their transform (> {config.max_spacing} m)"
            f"{density_note(sides)}; give denser clouds, or the transform (--transform F)"
        )
    georeferenced = before.crs is not None and after.crs is not None
    pose = None if start is None else _between(start.T_after_before, sides, before.origin)
    targets = [make_target(level) for level in sides[1].levels]
    fit = _attempt(*sides, targets, pose, georeferenced, config)
    return _report(fit, sides, targets[-1], before.origin, f"{fit.start} + NDT + point-to-plane ICP", config)


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
    sides, config = prepare_pair(before, after_here, config)
    local = _between(T_world, sides, origin)
    targets = [make_target(level) for level in sides[1].levels]
    try:
        fit = judge(sides[0], targets, local, None, method, config)
    except RegistrationError as error:
        raise RegistrationError(
            f"{error}{density_note(sides)}; check the transform, or leave it out to register"
        ) from error
    if fit.quality.overlap < config.min_overlap:
        raise RegistrationError(
            f"the epochs do not overlap at the {method} transform (overlap {fit.quality.overlap:.2f} "
            f"< {config.min_overlap}); check its direction: it must map before to after"
        )
    found = _report(fit, sides, targets[-1], origin, method, config)
    return _doubted(found, fit, sides, targets, config)


def _doubted(
    found: Registration,
    fit: Fit,
    sides: tuple[PreparedEpoch, PreparedEpoch],
    targets: list[Target],
    config: RegistrationConfig,
) -> Registration:
    """Test a given transform as a registration is tested, and state what speaks against it.

    What a registration that starts there would move *before* by widens the stated uncertainty.
    """
    warnings = [
        f"the {found.method} transform is not supported: {text}" for text in complaints(fit, True, config)
    ]
    try:
        better = refine(*sides, targets, fit.pose, "refined", config)
        against = complaints(better, True, config)
        if against:
            raise RegistrationError("; ".join(against))
        refuse_rivals(*sides, targets, better, config)
        shift, angle = difference(better.pose, fit.pose, fit.pairs.points.mean(axis=0))
    except RegistrationError as error:
        warnings.append(
            f"the {found.method} transform could not be verified, because no registration from it passes "
            f"the checks: {error}{density_note(sides)}"
        )
        return replace(found, warnings=(*found.warnings, *warnings))
    known = _report(better, sides, targets[-1], found.origin, found.method, config)
    along, offset = _distance_between(better.pose, fit)
    if shift > max(_NOTED, 3.0 * float(np.linalg.norm(known.pose_std[3:]))):
        warnings.append(
            f"the {found.method} transform was used as it is, but registration would move before by "
            f"{shift:.2f} m and {angle:.2f} deg: leave it out to register"
        )
    return replace(
        found,
        sigma_reg_m=float(np.hypot(known.sigma_reg_m, along)),
        pose_std=np.hypot(known.pose_std, offset),
        warnings=(*found.warnings, *warnings),
        details={**found.details, "registration_would_move_m": shift, "registration_would_turn_deg": angle},
    )


def _distance_between(pose: Floats, fit: Fit) -> tuple[float, Floats]:
    """RMS along the normals of the pairs by which a pose differs from a fit [m], and their twist (6,)."""
    points = fit.pairs.points
    moved = transform_points(pose @ invert_pose(fit.pose), points) - points
    along = float(np.sqrt(np.mean(np.einsum("ni,ni->n", moved, fit.pairs.normals) ** 2)))
    return along, twist_between(pose, fit.pose, points.mean(axis=0))


def _report(
    fit: Fit,
    sides: tuple[PreparedEpoch, PreparedEpoch],
    target: Target,
    origin: Floats,
    method: str,
    config: RegistrationConfig,
) -> Registration:
    """Put a fit into world terms about the overlap centroid, with its uncertainty."""
    # The wide biweight: what changed widens the stated spread although it no longer pulls the fit.
    weights = pair_weights(fit.pairs, config.tukey, config.huber)
    centre = np.average(fit.pairs.points, axis=0, weights=weights)
    spread = estimate_uncertainty(
        fit.pairs, weights, centre, config.min_eigenvalue, config.block, config.draws, config.seed
    )
    grouped = fit_groups(sides[0], target, fit.pose, centre, config)
    if fit.spread is not None:
        grouped = grouped + fit.spread.about(centre)
    along = np.sqrt(max(float(np.average(variance_along(fit.pairs, centre, grouped), weights=weights)), 0.0))
    centroid = centre + sides[1].centre
    rotation = fit.pose[:3, :3]
    T_local = fit.pose.copy()
    T_local[:3, 3] = sides[1].centre + fit.pose[:3, 3] + rotation @ (centroid - sides[0].centre) - centroid
    sigma = max(spread.sigma_hessian, spread.sigma_blocks, spread.block_bias, along, config.sigma_floor)
    inliers = float(np.mean(np.abs(fit.pairs.residuals) < config.tukey / 3.0)) * fit.pairs.matched
    std = np.maximum(np.maximum(spread.hessian_std, spread.block_std), np.sqrt(np.diag(grouped)))
    warnings = tuple(f"{name} is not fixed by the geometry; the prior was kept" for name in fit.degenerate)
    level = float(np.hypot(std[3], std[4]))
    if level > _NOTED_LEVEL:
        text = f"the horizontal position is known to {level:.2f} m only (standard deviation), because little "
        warnings += (text + "rises above the ground that both clouds show alike",)
    if fit.ndt_pose is not None and fit.is_disputed(config):
        apart, twist = _distance_between(fit.ndt_pose, fit)
        sigma, std = float(np.hypot(sigma, apart)), np.hypot(std, twist)
        text = (
            f"two ways of registering, NDT and ICP, end {fit.disagreement:.2f} m and"
            f" {fit.disagreement_deg:.2f} deg from each other and fit about as well: no rigid motion brings"
            " the epochs together better, and the stated uncertainty includes the difference"
        )
        warnings += (text,)
    return Registration(
        T_local, origin + centroid, sigma, fit.rmse, inliers, std, method,
        fit.degenerate, warnings, {**_details(fit, spread, sides), "sigma_groups_m": float(along)},
    )  # fmt: skip


def _details(fit: Fit, spread: Uncertainty, sides: tuple[PreparedEpoch, PreparedEpoch]) -> dict[str, float]:
    """Numbers behind the verdict, for registration.json."""
    return {
        "spacing_before_m": sides[0].spacing,
        "spacing_after_m": sides[1].spacing,
        "length_scale": sides[0].scale,
        "finest_leaf_m": sides[0].levels[-1].leaf,
        "structure_match": fit.support.match,
        "structure_chance": fit.support.chance,
        "structure_error": fit.support.error,
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
        "sigma_level_m": 0.0 if fit.spread is None else fit.spread.level,
        "correlated": float(fit.correlated),
    }
