"""Clouds, poses, transforms and paths as messages, from numpy arrays and back.

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
from nav_msgs.msg import Path
from numpy.typing import NDArray
from sensor_msgs.msg import NavSatFix, PointCloud2, PointField
from std_msgs.msg import Header

from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, Ints, pose_from_quaternion, quaternion_from_pose

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
