"""Tiny bags, good and bad, a few messages each."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from subiaco_geo.bags import TYPESTORE, BagWriter
from subiaco_geo.topics import FIX, MESSAGE_TYPES, POINTS, TF_STATIC

START_NS = 1_760_000_000_000_000_000
_T = TYPESTORE.types
_FLOAT32 = 7


def header(time_ns: int, frame: str) -> Any:
    stamp = _T["builtin_interfaces/msg/Time"](sec=time_ns // 10**9, nanosec=time_ns % 10**9)
    return _T["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)


def text(value: str) -> Any:
    return _T["std_msgs/msg/String"](data=value)


def cloud(time_ns: int, xyz: np.ndarray) -> Any:
    """Return a PointCloud2 of x, y, z without point times."""
    fields = [
        _T["sensor_msgs/msg/PointField"](name=name, offset=4 * i, datatype=_FLOAT32, count=1)
        for i, name in enumerate("xyz")
    ]
    data = np.frombuffer(xyz.astype("<f4").tobytes(), dtype=np.uint8)
    return _T["sensor_msgs/msg/PointCloud2"](
        header=header(time_ns, "lidar_link"),
        height=1,
        width=len(xyz),
        fields=fields,
        is_bigendian=False,
        point_step=12,
        row_step=12 * len(xyz),
        data=data,
        is_dense=True,
    )


def fix(time_ns: int, latitude: float, longitude: float, altitude: float, status: int = 2) -> Any:
    return _T["sensor_msgs/msg/NavSatFix"](
        header=header(time_ns, "gnss_link"),
        status=_T["sensor_msgs/msg/NavSatStatus"](status=status, service=1),
        latitude=latitude,
        longitude=longitude,
        altitude=altitude,
        position_covariance=np.eye(3).ravel() * 1e-4,
        position_covariance_type=2,
    )


def frames(*children: str) -> Any:
    """Return base_link to each child, 1 m up."""
    transform = _T["geometry_msgs/msg/Transform"](
        translation=_T["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=1.0),
        rotation=_T["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
    )
    stamped = _T["geometry_msgs/msg/TransformStamped"]
    return _T["tf2_msgs/msg/TFMessage"](
        transforms=[
            stamped(header=header(START_NS, "base_link"), child_frame_id=child, transform=transform)
            for child in children
        ]
    )


def room(scan: int = 0) -> np.ndarray:
    """Return points (N, 3) on floor and walls of a room about the scanner, seed by scan [m]."""
    rng = np.random.default_rng(scan)
    xyz = rng.uniform([-12.0, -8.0, -1.5], [14.0, 9.0, 3.0], (6000, 3))
    side = rng.integers(0, 5, len(xyz))
    for number, (axis, value) in enumerate([(0, -12.0), (0, 14.0), (1, -8.0), (1, 9.0), (2, -1.5)]):
        xyz[side == number, axis] = value
    return xyz


def points_bag(
    path: Path,
    scans: Sequence[np.ndarray],
    fixes: Sequence[tuple[float, float, float]] = (),
    children: Sequence[str] = ("lidar_link", "gnss_link"),
) -> Path:
    """Write a bag of clouds without point times, ten a second, with the fixes given and /tf_static."""
    with BagWriter(path) as writer:
        if children:
            writer.write(TF_STATIC, MESSAGE_TYPES[TF_STATIC], frames(*children), START_NS, latched=True)
        for number, xyz in enumerate(scans):
            time_ns = START_NS + number * 100_000_000
            writer.write(POINTS, MESSAGE_TYPES[POINTS], cloud(time_ns, xyz), time_ns)
        for number, values in enumerate(fixes):
            time_ns = START_NS + number * 100_000_000 + 50_000_000
            writer.write(FIX, MESSAGE_TYPES[FIX], fix(time_ns, *values), time_ns)
    return path


def text_bag(path: Path, *topics: str) -> Path:
    """Write a bag with one std_msgs/String on each topic."""
    with BagWriter(path) as writer:
        for topic in topics:
            writer.write(topic, "std_msgs/msg/String", text("hello"), START_NS)
    return path
