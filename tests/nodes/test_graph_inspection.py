"""What runs in a domain is shown without the ros2 command: nodes, topics, parameters, frames."""

from __future__ import annotations

import os
from typing import Any

import pytest
from pydantic import Field

from subiaco_bringup.cli import commands_graph_inspection as verbs
from subiaco_geo.config import StrictModel
from subiaco_geo.errors import InputError

pytestmark = pytest.mark.ros


class Own(StrictModel):
    """Parameters of a node."""

    rate: float = Field(2.0, ge=0, description="Speed of the replay")


@pytest.fixture
def inspector(ros: Any) -> Any:
    from subiaco_bringup.graph_inspection import Inspector

    node = ros.node("_subiaco_graph")
    return Inspector(node, lambda seconds: ros.executor.spin_once(timeout_sec=seconds))


def test_topics_show_type_quality_of_service_and_rate(ros: Any, inspector: Any) -> None:
    from sensor_msgs.msg import Imu

    from subiaco_bringup.graph_inspection import answer
    from subiaco_ros.qos import latched, reliable

    probe = ros.node("probe")
    imu = probe.create_publisher(Imu, "imu/data", reliable(10))
    probe.create_publisher(Imu, "kept", latched(1))
    probe.create_timer(0.05, lambda: imu.publish(Imu()))
    inspector.discover(0.5)
    found = answer(inspector, {"what": "graph", "seconds": 1.0})
    assert found["nodes"] == ["/probe"]
    shown = found["topics"]["/imu/data"]
    assert shown["type"] == "sensor_msgs/msg/Imu"
    (offered,) = shown["publishers"]
    assert (offered["node"], offered["reliability"]) == ("/probe", "reliable")
    assert offered["durability"] == "volatile"
    assert 0 < shown["rate_hz"] < 25  # sent at 20 Hz; a busy machine is slower
    text = verbs.graph_text(found)
    line = next(line for line in text.splitlines() if line.startswith("/imu/data"))
    assert "reliable" in line
    assert line.endswith("Hz")
    assert "reliable, latched" in next(line for line in text.splitlines() if line.startswith("/kept"))
    assert "/probe" in verbs.topic_text("/imu/data", shown)
    assert "/imu/data" in verbs.node_text("/probe", found)


def test_parameters_show_value_bounds_and_meaning(ros: Any, inspector: Any) -> None:
    from subiaco_ros.parameters import read_models

    read_models(ros.node("probe", rate=3.0), Own)
    inspector.discover(0.5)
    rows = {row["name"]: row for row in inspector.parameters("/probe")}
    assert rows["rate"] == {
        "name": "rate", "value": 3.0, "description": "Speed of the replay", "constraints": "at least 0",
        "read_only": True,
    }  # fmt: skip
    with pytest.raises(InputError, match="/nobody: no such node"):
        inspector.parameters("/nobody")


def test_frames_make_a_tree_with_rates(ros: Any, inspector: Any) -> None:
    import numpy as np

    from subiaco_ros.messages import transform_message
    from subiaco_ros.qos import latched, reliable
    from tf2_msgs.msg import TFMessage

    probe = ros.node("probe")
    moved = np.eye(4)
    moved[:3, 3] = [1.0, 2.0, 0.5]
    fixed = probe.create_publisher(TFMessage, "tf_static", latched(1))
    fixed.publish(TFMessage(transforms=[transform_message(moved, "base_link", "lidar_link", 0)]))
    tf = probe.create_publisher(TFMessage, "tf", reliable(10))
    moving = TFMessage(transforms=[transform_message(np.eye(4), "odom", "base_link", 0)])
    probe.create_timer(0.05, lambda: tf.publish(moving))
    rows = inspector.frames(1.0)
    assert [(row["parent"], row["child"], row["fixed"]) for row in rows] == [
        ("base_link", "lidar_link", True),
        ("odom", "base_link", False),
    ]
    lines = verbs.frames_text(rows).splitlines()
    assert lines[0] == "odom"
    assert lines[1].startswith("  base_link  (")
    assert "Hz" in lines[1]
    assert lines[2] == "    lidar_link  (fixed; at 1.00, 2.00, 0.50 m in base_link)"


def test_an_empty_domain_says_so_and_a_missing_node_is_bad_input(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("subiaco_msgs.msg", reason="workspace not sourced: source ros2_ws/env.sh")
    import domain_coordinator
    from ros_harness import next_domain

    from subiaco_bringup.cli.main import run

    held = domain_coordinator.domain_id(next_domain)
    domain = str(held.__enter__())
    os.environ.setdefault("ROS_LOG_DIR", "/tmp/subiaco-test-logs")
    assert run(["graph", "list", "--domain", domain, "--seconds", "0"]) == 0
    assert "no node runs in this ROS domain" in capsys.readouterr().out
    assert run(["graph", "param", "odometry", "--domain", domain]) == 2
    assert "/odometry: no such node runs" in capsys.readouterr().err
    held.__exit__(None, None, None)
