"""The table of topics says what the nodes do: every node runs, and is compared with its rows."""

from __future__ import annotations

import json
import re
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import yaml

from subiaco_bringup.topic_table import LATCHED, OFFERED, RELIABLE, SERVICES, TOPICS

BRINGUP = Path(__file__).resolve().parents[2] / "src" / "subiaco_bringup"
ROWS = {row.name: row for row in TOPICS}
#: Nodes that the table describes; topics that it does not list, such as /rosout, belong to ROS.
NODES = ("replay", "odometry", "pose_graph", "monitor", "recorder", "change")

#: Of every node, whatever it does.
OWN = re.compile(r"^/(rosout|parameter_events|clock|\w+/transition_event|.*/_action/\w+)$")


def built(ros: Any, tmp_path: Path) -> dict[str, Any]:
    """Start every node of the graph, as its process does."""
    from subiaco_change.nodes.change_node import build as change
    from subiaco_mapping.config import MappingConfig
    from subiaco_mapping.nodes import monitor_node, odometry_node, recorder_node, replay_node
    from subiaco_mapping.nodes.pose_graph_node import PoseGraphApp, PoseGraphParameters
    from subiaco_ros.parameters import read_models

    def pose_graph(node: Any) -> Any:
        own, config = read_models(node, PoseGraphParameters, MappingConfig)
        return PoseGraphApp(node, own, config, object())  # type: ignore[arg-type]

    makers: dict[str, tuple[Any, dict[str, Any]]] = {
        "replay": (replay_node.build, {"bags": [str(tmp_path / "bag")]}),
        "odometry": (odometry_node.build, {}),
        "pose_graph": (pose_graph, {}),
        "monitor": (monitor_node.build, {}),
        "recorder": (recorder_node.build, {"output": str(tmp_path / "drive")}),
        "change": (partial(change, write_pages=lambda *_, **__: None), {}),
    }
    nodes = {name: ros.managed(name, make, **given) for name, (make, given) in makers.items()}
    for node in nodes.values():
        node.start()
    return nodes


@pytest.fixture
def graph(ros: Any, tmp_path: Path) -> Any:
    nodes = built(ros, tmp_path)
    assert tuple(nodes) == NODES
    drivers = ros.node("driver")
    for row in TOPICS:
        if "driver" in row.publishers:
            module, name = row.msg_type.replace("/", ".").rsplit(".", 1)
            drivers.create_publisher(getattr(import_module(module), name), row.name, 10)
    looked = ros.node("tester")
    # Every node looks for drivers 5 times a second and listens to all of them in the end.
    wanted = {row.name for row in TOPICS if "driver" in row.publishers and row.name != "/diagnostics"}

    def heard(name: str) -> bool:
        users = set(ROWS[name].subscribers)
        found = {end.node_name for end in looked.get_subscriptions_info_by_topic(name)}
        return users <= found

    for app in (node for node in nodes.values() if node.get_name() in ("recorder", "monitor")):
        ros.apps.append(app)
        app.done = False
    ros.until(lambda: all(heard(name) for name in wanted), timeout=30.0)
    yield looked
    for node in nodes.values():
        node.put_away()


@pytest.mark.ros
def test_every_node_publishes_and_subscribes_what_the_table_says(ros: Any, graph: Any) -> None:
    for side, listed in (("publishers", "publishers"), ("subscriptions", "subscribers")):
        ask = getattr(graph, f"get_{side}_info_by_topic")
        for name, types in graph.get_topic_names_and_types():
            nodes = {end.node_name for end in ask(name)} & set(NODES)
            if OWN.match(name) or not nodes:
                continue
            assert name in ROWS, f"{name} ({side} {nodes}) is not in the table"
            assert types == [ROWS[name].msg_type], name
            assert nodes <= set(getattr(ROWS[name], listed)), f"{name}: {side}"
    for row in TOPICS:
        published = {end.node_name for end in graph.get_publishers_info_by_topic(row.name)}
        assert set(row.publishers) & set(NODES) <= published, row.name
        subscribed = {end.node_name for end in graph.get_subscriptions_info_by_topic(row.name)}
        assert set(row.subscribers) & set(NODES) <= subscribed, row.name


