"""One drive as a rosbag2: packets, inertial and GNSS messages in the order of their arrival."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from subiaco_geo import topics
from subiaco_geo.bags import TYPESTORE, BagWriter, packet_to_cdr
from subiaco_geo.frames import Floats, Ints, quaternion_from_pose
from subiaco_sim.config import FaultConfig
from subiaco_sim.drives import WORLD
from subiaco_sim.gnss import NONE, GnssSeries
from subiaco_sim.imu import ImuSeries, ouster_packets
from subiaco_sim.packets import TimedPacket, with_faults
from subiaco_sim.vehicle import MOUNTINGS

_PACKET_DELAY_NS = 300_000
_IMU_DELAY_NS = 1_000_000
_FIX_DELAY_NS = 60_000_000

Msg: TypeAlias = Any  # message objects of the type store

_T = TYPESTORE.types


@dataclass(frozen=True, order=True)
class Arrival:
    """A serialised message as it reaches the recorder."""

    log_ns: int
    topic: str
    cdr: bytes


def write_bag(path: Path, metadata_json: str, start_ns: int, streams: Iterable[Iterator[Arrival]]) -> None:
    """Write latched topics, then every stream merged by arrival."""
    begin_ns = start_ns - 150_000_000
    with BagWriter(path) as writer:
        string = _T["std_msgs/msg/String"](data=metadata_json)
        metadata_type = topics.MESSAGE_TYPES[topics.METADATA]
        writer.write(topics.METADATA, metadata_type, string, begin_ns, latched=True)
        tf_type = topics.MESSAGE_TYPES[topics.TF_STATIC]
        writer.write(topics.TF_STATIC, tf_type, tf_message(begin_ns), begin_ns, latched=True)
        for arrival in heapq.merge(*streams):
            writer.write_raw(arrival.topic, topics.MESSAGE_TYPES[arrival.topic], arrival.cdr, arrival.log_ns)


def stamp(time_ns: int) -> Msg:
    """Return a builtin_interfaces/Time."""
    return _T["builtin_interfaces/msg/Time"](sec=time_ns // 10**9, nanosec=time_ns % 10**9)


def _header(time_ns: int, frame: str) -> Msg:
    return _T["std_msgs/msg/Header"](stamp=stamp(time_ns), frame_id=frame)


def _vector(values: Iterable[float]) -> Msg:
    x, y, z = (float(v) for v in values)
    return _T["geometry_msgs/msg/Vector3"](x=x, y=y, z=z)


def _quaternion(values: Iterable[float]) -> Msg:
    x, y, z, w = (float(v) for v in values)
    return _T["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)


def tf_message(time_ns: int) -> Msg:
    """Return base_link to every sensor frame."""
    transforms = []
    for frame, mounting in MOUNTINGS.items():
        pose = mounting.T_base_sensor
        transform = _T["geometry_msgs/msg/Transform"](
            translation=_vector(pose[:3, 3]), rotation=_quaternion(quaternion_from_pose(pose))
        )
        transforms.append(
            _T["geometry_msgs/msg/TransformStamped"](
                header=_header(time_ns, "base_link"), child_frame_id=frame, transform=transform
            )
        )
    return _T["tf2_msgs/msg/TFMessage"](transforms=transforms)


def packet_arrivals(
    packets: Iterator[TimedPacket], faults: FaultConfig, rng: np.random.Generator
) -> Iterator[Arrival]:
    """Yield LiDAR packets; a packet that overtakes another still arrives after what came before it."""
    latest = 0
    for packet in with_faults(packets, faults, rng):
        latest = max(latest + 1, packet.last_column_ns + _PACKET_DELAY_NS)
        yield Arrival(latest, topics.LIDAR_PACKETS, packet_to_cdr(packet.buf))


_ABSENT = np.array([-1.0, *[0.0] * 8])  # covariance of what a message does not give
_UNKNOWN = np.zeros(9)


def _imu_message(
    time_ns: int, frame: str, orientation: Msg, covariance: Floats, gyro: Msg, accel: Msg, other: Floats
) -> bytes:
    message = _T["sensor_msgs/msg/Imu"](
        header=_header(time_ns, frame),
        orientation=orientation,
        orientation_covariance=covariance,
        angular_velocity=gyro,
        angular_velocity_covariance=other,
        linear_acceleration=accel,
        linear_acceleration_covariance=other,
    )
    return bytes(TYPESTORE.serialize_cdr(message, "sensor_msgs/msg/Imu"))


def imu_arrivals(series: ImuSeries) -> Iterator[Arrival]:
    """Yield inertial samples; orientation is declared absent (-1)."""
    nothing = _quaternion((0, 0, 0, 1))
    for time_ns, gyro, accel in zip(series.times_ns.tolist(), series.gyro, series.accel, strict=True):
        cdr = _imu_message(time_ns, "imu_link", nothing, _ABSENT, _vector(gyro), _vector(accel), _UNKNOWN)
        yield Arrival(time_ns + _IMU_DELAY_NS, topics.IMU, cdr)


def imu_packet_arrivals(series: ImuSeries, stamps: Ints) -> Iterator[Arrival]:
    """Yield the inertial packets of the LiDAR itself, stamped by its clock (N,) [ns]."""
    for time_ns, buf in zip(series.times_ns.tolist(), ouster_packets(series, stamps), strict=True):
        yield Arrival(time_ns + _IMU_DELAY_NS, topics.IMU_PACKETS, packet_to_cdr(buf))


def fix_arrivals(series: GnssSeries) -> Iterator[Arrival]:
    """Yield fixes; without one, position and covariance are NaN and status -1."""
    geodetic = np.full_like(series.enu, np.nan)
    known = series.status != NONE
    geodetic[known] = WORLD.to_geodetic(series.enu[known])
    make, service = _T["sensor_msgs/msg/NavSatFix"], 1 | 2 | 8
    for k, time_ns in enumerate(series.times_ns.tolist()):
        latitude, longitude, altitude = (float(v) for v in geodetic[k])
        message = make(
            header=_header(time_ns, "gnss_link"),
            status=_T["sensor_msgs/msg/NavSatStatus"](status=int(series.status[k]), service=service),
            latitude=latitude,
            longitude=longitude,
            altitude=altitude,
            position_covariance=np.diag(series.sigma[k] ** 2).ravel(),
            position_covariance_type=2 if known[k] else 0,
        )
        cdr = bytes(TYPESTORE.serialize_cdr(message, "sensor_msgs/msg/NavSatFix"))
        yield Arrival(time_ns + _FIX_DELAY_NS, topics.FIX, cdr)


def heading_arrivals(series: GnssSeries) -> Iterator[Arrival]:
    """Yield the yaw of base_link from east, where both antennas have a fix; the rest is absent (-1)."""
    covariance = np.diag([1e6, 1e6, series.yaw_sigma**2]).ravel()
    still = _vector((0, 0, 0))
    known = np.isfinite(series.yaw)
    for time_ns, yaw in zip(series.times_ns[known].tolist(), series.yaw[known], strict=True):
        orientation = _quaternion(Rotation.from_euler("Z", yaw).as_quat())
        cdr = _imu_message(time_ns, "base_link", orientation, covariance, still, still, _ABSENT)
        yield Arrival(time_ns + _FIX_DELAY_NS, topics.HEADING, cdr)
