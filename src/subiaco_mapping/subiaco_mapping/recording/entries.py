"""Messages in the recorder, and its state."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from subiaco_geo.bag_segments import RecordedTopic
from subiaco_geo.bags import TYPESTORE

RecordingState = Literal["recording", "disk full", "failed", "closed"]


@dataclass(frozen=True, slots=True)
class Entry:
    """One message on its way to the disk."""

    topic: RecordedTopic
    data: bytes
    log_time_ns: int
    publish_time_ns: int
    sequence: int
    latched: bool


@dataclass(frozen=True)
class RecorderStatus:
    """How a recording stands.

    ``minutes_left`` is until the disk's lower watermark at the present rate, None where nothing is
    written; ``slowest_sync_s`` is the longest wait for the disk so far, ``slowest_turn_s`` the longest time
    between two looks at the clock: a kill then would have cost so much more than ``flush_interval``.
    """

    state: RecordingState
    reason: str
    file: str
    files: int
    messages: int
    written_bytes: int
    queued_bytes: int
    dropped: int
    free_bytes: int
    rate_bytes: float
    minutes_left: float | None
    slowest_sync_s: float
    slowest_turn_s: float
    warnings: tuple[str, ...]


def free_bytes(folder: Path) -> int:
    """Return the free space of the disk that a folder is on."""
    return shutil.disk_usage(folder).free


def latched_key(entry: Entry) -> tuple[str, ...]:
    """Return what a later message on a latched topic must share to replace this one.

    Several nodes publish static transforms: one replaces another where it speaks of the same frames.
    """
    if entry.topic.msg_type != "tf2_msgs/msg/TFMessage":
        return (entry.topic.name,)
    try:
        message: Any = TYPESTORE.deserialize_cdr(entry.data, entry.topic.msg_type)
        return (entry.topic.name, *sorted(t.child_frame_id for t in message.transforms))
    except Exception:  # noqa: BLE001 - damaged bytes are recorded as they came
        return (entry.topic.name,)
