"""Numpy to rclpy messages and back: the ROS side of ``subiaco_mapping.preprocessing.conversions``.

Clouds on topics are float32 in a local frame. Their bytes go in with
``array.frombytes``: assigning a numpy array to ``data`` checks every byte in
Python and takes a thousand times as long.
"""

from __future__ import annotations

import array
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Pose, PoseStamped, Transform, TransformStamped
from nav_msgs.msg import Odometry, Path
from numpy.typing import NDArray
from sensor_msgs.msg import NavSatFix, PointCloud2, PointField
from std_msgs.msg import Header

from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, Ints, invert_pose, pose_from_quaternion, quaternion_from_pose
from subiaco_mapping.measurements import DeskewedScan, OdometryPose
from subiaco_mapping.nodes.covariance import UNKNOWN_VELOCITY, BaseVelocity
from subiaco_mapping.preprocessing.conversions import cloud_array, stamp_ns
from subiaco_msgs.msg import ScanQuality

_POINT_TYPES: dict[str, int] = {
    "i1": PointField.INT8,
    "u1": PointField.UINT8,
    "i2": PointField.INT16,
    "u2": PointField.UINT16,
    "i4": PointField.INT32,
    "u4": PointField.UINT32,
    "f4": PointField.FLOAT32,
    "f8": PointField.FLOAT64,
}

#: One point of ``points_deskewed``: 17 bytes; ``kind`` is one of the three below.
SCAN_POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("kind", "u1")])
#: Strongest return, second return, and no return: how far a beam proves the air empty.
STRONGEST, SECOND, SKY = 0, 1, 2


def stamp_message(time_ns: int) -> Time:
    """Turn nanoseconds into a stamp."""
    return Time(sec=int(time_ns) // 10**9, nanosec=int(time_ns) % 10**9)


def header(time_ns: int, frame_id: str) -> Header:
    """Build a header."""
    return Header(stamp=stamp_message(time_ns), frame_id=frame_id)


def cloud_message(points: NDArray[np.void], frame_id: str, time_ns: int) -> PointCloud2:
    """Build a PointCloud2 whose fields are those of a structured array (N,)."""
    if points.dtype.fields is None:
        raise InputError("points must be a structured array, e.g. of dtype [('x', 'f4'), ...]")
    fields = [
        PointField(name=name, offset=offset, datatype=_POINT_TYPES[dtype.str[1:]], count=1)
        for name, (dtype, offset) in ((n, e[:2]) for n, e in points.dtype.fields.items())
    ]
    data = array.array("B")
    data.frombytes(np.ascontiguousarray(points).view(np.uint8).data)
    return PointCloud2(
        header=header(time_ns, frame_id),
        height=1,
        width=len(points),
        fields=fields,
        is_bigendian=False,
        point_step=points.dtype.itemsize,
        row_step=points.dtype.itemsize * len(points),
        data=data,
        is_dense=True,
    )


def scan_points(scan: DeskewedScan) -> NDArray[np.void]:
    """Stack both returns and the sky of a scan as :data:`SCAN_POINT` rows."""
    parts = (scan.xyz, scan.last_xyz, scan.sky_xyz)
    xyz = np.concatenate(parts)
    points = np.zeros(len(xyz), SCAN_POINT)
    for axis, name in enumerate("xyz"):
        points[name] = xyz[:, axis]
    returns = len(scan.xyz) + len(scan.last_xyz)
    points["intensity"][:returns] = np.concatenate([scan.intensity, scan.last_intensity])
    points["kind"] = np.repeat([STRONGEST, SECOND, SKY], [len(part) for part in parts])
    return points


def scan_message(scan: DeskewedScan, frame_id: str) -> PointCloud2:
    """Build the message of a deskewed scan: returns and sky, float32, in ``lidar_link``."""
    return cloud_message(scan_points(scan), frame_id, scan.stamp_ns)


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
        covariance=np.asarray(pose.covariance, np.float64).ravel(),
    )


