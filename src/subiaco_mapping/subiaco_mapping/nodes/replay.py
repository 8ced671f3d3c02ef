"""Replay of bags one after the other, never faster than their consumers. Without ROS."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Protocol

from subiaco_geo.bag_files import sequence_name
from subiaco_geo.bags import BagMessage, BagReader
from subiaco_geo.errors import InputError
from subiaco_geo.topics import LATCHED, MESSAGE_TYPES
from subiaco_mapping.nodes.flow import FlowControl
from subiaco_mapping.nodes.names import END, SEQUENCE

#: Most messages in flight: packets two scans of 1024 columns, whole clouds a few.
WINDOWS: dict[str, int] = {"/ouster/lidar_packets": 128, "/lidar/points": 4, SEQUENCE: 1, END: 1}

CLOCK_STEP_NS = 10_000_000


class ReplayPort(Protocol):
    """Where the replay sends to: publishers, or a list in a test."""

    def mark(self, topic: str, name: str, counts: Mapping[str, int]) -> None:
        """Announce a sequence or the end, with counts by topic."""

    def publish(self, message: BagMessage) -> None:
        """Publish the raw bytes of one message."""

    def clock(self, time_ns: int) -> None:
        """Publish the log time."""

    def connected(self, topic: str) -> int:
        """Return how many subscribers of a topic are matched."""


def check_types(reader: BagReader, topics: Collection[str]) -> None:
    """Refuse a bag whose survey topics have another type than ours."""
    for topic in topics:
        expected, found = MESSAGE_TYPES.get(topic), reader.topics[topic].msg_type
        if expected is not None and found != expected:
            raise InputError(f"{reader.path}: {topic} is {found}, expected {expected}; remap or convert it")


class Replay:
    """Walk through bags in log order; :meth:`step` never blocks.

    Parameters
    ----------
    bags : sequence of Path
        One a sequence, in order.
    flow : FlowControl
        Fed with the counts of the consumers.
    port : ReplayPort
    topics : collection of str
        Topics to play; the others are left out.
    rate : float
        Log seconds a second; 0 goes as fast as the consumers.
    on_progress : callable
        Told the fraction of all messages played.
    open_bag : callable
        Opens a bag under our names.
    """

    def __init__(
        self,
        bags: Sequence[Path],
        flow: FlowControl,
        port: ReplayPort,
        topics: Collection[str] = tuple(MESSAGE_TYPES),
        rate: float = 0.0,
        on_progress: Callable[[float], None] | None = None,
        open_bag: Callable[[Path], BagReader] = BagReader,
    ) -> None:
        self._bags = tuple(Path(bag) for bag in bags)
        self._flow = flow
        self._port = port
        self._topics = frozenset(topics)
        self._rate = rate
        self._anchor: tuple[float, int] | None = None
        self._on_progress = on_progress or (lambda _fraction: None)
        self._open = open_bag
        self._steps = self._run()
        self._played = 0
        self._total = 0
        self.done = False

    def set_rate(self, rate: float) -> None:
        """Go on at another speed: log seconds a second, 0 as fast as the consumers."""
        self._rate = rate
        self._anchor = None

    def step(self) -> bool:
        """Do a little; return False where consumers or the clock must be waited for."""
        busy = next(self._steps, None)
        self.done = busy is None
        return bool(busy)

    def _run(self) -> Iterator[bool]:
        self._total = sum(self._count(bag) for bag in self._bags)
        while not self._flow.ready:
            yield False
        yield from self._until_connected(SEQUENCE)
        for bag in self._bags:
            yield from self._play(bag)
        self._port.mark(END, "replay", self._data_counts())
        self._flow.published(END)
        yield from self._until_settled()
        self._on_progress(1.0)

    def _chosen(self, reader: BagReader) -> frozenset[str]:
        chosen = self._topics & reader.topics.keys()
        if not chosen:
            raise InputError(
                f"{reader.path}: none of {', '.join(sorted(self._topics))}; record or remap them"
            )
        check_types(reader, chosen)
        return chosen

    def _count(self, bag: Path) -> int:
        with self._open(bag) as reader:
            return sum(reader.topics[topic].count for topic in self._chosen(reader))

    def _data_counts(self) -> dict[str, int]:
        return {topic: n for topic, n in self._flow.totals.items() if topic not in (SEQUENCE, END)}

    def _until_connected(self, topic: str) -> Iterator[bool]:
        while self._port.connected(topic) < self._flow.takers(topic):
            yield False

    def _until_settled(self) -> Iterator[bool]:
        while not self._flow.settled:
            yield False

    def _play(self, bag: Path) -> Iterator[bool]:
        with self._open(bag) as reader:
            chosen = self._chosen(reader)
            for topic in sorted(chosen):
                yield from self._until_connected(topic)
            self._port.mark(SEQUENCE, sequence_name(bag), {t: reader.topics[t].count for t in chosen})
            self._flow.published(SEQUENCE)
            yield from self._until_settled()
            self._port.clock(reader.start_ns)
            yield from self._publish_all(reader, chosen & LATCHED, paced=False)
            yield from self._until_settled()
            yield from self._publish_all(reader, chosen - LATCHED, paced=True)
            yield from self._until_settled()

    def _is_early(self, log_time_ns: int) -> bool:
        """Whether a message is not due yet; time counts from the first one after a change of the speed."""
        if not self._rate:
            return False
        if self._anchor is None:
            self._anchor = (time.monotonic(), log_time_ns)
        began, first_ns = self._anchor
        return time.monotonic() < began + (log_time_ns - first_ns) * 1e-9 / self._rate

    def _publish_all(self, reader: BagReader, topics: Collection[str], *, paced: bool) -> Iterator[bool]:
        self._anchor = (time.monotonic(), reader.start_ns)
        clock_ns = reader.start_ns
        for message in reader.messages(topics) if topics else ():
            while (paced and self._is_early(message.log_time_ns)) or not self._flow.may_publish(
                message.topic
            ):
                yield False
            if paced and message.log_time_ns - clock_ns >= CLOCK_STEP_NS:
                clock_ns = message.log_time_ns
                self._port.clock(clock_ns)
            self._port.publish(message)
            self._flow.published(message.topic)
            self._played += 1
            self._on_progress(self._played / self._total)
            yield True
