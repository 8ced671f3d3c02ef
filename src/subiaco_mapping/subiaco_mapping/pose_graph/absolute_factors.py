"""Absolute positions as gtsam factors: control points, a reference cloud, a common offset of GNSS."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from subiaco_geo.frames import Floats
from subiaco_mapping.method_numbers import NUMBERS
from subiaco_mapping.pose_graph.config import GnssConfig
from subiaco_mapping.pose_graph.factors import OFFSET_KEY, REFERENCE_KEY, MakeKernel, as_pose, pose_key

_SMALL_SHARE, _SLOW = NUMBERS.pose_graph.offset_share, NUMBERS.pose_graph.offset_correlation_time
_TURN = NUMBERS.pose_graph.reference_turn_sigma


@dataclass(frozen=True)
class PointTie:
    """A point seen from a scan, and where it is.

    Parameters
    ----------
    key : tuple of int
        Chain and scan.
    lever : (3,) float64
        In the scan's ``lidar_link`` [m].
    place : (3,) float64
        In the local frame [m].
    covariance : (3, 3) float64
        Local axes [m2]; a direction that the tie leaves open has a large variance.
    point : int
        Number of the control point.
    """

    key: tuple[int, int]
    lever: Floats
    place: Floats
    covariance: Floats
    point: int


@dataclass(frozen=True)
class PoseTie:
    """A scan registered to a reference cloud.

    Parameters
    ----------
    key : tuple of int
        Chain and scan.
    T_reference_lidar : (4, 4) float64
        In the local frame, as the reference has it.
    covariance : (6, 6) float64
        Rotation [rad], then translation [m], axes of ``lidar_link``.
    """

    key: tuple[int, int]
    T_reference_lidar: Floats
    covariance: Floats


@dataclass(frozen=True)
class AbsoluteTies:
    """What holds the graph in place beside GNSS.

    Parameters
    ----------
    points : tuple of PointTie
    poses : tuple of PoseTie
    offset_sigma : (3,) float64, optional
        Of a common offset of all fixes [m]; None: there is none.
    reference_sigma : float
        Of the position of the reference as a whole [m].
    point_kernel, pose_kernel : float
        Scale of the robust kernels in standard deviations.
    """

    points: tuple[PointTie, ...] = ()
    poses: tuple[PoseTie, ...] = ()
    offset_sigma: Floats | None = None
    reference_sigma: float = 0.1
    point_kernel: float = 3.0
    pose_kernel: float = 2.0

    def gnss_config(self, config: GnssConfig) -> GnssConfig:
        """Return the configuration of fixes whose slow errors can carry the common offset."""
        if self.offset_sigma is None:
            return config
        share, time = max(config.correlated_share, _SMALL_SHARE), config.correlation_time or _SLOW
        return config.model_copy(update={"correlated_share": share, "correlation_time": time})


NO_TIES = AbsoluteTies()


def add_ties(graph: Any, values: Any, ties: AbsoluteTies, make: MakeKernel) -> None:
    """Add the ties, and the variables that they need."""
    if ties.offset_sigma is not None:
        values.insert(OFFSET_KEY, np.zeros(3))
        noise = gtsam.noiseModel.Diagonal.Sigmas(ties.offset_sigma)
        graph.add(gtsam.PriorFactorPoint3(OFFSET_KEY, np.zeros(3), noise))
    for tie in ties.points:
        noise = _robust(make(ties.point_kernel), tie.covariance)
        graph.add(gtsam.GPSFactorArm(pose_key(*tie.key), tie.place, tie.lever, noise))
    if not ties.poses:
        return
    values.insert(REFERENCE_KEY, gtsam.Pose3())
    whole = np.repeat([_TURN, ties.reference_sigma], 3)
    prior = gtsam.noiseModel.Diagonal.Sigmas(whole)
    graph.add(gtsam.PriorFactorPose3(REFERENCE_KEY, gtsam.Pose3(), prior))
    for pose in ties.poses:
        noise = _robust(make(ties.pose_kernel), pose.covariance)
        measured = as_pose(pose.T_reference_lidar)
        graph.add(gtsam.BetweenFactorPose3(REFERENCE_KEY, pose_key(*pose.key), measured, noise))


def offset_of(values: Any, ties: AbsoluteTies) -> Floats:
    """Return what must be added to every fix (3,) [m]."""
    if ties.offset_sigma is None:
        return np.zeros(3)
    return np.asarray(values.atPoint3(OFFSET_KEY), dtype=np.float64)


def _robust(kernel: Any, covariance: Floats) -> Any:
    return gtsam.noiseModel.Robust.Create(kernel, gtsam.noiseModel.Gaussian.Covariance(covariance))
