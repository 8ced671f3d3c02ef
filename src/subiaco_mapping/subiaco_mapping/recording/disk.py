"""The disk that a recording goes to: the room it has, and the thread that waits for it."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from subiaco_geo.bag_segments import SegmentWriter
from subiaco_geo.errors import InputError
from subiaco_mapping.recording.config import RecordConfig

GB = 10**9
_LOOK_INTERVAL = 0.25
_RATE_MEMORY = 10.0


class DiskRoom:
    """Free space of a folder's disk against the watermarks, and how fast it goes.

    Parameters
    ----------
    folder : Path
    config : RecordConfig
    free : callable
        Folder to free bytes.

    Raises
    ------
    InputError
        There is too little already.
    """

    def __init__(self, folder: Path, config: RecordConfig, free: Callable[[Path], int]) -> None:
        self._folder = folder
        self._config = config
        self._free = free
        self._looked = time.monotonic()
        self._written = 0
        self.rate_bytes = 0.0
        self.free_bytes = free(folder)
        if self.full:
            raise InputError(
                f"{folder}: only {self.free_bytes / GB:.1f} GB are free, "
                f"{config.stop_free_gb:g} must stay free (record.stop_free_gb); make room"
            )

    def due(self, now: float) -> bool:
        """Whether the free space should be read again."""
        return now - self._looked >= _LOOK_INTERVAL

    def look(self, now: float, written: int) -> None:
        """Look how much is free, with so many bytes written in all."""
        share = min(1.0, (now - self._looked) / _RATE_MEMORY)
        rate = (written - self._written) / (now - self._looked)
        self.rate_bytes = rate if self.rate_bytes == 0 else (1 - share) * self.rate_bytes + share * rate
        self._looked, self._written = now, written
        self.free_bytes = self._free(self._folder)

    @property
    def low(self) -> bool:
        """Whether there is a reason to warn."""
        return self.free_bytes < self._config.warn_free_gb * GB

    @property
    def full(self) -> bool:
        """Whether the recording must end."""
        return self.free_bytes < self._config.stop_free_gb * GB

    @property
    def minutes_left(self) -> float | None:
        """Until it is full at the present rate, None where nothing is written."""
        spare = max(0.0, self.free_bytes - self._config.stop_free_gb * GB)
        return spare / self.rate_bytes / 60.0 if self.rate_bytes > 0 else None


class DiskWaiter:
    """Wait for the disk in a thread of its own, so that writing goes on meanwhile."""

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1, "disk")
        self._waiting: deque[Future[None]] = deque()
        self.slowest_s = 0.0

    def sync(self, segment: SegmentWriter) -> None:
        """Have the disk take what was flushed, unless it is busy with that already."""
        if not self._waiting:
            self.submit(lambda: self._sync(segment))

    def _sync(self, segment: SegmentWriter) -> None:
        begun = time.monotonic()
        segment.sync()
        self.slowest_s = max(self.slowest_s, time.monotonic() - begun)

    def submit(self, work: Callable[[], None]) -> None:
        """Do something after what waits already."""
        self._waiting.append(self._thread.submit(work))

    def check(self) -> None:
        """Forget what the disk has done, and raise what it refused."""
        while self._waiting and self._waiting[0].done():
            self._waiting.popleft().result()

    def finish(self) -> None:
        """Wait for everything."""
        self._thread.shutdown(wait=True)
