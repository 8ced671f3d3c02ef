"""Node: serve topics of a running graph to Foxglove, which connects with its own WebSocket protocol.

Messages go out as they come in, serialised, with the definition of their type. A topic is subscribed while
somebody looks at it, so that a graph without a viewer does no work for one.
"""

from __future__ import annotations

import logging
import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any, Protocol

from pydantic import Field
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.subscription import Subscription

from subiaco_geo.config import StrictModel
from subiaco_geo.errors import InputError
from subiaco_mapping.nodes.raw_subscriptions import message_text
from subiaco_mapping.recording.definitions import Definitions
from subiaco_ros.managed_node import App
from subiaco_ros.node_process import run_node
from subiaco_ros.parameters import read_models
from subiaco_ros.qos_adaptation import LOOK_INTERVAL, Offer, message_class, read_offer, wanted_qos
from subiaco_ros.topic_names import DIAGNOSTICS, relative

LOGGER = logging.getLogger(__name__)

#: What the shipped layouts show, and what a viewer needs beside: frames and log.
SHOWN = (
    "/tf", "/tf_static", "/odometry", "/odometry/quality", "/path", "/points_deskewed", "/points_sky",
    "/map/points", "/map/origin", "/quality/markers", "/quality/geojson", "/gnss/fix", "/gnss/heading",
    "/imu/data", "/change/before", "/change/after", "/change/origin", "/change/markers", "/change/table",
    DIAGNOSTICS, "/rosout",
)  # fmt: skip
#: Messages of a latched topic that a viewer gets when it comes later: /tf_static has several publishers.
_KEPT = 32
_DEPTH = 64


class FoxgloveParameters(StrictModel):
    """Parameters of the Foxglove node."""

    host: str = Field(
        "127.0.0.1",
        description="Address on which Foxglove can connect; the default lets only this computer connect",
    )
    port: int = Field(8765, ge=0, le=65535, description="TCP port of the server; 0 takes a free one")
    topics: tuple[str, ...] = Field(SHOWN, description="Topics that are served once somebody publishes them")


class Outlet(Protocol):
    """Where the messages of one topic go."""

    def log(self, msg: bytes, *, log_time: int | None = None) -> None:
        """Hand one message to every viewer of the topic."""


class Server(Protocol):
    """What serves viewers; the SDK of Foxglove, or a list in a test."""

    port: int

    def open(self, topic: str, msg_type: str, definition: str) -> Outlet:
        """Offer a topic."""

    def events(self) -> list[tuple[str, bool]]:
        """Return who began (true) or ceased to look at which topic since the last call."""

    def stop(self) -> None:
        """Let every viewer go."""


class FoxgloveServer:
    """The server of the Foxglove SDK; its callbacks come from other threads and are queued.

    Raises
    ------
    InputError
        The SDK is not installed, or the port is taken.
    """

    def __init__(self, host: str, port: int) -> None:
        try:
            self._sdk: Any = import_module("foxglove")
            start_server = self._sdk.start_server
        except (ImportError, AttributeError) as error:
            raise InputError(
                "foxglove-sdk: not installed; run 'make setup', or 'pip install foxglove-sdk'"
            ) from error
        self._events: deque[tuple[str, bool]] = deque()
        self._context = self._sdk.Context()
        try:
            self._server = start_server(
                name="Subiaco", host=host, port=port, server_listener=self, context=self._context
            )
        except Exception as error:
            raise InputError(f"foxglove server {host}:{port}: {error}; choose another port") from error
        self.port = int(self._server.port)

    def on_subscribe(self, _client: Any, channel: Any) -> None:
        """Note a viewer that begins to look (called by the SDK)."""
        self._events.append((str(channel.topic), True))

    def on_unsubscribe(self, _client: Any, channel: Any) -> None:
        """Note a viewer that ceases to look (called by the SDK)."""
        self._events.append((str(channel.topic), False))

    def open(self, topic: str, msg_type: str, definition: str) -> Outlet:
        """Offer a topic with the definition of its type."""
        schema = self._sdk.Schema(name=msg_type, encoding="ros2msg", data=definition.encode())
        channel: Outlet = self._sdk.Channel(
            topic, schema=schema, message_encoding="cdr", context=self._context
        )
        return channel

    def events(self) -> list[tuple[str, bool]]:
        """Return what viewers did since the last call."""
        return [self._events.popleft() for _ in range(len(self._events))]

    def stop(self) -> None:
        """Close every connection."""
        self._server.stop()


