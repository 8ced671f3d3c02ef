"""Counts on topics, by which a publisher paces itself."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.publisher import Publisher

from subiaco_mapping.nodes.flow import ConsumedCounter, FlowControl
from subiaco_msgs.msg import ReplayCounts
from subiaco_ros.qos import latched

CONSUMED = "replay/consumed"
REPORT_INTERVAL = 0.02


def counts_message(source: str, counts: Mapping[str, int]) -> ReplayCounts:
    """Build the message of counts by topic."""
    return ReplayCounts(source=source, topics=list(counts), counts=list(counts.values()))


def listen_to_consumers(node: Node, flow: FlowControl, then: Callable[[], None] | None = None) -> None:
    """Feed a flow control with what consumers report; ``then`` is called where one of its own has spoken."""

    def on_counts(message: ReplayCounts) -> None:
        if flow.on_counts(message.source, message.topics, message.counts) and then is not None:
            then()

    node.create_subscription(ReplayCounts, CONSUMED, on_counts, latched(100))


class ConsumptionReporter:
    """Report what a node has consumed, at once in batches and on a timer for the rest.

    Parameters
    ----------
    node : Node
        Its name is the source of the counts.
    counter : ConsumedCounter
    allowed : callable
        Reports are withheld while this is false: that is how a node whose own
        consumers are behind slows down the replay.
    """

    def __init__(
        self, node: Node, counter: ConsumedCounter, allowed: Callable[[], bool] = lambda: True
    ) -> None:
        self._name = node.get_name()
        self._counter = counter
        self._allowed = allowed
        self._publisher: Publisher = node.create_publisher(ReplayCounts, CONSUMED, latched(1))
        node.create_timer(REPORT_INTERVAL, self.flush, clock=Clock(clock_type=ClockType.STEADY_TIME))

    @property
    def counts(self) -> dict[str, int]:
        """What has been consumed so far, by topic."""
        return self._counter.counts

    def consumed(self, topic: str) -> None:
        """Note one message, and report when a batch is full."""
        self._counter.consumed(topic)
        if self._counter.due:
            self.flush()

    def flush(self) -> None:
        """Report now, if there is something to report and it may be."""
        if self._counter.pending and self._allowed():
            self._publisher.publish(counts_message(self._name, self._counter.take()))
