"""Nodes are configured, activated, deactivated and cleaned up through the services of lifecycle_msgs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from pydantic import Field

from subiaco_geo.config import StrictModel
from subiaco_geo.errors import InputError

pytestmark = pytest.mark.ros

CONFIGURE, CLEAN_UP, ACTIVATE, DEACTIVATE, SHUT_DOWN_INACTIVE = 1, 2, 3, 4, 6


class Own(StrictModel):
    """Parameters of a node."""

    depth: int = Field(5, gt=0, le=100, description="Messages that are kept")
    rate: float = Field(1.0, ge=0, description="Speed", json_schema_extra={"dynamic": True})


class Echo:
    """Counts messages, answers on another topic, and keeps what happened to it."""

    def __init__(self, node: Any) -> None:
        from std_msgs.msg import String
        from std_srvs.srv import Trigger

        from subiaco_ros.parameters import read_models
        from subiaco_ros.qos import reliable

        self.own, _ = read_models(node, Own)
        self.heard: list[str] = []
        self.steps = 0
        self.closed = 0
        self.done = False
        self._out = node.create_publisher(String, "out", reliable(10))
        node.create_subscription(String, "in", self._on_message, reliable(self.own.depth))
        node.create_service(Trigger, "ping", lambda _request, response: response)
        node.create_timer(0.01, lambda: None)

    def _on_message(self, message: Any) -> None:
        self.heard.append(message.data)
        self._out.publish(message)

    def step(self) -> float:
        """Count the steps."""
        self.steps += 1
        return 0.01

    def reconfigure(self, values: dict[str, Any]) -> None:
        """Take a new speed."""
        if values["rate"] > 10:
            raise InputError("rate: at most 10 while a bag is played")
        self.own = self.own.model_copy(update=values)

    def close(self) -> None:
        """Put away."""
        self.closed += 1


class Bench:
    """A managed node, and a tester that calls its services."""

    def __init__(self, ros: Any, build: Callable[[Any], Any], **parameters: Any) -> None:
        from lifecycle_msgs.srv import ChangeState, GetState
        from std_msgs.msg import String

        from subiaco_ros.qos import reliable

        self.ros = ros
        self.node = ros.managed("echo", build, **parameters)
        ros.apps.append(self)
        user = self.user = ros.node("tester")
        self._change = user.create_client(ChangeState, "echo/change_state")
        self._state = user.create_client(GetState, "echo/get_state")
        self.out = ros.collect(user, String, "out", latched=False)
        self.send = user.create_publisher(String, "in", reliable(100))

    @property
    def done(self) -> bool:
        """The process would end."""
        return bool(self.node.finished)

    def step(self) -> float:
        """As the loop of a process does."""
        return float(self.node.step())

    def call(self, client: Any, request: Any) -> Any:
        """Call a service of the node."""
        self.ros.until(client.service_is_ready)
        future = client.call_async(request)
        self.ros.until(future.done)
        return future.result()

    def change(self, number: int) -> bool:
        """Ask for a transition."""
        from lifecycle_msgs.msg import Transition
        from lifecycle_msgs.srv import ChangeState

        return bool(self.call(self._change, ChangeState.Request(transition=Transition(id=number))).success)

    def state(self) -> str:
        """Ask for the state."""
        from lifecycle_msgs.srv import GetState

        return str(self.call(self._state, GetState.Request()).current_state.label)

    def publish(self, text: str) -> None:
        """Send one message."""
        from std_msgs.msg import String

        self.send.publish(String(data=text))

    def topics(self) -> list[str]:
        """Return what the node subscribes to and publishes for its app."""
        found = self.node.get_subscriber_names_and_types_by_node("echo", "/")
        found += self.node.get_publisher_names_and_types_by_node("echo", "/")
        return sorted(name for name, _ in found if name in ("/in", "/out"))


def test_a_node_goes_through_its_states_and_works_only_while_active(ros: Any) -> None:
    made: list[Echo] = []

    def build(node: Any) -> Echo:
        made.append(Echo(node))
        return made[-1]

    bench = Bench(ros, build, autostart=False)
    bench.node.start()
    assert bench.state() == "unconfigured"
    assert made == []
    assert bench.topics() == []
    assert not bench.change(ACTIVATE)  # not before it is configured

    assert bench.change(CONFIGURE)
    assert bench.state() == "inactive"
    ros.until(lambda: bench.topics() == ["/in", "/out"])
    ros.until(bench.send.get_subscription_count)
    bench.publish("while inactive")
    for _ in range(20):
        ros.executor.spin_once(timeout_sec=0.01)
    assert (made[0].heard, made[0].steps) == ([], 0)

    assert bench.change(ACTIVATE)
    assert bench.state() == "active"
    ros.until(lambda: len(bench.out) == 1)  # the message waited in the middleware
    bench.publish("while active")
    ros.until(lambda: made[0].heard == ["while inactive", "while active"])
    assert made[0].steps > 0

    assert bench.change(DEACTIVATE)
    steps = made[0].steps
    bench.publish("later")
    for _ in range(20):
        ros.executor.spin_once(timeout_sec=0.01)
    assert (len(made[0].heard), made[0].steps) == (2, steps)

    assert bench.change(CLEAN_UP)
    assert bench.state() == "unconfigured"
    assert made[0].closed == 1
    ros.until(lambda: bench.topics() == [])
    assert bench.change(CONFIGURE)
    assert bench.change(ACTIVATE)
    assert len(made) == 2
    ros.until(bench.send.get_subscription_count)
    bench.publish("again")
    ros.until(lambda: made[1].heard == ["again"])
    assert bench.change(DEACTIVATE)
    assert bench.change(SHUT_DOWN_INACTIVE)
    assert made[1].closed == 1
    assert bench.node.finished


def test_what_could_not_be_put_away_at_shutdown_is_the_end_of_the_process_and_an_old_fault_is_not(
    ros: Any,
) -> None:
    from rclpy.parameter import Parameter

    class Stuck(Echo):
        def close(self) -> None:
            raise InputError("/disk: the file cannot be closed")

    whole = Bench(ros, Echo, autostart=False, depth=200)
    assert not whole.change(CONFIGURE)
    whole.node.set_parameters([Parameter("depth", value=20)])
    assert whole.change(CONFIGURE)
    whole.node.trigger_shutdown()
    assert whole.node.finished
    ros.apps.clear()
    stuck = ros.managed("stuck", Stuck)
    stuck.start()
    stuck.trigger_shutdown()
    with pytest.raises(InputError, match="/disk: the file cannot be closed"):
        assert stuck.finished
    assert stuck.app is None


def test_a_node_starts_by_itself_unless_autostart_is_false(ros: Any) -> None:
    bench = Bench(ros, Echo)
    bench.node.start()
    assert bench.node.active
    assert bench.state() == "active"
    ros.until(bench.send.get_subscription_count)
    bench.publish("one")
    ros.until(lambda: len(bench.out) == 1)


def test_parameters_at_fault_leave_a_node_unconfigured_until_they_are_mended(ros: Any) -> None:
    from rclpy.parameter import Parameter

    bench = Bench(ros, Echo, autostart=False, depth=200)
    assert not bench.change(CONFIGURE)
    assert bench.state() == "unconfigured"
    assert isinstance(bench.node.failure, InputError)
    assert "depth" in str(bench.node.failure)
    (result,) = bench.node.set_parameters([Parameter("depth", value=20)])
    assert result.successful
    assert bench.change(CONFIGURE)
    assert bench.node.app.own.depth == 20


def test_a_start_that_fails_raises_the_reason(ros: Any) -> None:
    bench = Bench(ros, Echo, depth=200)
    with pytest.raises(InputError, match="depth"):
        bench.node.start()
    assert bench.topics() == []


def test_parameters_are_read_only_while_configured_except_dynamic_ones(ros: Any) -> None:
    from rclpy.parameter import Parameter

    bench = Bench(ros, Echo)
    bench.node.start()
    refused = bench.node.set_parameters_atomically([Parameter("depth", value=7)])  # as its service does
    assert (refused.successful, bench.node.app.own.depth) == (False, 5)
    assert refused.reason.startswith("depth is read-only: the node has read it; deactivate and clean up")
    refused = bench.node.set_parameters_atomically([Parameter("autostart", value=False)])
    assert refused.reason == "autostart is read-only: give it when the process starts"
    (rate,) = bench.node.set_parameters([Parameter("rate", value=2.5)])
    assert rate.successful
    assert bench.node.app.own.rate == 2.5
    (refused,) = bench.node.set_parameters([Parameter("rate", value=11.0)])
    assert (refused.successful, refused.reason) == (False, "rate: at most 10 while a bag is played")
    assert bench.node.get_parameter("rate").value == 2.5
    assert bench.change(DEACTIVATE)
    assert bench.change(CLEAN_UP)
    (depth,) = bench.node.set_parameters([Parameter("depth", value=7)])
    assert depth.successful
    assert bench.change(CONFIGURE)
    assert (bench.node.app.own.depth, bench.node.app.own.rate) == (7, 2.5)
