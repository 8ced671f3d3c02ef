"""Rate, gaps and silence of one topic."""

from __future__ import annotations

from collections import deque

_BUCKET_NS = 100_000_000
_WINDOW = 20


class StreamWatch:
    """Count messages of a topic by their arrival.

    Parameters
    ----------
    silent_ns : int
        No message for longer is silence.
    """

    def __init__(self, silent_ns: int) -> None:
        self._silent_ns = silent_ns
        self._buckets: deque[tuple[int, int]] = deque()
        self._best = 0.0
        self._steady_ns = 0
        self.count = 0
        self.first_ns: int | None = None
        self.last_ns: int | None = None
        self.longest_gap_ns = 0
        self.gaps = 0

    def take(self, now_ns: int) -> None:
        """Note one message."""
        if self.last_ns is not None:
            gap_ns = now_ns - self.last_ns
            self.longest_gap_ns = max(self.longest_gap_ns, gap_ns)
            if gap_ns > self._silent_ns:
                self.gaps += 1
                self._steady_ns = now_ns
        else:
            self.first_ns = self._steady_ns = now_ns
        self.last_ns = now_ns
        self.count += 1
        bucket = now_ns // _BUCKET_NS
        if self._buckets and self._buckets[-1][0] == bucket:
            self._buckets[-1] = (bucket, self._buckets[-1][1] + 1)
        else:
            self._buckets.append((bucket, 1))

    def silent(self, now_ns: int) -> bool:
        """Whether the topic has spoken before and is silent now."""
        return self.last_ns is not None and now_ns - self.last_ns > self._silent_ns

    def rate(self, now_ns: int) -> float:
        """Return messages a second over the last two seconds, the running tenth left out."""
        newest = now_ns // _BUCKET_NS
        while self._buckets and self._buckets[0][0] < newest - _WINDOW:
            self._buckets.popleft()
        if self.first_ns is None:
            return 0.0
        span = min(_WINDOW, newest - self.first_ns // _BUCKET_NS)
        count = sum(n for bucket, n in self._buckets if newest - span <= bucket < newest)
        return count / (span * _BUCKET_NS * 1e-9) if span > 0 else 0.0

    def slow(self, now_ns: int, min_share: float) -> bool:
        """Whether the rate is below a share of the best one; four seconds after a gap that can be told."""
        if self.first_ns is None or now_ns - self._steady_ns < 2 * _WINDOW * _BUCKET_NS:
            return False
        rate = self.rate(now_ns)
        self._best = max(self._best, rate)
        return rate < min_share * self._best and not self.silent(now_ns)

    @property
    def usual_rate(self) -> float:
        """The best rate held so far, 0 while that is not known."""
        return self._best
