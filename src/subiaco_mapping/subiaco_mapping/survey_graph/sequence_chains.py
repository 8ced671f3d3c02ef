"""Recordings placed in one frame as chains of the pose graph, and solved chains back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from subiaco_geo.crs import EnuFrame
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, interpolate_poses, invert_pose, make_pose
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.manifest import describe_fixes
from subiaco_mapping.method_numbers import NUMBERS
from subiaco_mapping.pose_graph import gnss
from subiaco_mapping.pose_graph.config import GnssConfig
from subiaco_mapping.pose_graph.gravity import gravity_priors
from subiaco_mapping.pose_graph.records import (
    NO_WALLS,
    Chain,
    ChainSolution,
    GnssPriors,
    HeadingPriors,
    WallPriors,
)
from subiaco_mapping.pose_graph.upright_walls import wall_priors
from subiaco_mapping.sequences import SequenceRecord
from subiaco_mapping.survey_graph.solution import SequenceSolution

_OUTSIDE = NUMBERS.pose_graph.fix_outlier


@dataclass(frozen=True)
class Placement:
    """Where sequences can be placed by their fixes.

    Parameters
    ----------
    frame : EnuFrame or None
        None where no sequence can.
    reasons : tuple of str or None
        Of every sequence, why not; None where it can.
    """

    frame: EnuFrame | None
    reasons: tuple[str | None, ...]


def place_sequences(sequences: list[SequenceRecord], config: MappingConfig) -> Placement:
    """Find out which sequences GNSS places.

    Raises
    ------
    InputError
        A sequence has fixes and no lever arm.
    """
    frame = gnss.local_frame(
        [fix for sequence in sequences for fix in sequence.fixes], config.gnss, config.crs
    )
    if frame is None:
        return Placement(None, ("no usable GNSS fix",) * len(sequences))
    reasons = tuple(_why_not(sequence, frame, config) for sequence in sequences)
    return Placement(None if all(reasons) else frame, reasons)


def _why_not(sequence: SequenceRecord, frame: EnuFrame, config: MappingConfig) -> str | None:
    if sequence.fixes and sequence.extrinsics.t_base_gnss is None:
        raise InputError(
            "/tf_static: no antenna lever arm; record base_link -> gnss_link or set sensors.gnss in "
            "config/sensors.yaml"
        )
    fixes, attachment = _attached(sequence, frame, config)
    return gnss.enough_to_place(fixes.enu[attachment.kept], config.gnss)


def _attached(
    sequence: SequenceRecord, frame: EnuFrame, config: MappingConfig
) -> tuple[gnss.EnuFixes, gnss.Attachment]:
    fixes = gnss.to_enu(sequence.fixes, frame, config.gnss, config.crs)
    lever = sequence.extrinsics.t_lidar_gnss if sequence.fixes else np.zeros(3)
    attachment = gnss.attach(
        fixes.times_ns,
        sequence.stamps_ns,
        sequence.T_odom_lidar,
        lever,
        config.gnss.max_pose_gap_ns,
    )
    return fixes, attachment


def chain_of(
    sequence: SequenceRecord, frame: EnuFrame | None, config: MappingConfig, *, placed: bool
) -> Chain:
    """Return the chain of a sequence, placed by its fixes, or level on its own."""
    stamps_ns, poses = sequence.stamps_ns, sequence.T_odom_lidar
    window_ns = config.graph.gravity_window_ns
    gravity = gravity_priors(stamps_ns, poses, np.array(sequence.accel), window_ns)
    base_up = poses[0, :3, :3] @ sequence.extrinsics.T_base_lidar[2, :3]
    ups = np.einsum("nij,nj->ni", poses[gravity.index, :3, :3], gravity.up)
    up_odom = ups.mean(axis=0) if len(ups) else base_up
    T_world_odom = make_pose(gnss.level_rotation(up_odom), np.zeros(3)) if len(ups) else np.eye(4)
    priors = None if frame is None else _fixes_of(sequence, frame, config)
    heading = None if frame is None else _headings_of(sequence, config.gnss)
    if placed and priors is not None:
        at = poses[priors.index]
        antenna = np.einsum("nij,nj->ni", at[:, :3, :3], priors.levers) + at[:, :3, 3]
        sigma = np.sqrt(priors.covariance[:, 0, 0])
        T_world_odom = gnss.place(antenna, priors.enu, sigma, up_odom)
    return Chain(
        stamps_ns=stamps_ns,
        T_odom_lidar=poses,
        covariance=np.array([pose.covariance for pose in sequence.poses]),
        held=np.array([not (pose.degenerate or pose.predicted) for pose in sequence.poses]),
        segment=np.array([pose.segment for pose in sequence.poses], dtype=np.int64),
        T_world_odom=T_world_odom,
        gravity=gravity,
        gnss=priors,
        heading=heading,
        anchored=frame is None and placed,
        walls=_walls_of(sequence, poses, up_odom, config) if len(ups) or frame is not None else NO_WALLS,
    )


def _walls_of(
    sequence: SequenceRecord, T_odom_lidar: Floats, up_odom: Floats, config: MappingConfig
) -> WallPriors:
    """Return what the walls of a recording say; each wall is in several submaps, which share its lean."""
    submaps = [] if sequence.submaps is None or not config.graph.walls else sequence.submaps.done
    index = np.array([submap.anchor for submap in submaps], dtype=np.int64)
    seen_from = max(2 * config.loops.radius / config.loops.submap_length, 1.0)
    return wall_priors(
        [submap.wall_pieces for submap in submaps],
        index,
        T_odom_lidar[index, :3, :3],
        up_odom / np.linalg.norm(up_odom),
        config.graph.sigma_wall * np.sqrt(seen_from),
    )


def _fixes_of(sequence: SequenceRecord, frame: EnuFrame, config: MappingConfig) -> GnssPriors:
    fixes, attachment = _attached(sequence, frame, config)
    fixes = fixes.select(attachment.kept)
    return GnssPriors(
        index=attachment.index,
        times_ns=fixes.times_ns,
        enu=fixes.enu,
        levers=attachment.levers,
        covariance=fixes.covariance,
        status=fixes.status,
    )


def _headings_of(sequence: SequenceRecord, config: GnssConfig) -> HeadingPriors | None:
    """Return headings at the scans nearest to them; true north, as ENU is."""
    if not config.heading or not sequence.headings:
        return None
    times_ns = np.array([h.time_ns for h in sequence.headings], dtype=np.int64) + config.time_offset_ns
    stamps_ns, poses = sequence.stamps_ns, sequence.T_odom_lidar
    seen = gnss.attach(times_ns, stamps_ns, poses, np.zeros(3), config.max_pose_gap_ns)
    if len(seen.index) == 0:
        return None
    moved = np.swapaxes(poses[seen.index, :3, :3], 1, 2)
    moved = moved @ interpolate_poses(stamps_ns, poses, times_ns[seen.kept])[:, :3, :3]
    yaw = np.array([h.yaw for h in sequence.headings])[seen.kept] - np.radians(config.heading_offset_deg)
    sigma = np.array([h.sigma for h in sequence.headings])[seen.kept]
    floored = np.hypot(sigma, np.radians(config.heading_sigma_deg))
    return HeadingPriors(seen.index, yaw, floored, moved @ sequence.extrinsics.T_base_lidar[:3, :3].T)


def summary(sequence: SequenceRecord, chain: Chain, solution: ChainSolution) -> SequenceSolution:
    """Return what the graph found for a sequence."""
    used = len(solution.residuals)
    status = np.zeros(0, dtype=np.int64) if chain.gnss is None else chain.gnss.status
    received = [fix.status for fix in sequence.fixes]
    outside = 0 if chain.gnss is None else contradicting(solution.residuals, chain.gnss.covariance)
    return SequenceSolution(
        name=sequence.name,
        stamps_ns=chain.stamps_ns,
        T_local_lidar=solution.T_world_lidar,
        covariance=solution.covariance,
        T_local_odom=solution.T_world_lidar[-1] @ invert_pose(chain.T_odom_lidar[-1]),
        fixes_used=used,
        fixes_refused=sequence.refused_fixes,
        fixes_unattached=len(sequence.fixes) - used if chain.gnss is not None else len(sequence.fixes),
        fixes_downweighted=int((solution.weights < 0.3).sum()),
        gnss_states=describe_fixes(status, received, solution),
        headings_used=0 if chain.heading is None else len(chain.heading.index),
        headings_refused=sequence.refused_headings,
        fixes_contradicting=outside,
    )


def contradicting(residuals: Floats, covariance: Floats) -> int:
    """Count residuals (N, 3) [m], slow errors included, outside 99.9 % of their covariance (N, 3, 3)."""
    square = np.einsum("ni,nij,nj->n", residuals, np.linalg.inv(covariance), residuals)
    return int((square > _OUTSIDE).sum())
