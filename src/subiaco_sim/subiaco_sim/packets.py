"""Scans as real Ouster UDP packets, and the metadata that lets any decoder read them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from ouster.sdk import core
from ouster.sdk.core import HeaderType, PacketFormat, SensorInfo, TimestampMode, UDPProfileLidar

from subiaco_geo.frames import Floats, Ints
from subiaco_sim.config import FaultConfig, LidarMode
from subiaco_sim.lidar import Return, SimulatedScan
from subiaco_sim.sensors import Sensor, row_shift
from subiaco_sim.vehicle import LIDAR

COLUMNS_PER_PACKET = 16
SINGLE = UDPProfileLidar.RNG19_RFL8_SIG16_NIR16
DUAL = UDPProfileLidar.RNG19_RFL8_SIG16_NIR16_DUAL


def sensor_info(mode: LidarMode, dual: bool, beams: int = 128) -> SensorInfo:
    """Return the metadata of a simulated OS1-64 or OS1-128: +-22.5 deg, four staggered azimuths."""
    lidar_mode = core.LidarMode(mode.columns, 10)
    info = SensorInfo.from_default(lidar_mode)
    info.prod_line, info.sn, info.fw_rev = f"OS-1-{beams}", 992300000001, "v3.1.0"
    info.beam_altitude_angles = np.round(np.linspace(22.5, -22.5, beams), 2)
    info.beam_azimuth_angles = np.tile([4.21, 1.41, -1.40, -4.22], beams // 4)
    form = info.format
    form.pixels_per_column, form.columns_per_packet = beams, COLUMNS_PER_PACKET
    form.udp_profile_lidar = DUAL if dual else SINGLE
    form.header_type = HeaderType.STANDARD
    form.pixel_shift_by_row = [k * mode.columns // 1024 for k in (24, 16, 8, 0)] * (beams // 4)
    info.format = form
    settings = info.config
    settings.udp_port_lidar, settings.udp_port_imu = 7502, 7503
    settings.udp_profile_lidar = form.udp_profile_lidar
    settings.lidar_mode = lidar_mode
    settings.timestamp_mode = TimestampMode.TIME_FROM_SYNC_PULSE_IN
    info.config = settings
    return SensorInfo(info.to_json_string())


def true_sensor_info(mode: LidarMode, dual: bool, sensor: Sensor) -> SensorInfo:
    """Return the metadata of a sensor with the beam angles of a real unit."""
    info = sensor_info(mode, dual, sensor.beams)
    info.prod_line = sensor.line
    info.beam_altitude_angles = sensor.elevation_deg
    info.beam_azimuth_angles = sensor.azimuth_deg
    form = info.format
    form.pixel_shift_by_row = row_shift(sensor, mode.columns)
    info.format = form
    return SensorInfo(info.to_json_string())


def inner_imu(info: SensorInfo) -> Floats:
    """Return T_base_imu (4, 4) of the unit inside the LiDAR; its metadata are in millimetres."""
    inside = np.array(info.imu_to_sensor_transform, dtype=np.float64)
    inside[:3, 3] *= 1e-3
    return LIDAR.T_base_sensor @ inside


@dataclass(frozen=True)
class TimedPacket:
    """The bytes of one packet and the time of its last column [ns]."""

    last_column_ns: int
    buf: bytes


class PacketMaker:
    """Turns scans into packets of one sensor."""

    def __init__(self, info: SensorInfo) -> None:
        self._info = info
        self._format = PacketFormat(info)

    def packets(self, scan: SimulatedScan, stamps: Ints | None = None) -> Iterator[TimedPacket]:
        """Yield the packets of a scan in the order of their columns, with stamps of their own if given."""
        frame = core.LidarFrame(self._info)
        frame.frame_id = scan.frame_id % (self._format.max_frame_id + 1)
        frame.timestamp[:] = scan.times_ns if stamps is None else stamps
        frame.measurement_id[:] = np.arange(frame.w)
        frame.status[:] = 1
        _fill(frame, scan.first, "")
        if scan.second is not None:
            _fill(frame, scan.second, "2")
        frame.field("NEAR_IR")[:] = scan.first.reflectivity.astype(np.uint16) * 4
        last = scan.times_ns[COLUMNS_PER_PACKET - 1 :: COLUMNS_PER_PACKET]
        made = core.frame_to_packets(frame, self._format, self._info.init_id, self._info.sn)
        for time_ns, packet in zip(last.tolist(), made, strict=True):
            yield TimedPacket(time_ns, bytes(packet.buf))


def _fill(frame: core.LidarFrame, values: Return, suffix: str) -> None:
    frame.field("RANGE" + suffix)[:] = values.range_mm
    frame.field("REFLECTIVITY" + suffix)[:] = values.reflectivity
    frame.field("SIGNAL" + suffix)[:] = values.signal


def with_faults(
    packets: Iterator[TimedPacket], faults: FaultConfig, rng: np.random.Generator
) -> Iterator[TimedPacket]:
    """Lose, double and swap packets; each keeps the bytes and column times it has."""
    held: TimedPacket | None = None
    for packet in packets:
        draw = rng.random(3)
        if draw[0] < faults.packet_loss:
            continue
        if held is None and draw[2] < faults.reordered:
            held = packet
            continue
        yield packet
        if held is not None:
            yield held
            held = None
        if draw[1] < faults.duplicates:
            yield packet
    if held is not None:
        yield held
