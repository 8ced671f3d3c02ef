"""Every node of the graph through its states: configured twice, and shut down from each of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.ros

NAMES = ("replay", "odometry", "pose_graph", "monitor", "recorder", "change", "foxglove")


class NoServer:
    """Serves nobody."""

    port = 0

    def __init__(self, *_place: Any) -> None:
        self.stopped = False

    def open(self, *_topic: Any) -> Any:
        """Offer a topic."""
        return self

    def log(self, *_message: Any, **_times: Any) -> None:
        """Take a message."""

    def events(self) -> list[Any]:
        """Nobody looks."""
        return []

    def stop(self) -> None:
        """Stop."""
        self.stopped = True


@pytest.fixture
def make(ros: Any, tmp_path: Path) -> Iterator[Callable[[str], Any]]:
    """Make a node of ours as its process does, unconfigured."""
    from subiaco_bringup.nodes.foxglove_node import make_build
    from subiaco_change.nodes.change_node import build as change
    from subiaco_mapping.nodes import monitor_node, odometry_node, pose_graph_node, recorder_node, replay_node

    with ExitStack() as stack:
        makers: dict[str, tuple[Any, dict[str, Any]]] = {
            "replay": (replay_node.build, {"bags": [str(tmp_path / "bag")]}),
            "odometry": (odometry_node.build, {}),
            "pose_graph": (
                stack.enter_context(pose_graph_node.building()),
                {"output_directory": str(tmp_path / "map")},
            ),
            "monitor": (monitor_node.build, {"output_directory": str(tmp_path)}),
            "recorder": (
                recorder_node.build,
                {"output": str(tmp_path / "drive"), "resume": True, "record__stop_free_gb": 0.0},
            ),
            "change": (partial(change, write_pages=lambda *_, **__: None), {}),
            "foxglove": (make_build(NoServer), {}),
        }

        def made(name: str) -> Any:
            build, given = makers[name]
            node = ros.managed(name, build, autostart=False, **given)
            stack.callback(node.put_away)
            return node

        yield made


def entities(node: Any) -> dict[str, int]:
    """Count what a node has in the middleware."""
    kinds = ("publishers", "subscriptions", "services", "clients", "timers", "waitables")
    return {kind: len(list(getattr(node, kind))) for kind in kinds}


@pytest.mark.parametrize("name", NAMES)
def test_a_node_that_was_cleaned_up_leaves_nothing_and_can_be_configured_again(
    ros: Any, make: Callable[[str], Any], name: str
) -> None:
    from rclpy.lifecycle import TransitionCallbackReturn
    from rclpy.parameter import Parameter

    node = make(name)
    fresh = entities(node)
    for _ in range(2):
        assert node.trigger_configure() == TransitionCallbackReturn.SUCCESS, node.failure
        assert entities(node) != fresh
        for parameter in ("autostart", "use_sim_time"):
            asked = Parameter(parameter, value=not node.get_parameter(parameter).value)
            answer = node.set_parameters_atomically([asked])
            assert (answer.successful, answer.reason) == (
                False, f"{parameter} is read-only: give it when the process starts"
            )  # fmt: skip
        assert node.trigger_activate() == TransitionCallbackReturn.SUCCESS, node.failure
        if name != "replay":  # its bag is not there
            node.step()
        for _ in range(3):
            ros.executor.spin_once(timeout_sec=0.01)
        assert node.trigger_deactivate() == TransitionCallbackReturn.SUCCESS, node.failure
        assert node.trigger_cleanup() == TransitionCallbackReturn.SUCCESS, node.failure
        assert node.app is None
        assert entities(node) == fresh


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("state", ["unconfigured", "inactive", "active"])
def test_a_node_is_shut_down_from_every_state(
    ros: Any, make: Callable[[str], Any], name: str, state: str
) -> None:
    from rclpy.lifecycle import TransitionCallbackReturn

    node = make(name)
    fresh = entities(node)
    steps = {"unconfigured": (), "inactive": (node.trigger_configure,)}
    for trigger in steps.get(state, (node.trigger_configure, node.trigger_activate)):
        assert trigger() == TransitionCallbackReturn.SUCCESS, node.failure
    ros.executor.spin_once(timeout_sec=0.0)
    assert node.trigger_shutdown() == TransitionCallbackReturn.SUCCESS, node.failure
    assert node.finished
    assert entities(node) == fresh
    ros.executor.spin_once(timeout_sec=0.0)
