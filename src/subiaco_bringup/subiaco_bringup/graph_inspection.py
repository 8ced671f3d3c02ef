"""What runs in a ROS domain: nodes, topics with quality of service and rates, parameters, frames.

The wheels have no ``ros2`` command. :func:`inspect` starts this module as a process in the environment of the
nodes, and the process prints one JSON document.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from importlib import import_module
from typing import Any

from subiaco_geo.errors import InputError, SubiacoError

#: Until nodes on one busy host have found each other [s].
DISCOVERY = 2.0
_SERVICE_TIMEOUT = 3.0
_OWN_NAME = "_subiaco_graph"  # a leading underscore hides a node from the usual lists
_BATCH = 64


def inspect(environment: Mapping[str, str], request: Mapping[str, Any]) -> dict[str, Any]:
    """Ask what runs in the domain of an environment.

    Parameters
    ----------
    environment : mapping
        See :func:`subiaco_bringup.environment.node_environment`.
    request : mapping
        ``what``: ``graph`` (with ``seconds`` over which rates are counted, and ``topics``, all where empty),
        ``parameters`` (with ``node``) or ``frames`` (with ``seconds``).

    Raises
    ------
    InputError
        A node of the request does not run, or does not answer.
    SubiacoError
        ROS does not start.
    """
    command = [sys.executable, "-m", "subiaco_bringup.graph_inspection", json.dumps(dict(request))]
    finished = subprocess.run(
        command, env=dict(environment), capture_output=True, text=True, check=False, timeout=120
    )
    last = finished.stderr.strip().splitlines()[-1:] or ["it said nothing"]
    if finished.returncode == InputError.exit_code:
        raise InputError(last[0])
    if finished.returncode != 0:
        raise SubiacoError(f"the graph could not be inspected: {last[0]}")
    return dict(json.loads(finished.stdout.splitlines()[-1]))


class Inspector:
    """A hidden node that looks at the others.

    Parameters
    ----------
    node : rclpy.node.Node
    spin : callable
        Handles callbacks for at most so many seconds.
    """

    def __init__(self, node: Any, spin: Callable[[float], None]) -> None:
        self._node = node
        self._spin = spin

    def discover(self, seconds: float = DISCOVERY) -> None:
        """Wait until the other nodes are known."""
        self._spin_for(seconds)

    def nodes(self) -> list[str]:
        """Return the full names of the nodes, this one left out."""
        found = self._node.get_node_names_and_namespaces()
        full = {f"{namespace.rstrip('/')}/{name}" for name, namespace in found}
        return sorted(name for name in full if not name.rsplit("/", 1)[1].startswith("_"))

    def states(self) -> dict[str, str]:
        """Return the lifecycle state of every managed node."""
        services = dict(self._node.get_service_names_and_types())
        found = {}
        for name in self.nodes():
            if f"{name}/get_state" in services:
                answer = self._call("lifecycle_msgs.srv:GetState", f"{name}/get_state")
                found[name] = "no answer" if answer is None else str(answer.current_state.label)
        return found

    def topics(self) -> dict[str, dict[str, Any]]:
        """Return type, publishers and subscriptions of every topic."""
        found = {}
        for topic, types in sorted(self._node.get_topic_names_and_types()):
            ends = {
                "publishers": self._node.get_publishers_info_by_topic(topic),
                "subscriptions": self._node.get_subscriptions_info_by_topic(topic),
            }
            found[topic] = {"type": types[0]} | {
                side: [_endpoint(end) for end in given if not end.node_name.startswith("_subiaco")]
                for side, given in ends.items()
            }
        return found

    def services(self) -> dict[str, str]:
        """Return the type of every service that is not part of each node."""
        found = dict(self._node.get_service_names_and_types())
        return {name: types[0] for name, types in sorted(found.items()) if not _is_common(name)}

    def rates(self, topics: Mapping[str, Mapping[str, Any]], seconds: float) -> dict[str, dict[str, float]]:
        """Count messages and bytes of topics that are published, for some seconds.

        Returns
        -------
        dict
            By topic: ``rate_hz``, ``kilobytes_s``.
        """
        counts: Counter[str] = Counter()
        sizes: Counter[str] = Counter()
        subscriptions = [
            self._count(topic, facts["type"], facts["publishers"], counts, sizes)
            for topic, facts in topics.items()
            if facts["publishers"]
        ]
        began = time.monotonic()
        self._spin_for(seconds)
        took = time.monotonic() - began
        for subscription in filter(None, subscriptions):
            self._node.destroy_subscription(subscription)
        return {
            topic: {"rate_hz": counts[topic] / took, "kilobytes_s": sizes[topic] / took / 1e3}
            for topic in topics
        }

    def parameters(self, name: str) -> list[dict[str, Any]]:
        """Return name, value, unit and meaning of every parameter of a node.

        Raises
        ------
        InputError
            The node does not run, or does not answer.
        """
        from rclpy.parameter import parameter_value_to_python

        if name not in self.nodes():
            raise InputError(f"{name}: no such node runs in this domain; 'subiaco graph list' shows them")
        listed = self._call("rcl_interfaces.srv:ListParameters", f"{name}/list_parameters")
        if listed is None:
            raise InputError(f"{name}: does not answer; the node may be busy, ask again")
        names = sorted(listed.result.names)
        rows: list[dict[str, Any]] = []
        for first in range(0, len(names), _BATCH):
            batch = names[first : first + _BATCH]
            values = self._call("rcl_interfaces.srv:GetParameters", f"{name}/get_parameters", names=batch)
            described = self._call(
                "rcl_interfaces.srv:DescribeParameters", f"{name}/describe_parameters", names=batch
            )
            if values is None or described is None:
                raise InputError(f"{name}: does not answer; the node may be busy, ask again")
            for key, value, text in zip(batch, values.values, described.descriptors, strict=True):
                given = parameter_value_to_python(value)
                rows.append(
                    {
                        "name": key,
                        "value": list(given) if hasattr(given, "tolist") else given,
                        "description": text.description,
                        "constraints": text.additional_constraints,
                        "read_only": text.read_only,
                    }
                )
        return rows

    def frames(self, seconds: float) -> list[dict[str, Any]]:
        """Return every transform that comes in some seconds: parent, child, rate, position [m]."""
        from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

        from tf2_msgs.msg import TFMessage

        found: dict[tuple[str, str], dict[str, Any]] = {}

        def take(message: TFMessage, *, fixed: bool) -> None:
            for item in message.transforms:
                key = (item.header.frame_id, item.child_frame_id)
                place = item.transform.translation
                row = found.setdefault(key, {"parent": key[0], "child": key[1], "count": 0})
                row["count"] += 1
                row["fixed"] = fixed
                row["position"] = [place.x, place.y, place.z]

        profiles = (("/tf", DurabilityPolicy.VOLATILE), ("/tf_static", DurabilityPolicy.TRANSIENT_LOCAL))
        for topic, durability in profiles:
            fixed = topic == "/tf_static"
            profile = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=durability)
            self._node.create_subscription(TFMessage, topic, lambda m, f=fixed: take(m, fixed=f), profile)
        self._spin_for(seconds)
        rows = sorted(found.values(), key=lambda row: (row["parent"], row["child"]))
        return [{**row, "rate_hz": None if row["fixed"] else row["count"] / seconds} for row in rows]

    def _count(
        self,
        topic: str,
        msg_type: str,
        publishers: Iterable[Mapping[str, Any]],
        counts: Counter[str],
        sizes: Counter[str],
    ) -> Any:
        from rclpy.qos import QoSProfile, ReliabilityPolicy

        kind = _message_class(msg_type)
        if kind is None:
            return None

        def take(raw: bytes) -> None:
            counts[topic] += 1
            sizes[topic] += len(raw)

        reliable = all(end["reliability"] == "reliable" for end in publishers)
        quality = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
        return self._node.create_subscription(
            kind, topic, take, QoSProfile(depth=1000, reliability=quality), raw=True
        )

    def _call(self, kind: str, name: str, **fields: Any) -> Any:
        """Call a service; None where no answer comes in time."""
        module, _, attribute = kind.partition(":")
        service = getattr(import_module(module), attribute)
        client = self._node.create_client(service, name)
        deadline = time.monotonic() + _SERVICE_TIMEOUT
        while not client.service_is_ready() and time.monotonic() < deadline:
            self._spin(0.02)
        future = client.call_async(service.Request(**fields))
        while not future.done() and time.monotonic() < deadline:
            self._spin(0.02)
        answer = future.result() if future.done() else None
        self._node.destroy_client(client)
        return answer

    def _spin_for(self, seconds: float) -> None:
        deadline = time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0:
            self._spin(min(left, 0.05))


def _endpoint(end: Any) -> dict[str, Any]:
    quality = end.qos_profile
    return {
        "node": f"{end.node_namespace.rstrip('/')}/{end.node_name}",
        "reliability": quality.reliability.name.lower(),
        "durability": quality.durability.name.lower(),
        "depth": quality.depth,
    }


_COMMON_SERVICES = (
    "describe_parameters", "get_parameter_types", "get_parameters", "list_parameters", "set_parameters",
    "set_parameters_atomically", "get_type_description", "change_state", "get_state", "get_available_states",
    "get_available_transitions", "get_transition_graph", "get_logger_levels", "set_logger_levels",
)  # fmt: skip


def _is_common(service: str) -> bool:
    return service.rsplit("/", 1)[1] in _COMMON_SERVICES or "/_action/" in service


def _message_class(msg_type: str) -> Any:
    package, folder, name = msg_type.split("/")
    try:
        return getattr(import_module(f"{package}.{folder}"), name)
    except (ImportError, AttributeError):
        return None


def answer(inspector: Inspector, request: Mapping[str, Any]) -> dict[str, Any]:
    """Answer one request of :func:`inspect`."""
    seconds = float(request.get("seconds", 0.0))
    if request["what"] == "parameters":
        return {"parameters": inspector.parameters(str(request["node"]))}
    if request["what"] == "frames":
        return {"frames": inspector.frames(seconds)}
    topics = inspector.topics()
    chosen = {name: facts for name, facts in topics.items() if name in (request.get("topics") or topics)}
    rates = inspector.rates(chosen, seconds) if seconds else {}
    return {
        "nodes": inspector.nodes(),
        "states": inspector.states(),
        "topics": {name: facts | rates.get(name, {}) for name, facts in topics.items()},
        "services": inspector.services(),
    }


def main() -> int:
    """Answer the request given as the only argument, on standard output."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor

    rclpy.init()
    node = rclpy.create_node(_OWN_NAME, start_parameter_services=False)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    inspector = Inspector(node, lambda seconds: executor.spin_once(timeout_sec=seconds))
    try:
        inspector.discover()
        document = answer(inspector, json.loads(sys.argv[1]))
    except InputError as error:
        sys.stderr.write(f"{error}\n")
        return error.exit_code
    finally:
        rclpy.try_shutdown()
    sys.stdout.write(json.dumps(document) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
