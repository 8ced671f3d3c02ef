"""Register two epochs: coarse to fine, robust, and never silently wrong."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.spatial.transform import Rotation

from subiaco_change.geometry import Level, build_pyramid, remove_outliers
from subiaco_change.records import Registration
from subiaco_change.registration.checks import (
    Quality,
    Uncertainty,
    estimate_uncertainty,
    measure_quality,
)
from subiaco_change.registration.coarse import propose
from subiaco_change.registration.icp import (
    Pairs,
    Target,
    align_icp,
    find_pairs,
    make_target,
    pair_weights,
    solve,
)
from subiaco_change.registration.ndt import Distributions, about, align_ndt, distributions
from subiaco_geo.clouds import PointCloud
from subiaco_geo.config import StrictModel
from subiaco_geo.errors import InputError, RegistrationError
from subiaco_geo.frames import Floats, invert_pose, rotation_angle

_LOG = logging.getLogger(__name__)

Mask = NDArray[np.bool_]


class RegistrationConfig(StrictModel):
    """Registration of two epochs (method part B; the paper's values where it gives them)."""

    leaves: tuple[float, ...] = Field(
        (1.0, 0.5, 0.25), min_length=1, description="pyramid leaves, coarse first [m]"
    )
    normal_radius: float = Field(0.8, gt=0, description="normals: max(this, 2.5 leaf) [m]")
    outlier_neighbours: int = Field(10, ge=1, description="statistical outlier removal: neighbours")
    outlier_sigmas: float = Field(3.0, gt=0, description="statistical outlier removal: standard deviations")
    coarse: Literal["auto", "always", "never"] = Field(
        "auto", description="search without priors: auto = when identity does not hold and a CRS is missing"
    )
    coarse_pixel: float = Field(1.0, gt=0, description="bird's-eye pictures of the coarse search [m]")
    coarse_candidates: int = Field(25, ge=1, le=200, description="start poses that are refined and judged")
    ndt_iterations: int = Field(30, ge=1, description="NDT iterations a cell size")
    ndt_leaves_per_cell: float = Field(4.0, ge=2, description="NDT cell edge in leaves of the level")
    tukey: float = Field(0.3, gt=0, description="Tukey biweight of point-to-plane residuals [m]")
    huber: float = Field(0.5, gt=0, description="Huber weight of the distance of a pair [m]")
    icp_iterations: int = Field(20, ge=1, description="ICP iterations a level")
    icp_points: int = Field(200_000, ge=1000, description="points of before used by ICP at any level")
    min_eigenvalue: float = Field(
        2e-3, gt=0, lt=1 / 3, description="information a unit weight below which a direction is degenerate"
    )
    min_overlap: float = Field(0.15, gt=0, lt=1, description="smallest overlap, share of the smaller cloud")
    min_standing: float = Field(
        0.35, ge=0, lt=1, description="smallest share of walls in the overlap that match"
    )
    min_standing_search: float = Field(
        0.5, ge=0, lt=1, description="the same after a search without priors, which must be surer"
    )
    min_lying: float = Field(
        0.35, ge=0, lt=1, description="smallest share of ground in the overlap that matches"
    )
    max_rmse: float = Field(0.15, gt=0, description="largest robust point-to-plane RMSE [m]")
    max_disagreement: float = Field(0.10, gt=0, description="largest distance of NDT and ICP solutions [m]")
    max_disagreement_deg: float = Field(
        0.3, gt=0, description="largest angle between NDT and ICP solutions [deg]"
    )
    block: float = Field(20.0, gt=0, description="blocks of correlated residuals [m]")
    draws: int = Field(200, ge=10, description="block bootstrap draws")
    sigma_floor: float = Field(0.003, ge=0, description="smallest sigma_reg [m]")
    seed: int = Field(0, ge=0, description="seed of the bootstrap")


@dataclass(frozen=True)
class _Side:
    """One epoch prepared: its centre (3,) in the common frame, and levels about that centre."""

    centre: Floats
    levels: list[Level]
    grids: dict[float, Distributions]

    def grid(self, cell: float) -> Distributions:
        """Gaussians of the finest points, kept for the next call."""
        if cell not in self.grids:
            self.grids[cell] = distributions(self.levels[-1].xyz, cell)
        return self.grids[cell]


@dataclass(frozen=True)
class _Fit:
    """A refined pose between the centred frames, and what was seen on the way."""

    pose: Floats
    pairs: Pairs
    degenerate: tuple[str, ...]
    eigenvalues: Floats
    quality: Quality
    disagreement: float
    disagreement_deg: float
    rmse: float
    start: str


def _prepare(cloud: PointCloud, exclude: Mask | None, name: str, config: RegistrationConfig) -> _Side:
    """Drop excluded and outlying points, centre, and build the pyramid."""
    if exclude is not None:
        if len(exclude) != len(cloud):
            raise InputError(f"exclude_{name} has {len(exclude)} values for {len(cloud)} points")
        cloud = cloud.select(~exclude)
    if len(cloud) < 1000:
        raise RegistrationError(f"{name}: {len(cloud)} points are too few to register; check the cloud")
    cloud = remove_outliers(cloud, config.outlier_neighbours, config.outlier_sigmas)
    centre = np.median(cloud.xyz, axis=0)
    return _Side(centre, build_pyramid(cloud.xyz - centre, config.leaves, config.normal_radius), {})


def _thinned(level: Level, limit: int) -> Level:
    """Keep every k-th point, so that at most ``limit`` are left."""
    step = -(-len(level.xyz) // limit)
    if step <= 1:
        return level
    planes = level.planes
    thin = type(planes)(planes.normals[::step], planes.curvature[::step], planes.count[::step])
    return Level(level.leaf, level.xyz[::step], thin)


def _remapped(
    start: Floats, end: Floats, source: Level, target: Target, config: RegistrationConfig
) -> Floats:
    """Take back the part of a motion that lies in degenerate directions (solution remapping)."""
    pairs = find_pairs(source.xyz, source.planes, target, end, 2.0 * source.leaf)
    if len(pairs.residuals) < 50:
        return end
    centre = pairs.points.mean(axis=0)
    step = solve(pairs, pair_weights(pairs, config.tukey, config.huber), centre, config.min_eigenvalue)
    if not step.degenerate:
        return end
    motion = end @ invert_pose(start)
    length = float(np.sqrt(np.mean(np.sum((pairs.points - centre) ** 2, axis=1))))
    scale = np.array([length] * 3 + [1.0] * 3)
    shift = motion[:3, :3] @ centre + motion[:3, 3] - centre
    turn = Rotation.from_matrix(motion[:3, :3]).as_rotvec()
    # the motion turns about where the centre came from; first order is enough for a degenerate remainder
    twist = np.concatenate([turn, shift]) * scale
    _, vectors = np.linalg.eigh(step.hessian / np.outer(scale, scale))
    good = vectors[:, step.eigenvalues >= config.min_eigenvalue]
    return about(centre, (good @ (good.T @ twist)) / scale) @ start


def _refine_coarsely(
    before: _Side,
    after: _Side,
    pose: Floats,
    config: RegistrationConfig,
    factors: tuple[float, ...] = (1.0, 0.5),
) -> Floats:
    """NDT on the coarsest level, from large cells to small."""
    for factor in factors:
        cell = factor * config.ndt_leaves_per_cell * config.leaves[0]
        pose = align_ndt(before.grid(cell), after.grid(cell), pose, config.ndt_iterations).pose
    return pose


def _refine(
    before: _Side, after: _Side, targets: list[Target], pose: Floats, start: str, config: RegistrationConfig
) -> _Fit:
    """Coarse to fine: NDT, then point-to-plane ICP, on every level (method B3)."""
    ndt_pose = pose
    for i, target in enumerate(targets):
        source = _thinned(before.levels[i], config.icp_points)
        cell = config.ndt_leaves_per_cell * config.leaves[i]
        ndt_pose = align_ndt(before.grid(cell), after.grid(cell), pose, config.ndt_iterations).pose
        ndt_pose = _remapped(pose, ndt_pose, source, target, config)
        pose, _, step = align_icp(
            source, target, ndt_pose, tukey=config.tukey, huber=config.huber, reach=2.0 * source.leaf,
            min_eigenvalue=config.min_eigenvalue, max_iterations=config.icp_iterations,
        )  # fmt: skip
        if step is None:
            raise RegistrationError(
                f"{start}: fewer than 50 point pairs at the {source.leaf} m level: the epochs do not overlap"
            )
    return _judge(before, targets, pose, ndt_pose, start, config)


def _judge(
    before: _Side,
    targets: list[Target],
    pose: Floats,
    ndt_pose: Floats,
    start: str,
    config: RegistrationConfig,
) -> _Fit:
    """Measure everything that the checks look at, at a final pose."""
    source = _thinned(before.levels[-1], config.icp_points)
    pairs = find_pairs(source.xyz, source.planes, targets[-1], pose, 2.0 * source.leaf)
    if len(pairs.residuals) < 50:
        raise RegistrationError(
            f"{start}: {len(pairs.residuals)} point pairs at the finest level: the epochs do not overlap"
        )
    weights = pair_weights(pairs, config.tukey, config.huber)
    step = solve(pairs, weights, pairs.points.mean(axis=0), config.min_eigenvalue)
    middle = max(len(targets) - 2, 0)
    quality = measure_quality(before.levels[middle], targets[middle], pose, config.tukey)
    delta = ndt_pose @ invert_pose(pose)
    centre = pairs.points.mean(axis=0)
    apart = float(np.linalg.norm(delta[:3, :3] @ centre + delta[:3, 3] - centre))
    rmse = float(np.sqrt(np.average(pairs.residuals**2, weights=weights)))
    return _Fit(
        pose, pairs, step.degenerate, step.eigenvalues, quality, apart,
        float(np.degrees(rotation_angle(delta))), rmse, start,
    )  # fmt: skip


def _complaints(fit: _Fit, config: RegistrationConfig) -> list[str]:
    """Say in words which checks a fit fails."""
    q = fit.quality
    least = config.min_standing_search if fit.start == "coarse" else config.min_standing
    checks = [
        (q.overlap < config.min_overlap, f"overlap {q.overlap:.2f} < {config.min_overlap}"),
        (
            q.n_standing >= 100 and q.standing < least,
            f"only {q.standing:.2f} of the walls in the overlap match (< {least})",
        ),
        (
            q.lying < config.min_lying,
            f"only {q.lying:.2f} of the ground in the overlap matches (< {config.min_lying})",
        ),
        (fit.rmse > config.max_rmse, f"RMSE {fit.rmse:.3f} m > {config.max_rmse}"),
        (
            fit.disagreement > config.max_disagreement or fit.disagreement_deg > config.max_disagreement_deg,
            f"NDT and ICP disagree by {fit.disagreement:.2f} m, {fit.disagreement_deg:.2f} deg",
        ),
        (
            fit.start == "coarse" and bool(fit.degenerate),
            f"nothing fixes {', '.join(fit.degenerate)} and there is no prior",
        ),
    ]
    return [text for failed, text in checks if failed]


def _apart(before: _Side, after: _Side) -> bool:
    """Tell whether the bounding boxes are disjoint as the frames are given."""
    boxes = [
        (side.centre + side.levels[0].xyz.min(axis=0), side.centre + side.levels[0].xyz.max(axis=0))
        for side in (before, after)
    ]
    return bool(np.any(np.maximum(boxes[0][0], boxes[1][0]) > np.minimum(boxes[0][1], boxes[1][1]) + 5.0))


def _from_identity(before: _Side, after: _Side, targets: list[Target], config: RegistrationConfig) -> _Fit:
    """Refine from the frames as they are given; hopeless starts are given up after the coarsest NDT."""
    if _apart(before, after):
        raise RegistrationError("identity: the extents are disjoint")
    pose = np.eye(4)
    pose[:3, 3] = before.centre - after.centre
    rough = _refine_coarsely(before, after, pose, config)
    quality = measure_quality(before.levels[0], targets[0], rough, config.tukey)
    if quality.overlap < config.min_overlap or (
        quality.n_standing >= 100 and quality.standing < 0.6 * config.min_standing
    ):
        raise RegistrationError(
            f"identity: after NDT only {quality.standing:.2f} of the walls in the overlap "
            f"({quality.overlap:.2f}) match"
        )
    return _refine(before, after, targets, pose, "identity", config)


def _from_search(before: _Side, after: _Side, targets: list[Target], config: RegistrationConfig) -> _Fit:
    """Refine the best of the proposed start poses."""
    candidates = propose(before.levels[0], after.levels[0], config.coarse_pixel, config.coarse_candidates)
    if not candidates:
        raise RegistrationError(
            "coarse: nothing stands in the clouds that could fix a position; give --transform"
        )
    poses = [candidate.pose for candidate in candidates]
    for cells, keep in (((1.0,), 5), ((0.5,), 1)):
        moved = [_refine_coarsely(before, after, pose, config, cells) for pose in poses]
        scores = [measure_quality(before.levels[0], targets[0], pose, config.tukey).score for pose in moved]
        best = np.argsort(scores, kind="stable")[::-1][:keep]
        _LOG.debug("coarse candidates score %s", np.round(scores))
        poses = [moved[i] for i in best]
    return _refine(before, after, targets, poses[0], "coarse", config)


def _attempt(before: _Side, after: _Side, georeferenced: bool, config: RegistrationConfig) -> _Fit:
    """Try the start poses that the inputs allow, and return the first fit that passes every check."""
    targets = [make_target(level) for level in after.levels]
    attempts = [] if config.coarse == "always" else [_from_identity]
    if config.coarse == "always" or (config.coarse == "auto" and not georeferenced):
        attempts.append(_from_search)
    reasons = []
    for attempt in attempts:
        try:
            fit = attempt(before, after, targets, config)
        except RegistrationError as error:
            reasons.append(str(error))
            continue
        complaints = _complaints(fit, config)
        if not complaints:
            return fit
        reasons.append(f"{fit.start}: " + "; ".join(complaints))
    raise RegistrationError(
        "the epochs could not be registered: "
        + " | ".join(reasons)
        + ". Check that they show the same place, "
        "or give the transform (--transform F)"
    )


def register(
    before: PointCloud,
    after: PointCloud,
    config: RegistrationConfig,
    exclude_before: Mask | None = None,
    exclude_after: Mask | None = None,
) -> Registration:
    """Find the rigid transform from *before* to *after*.

    Parameters
    ----------
    before, after : PointCloud
        At the working leaf, z roughly up.
    config : RegistrationConfig
    exclude_before, exclude_after : (N,) bool, optional
        Points that must not take part, e.g. what a first pass calls changed.

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
        _prepare(before, exclude_before, "before", config),
        _prepare(after_here, exclude_after, "after", config),
    )
    georeferenced = before.crs is not None and after.crs is not None
    fit = _attempt(*sides, georeferenced, config)
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
    sides = (_prepare(before, None, "before", config), _prepare(after_here, None, "after", config))
    local = T_world.copy()
    local[:3, 3] = rotation @ (origin + sides[0].centre) + T_world[:3, 3] - (origin + sides[1].centre)
    targets = [make_target(level) for level in sides[1].levels]
    fit = _judge(sides[0], targets, local, local, method, config)
    if fit.quality.overlap < config.min_overlap:
        raise RegistrationError(
            f"the epochs do not overlap at the {method} transform (overlap {fit.quality.overlap:.2f} "
            f"< {config.min_overlap}); check its direction: it must map before to after"
        )
    return _report(fit, sides, origin, method, config)


def _report(
    fit: _Fit, sides: tuple[_Side, _Side], origin: Floats, method: str, config: RegistrationConfig
) -> Registration:
    """Put a fit into world terms about the overlap centroid, with its uncertainty."""
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


def _details(fit: _Fit, spread: Uncertainty) -> dict[str, float]:
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
