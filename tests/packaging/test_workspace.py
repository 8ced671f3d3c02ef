"""The built workspace: interfaces import, processes hear each other, shares are where nodes look."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
pytestmark = pytest.mark.ros

LISTEN = """
    import rclpy
    from ouster_sensor_msgs.msg import PacketMsg
    rclpy.init()
    node = rclpy.create_node("listener")
    heard = []
    node.create_subscription(PacketMsg, "packets", lambda raw: heard.append(raw), 200, raw=True)
    while len(heard) < 100:
        rclpy.spin_once(node, timeout_sec=1.0)
    print(sum(map(len, heard)), heard[7][8])
"""
SPEAK = """
    import struct, rclpy
    from rclpy.duration import Duration
    from rclpy.event_handler import PublisherEventCallbacks
    from ouster_sensor_msgs.msg import PacketMsg
    rclpy.init()
    node = rclpy.create_node("speaker")
    matched = PublisherEventCallbacks(matched=lambda info: None)
    publisher = node.create_publisher(PacketMsg, "packets", 200, event_callbacks=matched)
    while publisher.get_subscription_count() < 1:
        rclpy.spin_once(node, timeout_sec=0.1)
    for index in range(100):
        publisher.publish(b"\\0\\1\\0\\0" + struct.pack("<I", 24832) + bytes([index]) * 24832)
    assert publisher.wait_for_all_acked(Duration(seconds=30))
"""


def start(code: str) -> subprocess.Popen[str]:
    environment = {k: v for k, v in os.environ.items() if k != "_ROS_WHEELS_BOOTSTRAP_COMPLETE"}
    return subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(code)], env=environment, stdout=subprocess.PIPE, text=True
    )


def test_two_processes_exchange_raw_packets_without_loss() -> None:
    listener, speaker = start(LISTEN), start(SPEAK)
    try:
        said, _ = listener.communicate(timeout=60)
        assert speaker.wait(timeout=60) == 0
    finally:
        listener.kill()
        speaker.kill()
    assert said.split() == [str(100 * (4 + 4 + 24832)), "7"]


def test_every_interface_of_the_contracts_imports() -> None:
    from ouster_sensor_msgs.msg import PacketMsg
    from subiaco_msgs.action import DetectChanges
    from subiaco_msgs.msg import ChangeRecord, ChangeTable, ReplayCounts
    from subiaco_msgs.srv import Optimize, SaveMap
    from tf2_msgs.msg import TFMessage

    assert ChangeTable(records=[ChangeRecord(object_id=7)]).records[0].object_id == 7
    assert ReplayCounts.get_fields_and_field_types()["counts"] == "sequence<uint64>"
    assert SaveMap.Request().overwrite is False
    assert DetectChanges.Feedback().fraction == 0.0
    assert Optimize.Response().success is False
    assert PacketMsg.get_fields_and_field_types() == {"buf": "sequence<uint8>"}
    assert TFMessage.get_fields_and_field_types() == {
        "transforms": "sequence<geometry_msgs/TransformStamped>"
    }


def test_configuration_is_installed_with_bringup() -> None:
    from ament_index_python.packages import get_package_share_directory

    share = Path(get_package_share_directory("subiaco_bringup"))
    installed = {path.name for path in (share / "config").glob("*.yaml")}
    assert installed == {path.name for path in (REPOSITORY / "config").glob("*.yaml")}


def test_node_executables_run_with_the_interpreter_of_the_environment() -> None:
    from ament_index_python.packages import get_package_prefix

    for package, names in {
        "subiaco_mapping": ("replay_node", "odometry_node", "pose_graph_node"),
        "subiaco_bringup": ("change_node",),
    }.items():
        for name in names:
            first = (Path(get_package_prefix(package)) / "lib" / package / name).read_text(encoding="utf-8")
            assert first.splitlines()[0] == f"#!{sys.executable}"
