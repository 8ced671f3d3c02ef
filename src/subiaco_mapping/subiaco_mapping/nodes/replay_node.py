"""Node: play survey bags at the speed of their consumers."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from builtin_interfaces.msg import Time
from pydantic import Field
from rclpy.node import Node
from rclpy.publisher import Publisher
from rosgraph_msgs.msg import Clock

from subiaco_geo.bags import BagMessage
from subiaco_geo.config import StrictModel
from subiaco_geo.errors import InputError, SubiacoError
from subiaco_geo.topics import LATCHED, MESSAGE_TYPES
from subiaco_mapping.named_bags import open_bag
from subiaco_mapping.nodes.counts import counts_message, listen_to_consumers
from subiaco_mapping.nodes.flow import FlowControl
from subiaco_mapping.nodes.names import END, SEQUENCE
from subiaco_mapping.nodes.replay import WINDOWS, Replay
from subiaco_mapping.topic_names import TopicsConfig
from subiaco_msgs.msg import ReplayCounts
from subiaco_ros.diagnostics import ProgressReporter
from subiaco_ros.managed_node import App
from subiaco_ros.node_process import run_node
from subiaco_ros.parameters import DYNAMIC, read_models
from subiaco_ros.qos import latched, reliable

#: Messages published between two looks at the callbacks.
BURST = 16
PATIENCE = 0.02


class ReplayParameters(StrictModel):
    """Parameters of the replay node."""

    bags: tuple[str, ...] = Field(description="Bags to replay, one per sequence")
    consumers: tuple[str, ...] = Field((), description="Nodes whose message counts the replay waits for")
    rate: float = Field(
        0.0,
        ge=0,
        description="Replay speed as a multiple of real time; 0 replays as fast as the consumers can process",
        json_schema_extra=DYNAMIC,
    )
    topics: tuple[str, ...] = Field(tuple(MESSAGE_TYPES), description="Topics that are replayed")
    names: TopicsConfig = Field(TopicsConfig(), description="Names of the topics in the bags")
    consumer_timeout: float = Field(60.0, gt=0, description="Time to wait for the consumers to appear [s]")


def _message_class(topic: str) -> Any:
    name = MESSAGE_TYPES.get(topic)
    if name is None:
        raise InputError(f"{topic}: not a survey topic; choose from {', '.join(MESSAGE_TYPES)}")
    package, _, kind = name.split("/")
    return getattr(import_module(f"{package}.msg"), kind)


class NodePort:
    """Publishers of everything that a replay sends; names become relative, so that they can be remapped."""

    def __init__(self, node: Node, topics: Sequence[str], consumers: Sequence[str] = ()) -> None:
        self._node = node
        self._consumers = frozenset(consumers)
        self._publishers: dict[str, Publisher] = {}
        for topic in topics:
            profile = latched(100) if topic in LATCHED else reliable(1000)
            self._publishers[topic] = node.create_publisher(_message_class(topic), topic.lstrip("/"), profile)
        for topic in (SEQUENCE, END):
            self._publishers[topic] = node.create_publisher(ReplayCounts, topic.lstrip("/"), latched(1))
        self._clock = node.create_publisher(Clock, "/clock", reliable(10))

    def mark(self, topic: str, name: str, counts: Mapping[str, int]) -> None:
        """Announce a sequence or the end."""
        self._publishers[topic].publish(counts_message(name, counts))

    def publish(self, message: BagMessage) -> None:
        """Publish raw bytes."""
        self._publishers[message.topic].publish(message.raw)

    def clock(self, time_ns: int) -> None:
        """Publish the log time."""
        stamp = Time(sec=time_ns // 10**9, nanosec=time_ns % 10**9)
        self._clock.publish(Clock(clock=stamp))

    def connected(self, topic: str) -> int:
        """Return how many consumers are matched; a viewer that subscribes too does not count."""
        publisher = self._publishers[topic]
        found = self._node.get_subscriptions_info_by_topic(publisher.topic_name)
        named = {end.node_name for end in found} & self._consumers
        return min(len(named), int(publisher.get_subscription_count()))


class ReplayApp:
    """Drive a :class:`Replay` between callbacks."""

    def __init__(self, node: Node, replay: Replay, flow: FlowControl, consumer_timeout: float) -> None:
        self._node = node
        self._replay = replay
        self._flow = flow
        self._deadline = time.monotonic() + consumer_timeout
        self._timeout = consumer_timeout
        listen_to_consumers(node, flow)

    def reconfigure(self, values: Mapping[str, Any]) -> None:
        """Go on at another speed."""
        if "rate" in values:
            self._replay.set_rate(float(values["rate"]))

    @property
    def done(self) -> bool:
        """Whether everything was played and consumed."""
        return self._replay.done

    def step(self) -> float:
        """Publish a burst; wait for callbacks only where the replay has to wait."""
        if not self._flow.ready and time.monotonic() > self._deadline:
            raise SubiacoError(
                f"no sign of {', '.join(self._flow.missing)} within {self._timeout:.0f} s; start them "
                "or leave them out of the parameter consumers"
            )
        busy = all(self._replay.step() for _ in range(BURST))
        if self._replay.done:
            self._report()
        return 0.0 if busy else PATIENCE

    def _report(self) -> None:
        counts = ", ".join(f"{topic} {n}" for topic, n in sorted(self._flow.totals.items()))
        self._node.get_logger().info(f"played and consumed: {counts}")


def build(node: Node) -> App:
    """Put the node together from its parameters."""
    own, _ = read_models(node, ReplayParameters)
    flow = FlowControl(own.consumers, WINDOWS)
    progress = ProgressReporter(node)
    port = NodePort(node, own.topics, own.consumers)
    replay = Replay(
        [Path(bag) for bag in own.bags],
        flow,
        port,
        own.topics,
        own.rate,
        lambda fraction: progress("replay", fraction),
        lambda bag: open_bag(bag, own.names),
    )
    return ReplayApp(node, replay, flow, own.consumer_timeout)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run_node("replay", build, argv)


if __name__ == "__main__":
    sys.exit(main())
