"""One fit: prepare both epochs, refine a start pose, judge what came out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from subiaco_change.geometry import Level, build_pyramid, remove_outliers
from subiaco_change.registration.checks import (
    Quality,
    measure_quality,
)
from subiaco_change.registration.config import RegistrationConfig
from subiaco_change.registration.icp import (
    Pairs,
    Target,
    align_icp,
    find_pairs,
    pair_weights,
    solve,
)
from subiaco_change.registration.ndt import Distributions, about, align_ndt, distributions
from subiaco_change.registration.planes import PlanePairs, extract_planes, match_planes
from subiaco_geo.clouds import PointCloud
from subiaco_geo.errors import InputError, RegistrationError
from subiaco_geo.frames import Floats, invert_pose, rotation_angle

Mask = NDArray[np.bool_]
_POLISHES = 2  # the second takes its width from the residuals of the first
_NARROWEST = 0.02  # biweight of a fit [m]


@dataclass(frozen=True)
class Side:
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
class Fit:
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


def prepare(cloud: PointCloud, exclude: Mask | None, name: str, config: RegistrationConfig) -> Side:
    """Drop excluded and outlying points, centre, and build the pyramid."""
    if exclude is not None:
        if len(exclude) != len(cloud):
            raise InputError(f"exclude_{name} has {len(exclude)} values for {len(cloud)} points")
        cloud = cloud.select(~exclude)
    if len(cloud) < 1000:
        raise RegistrationError(f"{name}: {len(cloud)} points are too few to register; check the cloud")
    cloud = remove_outliers(cloud, config.outlier_neighbours, config.outlier_sigmas)
    centre = np.median(cloud.xyz, axis=0)
    return Side(centre, build_pyramid(cloud.xyz - centre, config.leaves, config.normal_radius), {})


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


def refine_coarsely(
    before: Side,
    after: Side,
    pose: Floats,
    config: RegistrationConfig,
    factors: tuple[float, ...] = (1.0, 0.5),
) -> Floats:
    """NDT on the coarsest level, from large cells to small."""
    for factor in factors:
        cell = factor * config.ndt_leaves_per_cell * config.leaves[0]
        pose = align_ndt(before.grid(cell), after.grid(cell), pose, config.ndt_iterations).pose
    return pose


def refine(
    before: Side, after: Side, targets: list[Target], pose: Floats, start: str, config: RegistrationConfig
) -> Fit:
    """Coarse to fine: NDT, then point-to-plane ICP, on every level (method B3)."""
    ndt_pose = pose
    finest = len(targets) - 1
    for i, target in enumerate(targets):
        source = _thinned(before.levels[i], config.icp_points)
        cell = config.ndt_leaves_per_cell * config.leaves[i]
        ndt_pose = align_ndt(before.grid(cell), after.grid(cell), pose, config.ndt_iterations).pose
        ndt_pose = _remapped(pose, ndt_pose, source, target, config)
        planes = _same_planes(before, after, ndt_pose, config) if i == finest else None
        pose, _, step = align_icp(
            source, target, ndt_pose, tukey=config.tukey, huber=config.huber, reach=2.0 * source.leaf,
            min_eigenvalue=config.min_eigenvalue, max_iterations=config.icp_iterations, planes=planes,
        )  # fmt: skip
        if step is None:
            raise RegistrationError(
                f"{start}: fewer than 50 point pairs at the {source.leaf} m level: the epochs do not overlap"
            )
    pose = _polished(source, targets[-1], pose, planes, config)
    return judge(before, targets, pose, ndt_pose, start, config)


def _polished(
    source: Level, target: Target, pose: Floats, planes: PlanePairs | None, config: RegistrationConfig
) -> Floats:
    """Fit again with a biweight as narrow as the residuals are.

    A hedge grown by 0.1 m or ground raised by 0.2 m lies well inside the 0.3 m of the method and
    pulls the fit by millimetres (Decision 2).
    """
    for _ in range(_POLISHES if config.polish > 0 else 0):
        pairs = find_pairs(source.xyz, source.planes, target, pose, 2.0 * source.leaf)
        if len(pairs.residuals) < 50:
            break
        spread = 1.4826 * float(np.median(np.abs(pairs.residuals)))
        width = min(max(config.polish * spread, _NARROWEST), config.tukey)
        pose, _, _ = align_icp(
            source, target, pose, tukey=width, huber=config.huber, reach=2.0 * source.leaf,
            min_eigenvalue=config.min_eigenvalue, max_iterations=config.icp_iterations, planes=planes,
        )  # fmt: skip
    return pose


def _same_planes(before: Side, after: Side, pose: Floats, config: RegistrationConfig) -> PlanePairs | None:
    """Pair the planes of both epochs for the plane-to-plane term, where it is wanted."""
    if config.plane_weight == 0:
        return None
    found = [extract_planes(side.levels[-1], config.seed) for side in (before, after)]
    return match_planes(found[0], found[1], pose, config.plane_weight)


def judge(
    before: Side,
    targets: list[Target],
    pose: Floats,
    ndt_pose: Floats,
    start: str,
    config: RegistrationConfig,
) -> Fit:
    """Measure everything that the checks look at, at a final pose."""
    source = _thinned(before.levels[-1], config.icp_points)
    pairs = find_pairs(source.xyz, source.planes, targets[-1], pose, 2.0 * source.leaf)
    if len(pairs.residuals) < 50:
        raise RegistrationError(
            f"{start}: {len(pairs.residuals)} point pairs at the finest level: the epochs do not overlap, "
            f"or their points lie farther apart than {config.normal_radius} m"
        )
    weights = pair_weights(pairs, config.tukey, config.huber)
    step = solve(pairs, weights, pairs.points.mean(axis=0), config.min_eigenvalue)
    middle = max(len(targets) - 2, 0)
    quality = measure_quality(before.levels[middle], targets[middle], pose, config.tukey)
    delta = ndt_pose @ invert_pose(pose)
    centre = pairs.points.mean(axis=0)
    apart = float(np.linalg.norm(delta[:3, :3] @ centre + delta[:3, 3] - centre))
    rmse = float(np.sqrt(np.average(pairs.residuals**2, weights=weights)))
    return Fit(
        pose, pairs, step.degenerate, step.eigenvalues, quality, apart,
        float(np.degrees(rotation_angle(delta))), rmse, start,
    )  # fmt: skip


def complaints(fit: Fit, trusted: bool, config: RegistrationConfig) -> list[str]:
    """Say in words which checks a fit fails; ``trusted`` says that a prior vouches for its start."""
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
            bool(fit.degenerate) and not trusted,
            f"nothing fixes {', '.join(fit.degenerate)} and there is no prior",
        ),
    ]
    return [text for failed, text in checks if failed]
