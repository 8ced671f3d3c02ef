"""The recorder: takes serialised messages from any thread, writes them in one of its own."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import yaml

from subiaco_geo.atomic import refuse_existing, whole_file
from subiaco_geo.bag_files import PARTIAL
from subiaco_geo.bag_metadata import SegmentInfo, describe_segment, write_bag_metadata
from subiaco_geo.bag_segments import RecordedTopic, SegmentWriter, natural_order, segment_path, sole_writer
from subiaco_geo.errors import InputError
from subiaco_mapping.recording.config import RecordConfig
from subiaco_mapping.recording.disk import GB, DiskRoom, DiskWaiter
from subiaco_mapping.recording.entries import Entry, RecorderStatus, RecordingState, free_bytes, latched_key

LOGGER = logging.getLogger(__name__)

COUNTS_NAME = "recording.yaml"
_MB = 10**6
_NAP = 0.02  # woken by time and not by every message: many are written in one go

Facts = Callable[[], Mapping[str, Any]]


#: What to do about a folder that is there already.
RESUME_REMEDY = "choose another place, or pass --resume to go on in it with a new file"


def _prepare(folder: Path, resume: bool) -> bool:
    """Make the folder; False where it was there before."""
    if resume and folder.is_dir():
        return False
    refuse_existing(folder, overwrite=False, remedy=RESUME_REMEDY)
    try:
        folder.mkdir(parents=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made ({error.strerror}); choose another place") from error
    return True


def _existing(folder: Path) -> tuple[list[SegmentInfo], int]:
    """Return the whole files of an earlier start, and the next free number."""
    whole = sorted(folder.glob("*.mcap"), key=natural_order)
    taken = [path.name.removesuffix(PARTIAL) for path in (*whole, *folder.glob(f"*.mcap{PARTIAL}"))]
    index = 0
    while any(name >= segment_path(folder, index).name for name in taken):
        index += 1
    return [describe_segment(path) for path in whole], index


class Recorder:
    """Write messages into a folder of mcap files, so that a kill costs little and a full disk nothing.

    Parameters
    ----------
    folder : Path
        The rosbag2 folder to make.
    config : RecordConfig
    resume : bool
        Go on with a new file where the folder exists.
    facts : callable, optional
        Counts of the receiving side, for ``recording.yaml``.
    free : callable
        Folder to free bytes; replaced in tests.

    Raises
    ------
    InputError
        The folder exists, or somebody else records into it.
    """

    def __init__(
        self,
        folder: Path,
        config: RecordConfig,
        *,
        resume: bool = False,
        facts: Facts | None = None,
        free: Callable[[Path], int] = free_bytes,
    ) -> None:
        self.folder = Path(folder).absolute()
        self._config = config
        self._facts = facts or dict
        fresh = _prepare(self.folder, resume)
        self._held = ExitStack()
        self._held.enter_context(sole_writer(self.folder))
        try:
            self._room = DiskRoom(self.folder, config, free)
        except InputError:
            self._held.close()
            if fresh:
                self.folder.rmdir()
            raise
        self._segments, self._index = _existing(self.folder)
        self._segment: SegmentWriter | None = None
        self._disk = DiskWaiter()
        self._latched: dict[tuple[str, ...], Entry] = {}
        self._queue: deque[Entry] = deque()
        self._queued_bytes = 0
        self._wake = threading.Condition()
        self._ending = False
        self._state: RecordingState = "recording"
        self._reason = ""
        self._accepted = self._refused = self._messages = self._closed_bytes = self._repeated = 0
        now = time.monotonic()
        self._flushed = self._split = self._turned = now
        self._slowest_turn = self.slowest_drain_s = 0.0
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    # The receiving side ---------------------------------------------------------------------------

    def add(
        self,
        topic: RecordedTopic,
        data: bytes,
        log_time_ns: int,
        publish_time_ns: int = 0,
        sequence: int = 0,
        *,
        latched: bool = False,
    ) -> bool:
        """Take one message; False where it had to be dropped, because the disk is too slow or full.

        Never waits for the disk. ``latched`` messages are repeated at the head of every file.
        """
        with self._wake:
            full = self._queued_bytes + len(data) > self._config.queue_mb * _MB
            if full or self._state != "recording" or self._ending:
                self._refused += 1
                return False
            self._accepted += 1
            publish = publish_time_ns or log_time_ns
            self._queue.append(Entry(topic, data, log_time_ns, publish, sequence & 0xFFFFFFFF, latched))
            self._queued_bytes += len(data)
        return True

    @property
    def stopped(self) -> bool:
        """Whether nothing is recorded any more."""
        return self._state != "recording"

    def status(self) -> RecorderStatus:
        """Return how the recording stands."""
        segment = self._segment
        return RecorderStatus(
            state=self._state,
            reason=self._reason,
            file="" if segment is None else segment.path.name,
            files=len(self._segments) + (segment is not None),
            messages=self._messages,
            written_bytes=self._closed_bytes + (0 if segment is None else segment.size),
            queued_bytes=self._queued_bytes,
            dropped=self._dropped(),
            free_bytes=self._room.free_bytes,
            rate_bytes=self._room.rate_bytes,
            minutes_left=self._room.minutes_left,
            slowest_sync_s=self._disk.slowest_s,
            slowest_turn_s=self._slowest_turn,
            warnings=tuple(self._warnings()),
        )

    def _dropped(self) -> int:
        """Return how many were refused, and after a stop those that were taken in but not written either."""
        return self._refused + (self._accepted - self._messages if self.stopped else 0)

    def _warnings(self) -> list[str]:
        warnings = [self._reason] if self._reason else []
        if self._state == "recording" and self._room.low:
            warnings.append(f"only {self._room.free_bytes / GB:.1f} GB free on the disk")
        if self._queued_bytes > 0.5 * self._config.queue_mb * _MB:
            warnings.append(f"the disk is too slow: {self._queued_bytes / _MB:.0f} MB wait for it")
        if dropped := self._dropped():
            warnings.append(f"{dropped} messages not recorded")
        return warnings

    def close(self) -> RecorderStatus:
        """Write what waits, finish the file, and return how the recording ended."""
        with self._wake:
            self._ending = True
            self._wake.notify()
        self._thread.join()
        self._held.close()
        return self.status()

    # The writing thread ---------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            while not (self._ending and not self._queue) and self._state == "recording":
                for entry in self._take():
                    self._write(entry)
                self._tend()
            self._finish_segment()
            self._disk.finish()
            self._disk.check()
            if self._state == "recording":
                self._state = "closed"
        except OSError as error:
            self._fail(error)
        except Exception as error:
            LOGGER.exception("the recorder's writing thread")
            self._fail(error)
        self._write_counts()

    def _take(self) -> list[Entry]:
        """Return what waits, a little at a time so that the clock is looked at in between."""
        with self._wake:
            if not self._queue and not self._ending:
                self._wake.wait(_NAP)
            batch = [self._queue.popleft() for _ in range(min(64, len(self._queue)))]
            self._queued_bytes -= sum(len(entry.data) for entry in batch)
        return batch

    def _write(self, entry: Entry) -> None:
        if self._segment is None:
            self._open_segment(entry)
        assert self._segment is not None
        if entry.latched:
            self._latched[latched_key(entry)] = entry
        self._put(self._segment, entry, entry.log_time_ns)
        self._messages += 1
        if self._segment.pending_bytes >= self._config.chunk_bytes:
            self._flush(sync=self._config.fsync == "chunk")

    @staticmethod
    def _put(segment: SegmentWriter, entry: Entry, log_time_ns: int) -> None:
        segment.write(entry.topic, entry.data, log_time_ns, entry.publish_time_ns, entry.sequence)

    def _open_segment(self, first: Entry) -> None:
        """Begin a file with what a late listener needs, as of the time of its first message."""
        self._segment = SegmentWriter(segment_path(self.folder, self._index))
        self._index += 1
        self._split = time.monotonic()
        for latched in self._latched.values():
            self._put(self._segment, latched, first.log_time_ns)
            self._repeated += 1

    def _flush(self, *, sync: bool) -> None:
        """Hand the chunk to the system: safe from a kill at once, from a loss of power when synced."""
        assert self._segment is not None
        self._segment.flush()
        if sync:
            self._disk.sync(self._segment)

    def _tend(self) -> None:
        """Do what is due by the clock: flush, look at the disk, begin a new file."""
        self._disk.check()
        now = time.monotonic()
        self._slowest_turn = max(self._slowest_turn, now - self._turned)
        self._turned = now
        if now - self._flushed >= self._config.flush_interval:
            self._flushed = now
            if self._segment is not None and self._segment.pending_bytes:
                self._flush(sync=self._config.fsync != "close")
        if self._room.due(now):
            self._room.look(now, self.status().written_bytes)
            if self._room.full:
                free = self._room.free_bytes / GB
                self._stop("disk full", f"stopped, all files whole: only {free:.2f} GB are free")
        if self._segment is not None and now - self._split >= self._config.split_duration:
            self._finish_segment()

    def _stop(self, state: RecordingState, reason: str) -> None:
        with self._wake:
            self._state, self._reason = state, f"{self.folder}: {reason}"
            self._queue.clear()
            self._queued_bytes = 0
        LOGGER.error("%s", self._reason)

    def _fail(self, error: Exception) -> None:
        """Give up on a disk that refuses; what was flushed stays in the partial file."""
        self._disk.finish()
        segment, self._segment = self._segment, None
        if segment is not None:
            segment.abandon()
            self._messages -= segment.pending_messages
        reason = getattr(error, "strerror", None) or f"{type(error).__name__}: {error}"
        advice = f"run 'subiaco recover {self.folder}'" if segment is not None else "choose another disk"
        self._stop("failed", f"{reason.lower()}; {advice}")

    def _finish_segment(self) -> None:
        if self._segment is None:
            return
        segment = self._segment
        segment.finish()  # where that fails, the file is still the present one
        self._segment = None
        self._closed_bytes += segment.size
        self._disk.submit(lambda: self._settle(segment))

    def _settle(self, segment: SegmentWriter) -> None:
        segment.settle()
        self._segments.append(describe_segment(segment.path))
        write_bag_metadata(self.folder, self._segments, {"recorder": "subiaco"})
        self._write_counts()

    def _write_counts(self) -> None:
        """Keep the counts beside the files: what was lost must be known from the recording alone."""
        facts = {
            "state": self._state,
            "reason": self._reason,
            "files": len(self._segments),
            "messages": self._messages,
            "repeated_latched": self._repeated,
            "dropped": self._dropped(),
            "bytes": self._closed_bytes,
            "slowest_sync_s": round(self._disk.slowest_s, 3),
            "slowest_turn_s": round(self._slowest_turn, 3),
            "slowest_drain_s": round(self.slowest_drain_s, 3),
            "topics": dict(self._facts()),
        }
        try:
            with whole_file(self.folder / COUNTS_NAME) as temporary:
                temporary.write_text(yaml.safe_dump(facts, sort_keys=False), "utf-8")
        except OSError as error:
            LOGGER.warning("%s: %s cannot be written (%s)", self.folder, COUNTS_NAME, error.strerror)
