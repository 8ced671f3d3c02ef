"""Covariance of an odometry pose, and velocity with its covariance, from its motions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from subiaco_geo.frames import Floats, invert_pose
from subiaco_mapping.measurements import OdometryPose
from subiaco_mapping.preprocessing.deskew import body_twist


def _skew(vector: Floats) -> Floats:
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def adjoint(pose: Floats) -> Floats:
    """Return the adjoint (6, 6) of a pose for twists with rotation first."""
    rotation = pose[:3, :3]
    result = np.zeros((6, 6))
    result[:3, :3] = result[3:, 3:] = rotation
    result[3:, :3] = _skew(pose[:3, 3]) @ rotation
    return result


_UNKNOWN = 1e6  # variance of a velocity that nothing tells [m2/s2, rad2/s2]


@dataclass(frozen=True)
class BaseVelocity:
    """Velocity of ``base_link`` in its own axes, in ROS order: linear [m/s], then angular [rad/s].

    Parameters
    ----------
    twist : (6,) float64
        Mean over the time since the scan before.
    covariance : (6, 6) float64
        Variances of 1e6 where the velocity is not known.
    """

    twist: Floats
    covariance: Floats


#: Nothing tells how fast the vehicle moves.
UNKNOWN_VELOCITY = BaseVelocity(np.zeros(6), np.eye(6) * _UNKNOWN)


def base_velocity(previous: OdometryPose | None, pose: OdometryPose, T_base_lidar: Floats) -> BaseVelocity:
    """Return the velocity of ``base_link`` between two scans of one odometry.

    Not known for the first scan of a segment, and where the pose is a prediction.
    """
    known = previous is not None and previous.segment == pose.segment and not pose.predicted
    if previous is None or not known or pose.stamp_ns <= previous.stamp_ns:
        return UNKNOWN_VELOCITY
    duration_s = (pose.stamp_ns - previous.stamp_ns) * 1e-9
    T_lidar_base = invert_pose(T_base_lidar)
    motion = T_base_lidar @ invert_pose(previous.T_odom_lidar) @ pose.T_odom_lidar @ T_lidar_base
    to_base = adjoint(T_base_lidar)
    order = [3, 4, 5, 0, 1, 2]
    covariance = (to_base @ pose.covariance @ to_base.T / duration_s**2)[np.ix_(order, order)]
    return BaseVelocity(body_twist(motion, duration_s)[order], covariance)


class PoseCovariance:
    """Accumulate motion covariances into that of ``base_link`` in ``odom``.

    First order: ``P_k = Ad(T_k^-1 T_k-1) P_k-1 Ad^T + Q_k`` for right
    perturbations (Sola, Deray, Atchuthan 2018, "A micro Lie theory").

    Parameters
    ----------
    T_base_lidar : (4, 4) float64
    """

    def __init__(self, T_base_lidar: Floats) -> None:
        self._T_base_lidar = T_base_lidar
        self._T_odom_lidar: Floats | None = None
        self._covariance = np.zeros((6, 6))

    def step(self, pose: OdometryPose) -> Floats:
        """Take the next pose; return (6, 6) in ROS order: x y z, rotation about fixed axes of ``odom``."""
        if self._T_odom_lidar is not None:
            carry = adjoint(invert_pose(pose.T_odom_lidar) @ self._T_odom_lidar)
            self._covariance = carry @ self._covariance @ carry.T + pose.covariance
        self._T_odom_lidar = pose.T_odom_lidar
        to_base = adjoint(self._T_base_lidar)
        local = to_base @ self._covariance @ to_base.T
        rotation = (pose.T_odom_lidar @ invert_pose(self._T_base_lidar))[:3, :3]
        turn = np.zeros((6, 6))
        turn[:3, 3:] = turn[3:, :3] = rotation
        return np.asarray(turn @ local @ turn.T)
