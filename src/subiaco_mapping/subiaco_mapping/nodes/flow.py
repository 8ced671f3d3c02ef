"""Flow control by counting: the publisher knows what has been consumed, and waits.

No ROS here, so that the rules are tested without it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence


class FlowControl:
    """The publishing side: messages in flight on each topic, from counts that consumers send back.

    A consumer says which topics it takes by counting them; a topic that nobody counts is never held back.
    Nothing is sent before every consumer has spoken, so that what it counted until then came from others: a
    replay before this one.

    Parameters
    ----------
    consumers : iterable of str
        Names that must have spoken before :attr:`ready`.
    windows : mapping of str to int
        Most messages in flight, by topic.
    default_window : int
        For every other topic.
    """

    def __init__(
        self, consumers: Iterable[str], windows: Mapping[str, int] | None = None, default_window: int = 128
    ) -> None:
        self._consumers = tuple(consumers)
        self._windows = dict(windows or {})
        self._default_window = default_window
        self._consumed: dict[str, dict[str, int]] = {}
        self._before: dict[str, dict[str, int]] = {}
        self.totals: Counter[str] = Counter()

    @property
    def missing(self) -> tuple[str, ...]:
        """Consumers that have not spoken yet."""
        return tuple(name for name in self._consumers if name not in self._consumed)

    @property
    def ready(self) -> bool:
        """Whether every named consumer has spoken."""
        return not self.missing

    def published(self, topic: str) -> None:
        """Note one message sent."""
        self.totals[topic] += 1

    def on_counts(self, source: str, topics: Sequence[str], counts: Sequence[int]) -> bool:
        """Note what one consumer has consumed so far; others than the named ones are ignored: False."""
        if source not in self._consumers:
            return False
        known, before = self._consumed.setdefault(source, {}), self._before.setdefault(source, {})
        for topic, count in zip(topics, counts, strict=True):
            if not self.totals[topic]:
                before[topic] = int(count)
            known[topic] = max(known.get(topic, 0), int(count) - before.get(topic, 0))
        return True

    def takers(self, topic: str) -> int:
        """Return how many of the named consumers take a topic."""
        return sum(topic in known for known in self._consumed.values())

    def in_flight(self, topic: str) -> int:
        """Return how many messages the slowest consumer of a topic is behind."""
        counts = [known[topic] for known in self._consumed.values() if topic in known]
        return max(0, self.totals[topic] - min(counts)) if counts else 0

    def may_publish(self, topic: str) -> bool:
        """Whether the window of a topic has room for one more."""
        return self.in_flight(topic) < self._windows.get(topic, self._default_window)

    @property
    def settled(self) -> bool:
        """Whether everything sent has been consumed by all who take it."""
        return all(self.in_flight(topic) == 0 for topic in self.totals)


class ConsumedCounter:
    """The consuming side: counts to send back, in small batches.

    Parameters
    ----------
    topics : iterable of str
        Topics that this node takes; they are reported from zero.
    batch : int
        Messages after which a report is due at once; fewer wait for the timer.
    """

    def __init__(self, topics: Iterable[str], batch: int = 16) -> None:
        self.counts: dict[str, int] = dict.fromkeys(topics, 0)
        self._batch = batch
        self._unsent = 1  # the first report says the topics

    def consumed(self, topic: str) -> None:
        """Note one message consumed."""
        self.counts[topic] += 1
        self._unsent += 1

    @property
    def pending(self) -> bool:
        """Whether there is anything to report."""
        return self._unsent > 0

    @property
    def due(self) -> bool:
        """Whether a full batch waits to be reported."""
        return self._unsent >= self._batch

    def take(self) -> dict[str, int]:
        """Return the counts to send, and note them as sent."""
        self._unsent = 0
        return dict(self.counts)
