"""Raw subscriptions of the recorder, with every message counted."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from ament_index_python.packages import get_package_share_directory
from rclpy.node import Node
from rclpy.subscription import Subscription

from subiaco_geo.bag_segments import RecordedTopic, qos_text
from subiaco_geo.bags import TYPESTORE
from subiaco_geo.errors import InputError
from subiaco_geo.topics import LIDAR_PACKETS, MESSAGE_TYPES, METADATA, PACKET_TYPE
from subiaco_mapping.recording.config import RecordConfig
from subiaco_mapping.recording.definitions import Definitions
from subiaco_mapping.recording.losses import PERIODIC_TYPES, PacketHeaders, TopicCounter
from subiaco_ros.qos_adaptation import (
    Offer,
    PolledCallbackGroup,
    message_class,
    read_offer,
    take_from,
    wanted_qos,
)
from subiaco_ros.topic_names import relative

_WHOLE_CLOUDS = "sensor_msgs/msg/PointCloud2"
_BURST = 4096


def message_text(msg_type: str) -> str:
    """Return the definition of a message type, as its installed package states it."""
    package, _, name = msg_type.split("/")
    share = Path(get_package_share_directory(package))
    return (share / "msg" / f"{name}.msg").read_text("utf-8")


def _never_called(_raw: bytes) -> None:
    raise AssertionError("read by drain() alone")


@dataclass
class _Listening:
    """One topic that is being recorded."""

    topic: RecordedTopic
    offer: Offer
    subscription: Subscription
    counter: TopicCounter
    publishers: frozenset[bytes]


class RawListener:
    """Subscribe to what is offered, and hand every message to the recorder.

    Parameters
    ----------
    node : Node
        Its remappings say where a topic comes from; the bag gets our names.
    config : RecordConfig
    take : callable
        Takes ``(topic, data, log_time_ns, publish_time_ns, sequence, latched)``; false if dropped.
    """

    def __init__(self, node: Node, config: RecordConfig, take: Callable[..., bool]) -> None:
        self._node = node
        self._config = config
        self._take = take
        self._polled = PolledCallbackGroup()
        self._definitions = Definitions(message_text)
        self._topics: dict[str, _Listening] = {}
        self._refused: dict[str, str] = {}
        self._metadata: str | None = None
        if LIDAR_PACKETS in config.topics:  # now, and not while packets wait for their counter
            import_module("subiaco_mapping.preprocessing.decode")

    @property
    def counters(self) -> dict[str, TopicCounter]:
        """Counters by topic."""
        return {name: listening.counter for name, listening in self._topics.items()}

    def facts(self) -> dict[str, dict[str, int]]:
        """Return counts by topic and name."""
        return {name: counter.facts() for name, counter in self.counters.items()}

    def complaints(self) -> list[str]:
        """Say what is wrong with what is offered."""
        found = [f"{name}: {reason}" for name, reason in self._refused.items()]
        for name, listening in self._topics.items():
            if not listening.offer.reliable and listening.offer.msg_type == PACKET_TYPE:
                found.append(f"{name}: its publisher is best effort and may lose packets unseen")
            if listening.offer.mixed:
                found.append(f"{name}: its publishers offer different qualities, the weakest is taken")
        return found

    def missing(self) -> list[str]:
        """Return the topics of the list that nobody publishes."""
        return [name for name in self._config.topics if name not in self._topics]

    def look(self) -> None:
        """Subscribe to new publishers, and again where the offered quality of service has changed."""
        for name in self._wanted():
            offer = read_offer(self._node, self._node.resolve_topic_name(self._source(name)))
            known = self._topics.get(name)
            if offer is None or (known is not None and known.offer.key == offer.key):
                continue
            try:
                self._listen(name, offer, known)
                self._refused.pop(name, None)
            except InputError as error:
                self._refused[name] = str(error)

    def _wanted(self) -> list[str]:
        names = list(self._config.topics)
        if self._config.all_topics:
            left_out = {*names, *self._config.exclude}
            sources = {self._node.resolve_topic_name(relative(name)) for name in names}
            found = (name for name, _ in self._node.get_topic_names_and_types())
            names += sorted(name for name in found if name not in left_out | sources)
        return names

    def _source(self, name: str) -> str:
        """Return under which name a topic is subscribed: ours in the node's namespace, others as found."""
        return relative(name) if name in self._config.topics else name

    def _recorded_topic(self, name: str, offer: Offer, known: _Listening | None) -> RecordedTopic:
        """Describe a topic; what was offered first stands, since a bag has one entry a topic."""
        if known is not None and known.topic.msg_type == offer.msg_type:
            return known.topic
        text, type_hash = self._definitions.describe(offer.msg_type)
        return RecordedTopic(
            name, offer.msg_type, text, offer.type_hash or type_hash, qos_text(offer.profiles)
        )

    def _listen(self, name: str, offer: Offer, known: _Listening | None) -> None:
        topic = self._recorded_topic(name, offer, known)
        kind = message_class(offer.msg_type)
        if known is not None:
            self._node.destroy_subscription(known.subscription)
        counter = self._new_counter(name, offer) if known is None else known.counter
        subscription = self._node.create_subscription(
            kind,
            self._source(name),
            _never_called,
            wanted_qos(offer, self._depth(offer.msg_type)),
            callback_group=self._polled,
            raw=True,
        )
        publishers = self._publishers(name) if known is None else known.publishers
        self._topics[name] = _Listening(topic, offer, subscription, counter, publishers)
        self._count_packets()

    @staticmethod
    def _new_counter(name: str, offer: Offer) -> TopicCounter:
        headers = PacketHeaders() if name == LIDAR_PACKETS else None
        return TopicCounter(stamped=offer.msg_type in PERIODIC_TYPES, headers=headers)

    def _publishers(self, name: str) -> frozenset[bytes]:
        """Return the identities of those who publish a topic now."""
        found = self._node.get_publishers_info_by_topic(self._node.resolve_topic_name(self._source(name)))
        return frozenset(bytes(endpoint.endpoint_gid) for endpoint in found)

    def _greet(self, listening: _Listening) -> None:
        """Tell the counter of drivers that have come up: what they said before us is no loss."""
        present = self._publishers(listening.topic.name)
        listening.counter.transport.newcomers += len(present - listening.publishers)
        listening.publishers = present

    def _depth(self, msg_type: str) -> int:
        if msg_type == PACKET_TYPE:
            return self._config.packet_depth
        return max(1, self._config.depth // 10) if msg_type == _WHOLE_CLOUDS else self._config.depth

    def drain(self) -> None:
        """Take everything that has arrived."""
        for listening in list(self._topics.values()):
            for _ in range(_BURST):
                taken = take_from(listening.subscription)
                if taken is None:
                    break
                self._on_message(listening, *taken)

    def _on_message(self, listening: _Listening, raw: bytes, info: Mapping[str, int | None]) -> None:
        topic, counter = listening.topic, listening.counter
        received = info["received_timestamp"] or time.time_ns()
        sequence = info["publication_sequence_number"]
        if sequence is not None and not counter.transport.expects(sequence):
            self._greet(listening)
        counter.take(raw, received, sequence)
        if topic.name == METADATA:
            self._on_metadata(raw)
        kept = self._take(
            topic, raw, received, info["source_timestamp"], sequence or 0, latched=listening.offer.latched
        )
        counter.dropped += not kept

    def _on_metadata(self, raw: bytes) -> None:
        try:
            message: Any = TYPESTORE.deserialize_cdr(raw, MESSAGE_TYPES[METADATA])
        except Exception as error:  # noqa: BLE001 - whatever damaged bytes may do to a parser
            self._refused[METADATA] = f"cannot be read ({error})"
            return
        self._metadata = message.data
        self._count_packets()

    def _count_packets(self) -> None:
        """Count packets by their ids, once their layout and their topic are known."""
        listening = self._topics.get(LIDAR_PACKETS)
        if listening is None or self._metadata is None:
            return
        try:
            listening.counter.know_packets(self._metadata)
            self._refused.pop(METADATA, None)
        except InputError as error:
            self._refused[METADATA] = str(error)
