"""Covariance of an odometry pose from those of its motions."""

from __future__ import annotations

import numpy as np

from subiaco_geo.frames import Floats, invert_pose
from subiaco_mapping.measurements import OdometryPose


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
