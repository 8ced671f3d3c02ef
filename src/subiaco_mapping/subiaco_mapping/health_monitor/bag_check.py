"""The health monitor applied to a bag by log time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from subiaco_geo.bags import BagMessage, BagReader
from subiaco_geo.topics import FIX, IMU, LIDAR_PACKETS, METADATA, POINTS
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.health_monitor.config import PPS_WORDS
from subiaco_mapping.health_monitor.dop import dop_of_gps_fix, dop_of_nmea
from subiaco_mapping.health_monitor.monitor import Monitor
from subiaco_mapping.preprocessing.conversions import fix_from_msg, imu_from_msg
from subiaco_mapping.recording.losses import header_stamp_ns
from subiaco_mapping.topic_names import GPS_FIX, NMEA_SENTENCE, TIME_REFERENCE

DIAGNOSTICS = "/diagnostics"
_TICK_NS = 100_000_000
_MOST_TICKS = 200


def watch_bag(reader: BagReader, config: MappingConfig) -> Monitor:
    """Feed a whole bag to a watch and return it.

    Raises
    ------
    InputError
        The bag is damaged, or the packets' metadata is not what it should be.
    """
    monitor = Monitor(config)
    take = _handlers(monitor, reader)
    before_ns = 0
    for message in reader.messages(take.keys() & reader.topics.keys()):
        _fill(monitor, before_ns, message.log_time_ns)
        before_ns = message.log_time_ns
        take[message.topic](message)
    _fill(monitor, before_ns, reader.end_ns)
    monitor.tick(max(reader.end_ns, before_ns))
    return monitor


def _fill(monitor: Monitor, before_ns: int, now_ns: int) -> None:
    """Let time pass where every topic is silent."""
    gap_ns = now_ns - before_ns
    if before_ns == 0 or gap_ns <= _TICK_NS:
        return
    count = min(gap_ns // _TICK_NS, _MOST_TICKS)
    for k in range(1, count):
        monitor.tick(before_ns + gap_ns * k // count)


def _handlers(monitor: Monitor, reader: BagReader) -> dict[str, Callable[[BagMessage], None]]:
    def read(message: BagMessage) -> Any:
        return reader.deserialize(message)

    def on_points(message: BagMessage) -> None:
        stamp = header_stamp_ns(message.raw)
        if stamp is not None:
            monitor.on_points(stamp, message.log_time_ns, message.log_time_ns)

    def on_fix(message: BagMessage) -> None:
        fix = fix_from_msg(read(message), monitor.config.gnss)
        monitor.on_fix(fix, message.log_time_ns, message.log_time_ns)

    def on_sentence(message: BagMessage) -> None:
        found = dop_of_nmea(str(read(message).sentence))
        if found is not None:
            monitor.on_dop(*found, message.log_time_ns)

    handlers: dict[str, Callable[[BagMessage], None]] = {
        METADATA: lambda m: monitor.on_metadata(str(read(m).data)),
        LIDAR_PACKETS: lambda m: monitor.on_packet(m.raw, m.log_time_ns, m.log_time_ns),
        IMU: lambda m: monitor.on_imu(imu_from_msg(read(m)), m.log_time_ns, m.log_time_ns),
        FIX: on_fix,
        TIME_REFERENCE: lambda m: monitor.on_time_reference(m.log_time_ns),
        GPS_FIX: lambda m: monitor.on_dop(*dop_of_gps_fix(read(m)), m.log_time_ns),
        NMEA_SENTENCE: on_sentence,
        DIAGNOSTICS: lambda m: _take_locks(monitor, read(m), m.log_time_ns),
    }
    if LIDAR_PACKETS not in reader.topics:
        handlers[POINTS] = on_points
    return handlers


def _take_locks(monitor: Monitor, message: Any, now_ns: int) -> None:
    """Hand on what drivers said of their lock on the pulse."""
    for status in message.status:
        name = str(status.name).lower()
        if not name.startswith("monitor: ") and any(word in name for word in PPS_WORDS):
            monitor.on_pps_lock(int(status.level) == 0, f"{status.name}: {status.message}", now_ns)
