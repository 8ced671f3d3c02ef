"""Shorter bags for graphs that need not drive far."""

from __future__ import annotations

from pathlib import Path

from subiaco_geo.bags import BagReader, BagWriter
from subiaco_geo.topics import LATCHED, LIDAR_PACKETS


def last_seconds(source: Path, target: Path, seconds: float) -> int:
    """Copy what every sensor sent at the end of a bag; return the LiDAR packets."""
    with BagReader(source) as reader, BagWriter(target) as writer:
        for message in reader.messages():
            latched = message.topic in LATCHED
            if latched or message.log_time_ns >= reader.end_ns - seconds * 1e9:
                writer.write_raw(
                    message.topic, message.msg_type, message.raw, message.log_time_ns, latched=latched
                )
    with BagReader(target) as reader:
        return reader.topics[LIDAR_PACKETS].count
