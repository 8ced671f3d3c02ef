"""Serialised messages for a survey bag: clouds with point times, fixes, extrinsics."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from subiaco_geo.bags import TYPESTORE
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.topics import FIX, MESSAGE_TYPES, POINTS, TF_STATIC

_T = TYPESTORE.types
_POINT = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("t", "<u4"), ("ring", "<u2")]
)
_CODES = {"<f4": 7, "<u4": 6, "<u2": 4}  # of sensor_msgs/PointField


@dataclass(frozen=True)
class LogMessage:
    """One message: topic, UTC time and its serialised bytes."""

    topic: str
    time_ns: int
    cdr: bytes


def stamp_ns(time_ns: int) -> int:
    """Return a time that a ROS stamp can hold; ValueError for one before 1970 or after 2038."""
    if not 0 <= time_ns < 2**31 * 10**9:
        raise ValueError(f"{time_ns} ns is no time between 1970 and 2038")
    return time_ns


def header(time_ns: int, frame: str) -> Any:
    """Return a std_msgs/Header."""
    stamp = _T["builtin_interfaces/msg/Time"](sec=int(time_ns) // 10**9, nanosec=int(time_ns) % 10**9)
    return _T["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)


def message(topic: str, time_ns: int, **fields: Any) -> LogMessage:
    """Serialise a message of one of our topics from its fields."""
    kind = MESSAGE_TYPES[topic]
    return LogMessage(topic, time_ns, bytes(TYPESTORE.serialize_cdr(_T[kind](**fields), kind)))


def cloud_message(
    xyz: Floats,
    times_ns: Ints,
    intensity: NDArray[np.floating[Any]] | None = None,
    ring: NDArray[np.integer[Any]] | None = None,
) -> LogMessage:
    """Return one sweep as ``/lidar/points``, logged when its last point was measured.

    Parameters
    ----------
    xyz : (N, 3) float64
        ``lidar_link`` [m]; N is at least 1.
    times_ns : (N,) int64
        Of each point, within 4 s of the first.
    intensity : (N,) float, optional
    ring : (N,) int, optional
    """
    start_ns = int(times_ns.min())
    points = np.zeros(len(xyz), _POINT)
    for axis, name in enumerate("xyz"):
        points[name] = xyz[:, axis]
    points["t"] = times_ns - start_ns
    if intensity is not None:
        points["intensity"] = intensity
    if ring is not None:
        points["ring"] = ring
    field = _T["sensor_msgs/msg/PointField"]
    listed = [
        field(name, int(_POINT.fields[name][1]), _CODES[_POINT[name].str], 1)  # type: ignore[index]
        for name in _POINT.names or ()
    ]
    return message(
        POINTS,
        int(times_ns.max()),
        header=header(start_ns, "lidar_link"),
        height=1,
        width=len(points),
        fields=listed,
        is_bigendian=False,
        point_step=_POINT.itemsize,
        row_step=_POINT.itemsize * len(points),
        data=points.view(np.uint8).reshape(-1),
        is_dense=True,
    )


def fix_message(time_ns: int, place: Floats, covariance: Floats, status: int, *, known: bool) -> LogMessage:
    """Return a sensor_msgs/NavSatFix.

    Parameters
    ----------
    time_ns : int
    place : (3,) float64
        Latitude, longitude [deg], ellipsoidal height [m].
    covariance : (3, 3) float64
        East, north, up [m2].
    status : int
        2 RTK fixed, 1 float, 0 single, -1 none.
    known : bool
        Whether the receiver stated the covariance.
    """
    stated = 2 if np.count_nonzero(covariance - np.diag(np.diagonal(covariance))) == 0 else 3
    return message(
        FIX,
        time_ns,
        header=header(time_ns, "gnss_link"),
        status=_T["sensor_msgs/msg/NavSatStatus"](status=status, service=1),
        latitude=float(place[0]),
        longitude=float(place[1]),
        altitude=float(place[2]),
        position_covariance=np.asarray(covariance, dtype=np.float64).reshape(9),
        position_covariance_type=stated if known else 1,
    )


def extrinsics_message(time_ns: int, frames: Mapping[str, Floats]) -> LogMessage:
    """Return ``/tf_static`` with ``T_base_frame`` (4, 4) of every frame named."""
    vector, turn = _T["geometry_msgs/msg/Vector3"], _T["geometry_msgs/msg/Quaternion"]
    items = []
    for child, pose in frames.items():
        quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat()
        joined = _T["geometry_msgs/msg/Transform"](
            translation=vector(*map(float, pose[:3, 3])), rotation=turn(*map(float, quaternion))
        )
        items.append(
            _T["geometry_msgs/msg/TransformStamped"](
                header=header(time_ns, "base_link"), child_frame_id=child, transform=joined
            )
        )
    return message(TF_STATIC, time_ns, transforms=items)