def _stack_xyz(points: NDArray[np.void]) -> Floats:
    return np.stack([points[name] for name in "xyz"], axis=1).astype(np.float64)


def scan_from_messages(cloud: Any, quality: Any) -> DeskewedScan:
    """Rebuild a deskewed scan from cloud and quality of one stamp."""
    points = cloud_array(cloud)
    first, last, sky = (points[points["kind"] == kind] for kind in (STRONGEST, SECOND, SKY))
    accel = np.array(quality.accel, dtype=np.float64)
    return DeskewedScan(
        stamp_ns=stamp_ns(cloud.header.stamp),
        xyz=_stack_xyz(first),
        intensity=first["intensity"].astype(np.float32),
        mode=quality.mode,
        last_xyz=_stack_xyz(last),
        last_intensity=last["intensity"].astype(np.float32),
        sky_xyz=_stack_xyz(sky),
        accel=None if np.isnan(accel).any() else accel,
        columns=quality.columns,
        lost_columns=quality.lost_columns,
        dropped_points=quality.dropped_points,
    )


def pose_message(pose: Floats) -> Pose:
    """Build a Pose from (4, 4)."""
    message = Pose()
    position, orientation = message.position, message.orientation
    position.x, position.y, position.z = pose[:3, 3].tolist()
    orientation.x, orientation.y, orientation.z, orientation.w = quaternion_from_pose(pose).tolist()
    return message


def pose_array(message: Any) -> Floats:
    """Return a Pose as (4, 4)."""
    position, orientation = message.position, message.orientation
    return pose_from_quaternion(
        [position.x, position.y, position.z],
        [orientation.x, orientation.y, orientation.z, orientation.w],
    )


def transform_message(pose: Floats, parent: str, child: str, time_ns: int) -> TransformStamped:
    """Build ``T_parent_child`` as a stamped transform."""
    transform = Transform()
    translation, rotation = transform.translation, transform.rotation
    translation.x, translation.y, translation.z = pose[:3, 3].tolist()
    rotation.x, rotation.y, rotation.z, rotation.w = quaternion_from_pose(pose).tolist()
    return TransformStamped(header=header(time_ns, parent), child_frame_id=child, transform=transform)


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
        covariance=np.array(quality.covariance, dtype=np.float64).reshape(6, 6),
        inliers=quality.inliers,
        residual_rmse=quality.residual_rmse,
        degenerate=quality.degenerate,
        segment=quality.segment,
        predicted=quality.predicted,
    )


def path_message(times_ns: Ints, poses: Floats, frame_id: str) -> Path:
    """Build a path from poses (N, 4, 4)."""
    stamped = [
        PoseStamped(header=header(int(t), frame_id), pose=pose_message(pose))
        for t, pose in zip(times_ns, poses, strict=True)
    ]
    last_ns = int(times_ns[-1]) if len(times_ns) else 0
    return Path(header=header(last_ns, frame_id), poses=stamped)


def xyz_cloud(xyz: Floats, **fields: NDArray[np.generic]) -> NDArray[np.void]:
    """Make a structured float32 cloud (N,) of local coordinates (N, 3) and scalar fields (N,)."""
    if len(xyz) and np.abs(xyz).max() > 1e5:
        raise InputError("clouds on topics are float32: give local coordinates, not those of a map grid")
    columns = [(name, "<f4") for name in "xyz"]
    columns += [(name, values.dtype.newbyteorder("<").str) for name, values in fields.items()]
    points = np.zeros(len(xyz), np.dtype(columns))
    for axis, name in enumerate("xyz"):
        points[name] = xyz[:, axis]
    for name, values in fields.items():
        points[name] = values
    return points


def origin_message(latitude: float, longitude: float, height: float, frame_id: str) -> NavSatFix:
    """Build the origin of the local frame: degrees and ellipsoidal height."""
    return NavSatFix(
        header=header(0, frame_id),
        latitude=float(latitude),
        longitude=float(longitude),
        altitude=float(height),
    )
