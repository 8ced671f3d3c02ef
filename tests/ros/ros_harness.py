"""A ROS context of its own for every test, spun until something holds, never slept."""

from __future__ import annotations

import gc
import itertools
import os
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

#: Numbers of domains in turn: what a test leaves behind is gone before its domain comes round again.
_IN_TURN = itertools.cycle(range(1, 101))


def next_domain() -> int:
    """Return the number of the next domain that no worker of the session has for itself."""
    taken = set(map(int, os.environ.get("SUBIACO_TEST_DOMAINS", "").split()))
    return next(number for number in _IN_TURN if number not in taken)


class Harness:
    """Nodes of one test in one single-threaded executor, in a context and domain of their own."""

    def __init__(self) -> None:
        import domain_coordinator
        import rclpy
        from rclpy.executors import SingleThreadedExecutor

        self._held = domain_coordinator.domain_id(next_domain)
        self.context = rclpy.Context()
        self.context.init(domain_id=self._held.__enter__())
        self.executor = SingleThreadedExecutor(context=self.context)
        self._nodes: list[Any] = []
        self.apps: list[Any] = []

    def node(self, name: str, *, namespace: str = "", **parameters: Any) -> Any:
        """Make a node with parameters as a params file would give them; ``a__b`` means ``a.b``."""
        from rclpy.node import Node

        options = self._options(parameters)
        declared = {"automatically_declare_parameters_from_overrides": True}
        return self._added(Node(name, namespace=namespace, **declared, **options))

    def managed(
        self, name: str, build: Callable[[Any], Any], *, namespace: str = "", **parameters: Any
    ) -> Any:
        """Make a lifecycle node around an app, as a node process does."""
        from subiaco_ros.managed_node import ManagedNode

        return self._added(ManagedNode(name, build, namespace=namespace, **self._options(parameters)))

    def _options(self, parameters: dict[str, Any]) -> dict[str, Any]:
        from rclpy.parameter import Parameter

        overrides = [Parameter(key.replace("__", "."), value=value) for key, value in parameters.items()]
        return {"context": self.context, "parameter_overrides": overrides}

    def _added(self, node: Any) -> Any:
        self.executor.add_node(node)
        self._nodes.append(node)
        return node

    def collect(self, node: Any, kind: Any, topic: str, depth: int = 100, latched: bool = True) -> list[Any]:
        """Subscribe; return the list that fills up."""
        from subiaco_ros import qos

        received: list[Any] = []
        profile = qos.latched(depth) if latched else qos.reliable(depth)
        node.create_subscription(kind, topic, received.append, profile)
        return received

    def until(self, condition: Callable[[], Any], timeout: float = 20.0) -> None:
        """Spin, stepping the apps, until a condition holds; fail after a timeout [s]."""
        deadline = time.monotonic() + timeout
        while not condition():
            assert time.monotonic() < deadline, "what was awaited did not come in time"
            waits = [app.step() for app in self.apps if not app.done]
            self.executor.spin_once(timeout_sec=min([0.05, *waits]))

    def close(self) -> None:
        """Leave nothing behind: the next test may get the same domain."""
        self.executor.shutdown()
        for node in self._nodes:
            node.destroy_node()
        self._nodes.clear()
        self.apps.clear()
        gc.collect()  # action clients and servers keep their node in the domain until they are collected
        self.context.try_shutdown()
        self._held.__exit__(None, None, None)


@pytest.fixture
def ros() -> Iterator[Harness]:
    """Give a harness; skip, with the reason, where the workspace is not sourced."""
    pytest.importorskip("subiaco_msgs.msg", reason="workspace not sourced: source ros2_ws/env.sh")
    os.environ.setdefault("ROS_LOG_DIR", "/tmp/subiaco-test-logs")
    harness = Harness()
    yield harness
    harness.close()
