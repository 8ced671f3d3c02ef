"""Submaps registered to a cloud of known position: soft priors with their uncertainty, or refused."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

import gtsam
import numpy as np
import small_gicp

from subiaco_geo.crs import EnuFrame, transformer
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, invert_pose
from subiaco_geo.geoid import undulations
from subiaco_geo.sources import open_epoch
from subiaco_mapping.absolute_positions.config import ReferenceConfig
from subiaco_mapping.loop_closure.config import LoopConfig
from subiaco_mapping.loop_closure.submap_registration import PreparedSubmap, register
from subiaco_mapping.loop_closure.submaps import Submap
from subiaco_mapping.method_numbers import NUMBERS
from subiaco_mapping.pose_graph.absolute_factors import PoseTie
from subiaco_mapping.pose_graph.factors import as_pose

_FEW = NUMBERS.absolute_positions.reference_points
_WEAK = NUMBERS.absolute_positions.weak_sigma
_OTHER_HEIGHTS = NUMBERS.absolute_positions.height_mismatch


@dataclass(frozen=True)
class ReferenceFit:
    """What came of the registrations to a reference.

    Parameters
    ----------
    ties : tuple of PoseTie
    counts : dict of str to int
        ``used``, and refused by reason.
    offset : (3,) float64 or None
        Median of the map less the reference over all registrations that were good, used or not [m].
    """

    ties: tuple[PoseTie, ...] = ()
    counts: dict[str, int] = field(default_factory=dict)
    offset: Floats | None = None


def read_reference(config: ReferenceConfig, frame: EnuFrame, crs: str, around: Floats) -> Floats:
    """Read the points (N, 3) of the reference near scans (M, 3), in the local frame [m].

    Raises
    ------
    InputError
        The cloud cannot be read, has no CRS, or has no point near the drive.
    """
    path = config.cloud
    assert path is not None
    epoch = open_epoch(path)
    if epoch.crs is None:
        raise InputError(f"{path}: the reference has no CRS; assign the one it was surveyed in")
    operation = transformer(epoch.crs, crs)
    low, high = around[:, :2].min(axis=0) - config.radius, around[:, :2].max(axis=0) + config.radius
    parts = []
    for part in epoch.clouds(()):
        world = operation.apply(part.world())
        local = frame.points_from_map(world, crs)
        inside = np.all((local[:, :2] > low) & (local[:, :2] < high), axis=1)
        if config.geoid_grid is not None and inside.any():
            local[inside, 2] += undulations(world[inside, :2], crs, config.geoid_grid)
        if inside.any():
            thin = small_gicp.voxelgrid_sampling(local[inside], 0.5 * config.leaf)
            parts.append(np.asarray(thin.points()[:, :3]))
    if not parts:
        raise InputError(f"{path}: the reference has no point near the drive; check its CRS and its extent")
    thin = small_gicp.voxelgrid_sampling(np.concatenate(parts), config.leaf)
    return np.asarray(thin.points()[:, :3], dtype=np.float64)


def fit_reference(
    reference: Floats,
    submaps: Mapping[tuple[int, int], Submap],
    poses: Mapping[int, Floats],
    covariances: Mapping[int, Floats],
    configs: tuple[ReferenceConfig, LoopConfig],
) -> ReferenceFit:
    """Register every submap to the reference around it.

    A registration is refused where too little of it meets the reference, where surfaces lie too far
    apart, and where it contradicts the present estimate: a reference and a survey that disagree are
    a matter for a person, not for a compromise.

    Parameters
    ----------
    reference : (N, 3) float64
        Local frame [m].
    submaps : mapping of (chain, scan) to Submap
    poses, covariances : mapping of int to (S, 4, 4), (S, 6, 6)
        By chain; covariances of rotation [rad] and translation [m] in local axes.
    configs : tuple
        Of the reference and of loops, whose registration is used.

    Raises
    ------
    InputError
        Reference and map have heights of two kinds.
    """
    config, loops = configs
    loops = loops.model_copy(
        update={"min_overlap": config.min_overlap, "max_residual": config.max_residual, "max_sigma": _WEAK}
    )
    counts: Counter[str] = Counter()
    ties, offsets = [], []
    for key in sorted(submaps):
        pose = poses[key[0]][key[1]]
        near = reference[((reference[:, :2] - pose[:2, 3]) ** 2).sum(axis=1) < config.radius**2]
        if len(near) < _FEW:
            counts["outside"] += 1
            continue
        points = submaps[key].points()
        _refuse_heights(near, points @ pose[:3, :3].T + pose[:3, 3], config)
        middle = pose.copy()
        middle[:3, 3] = 0.0
        found = register(PreparedSubmap(near - pose[:3, 3]), PreparedSubmap(points), middle, loops)
        reason = found.refused(loops)
        if reason is not None:
            counts[f"refused_{reason}"] += 1
            continue
        T = found.T_target_source.copy()
        T[:3, 3] += pose[:3, 3]
        offsets.append(pose[:3, 3] - T[:3, 3])
        floor = np.diag([0.0] * 3 + [config.sigma_place**2] * 3)
        tie = PoseTie(key, T, found.covariance + floor)
        if _disagrees(tie, pose, covariances[key[0]][key[1]], config):
            counts["refused_disagrees"] += 1
        else:
            ties.append(tie)
    counts["used"] = len(ties)
    return ReferenceFit(tuple(ties), dict(counts), np.median(offsets, axis=0) if offsets else None)


def _disagrees(tie: PoseTie, pose: Floats, covariance: Floats, config: ReferenceConfig) -> bool:
    """Tell whether a registration contradicts the estimate of a pose beyond the gate."""
    error = gtsam.Pose3.Logmap(as_pose(invert_pose(pose) @ tie.T_reference_lidar))
    turn = np.zeros((6, 6))
    turn[:3, :3] = turn[3:, 3:] = pose[:3, :3].T
    whole = np.diag([0.0] * 3 + [config.sigma**2] * 3)
    total = turn @ (covariance + whole) @ turn.T + tie.covariance
    return bool(error @ np.linalg.solve(total, error) > config.gate)


def _refuse_heights(reference: Floats, points: Floats, config: ReferenceConfig) -> None:
    """Refuse heights of two kinds: the lowest surfaces of both lie metres apart."""
    apart = float(np.quantile(points[:, 2], 0.1) - np.quantile(reference[:, 2], 0.1))
    if abs(apart) > _OTHER_HEIGHTS:
        side = "above" if apart > 0 else "below"
        raise InputError(
            f"{config.cloud}: the map lies {abs(apart):.1f} m {side} the reference: heights of two kinds, "
            "probably above the ellipsoid and above the geoid; give reference.geoid_grid"
        )
