"""One fit: prepare both epochs, refine a start pose, check the result."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from subiaco_change.geometry import Level, build_pyramid, remove_outliers
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.point_spacing import STREET_SPACING, PointSpacing, pair_spacing
from subiaco_change.registration.config import RegistrationConfig
from subiaco_change.registration.correlation import Correlation, correlate
from subiaco_change.registration.displaced_starts import PoseSpread, spread_of_starts, twist_between
from subiaco_change.registration.icp import (
    Noise,
    Pairs,
    Target,
    align_icp,
    align_level,
    find_pairs,
    make_target,
    measure_noise,
    pair_weights,
    solve,
)
from subiaco_change.registration.ndt import Distributions, about, align_ndt, distributions
from subiaco_change.registration.planes import PlanePairs, extract_planes, match_planes
from subiaco_change.registration.plausibility import (
    PLANE_POINTS,
    Quality,
    Support,
    blocks_of,
    measure_quality,
    measure_support,
)
from subiaco_geo.clouds import PointCloud
from subiaco_geo.errors import InputError, RegistrationError
from subiaco_geo.frames import Floats, invert_pose, rotation_angle, transform_points

Mask = NDArray[np.bool_]
_LOG = logging.getLogger(__name__)
_POLISHES = NUMBERS.fitting.polishes
_NARROWEST = NUMBERS.fitting.narrowest
_GROUPS = NUMBERS.fitting.block_groups
_STARTERS = NUMBERS.displaced_starts.points
_GROUP_ITERATIONS = NUMBERS.fitting.group_iterations
_SMALLEST = NUMBERS.fitting.smallest_block
_GAUSSIANS = NUMBERS.fitting.fewest_gaussians
_COLUMN = NUMBERS.fitting.column
_LYING = NUMBERS.fitting.level_normal
_AS_WELL = NUMBERS.fitting.equal_fit
_WORSE = NUMBERS.fitting.worse_factor
_SURE = NUMBERS.fitting.too_small_errors
_FEW = NUMBERS.fitting.fewest_squares
_SUPPORTED = NUMBERS.fitting.support_errors


@dataclass(frozen=True)
class PreparedEpoch:
    """One epoch prepared: its centre (3,) in the common frame, and levels about that centre.

    ``spacing``: of the points of the epoch [m]; ``scale``: factor on lengths that the pair asks for.
    """

    centre: Floats
    levels: list[Level]
    grids: dict[float, Distributions]
    spacing: float
    scale: float

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
    support: Support
    disagreement: float
    disagreement_deg: float
    ndt_better: bool
    rmse: float
    start: str
    spread: PoseSpread | None = None
    correlated: bool = False
    ndt_pose: Floats | None = None

    def is_disputed(self, config: RegistrationConfig) -> bool:
        """Tell whether NDT ends further away than is allowed, and fits as well there."""
        return self.ndt_better and self.disagreements(config) > 1.0

    def disagreements(self, config: RegistrationConfig) -> float:
        """How far NDT ends away, as a multiple of what is allowed; NaN where NDT says nothing."""
        shift, angle = config.max_disagreement, config.max_disagreement_deg
        return max(self.disagreement / shift, self.disagreement_deg / angle)


def prepare_pair(
    before: PointCloud,
    after: PointCloud,
    config: RegistrationConfig,
    exclude_before: Mask | None = None,
    exclude_after: Mask | None = None,
) -> tuple[tuple[PreparedEpoch, PreparedEpoch], RegistrationConfig]:
    """Prepare both epochs; return them, and the settings that their spacing asks for."""
    clouds = (
        _cleaned(before, exclude_before, "before", config),
        _cleaned(after, exclude_after, "after", config),
    )
    spacing = pair_spacing(clouds[0].xyz, clouds[1].xyz)
    config = config.scaled(spacing.scale)
    sides = (
        _side(clouds[0], spacing.before, spacing, config),
        _side(clouds[1], spacing.after, spacing, config),
    )
    return sides, config


def _cleaned(cloud: PointCloud, exclude: Mask | None, name: str, config: RegistrationConfig) -> PointCloud:
    """Drop excluded and outlying points."""
    if exclude is not None:
        if len(exclude) != len(cloud):
            raise InputError(f"exclude_{name} has {len(exclude)} values for {len(cloud)} points")
        cloud = cloud.select(~exclude)
    if len(cloud) < config.min_points:
        raise RegistrationError(
            f"{name}: {len(cloud)} points are too few to register (< {config.min_points}); check the cloud"
        )
    return remove_outliers(cloud, config.outlier_neighbours, config.outlier_sigmas)


def _side(cloud: PointCloud, own: float, spacing: PointSpacing, config: RegistrationConfig) -> PreparedEpoch:
    """Centre a cloud and build its pyramid."""
    centre = np.median(cloud.xyz, axis=0)
    levels = build_pyramid(cloud.xyz - centre, config.leaves, config.normal_radius)
    return PreparedEpoch(centre, levels, {}, own, spacing.scale)


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
    before: PreparedEpoch,
    after: PreparedEpoch,
    pose: Floats,
    config: RegistrationConfig,
    factors: tuple[float, ...] = (1.0, 0.5),
) -> Floats:
    """NDT on the coarsest level, from large cells to small."""
    for factor in factors:
        cell = factor * config.ndt_leaves_per_cell * config.leaves[0]
        found = _by_ndt(before, after, cell, pose, config)
        pose = pose if found is None else found
    return pose


def _by_ndt(
    before: PreparedEpoch, after: PreparedEpoch, cell: float, pose: Floats, config: RegistrationConfig
) -> Floats | None:
    """Align Gaussians of voxels of an edge [m]; None where either epoch has too few of them."""
    grids = before.grid(cell), after.grid(cell)
    if min(len(grid.keys) for grid in grids) < _GAUSSIANS:
        return None
    return align_ndt(*grids, pose, config.ndt_iterations).pose


def refine(
    before: PreparedEpoch,
    after: PreparedEpoch,
    targets: list[Target],
    pose: Floats,
    start: str,
    config: RegistrationConfig,
) -> Fit:
    """Coarse to fine: NDT, then point-to-plane ICP, on every level (method B3)."""
    ndt_pose = None
    finest = len(targets) - 1
    for i, target in enumerate(targets):
        source = _thinned(before.levels[i], config.icp_points)
        found = _by_ndt(before, after, config.ndt_leaves_per_cell * config.leaves[i], pose, config)
        ndt_pose = None if found is None else _remapped(pose, found, source, target, config)
        begin = pose if ndt_pose is None else ndt_pose
        planes = _same_planes(before, after, begin, config) if i == finest else None
        pose, _, step = align_icp(
            source, target, begin, tukey=config.tukey, huber=config.huber, reach=2.0 * source.leaf,
            min_eigenvalue=config.min_eigenvalue, max_iterations=config.icp_iterations, planes=planes,
        )  # fmt: skip
        if step is None:
            raise RegistrationError(
                f"{start}: fewer than 50 point pairs at the {source.leaf:.2f} m level: "
                "the epochs do not overlap"
            )
    pose = _polished(source, targets[-1], pose, planes, config)
    if before.scale == 1.0:
        return judge(before, targets, pose, ndt_pose, start, config)
    spread, peak = _spreads(before, after, targets[-1], pose, config)
    if spread is None or peak is None or peak.spread.level >= spread.level:
        return replace(judge(before, targets, pose, ndt_pose, start, config), spread=spread)
    _LOG.debug("%s: the correlation moves the pose by %s m", start, np.round(peak.motion[:3], 2))
    pose = align_level(
        source, targets[-1], peak.pose, tukey=config.tukey, huber=config.huber,
        reach=2.0 * source.leaf, max_iterations=config.icp_iterations,
    )  # fmt: skip
    # NDT of sparse clouds ends beside the peak too: what counts is that its pose leads to the same peak.
    again = None if ndt_pose is None else _peak(before, after, ndt_pose, config)
    fit = judge(before, targets, pose, ndt_pose if again is None else again.pose, start, config)
    fixed = tuple(name for name in fit.degenerate if name not in ("x", "y", "yaw"))
    return replace(fit, ndt_better=False, spread=peak.spread, correlated=True, degenerate=fixed)


def _spreads(
    before: PreparedEpoch, after: PreparedEpoch, target: Target, pose: Floats, config: RegistrationConfig
) -> tuple[PoseSpread | None, Correlation | None]:
    """Measure how far a fit depends on its start, and find where what rises above the ground correlates."""
    spacing = STREET_SPACING * before.scale
    source = _thinned(before.levels[-1], _STARTERS)
    noise = _noise(source, target, pose, config)
    spread = None if noise is None else spread_of_starts(source, target, pose, noise, spacing, config)
    return spread, _peak(before, after, pose, config)


def _peak(
    before: PreparedEpoch, after: PreparedEpoch, pose: Floats, config: RegistrationConfig
) -> Correlation | None:
    """Correlate what rises above the ground, from a pose."""
    xyz = before.levels[-1].xyz, after.levels[-1].xyz
    return correlate(*xyz, pose, STREET_SPACING * before.scale, config.block, config.seed)


def _polished(
    source: Level, target: Target, pose: Floats, planes: PlanePairs | None, config: RegistrationConfig
) -> Floats:
    """Fit again with biweights as narrow as the residuals of each kind of neighbourhood are.

    A hedge grown by 0.1 m or ground raised by 0.2 m lies well inside the 0.3 m of the method and
    pulls the fit by millimetres (Decision 2).
    """
    for _ in range(_POLISHES if config.polish > 0 else 0):
        noise = _noise(source, target, pose, config)
        if noise is None:
            break
        pose, _, _ = align_icp(
            source, target, pose, tukey=config.tukey, huber=config.huber, reach=2.0 * source.leaf,
            min_eigenvalue=config.min_eigenvalue, max_iterations=config.icp_iterations, planes=planes,
            noise=noise,
        )  # fmt: skip
    return pose


def _noise(source: Level, target: Target, pose: Floats, config: RegistrationConfig) -> Noise | None:
    """Measure the spread of the residuals at a pose; None with too few."""
    pairs = find_pairs(source.xyz, source.planes, target, pose, 2.0 * source.leaf)
    if len(pairs.residuals) < 50:
        return None
    return measure_noise(pairs, config.polish, _NARROWEST, config.tukey)


def fit_groups(
    before: PreparedEpoch, target: Target, pose: Floats, centre: Floats, config: RegistrationConfig
) -> Floats:
    """Fit groups of blocks on their own; return the covariance (6, 6) of the pose about a centre (3,).

    Points are matched again as each group moves. On rough surfaces pairs follow a motion, so that the
    normal equations of fixed pairs promise too much.
    """
    source = _thinned(before.levels[-1], config.icp_points)
    noise = _noise(source, target, pose, config) if config.polish > 0 else None
    names, member = blocks_of(
        transform_points(pose, source.xyz), config.block, _SMALLEST * before.scale, _GROUPS
    )
    group = np.random.default_rng(config.seed).permutation(len(names))[member] % _GROUPS
    twists = []
    for k in range(_GROUPS):
        own = np.flatnonzero(group == k)
        planes = source.planes
        part = type(planes)(planes.normals[own], planes.curvature[own], planes.count[own])
        found, _, step = align_icp(
            Level(source.leaf, source.xyz[own], part), target, pose, tukey=config.tukey, huber=config.huber,
            reach=2.0 * source.leaf, min_eigenvalue=config.min_eigenvalue, max_iterations=_GROUP_ITERATIONS,
            noise=noise,
        )  # fmt: skip
        if step is not None:
            twists.append(twist_between(found, pose, centre))
    if len(twists) < 3:
        return np.zeros((6, 6))
    return np.atleast_2d(np.cov(np.array(twists).T)) / len(twists)


def _same_planes(
    before: PreparedEpoch, after: PreparedEpoch, pose: Floats, config: RegistrationConfig
) -> PlanePairs | None:
    """Pair the planes of both epochs for the plane-to-plane term, where it is wanted."""
    if config.plane_weight == 0:
        return None
    found = [extract_planes(side.levels[-1], config.seed) for side in (before, after)]
    return match_planes(found[0], found[1], pose, config.plane_weight)


def judge(
    before: PreparedEpoch,
    targets: list[Target],
    pose: Floats,
    ndt_pose: Floats | None,
    start: str,
    config: RegistrationConfig,
) -> Fit:
    """Measure everything that the checks look at, at a final pose; without ``ndt_pose`` NDT says nothing."""
    source = _thinned(before.levels[-1], config.icp_points)
    pairs = find_pairs(source.xyz, source.planes, targets[-1], pose, 2.0 * source.leaf)
    if len(pairs.residuals) < 50:
        raise RegistrationError(
            f"{start}: {len(pairs.residuals)} point pairs at the finest level: the epochs do not overlap, "
            f"or their surfaces hold too few points within {config.normal_radius:.1f} m"
        )
    weights = pair_weights(pairs, config.tukey, config.huber)
    step = solve(pairs, weights, pairs.points.mean(axis=0), config.min_eigenvalue)
    middle = max(len(targets) - 2, 0)
    # In sparse clouds voxels of finer levels hold a point or none, and equal crowns match in a third of them.
    full = middle if before.scale == 1.0 else 0
    quality = measure_pair(before, targets[middle], middle, pose, wanted_walls(start, config), config)
    support = support_pair(before, targets[full], full, pose, config)
    apart = angle = np.nan
    ndt_better = False
    if ndt_pose is not None:
        apart, angle = difference(ndt_pose, pose, pairs.points.mean(axis=0))
        there = find_pairs(source.xyz, source.planes, targets[-1], ndt_pose, 2.0 * source.leaf)
        as_well = _AS_WELL if before.scale == 1.0 else 1.0  # sparse structure hardly tells them apart
        ndt_better = _structure(there, config) > as_well * _structure(pairs, config)
    rmse = float(np.sqrt(np.average(pairs.residuals**2, weights=weights)))
    return Fit(
        pose, pairs, step.degenerate, step.eigenvalues, quality, support, apart, angle, ndt_better, rmse,
        start, ndt_pose=ndt_pose,
    )  # fmt: skip


def wanted_walls(start: str, config: RegistrationConfig) -> float:
    """Share of the walls in the overlap that must match, by how the fit began."""
    return config.min_standing_search if start == "coarse" else config.min_standing


def measure_pair(
    before: PreparedEpoch,
    target: Target,
    level: int,
    pose: Floats,
    least: float,
    config: RegistrationConfig,
) -> Quality:
    """Judge a pose on one level; where the walls of *before* fall short of a share, by those of *after*.

    A building that was taken down matches nothing at the right pose, and one that is new the other way
    round. At a wrong pose the walls of neither epoch match.
    """
    source, cell = before.levels[level], column(before)
    quality = measure_quality(source, target, pose, config.tukey, cell)
    if not falls_short(quality.standing, quality.n_standing, least):
        return quality
    back = measure_quality(target.level, make_target(source), invert_pose(pose), config.tukey, cell)
    if falls_short(back.standing, back.n_standing, least):
        return quality
    return replace(quality, standing=back.standing, n_standing=back.n_standing)


def support_pair(
    before: PreparedEpoch, target: Target, level: int, pose: Floats, config: RegistrationConfig
) -> Support:
    """Compare the match of structure with chance; where that of *before* is too little, that of *after*."""
    source, cell = before.levels[level], column(before)
    support = measure_support(source, target, pose, config.tukey, cell, before.scale)
    if surely_beyond_chance(support) >= config.min_support:
        return support
    turned = make_target(source), invert_pose(pose)
    back = measure_support(target.level, *turned, config.tukey, cell, before.scale)
    return max(support, back, key=surely_beyond_chance)


def surely_beyond_chance(support: Support) -> float:
    """Share of the structure that matches beyond chance, less its standard errors."""
    return support.excess - _SUPPORTED * support.excess_error


def _structure(pairs: Pairs, config: RegistrationConfig) -> float:
    """Weight of the pairs that tell a level shift: those that do not lie."""
    steep = np.abs(pairs.normals[:, 2]) < _LYING
    return float(pair_weights(pairs, config.tukey, config.huber)[steep].sum())


def column(side: PreparedEpoch) -> float:
    """Edge of the columns by which overlap is measured [m]."""
    return _COLUMN * side.scale


def difference(one: Floats, other: Floats, centre: Floats) -> tuple[float, float]:
    """Shift of a centre (3,) [m] and angle [deg] between two poses."""
    delta = one @ invert_pose(other)
    shift = float(np.linalg.norm(delta[:3, :3] @ centre + delta[:3, 3] - centre))
    return shift, float(np.degrees(rotation_angle(delta)))


def complaints(fit: Fit, trusted: bool, config: RegistrationConfig) -> list[str]:
    """Say in words which checks a fit fails; ``trusted`` says that a prior vouches for its start."""
    q, support = fit.quality, fit.support
    least = wanted_walls(fit.start, config)
    words = (
        f"only {support.match:.2f} of the walls, crowns and trunks in the overlap match, "
        f"{support.chance:.2f} match by chance at poses aside"
    )
    needed = 0.0 if trusted else config.min_support
    unsupported = surely_beyond_chance(support) < needed
    checks = [
        (q.overlap < config.min_overlap, f"overlap {q.overlap:.2f} < {config.min_overlap}"),
        (
            falls_short(q.standing, q.n_standing, least),
            f"only {q.standing:.2f} of the walls in the overlap match (< {least})",
        ),
        (
            falls_short(q.lying, q.n_lying, config.min_lying),
            f"only {q.lying:.2f} of the ground in the overlap matches (< {config.min_lying})",
        ),
        (unsupported and not (trusted and support.squares < _FEW), words),
        (fit.rmse > config.max_rmse, f"RMSE {fit.rmse:.3f} m > {config.max_rmse}"),
        (
            fit.disagreements(config) > _WORSE or (fit.is_disputed(config) and not trusted),
            f"NDT and ICP disagree by {fit.disagreement:.2f} m, {fit.disagreement_deg:.2f} deg",
        ),
        (
            bool(fit.degenerate) and not trusted,
            f"nothing fixes {', '.join(fit.degenerate)} and there is no prior",
        ),
    ]
    return [text for failed, text in checks if failed]


def falls_short(share: float, count: int, least: float) -> bool:
    """Tell whether a share of so many points is smaller than a limit by more than its standard error.

    Points on one surface match or miss together: :data:`PLANE_POINTS` of them count as one trial.
    """
    trials = count / PLANE_POINTS
    return trials > 0 and share + _SURE * np.sqrt(least * (1.0 - least) / trials) < least


def density_note(sides: tuple[PreparedEpoch, PreparedEpoch]) -> str:
    """Name the density of the clouds where it is below that of a mapped street; else nothing."""
    if sides[0].scale <= 1.0:
        return ""
    words = [f"{name} {side.spacing:.2f} m" for name, side in zip(("before", "after"), sides, strict=True)]
    thin = [
        name
        for name, side in zip(("before", "after"), sides, strict=True)
        if np.mean(side.levels[-1].planes.count >= PLANE_POINTS) < 0.5
    ]
    cause = f"; {' and '.join(thin)}: too few points to tell surfaces from leaves" if thin else ""
    return f" (density: points lie apart by {', '.join(words)}{cause})"
