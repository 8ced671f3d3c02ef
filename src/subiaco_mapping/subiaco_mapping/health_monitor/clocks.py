"""Clocks: steps, drift and wrong time scales, from stamps and arrival times."""

from __future__ import annotations

import statistics
from collections import deque
from dataclasses import dataclass

from subiaco_mapping.health_monitor.config import ClockLimits

_WINDOW_NS = 500_000_000
_LONG_NS = 5_000_000_000
_DECIDE_NS = 900_000_000
_UTC_NS = 10**18  # September 2001: anything earlier counts from switching on


class OffsetWatch:
    """Arrival minus stamp of one sensor, as the least of a window: delays only ever add.

    Parameters
    ----------
    step : float
        Jump that counts as a step [s].
    """

    def __init__(self, step: float) -> None:
        self._step_ns = int(step * 1e9)
        self._recent: deque[tuple[int, int]] = deque()
        self._minima: deque[tuple[int, int]] = deque()
        self.offset_ns: int | None = None
        self.not_utc = False
        self._settled = False
        self.steps: list[tuple[int, int]] = []

    def take(self, now_ns: int, stamp_ns: int, arrival_ns: int) -> None:
        """Note one stamp; steps found are appended to ``steps`` as (when, how far)."""
        self.not_utc = stamp_ns < _UTC_NS
        if self.not_utc:
            return
        difference = arrival_ns - stamp_ns
        self._recent.append((now_ns, difference))
        while self._recent[0][0] < now_ns - _WINDOW_NS and len(self._recent) > 3:
            self._recent.popleft()
        self._judge(now_ns, difference)

    def _judge(self, now_ns: int, difference: int) -> None:
        if self.offset_ns is None or not self._settled:  # the first ones may have waited longer
            self.offset_ns = min(value for _, value in self._recent)
        earlier = difference < self.offset_ns - self._step_ns
        least = difference if earlier else min(value for _, value in self._recent)
        filled = len(self._recent) >= 3 and now_ns - self._recent[0][0] >= 0.8 * _WINDOW_NS
        if earlier or (filled and least > self.offset_ns + self._step_ns):
            self.steps.append((now_ns, least - self.offset_ns))
            self._recent = deque([(now_ns, least)])
            self._minima.clear()
            self.offset_ns = least
            return
        if filled:
            self.offset_ns, self._settled = least, True
        self._minima.append((now_ns, least))
        while self._minima[0][0] < now_ns - _LONG_NS:
            self._minima.popleft()

    def fresh(self, now_ns: int) -> bool:
        """Whether there was a stamp of late."""
        return bool(self._recent) and now_ns - self._recent[-1][0] < 2_000_000_000

    @property
    def floor_ns(self) -> int | None:
        """The least offset of the last five seconds."""
        return min((value for _, value in self._minima), default=None)


@dataclass(frozen=True)
class ClockStep:
    """A clock that jumped: a sensor's, or the host's where all jumped together."""

    source: str
    when_ns: int
    size: float


class ClockWatch:
    """The clocks of all sensors together.

    Parameters
    ----------
    limits : ClockLimits
    """

    def __init__(self, limits: ClockLimits) -> None:
        self._limits = limits
        self._settle_ns = int(limits.settle * 1e9)
        self.sensors: dict[str, OffsetWatch] = {}
        self._pending: dict[str, tuple[int, int]] = {}
        self._base: dict[str, int] = {}
        self._since_ns: int | None = None

    def take(self, sensor: str, now_ns: int, stamp_ns: int, arrival_ns: int) -> None:
        """Note the stamp of one message and when it arrived by the host's clock."""
        watch = self.sensors.setdefault(sensor, OffsetWatch(self._limits.step))
        watch.take(now_ns, stamp_ns, arrival_ns)
        if watch.steps:
            self._pending[sensor] = watch.steps[-1]
            watch.steps.clear()
            self._since_ns = None  # the reference of the drift restarts

    def steps(self, now_ns: int) -> list[ClockStep]:
        """Return the steps whose sensor is identified at this time; each step is returned once."""
        if not self._pending:
            return []
        first_ns = min(when for when, _ in self._pending.values())
        fresh = [name for name, watch in self.sensors.items() if watch.fresh(now_ns)]
        together = len(self._pending) > 1 and self._alike()
        if now_ns - first_ns < _DECIDE_NS and not (together and len(self._pending) == len(fresh)):
            return []
        found, self._pending = self._pending, {}
        if together and 2 * len(found) > len(fresh):
            size = statistics.median(size for _, size in found.values()) * 1e-9
            return [ClockStep("host", first_ns, size)]
        return [ClockStep(name, when, -size * 1e-9) for name, (when, size) in found.items()]

    def _alike(self) -> bool:
        sizes = [size for _, size in self._pending.values()]
        return max(sizes) - min(sizes) < 2e9 * self._limits.step

    def offsets(self, now_ns: int) -> dict[str, float]:
        """Return arrival minus stamp [s] of every sensor that speaks."""
        return {
            name: watch.offset_ns * 1e-9
            for name, watch in self.sensors.items()
            if watch.offset_ns is not None and watch.fresh(now_ns) and not watch.not_utc
        }

    def disagreement(self, now_ns: int) -> tuple[float, str]:
        """Return the largest difference [s] between two sensors' offsets, and which two."""
        offsets = self.offsets(now_ns)
        if len(offsets) < 2:
            return 0.0, ""
        low, high = min(offsets, key=offsets.__getitem__), max(offsets, key=offsets.__getitem__)
        return offsets[high] - offsets[low], f"{low} and {high}"

    def drifts(self, now_ns: int) -> dict[str, float]:
        """Return by how much each sensor's clock left the others' since the start [s]; two at least."""
        floors = {n: w.floor_ns for n, w in self.sensors.items() if w.fresh(now_ns) and not w.not_utc}
        known = {name: floor for name, floor in floors.items() if floor is not None}
        if len(known) < 2:
            return {}
        if self._since_ns is None:
            self._since_ns, self._base = now_ns, {}
        if now_ns - self._since_ns <= self._settle_ns or not known.keys() <= self._base.keys():
            self._base = dict(known)
            return {}
        moved = {name: floor - self._base[name] for name, floor in known.items()}
        return {name: _against_nearest(moved, name) * -1e-9 for name in moved}


def _against_nearest(moved: dict[str, int], name: str) -> int:
    """Return how far one clock moved against the one nearest to it: what is common is the host's."""
    return min((moved[name] - way for other, way in moved.items() if other != name), key=abs)
