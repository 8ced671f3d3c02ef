"""What whole mcap files hold, and the ``metadata.yaml`` that makes one bag of several."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Channel, Schema

from subiaco_geo.atomic import whole_file
from subiaco_geo.bag_files import READ_FAULTS
from subiaco_geo.bag_segments import HASH_KEY, QOS_KEY, RecordedTopic
from subiaco_geo.errors import InputError

METADATA_NAME = "metadata.yaml"
_METADATA_VERSION = 9


@dataclass(frozen=True)
class SegmentInfo:
    """What one whole file holds; times are log times."""

    name: str
    start_ns: int
    end_ns: int
    counts: Mapping[RecordedTopic, int]

    @property
    def messages(self) -> int:
        """Number of messages."""
        return sum(self.counts.values())


def recorded_topic(channel: Channel, schemas: Mapping[int, Schema]) -> RecordedTopic:
    """Return the topic of an mcap channel."""
    schema = schemas.get(channel.schema_id)
    return RecordedTopic(
        name=channel.topic,
        msg_type="" if schema is None else schema.name,
        definition="" if schema is None else schema.data.decode(errors="replace"),
        type_hash=channel.metadata.get(HASH_KEY, ""),
        qos=channel.metadata.get(QOS_KEY, ""),
        encoding="ros2msg" if schema is None else schema.encoding,
    )


def describe_segment(path: Path) -> SegmentInfo:
    """Read from its summary what a whole mcap file holds.

    Raises
    ------
    InputError
        The file is cut or damaged.
    """
    try:
        with path.open("rb") as stream:
            summary = make_reader(stream).get_summary()
        if summary is None or summary.statistics is None:
            raise InputError(f"{path}: has no summary; run 'subiaco recover {path}'")
        counts = {
            recorded_topic(channel, summary.schemas): summary.statistics.channel_message_counts.get(key, 0)
            for key, channel in summary.channels.items()
        }
    except (McapError, *READ_FAULTS) as error:
        raise InputError(f"{path}: is cut or damaged; run 'subiaco recover {path}'") from error
    statistics = summary.statistics
    return SegmentInfo(path.name, statistics.message_start_time, statistics.message_end_time, counts)


def _total(segments: Sequence[SegmentInfo]) -> list[tuple[RecordedTopic, int]]:
    """Add up the messages of a topic over files; the same topic is one, however its definition is worded."""
    totals: dict[RecordedTopic, int] = {}
    for segment in segments:
        for topic, count in segment.counts.items():
            key = replace(topic, definition="", encoding="")
            totals[key] = totals.get(key, 0) + count
    return list(totals.items())


def _span(start_ns: int, end_ns: int) -> dict[str, dict[str, int]]:
    return {
        "starting_time": {"nanoseconds_since_epoch": start_ns},
        "duration": {"nanoseconds": max(0, end_ns - start_ns)},
    }


def bag_metadata(segments: Sequence[SegmentInfo], custom: Mapping[str, str] | None = None) -> dict[str, Any]:
    """Return the ``metadata.yaml`` of files, in the order in which they are to be read."""
    start = min(segment.start_ns for segment in segments)
    end = max(segment.end_ns for segment in segments)
    topics = [
        {
            "topic_metadata": {
                "name": topic.name,
                "type": topic.msg_type,
                "serialization_format": "cdr",
                "offered_qos_profiles": yaml.safe_load(topic.qos) if topic.qos else [],
                "type_description_hash": topic.type_hash,
            },
            "message_count": count,
        }
        for topic, count in _total(segments)
    ]
    files = [{"path": s.name, **_span(s.start_ns, s.end_ns), "message_count": s.messages} for s in segments]
    information = {
        "version": _METADATA_VERSION,
        "storage_identifier": "mcap",
        **_span(start, end),
        "message_count": sum(segment.messages for segment in segments),
        "topics_with_message_count": topics,
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [segment.name for segment in segments],
        "files": files,
        "custom_data": dict(custom) if custom else None,
        "ros_distro": "jazzy",
    }
    return {"rosbag2_bagfile_information": information}


def write_bag_metadata(
    folder: Path, segments: Sequence[SegmentInfo], custom: Mapping[str, str] | None = None
) -> None:
    """Write (or replace) the ``metadata.yaml`` of a folder; none where there is no whole file."""
    if not segments:
        return
    with whole_file(folder / METADATA_NAME) as temporary:
        temporary.write_text(yaml.safe_dump(bag_metadata(segments, custom), sort_keys=False), "utf-8")
