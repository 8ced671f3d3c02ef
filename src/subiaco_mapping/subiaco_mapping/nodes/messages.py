"""Deskewed scans and odometry poses as messages, and back: nothing is lost between the nodes."""

from __future__ import annotations

from typing import Any

import numpy as np
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2

from subiaco_geo.frames import Floats, invert_pose
from subiaco_mapping.measurements import DeskewedScan, OdometryPose
from subiaco_mapping.nodes.covariance import UNKNOWN_VELOCITY, BaseVelocity
from subiaco_mapping.preprocessing.conversions import cloud_array, stamp_ns
from subiaco_msgs.msg import ScanQuality
from subiaco_ros.messages import cloud_message, header, pose_array, pose_message, xyz_cloud

#: One point of ``points_deskewed``: 17 bytes; ``kind`` is one of the two below.
SCAN_POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("kind", "u1")])
#: Strongest return, second return.
STRONGEST, SECOND = 0, 1
#: Covariances of the library have rotation first, those of ROS messages translation (REP 103).
_ROS_ORDER = np.array([3, 4, 5, 0, 1, 2])


def scan_points(scan: DeskewedScan) -> NDArray[np.void]:
    """Stack both returns of a scan as :data:`SCAN_POINT` rows."""
    parts = (scan.xyz, scan.last_xyz)
    xyz = np.concatenate(parts)
    points = np.zeros(len(xyz), SCAN_POINT)
    for axis, name in enumerate("xyz"):
        points[name] = xyz[:, axis]
    points["intensity"] = np.concatenate([scan.intensity, scan.last_intensity])
    points["kind"] = np.repeat([STRONGEST, SECOND], [len(part) for part in parts])
    return points


def scan_message(scan: DeskewedScan, frame_id: str) -> PointCloud2:
    """Build the message of a deskewed scan: both returns, float32, in ``lidar_link``."""
    return cloud_message(scan_points(scan), frame_id, scan.stamp_ns)


def sky_message(scan: DeskewedScan, frame_id: str) -> PointCloud2:
    """Build the message of the beams of a scan that met nothing: how far each proves the air empty."""
    return cloud_message(xyz_cloud(scan.sky_xyz), frame_id, scan.stamp_ns)


def quality_message(pose: OdometryPose, scan: DeskewedScan, frame_id: str) -> ScanQuality:
    """Build what goes beside pose and cloud, so that nothing is lost between the nodes."""
    return ScanQuality(
        header=header(pose.stamp_ns, frame_id),
        segment=pose.segment,
        inliers=pose.inliers,
        residual_rmse=float(pose.residual_rmse),
        degenerate=bool(pose.degenerate),
        predicted=bool(pose.predicted),
        mode=scan.mode,
        columns=scan.columns,
        lost_columns=scan.lost_columns,
        dropped_points=scan.dropped_points,
        accel=np.full(3, np.nan) if scan.accel is None else np.asarray(scan.accel, np.float64),
        covariance=np.asarray(pose.covariance, np.float64)[np.ix_(_ROS_ORDER, _ROS_ORDER)].ravel(),
    )


def _stack_xyz(points: NDArray[np.void]) -> Floats:
    return np.stack([points[name] for name in "xyz"], axis=1).astype(np.float64)


def scan_from_messages(cloud: Any, sky: Any, quality: Any) -> DeskewedScan:
    """Rebuild a deskewed scan from cloud, sky and quality of one stamp."""
    points = cloud_array(cloud)
    first, last = (points[points["kind"] == kind] for kind in (STRONGEST, SECOND))
    accel = np.array(quality.accel, dtype=np.float64)
    return DeskewedScan(
        stamp_ns=stamp_ns(cloud.header.stamp),
        xyz=_stack_xyz(first),
        intensity=first["intensity"].astype(np.float32),
        mode=quality.mode,
        last_xyz=_stack_xyz(last),
        last_intensity=last["intensity"].astype(np.float32),
        sky_xyz=_stack_xyz(cloud_array(sky)),
        accel=None if np.isnan(accel).any() else accel,
        columns=quality.columns,
        lost_columns=quality.lost_columns,
        dropped_points=quality.dropped_points,
    )


def odometry_message(
    pose: OdometryPose,
    T_base_lidar: Floats,
    covariance: Floats,
    odom_frame: str,
    base_frame: str,
    velocity: BaseVelocity = UNKNOWN_VELOCITY,
) -> Odometry:
    """Build the odometry of ``base_link``.

    Parameters
    ----------
    covariance : (6, 6) float64
        Of the pose in ROS order: x y z, then rotation about fixed axes of ``odom``.
    velocity : BaseVelocity
        In the axes of ``base_link``.
    """
    message = Odometry(header=header(pose.stamp_ns, odom_frame), child_frame_id=base_frame)
    message.pose.pose = pose_message(pose.T_odom_lidar @ invert_pose(T_base_lidar))
    message.pose.covariance = covariance.ravel()
    linear, angular = message.twist.twist.linear, message.twist.twist.angular
    linear.x, linear.y, linear.z, angular.x, angular.y, angular.z = velocity.twist.tolist()
    message.twist.covariance = velocity.covariance.ravel()
    return message


def pose_from_messages(odometry: Any, quality: Any, T_base_lidar: Floats) -> OdometryPose:
    """Rebuild an odometry pose from the messages of one stamp."""
    return OdometryPose(
        stamp_ns=stamp_ns(odometry.header.stamp),
        T_odom_lidar=pose_array(odometry.pose.pose) @ T_base_lidar,
        covariance=np.reshape(quality.covariance, (6, 6))[np.ix_(_ROS_ORDER, _ROS_ORDER)],
        inliers=quality.inliers,
        residual_rmse=quality.residual_rmse,
        degenerate=quality.degenerate,
        segment=quality.segment,
        predicted=quality.predicted,
    )
