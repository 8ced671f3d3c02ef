"""Quality of service adapted to what publishers offer."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

from subiaco_geo.errors import InputError
from subiaco_ros.qos import overridable
from subiaco_ros.topic_names import relative

#: How often it is looked who publishes [s].
LOOK_INTERVAL = 0.2


@dataclass(frozen=True)
class Offer:
    """What the publishers of one topic offer together.

    Parameters
    ----------
    msg_type, type_hash : str
    profiles : tuple of Qos
        The distinct ones.
    reliable, latched : bool
        Every publisher is reliable; every one keeps its messages for late listeners.
    mixed : bool
        The publishers differ, so that the weaker one is taken.
    """

    msg_type: str
    type_hash: str
    profiles: tuple[Qos, ...]
    reliable: bool
    latched: bool
    mixed: bool

    @property
    def key(self) -> tuple[str, bool, bool]:
        """What a subscription depends on."""
        return self.msg_type, self.reliable, self.latched


def _time(duration: Duration) -> QosTime:
    return QosTime(duration.nanoseconds // 10**9, duration.nanoseconds % 10**9)


def _member(kind: Any, name: str) -> Any:
    return kind.__members__.get(name, kind.UNKNOWN)


def offered_qos(profile: QoSProfile) -> Qos:
    """Return a discovered profile in the terms of a bag; history is never known, as in rosbag2."""
    return Qos(
        history=_member(QosHistory, profile.history.name),
        depth=profile.depth,
        reliability=_member(QosReliability, profile.reliability.name),
        durability=_member(QosDurability, profile.durability.name),
        deadline=_time(profile.deadline),
        lifespan=_time(profile.lifespan),
        liveliness=_member(QosLiveliness, profile.liveliness.name),
        liveliness_lease_duration=_time(profile.liveliness_lease_duration),
        avoid_ros_namespace_conventions=profile.avoid_ros_namespace_conventions,
    )


def _hash_text(endpoint: Any) -> str:
    text = str(endpoint.topic_type_hash)
    return text if text.startswith("RIHS01_") and set(text[7:]) != {"0"} else ""


def read_offer(node: Node, topic: str) -> Offer | None:
    """Return what is offered on a topic (resolved name), None while nobody publishes it."""
    endpoints: Sequence[Any] = node.get_publishers_info_by_topic(topic)
    if not endpoints:
        return None
    profiles = tuple(dict.fromkeys(offered_qos(endpoint.qos_profile) for endpoint in endpoints))
    reliable = {endpoint.qos_profile.reliability == ReliabilityPolicy.RELIABLE for endpoint in endpoints}
    latched = {endpoint.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for endpoint in endpoints}
    return Offer(
        msg_type=endpoints[0].topic_type,
        type_hash=_hash_text(endpoints[0]),
        profiles=profiles,
        reliable=reliable == {True},
        latched=latched == {True},
        mixed=len(reliable) > 1 or len(latched) > 1,
    )


def wanted_qos(offer: Offer, depth: int) -> QoSProfile:
    """Return the profile of a subscription that matches every publisher and loses as little as it can."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if offer.reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if offer.latched else DurabilityPolicy.VOLATILE,
    )


def message_class(msg_type: str) -> Any:
    """Return the Python class of ``package/msg/Name``.

    Raises
    ------
    InputError
        Its package is not installed, or not sourced.
    """
    try:
        package, kind, name = msg_type.split("/")
        return getattr(import_module(f"{package}.{kind}"), name)
    except (ValueError, ImportError, AttributeError) as error:
        raise InputError(f"{msg_type}: message package not found; install or source it") from error


class PolledCallbackGroup(CallbackGroup):
    """Keeps subscriptions out of the executor, which would rebuild its wait set for every message.

    Measured at 1,280 packets a second: a third of a core through the executor, of which a tenth is reading.
    """

    def can_execute(self, entity: Any) -> bool:  # noqa: ARG002 - its interface
        """Say that nothing of this group is to be waited for."""
        return False