@pytest.mark.ros
def test_publishers_offer_the_quality_of_service_of_the_table(ros: Any, graph: Any) -> None:
    from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

    for row in TOPICS:
        ends = [e for e in graph.get_publishers_info_by_topic(row.name) if e.node_name in NODES]
        for end in ends:
            assert end.qos_profile.reliability == ReliabilityPolicy.RELIABLE, row.name
            latched = end.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
            if row.quality != OFFERED:
                assert latched == (row.quality == LATCHED), f"{row.name} of {end.node_name}"


@pytest.mark.ros
def test_services_and_actions_are_those_of_the_table(ros: Any, graph: Any) -> None:
    found = dict(graph.get_service_names_and_types())
    for row in SERVICES:
        name = f"{row.name}/_action/send_goal" if "/action/" in row.kind else row.name
        assert any(kind.startswith(row.kind) for kind in found[name]), row.name
    ours = {name for name, kinds in found.items() if any(kind.startswith("subiaco_msgs") for kind in kinds)}
    assert {name.split("/_action/")[0] for name in ours} == {row.name for row in SERVICES}


def test_every_row_has_a_meaning_and_names_nodes_and_qualities_that_exist() -> None:
    assert len(ROWS) == len(TOPICS)
    for row in TOPICS:
        assert row.meaning.endswith("."), row.name
        assert row.rate, row.name
        assert row.quality in (RELIABLE, LATCHED, OFFERED), row.name
        assert set(row.publishers) <= {*NODES, "driver"}, row.name
        assert set(row.subscribers) <= {*NODES, "anybody"}, row.name
        of_drivers = "driver" in row.publishers and row.name not in ("/tf_static", "/diagnostics")
        assert (row.quality == OFFERED) == of_drivers, row.name


#: Topics on which several nodes speak, each about itself.
SHARED = {"/tf", "/progress", "/diagnostics", "/replay/consumed"}


def test_what_is_one_statement_about_the_world_has_one_node_that_makes_it() -> None:
    several = {row.name for row in TOPICS if len(set(row.publishers) - {"driver", "replay"}) > 1}
    assert several == SHARED


def displays(name: str) -> list[dict[str, Any]]:
    manager = yaml.safe_load((BRINGUP / "rviz" / f"{name}.rviz").read_text())["Visualization Manager"]
    return [display for display in manager["Displays"] if "Topic" in display]


#: What a display of RViz shows.
SHOWS = {
    "rviz_default_plugins/PointCloud2": "sensor_msgs/msg/PointCloud2",
    "rviz_default_plugins/MarkerArray": "visualization_msgs/msg/MarkerArray",
    "rviz_default_plugins/Path": "nav_msgs/msg/Path",
    "rviz_default_plugins/Odometry": "nav_msgs/msg/Odometry",
}


@pytest.mark.parametrize("name", ["mapping", "change"])
def test_rviz_displays_have_the_type_of_their_topic_and_match_its_quality(name: str) -> None:
    for display in displays(name):
        topic = display["Topic"]
        row = ROWS["/" + topic["Value"]]
        assert SHOWS[display["Class"]] == row.msg_type, row.name
        durability = "Transient Local" if row.quality == LATCHED else "Volatile"
        assert topic["Durability Policy"] == durability, row.name


#: Types that a panel of Foxglove can show; raw messages and plots show every type.
PANELS = {
    "3D": {
        "sensor_msgs/msg/PointCloud2", "visualization_msgs/msg/MarkerArray", "nav_msgs/msg/Path",
        "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage",
    },
    "map": {"sensor_msgs/msg/NavSatFix"},
    "DiagnosticSummary": {"diagnostic_msgs/msg/DiagnosticArray"},
}  # fmt: skip


@pytest.mark.parametrize("name", ["mapping", "change"])
def test_foxglove_panels_show_topics_that_are_served_and_whose_type_they_can_draw(name: str) -> None:
    pytest.importorskip("subiaco_msgs.msg", reason="workspace not sourced: source ros2_ws/env.sh")
    from subiaco_bringup.nodes.foxglove_node import SHOWN

    layout = json.loads((BRINGUP / "foxglove" / f"{name}.json").read_text())
    assert layout["configById"]
    for panel, config in layout["configById"].items():
        topics = set(re.findall(r'"(/[a-z_/]+)', json.dumps(config)))
        assert topics <= set(ROWS) & set(SHOWN), panel
        can_draw = PANELS.get(panel.split("!")[0])
        if can_draw is not None:
            assert {ROWS[topic].msg_type for topic in topics} <= can_draw, panel
    assert set(SHOWN) - {"/rosout"} <= set(ROWS)
