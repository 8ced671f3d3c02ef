"""A subscription that takes what is offered: reliable where the publisher is, best effort where not."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.subscription import Subscription

from subiaco_mapping.nodes.offers import read_offer, wanted_qos


class OfferedSubscription:
    """Subscribe as soon as somebody publishes, and anew where the offer changes.

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
    """

    def __init__(
        self, node: Node, kind: Any, topic: str, handler: Callable[..., None], depth: int, raw: bool = False
    ) -> None:
        self._node = node
        self._kind = kind
        self._topic = topic
        self._handler = handler
        self._depth = depth
        self._raw = raw
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
                self._kind, self._topic, self._handler, wanted_qos(offer, self._depth), raw=self._raw
            )
        return True


LOOK_INTERVAL = 0.2

#: Kind, our topic, handler, depth, raw.
Wanted = tuple[Any, str, Callable[..., None], int, bool]


def follow_offers(node: Node, wanted: Iterable[Wanted]) -> dict[str, OfferedSubscription]:
    """Subscribe to topics as they are offered, looking again and again; return them by topic."""
    found = {
        topic: OfferedSubscription(node, kind, topic.lstrip("/"), handler, depth, raw)
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