def take_from(subscription: Subscription) -> Any | None:
    """Take one message that has arrived with its info, None where there is none."""
    with subscription.handle:
        return subscription.handle.take_message(subscription.msg_type, subscription.raw)


def drain(subscription: Subscription, handler: Callable[..., object], most: int) -> int:
    """Hand on messages that have arrived, each with its info, at most so many; return how many."""
    for count in range(most):
        taken = take_from(subscription)
        if taken is None:
            return count
        handler(*taken)
    return most


class OfferedSubscription:
    """Subscribe as soon as a publisher appears, and again where its offer changes.

    The profile is that of sensor data (best effort, volatile), and better where every publisher offers
    better: a driver is heard whatever it offers, and a replay that is reliable loses nothing.

    Parameters
    ----------
    node : Node
    kind : type
        Message class.
    topic : str
        Relative name; remappings hold.
    handler : callable
        Takes the message, and its info where it has a second argument.
    depth : int
    raw : bool
        Give serialised bytes.
    polled : CallbackGroup, optional
        Leave the messages to :meth:`drain`; the handler then takes the info too.
    """

    def __init__(
        self,
        node: Node,
        kind: Any,
        topic: str,
        handler: Callable[..., None],
        depth: int,
        raw: bool = False,
        polled: PolledCallbackGroup | None = None,
    ) -> None:
        self._node = node
        self._kind = kind
        self._topic = topic
        self._handler = handler
        self._depth = depth
        self._raw = raw
        self._polled = polled
        self._key: tuple[str, bool, bool] | None = None
        self._subscription: Subscription | None = None
        self.reliable = True
        self.wrong_type = ""

    def look(self) -> bool:
        """Look who publishes; return whether anybody does."""
        offer = read_offer(self._node, self._node.resolve_topic_name(self._topic))
        if offer is None:
            return False
        if offer.key == self._key:
            return True
        self._key = offer.key
        expected = _type_name(self._kind)
        self.wrong_type = "" if offer.msg_type == expected else f"is {offer.msg_type}, expected {expected}"
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
            self._subscription = None
        if not self.wrong_type:
            self.reliable = offer.reliable
            self._subscription = self._node.create_subscription(
                self._kind,
                self._topic,
                self._handler,
                wanted_qos(offer, self._depth),
                callback_group=self._polled,
                raw=self._raw,
                qos_overriding_options=overridable() if self._is_overridden() else None,
            )
        return True

    def _is_overridden(self) -> bool:
        """Whether parameters ``qos_overrides.TOPIC.subscription`` ask for a quality, whatever is offered."""
        topic = self._node.resolve_topic_name(self._topic)
        return bool(self._node.get_parameters_by_prefix(f"qos_overrides.{topic}.subscription"))

    def drain(self, most: int | None = None) -> int:
        """Hand on what has arrived, where the subscription is polled; at most what it holds."""
        if self._polled is None or self._subscription is None:
            return 0
        return drain(self._subscription, self._handler, self._depth if most is None else most)


#: Kind, our topic, handler, depth, raw.
Wanted = tuple[Any, str, Callable[..., None], int, bool]


def follow_offers(
    node: Node, wanted: Iterable[Wanted], polled: Collection[str] = ()
) -> dict[str, OfferedSubscription]:
    """Subscribe to topics as they are offered, looking again and again; return them by topic.

    Those of ``polled`` are left to their ``drain``.
    """
    group = PolledCallbackGroup() if polled else None
    found = {
        topic: OfferedSubscription(
            node, kind, relative(topic), handler, depth, raw, group if topic in polled else None
        )
        for kind, topic, handler, depth, raw in wanted
    }

    def look() -> None:
        for topic, subscription in found.items():
            subscription.look()
            if subscription.wrong_type:
                node.get_logger().error(
                    f"{topic} {subscription.wrong_type}; remap the right topic", throttle_duration_sec=10.0
                )

    node.create_timer(LOOK_INTERVAL, look, clock=Clock(clock_type=ClockType.STEADY_TIME))
    return found


def _type_name(kind: Any) -> str:
    package, folder = kind.__module__.split(".")[:2]
    return f"{package}/{folder}/{kind.__name__}"