class Channel:
    """One topic between the graph and its viewers.

    Parameters
    ----------
    node : Node
    topic : str
    offer : Offer
    outlet : Outlet
    """

    def __init__(self, node: Node, topic: str, offer: Offer, outlet: Outlet) -> None:
        self._node = node
        self._topic = topic
        self._outlet = outlet
        self._offer = offer
        self._viewers = 0
        self._kept: deque[bytes] = deque(maxlen=_KEPT if topic == "/tf_static" else 1)
        self._subscription: Subscription | None = None

    def renew(self, offer: Offer) -> None:
        """Follow a changed offer."""
        if offer.key != self._offer.key:
            self._offer = offer
            self._subscribe()

    def looked_at(self, begins: bool) -> None:
        """Count the viewers; the first one starts the subscription, the last one ends it."""
        self._viewers = max(0, self._viewers + (1 if begins else -1))
        if not self._viewers:
            self._drop()
        elif self._subscription is None:
            self._subscribe()
        elif begins:
            for raw in list(self._kept):
                self._send(raw)

    def _subscribe(self) -> None:
        self._drop()
        if self._viewers:
            self._subscription = self._node.create_subscription(
                message_class(self._offer.msg_type),
                relative(self._topic),
                self._take,
                wanted_qos(self._offer, _DEPTH),
                raw=True,
            )

    def _drop(self) -> None:
        self._kept.clear()
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
            self._subscription = None

    def _take(self, raw: bytes) -> None:
        if self._offer.latched:
            self._kept.append(raw)
        self._send(raw)

    def _send(self, raw: bytes) -> None:
        now_ns = int(self._node.get_clock().now().nanoseconds) or time.time_ns()
        self._outlet.log(raw, log_time=now_ns)


class FoxgloveApp:
    """Offer what is published, hand on what somebody looks at.

    Parameters
    ----------
    node : Node
    own : FoxgloveParameters
    server : Server
    """

    done = False

    def __init__(self, node: Node, own: FoxgloveParameters, server: Server) -> None:
        self._node = node
        self._topics = own.topics
        self._server = server
        self._definitions = Definitions(message_text)
        self._channels: dict[str, Channel] = {}
        self._refused: set[str] = set()
        node.create_timer(LOOK_INTERVAL, self._look, clock=Clock(clock_type=ClockType.STEADY_TIME))
        LOGGER.info("Foxglove: open ws://%s:%d", own.host, server.port)

    @property
    def offered(self) -> list[str]:
        """The topics that viewers can choose."""
        return list(self._channels)

    def step(self) -> float:
        """Follow what viewers do."""
        for topic, begins in self._server.events():
            if topic in self._channels:
                self._channels[topic].looked_at(begins)
        return 0.05

    def close(self) -> None:
        """Let every viewer go."""
        self._server.stop()

    def _look(self) -> None:
        for topic in self._topics:
            offer = read_offer(self._node, self._node.resolve_topic_name(relative(topic)))
            if offer is None:
                continue
            if topic in self._channels:
                self._channels[topic].renew(offer)
            elif topic not in self._refused:
                self._open(topic, offer)

    def _open(self, topic: str, offer: Offer) -> None:
        try:
            definition, _ = self._definitions.describe(offer.msg_type)
        except InputError as error:
            self._refused.add(topic)
            LOGGER.warning("%s is not served: %s", topic, error)
            return
        outlet = self._server.open(topic, offer.msg_type, definition)
        self._channels[topic] = Channel(self._node, topic, offer, outlet)


def make_build(make_server: Callable[[str, int], Server] = FoxgloveServer) -> Callable[[Node], App]:
    """Return what puts the node together from its parameters."""

    def build(node: Node) -> App:
        own, _ = read_models(node, FoxgloveParameters)
        return FoxgloveApp(node, own, make_server(own.host, own.port))

    return build


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run_node("foxglove", make_build(), argv)


if __name__ == "__main__":
    sys.exit(main())
