"""Configuration of the recorder."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, Self

from pydantic import Field, model_validator

from subiaco_geo.config import StrictModel
from subiaco_geo.topics import FIX, LIDAR_PACKETS, MESSAGE_TYPES, METADATA, POINTS
from subiaco_mapping.topic_names import GPS_FIX, NMEA_SENTENCE, TIME_REFERENCE

#: What a survey cannot do without: a name for people, and the topics of which one must have messages.
ESSENTIAL = {"LiDAR": (LIDAR_PACKETS, POINTS), "GNSS": (FIX,)}


class RecordConfig(StrictModel):
    """What is recorded, how it is cut into files, and what the disk must keep free."""

    topics: tuple[str, ...] = Field(
        (*MESSAGE_TYPES, TIME_REFERENCE, GPS_FIX, NMEA_SENTENCE, "/diagnostics"),
        description="Topics to record, by their names in the bag",
    )
    all_topics: bool = Field(False, description="Record all other topics of the ROS graph too")
    exclude: tuple[str, ...] = Field(
        ("/clock", "/rosout", "/parameter_events"), description="Topics that all_topics leaves out"
    )
    split_duration: float = Field(60.0, gt=0, description="Duration after which a new bag file begins [s]")
    chunk_bytes: int = Field(
        1 << 20, ge=1 << 12, le=1 << 26, description="Size at which a chunk of the bag file is closed [bytes]"
    )
    flush_interval: float = Field(
        0.25,
        gt=0,
        le=1.0,
        description="Longest time until recorded data are written, and so lost at most if the process is "
        "killed [s]",
    )
    fsync: Literal["chunk", "flush", "close"] = Field(
        "flush",
        description="Interval at which data are forced to the disk: every chunk, every flush_interval, or "
        "every file",
    )
    queue_mb: int = Field(
        512,
        ge=16,
        description="Memory for messages that wait for a slow disk [MB]; further messages are dropped",
    )
    warn_free_gb: float = Field(20.0, ge=0, description="Free disk space below which the recorder warns [GB]")
    stop_free_gb: float = Field(
        2.0, ge=0, description="Free disk space below which the recording ends with complete files [GB]"
    )
    exit_when_stopped: bool = Field(
        True,
        description="End the process when the disk is full; otherwise keep running and report on "
        "/diagnostics",
    )
    packet_depth: int = Field(
        2048, ge=256, description="Queue depth of the middleware for LiDAR and IMU packets [messages]"
    )
    depth: int = Field(
        512,
        ge=1,
        description="Queue depth of the middleware for other topics [messages]; a tenth for complete "
        "point clouds",
    )

    def absent(self, received: Mapping[str, int]) -> list[str]:
        """Name what a survey cannot do without, that should be recorded and of which no message came.

        Parameters
        ----------
        received : mapping of str to int
            Messages a topic, by the names that the bag gets.
        """
        absent = [
            f"no {sensor} data ({', '.join(topics)})"
            for sensor, topics in ESSENTIAL.items()
            if set(topics) & set(self.topics) and not any(received.get(topic) for topic in topics)
        ]
        if received.get(LIDAR_PACKETS) and METADATA in self.topics and not received.get(METADATA):
            absent.append(f"no LiDAR metadata ({METADATA}), without which no packet can be decoded,")
        return absent

    @model_validator(mode="after")
    def _watermarks_in_order(self) -> Self:
        if self.warn_free_gb < self.stop_free_gb:
            raise ValueError("warn_free_gb must not be below stop_free_gb")
        return self


class RecordingConfig(StrictModel):
    """The configuration file of ``subiaco record``."""

    PUBLIC = (
        "record.topics",
        "record.all_topics",
        "record.exclude",
        "record.split_duration",
        "record.queue_mb",
        "record.warn_free_gb",
        "record.stop_free_gb",
    )

    record: RecordConfig = RecordConfig()
