"""Sequences placed in one frame and turned into chains of the graph, and solved chains back."""

from __future__ import annotations

import logging

import numpy as np

from subiaco_geo.crs import EnuFrame
from subiaco_geo.errors import InputError
from subiaco_geo.frames import invert_pose, make_pose
from subiaco_mapping import gnss
from subiaco_mapping.config import GnssConfig, MappingConfig
from subiaco_mapping.graph import Chain, ChainSolution, GnssPriors, gravity_priors
from subiaco_mapping.manifest import describe_fixes
from subiaco_mapping.sequences import SequenceRecord
from subiaco_mapping.solution import SequenceSolution

logger = logging.getLogger(__name__)


def place_sequences(
    sequences: list[SequenceRecord], config: GnssConfig
) -> tuple[EnuFrame | None, str | None]:
    """Return the ENU frame, or None and why the map stays local."""
    fixes = [fix for sequence in sequences for fix in sequence.fixes]
    frame = gnss.local_frame(fixes, config)
    for sequence in sequences:
        reason = "no usable GNSS fix" if frame is None else _why_not(sequence, frame, config)
        if reason is None:
            continue
        if config.required or len(sequences) > 1:
            raise InputError(
                f"{sequence.name}: cannot be georeferenced ({reason}); record GNSS over a longer way"
                + (", or map it alone" if len(sequences) > 1 else ", or set gnss.required: false")
            )
        logger.warning("%s: %s; the map is local, without CRS", sequence.name, reason)
        return None, reason
    return frame, None


def _why_not(sequence: SequenceRecord, frame: EnuFrame, config: GnssConfig) -> str | None:
    if sequence.fixes and sequence.extrinsics.t_base_gnss is None:
        raise InputError(
            "/tf_static: no antenna lever arm; record base_link -> gnss_link or set sensors.gnss in "
            "config/sensors.yaml"
        )
    fixes, attachment = _attached(sequence, frame, config)
    return gnss.enough_to_place(fixes.enu[attachment.kept], config)


def _attached(
    sequence: SequenceRecord, frame: EnuFrame, config: GnssConfig
) -> tuple[gnss.EnuFixes, gnss.Attachment]:
    fixes = gnss.to_enu(sequence.fixes, frame, config)
    lever = sequence.extrinsics.t_lidar_gnss if sequence.fixes else np.zeros(3)
    attachment = gnss.attach(
        fixes.times_ns,
        sequence.stamps_ns,
        sequence.T_odom_lidar,
        lever,
        config.max_pose_gap_ns,
    )
    return fixes, attachment


def chain_of(sequence: SequenceRecord, frame: EnuFrame | None, config: MappingConfig) -> Chain:
    """Return the chain of a sequence, placed by its fixes, or level on its own without a frame."""
    stamps_ns, poses = sequence.stamps_ns, sequence.T_odom_lidar
    window_ns = config.graph.gravity_window_ns
    gravity = gravity_priors(stamps_ns, poses, np.array(sequence.accel), window_ns)
    base_up = poses[0, :3, :3] @ sequence.extrinsics.T_base_lidar[2, :3]
    ups = np.einsum("nij,nj->ni", poses[gravity.index, :3, :3], gravity.up)
    up_odom = ups.mean(axis=0) if len(ups) else base_up
    priors = None
    if frame is None:
        T_world_odom = make_pose(gnss.level_rotation(up_odom), np.zeros(3)) if len(ups) else np.eye(4)
    else:
        fixes, attachment = _attached(sequence, frame, config.gnss)
        fixes = fixes.select(attachment.kept)
        priors = GnssPriors(
            attachment.index,
            fixes.enu,
            attachment.levers,
            fixes.covariance,
            fixes.status,
            gnss.correlation_inflation(fixes.times_ns, config.gnss),
        )
        at = poses[attachment.index]
        antenna = np.einsum("nij,nj->ni", at[:, :3, :3], attachment.levers) + at[:, :3, 3]
        sigma = np.sqrt(fixes.covariance[:, 0, 0])
        T_world_odom = gnss.place(antenna, fixes.enu, sigma, up_odom)
    return Chain(
        stamps_ns=stamps_ns,
        T_odom_lidar=poses,
        covariance=np.array([pose.covariance for pose in sequence.poses]),
        held=np.array([not (pose.degenerate or pose.predicted) for pose in sequence.poses]),
        segment=np.array([pose.segment for pose in sequence.poses], dtype=np.int64),
        T_world_odom=T_world_odom,
        gnss=priors,
        gravity=gravity,
    )


def summary(sequence: SequenceRecord, chain: Chain, solution: ChainSolution) -> SequenceSolution:
    """Return what the graph found for a sequence."""
    used = len(solution.residuals)
    status = np.zeros(0, dtype=np.int64) if chain.gnss is None else chain.gnss.status
    received = [fix.status for fix in sequence.fixes]
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
        gnss_states=describe_fixes(status, received, solution.residuals, solution.weights),
        gnss_inflation=1.0 if chain.gnss is None else chain.gnss.inflation,
    )
