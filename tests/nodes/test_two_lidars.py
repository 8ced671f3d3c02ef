"""Two LiDARs of one vehicle, each with its own graph in a namespace: neither hears the other."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from subiaco_geo.bags import packet_to_cdr
from subiaco_geo.topics import LIDAR_PACKETS, METADATA, TF_STATIC
from subiaco_mapping.measurements import DeskewedScan, OdometryPose

pytestmark = pytest.mark.ros

SIDES = ("left", "right")


class OneScanPerPacket:
    """A front end that answers each packet with a scan, whose one point tells which packet it was."""

    behind_ns = 0

    def __init__(self, metadata: str | None) -> None:
        self.metadata = metadata

    def set_metadata(self, metadata: str) -> None:
        """Know the sensor."""
        self.metadata = metadata

    def on_packet(self, buf: memoryview) -> list[Any]:
        """Answer."""
        from subiaco_mapping.odometry.frontend import FrontendOutput

        number = buf[0]
        scan = DeskewedScan(number * 10**8, np.full((1, 3), float(number)), np.zeros(1, np.float32), "gyro")
        pose = OdometryPose(number * 10**8, np.eye(4), np.eye(6), 5, 0.1, degenerate=False, segment=0)
        return [FrontendOutput(pose, scan)]

    def finish(self) -> list[Any]:
        """Nothing waits."""
        return []

    def facts(self) -> dict[str, Any]:
        """Nothing to tell."""
        return {}


def odometry(ros: Any, side: str, fronts: dict[str, OneScanPerPacket]) -> Any:
    """Make the odometry of one LiDAR."""
    from subiaco_mapping.config import MappingConfig
    from subiaco_mapping.nodes.odometry_node import OdometryApp, OdometryParameters
    from subiaco_ros.parameters import read_models

    def build(node: Any) -> OdometryApp:
        own, config = read_models(node, OdometryParameters, MappingConfig)

        def make(_extrinsics: Any, metadata: str | None) -> Any:
            fronts[side] = OneScanPerPacket(metadata)
            return fronts[side]

        return OdometryApp(node, own, config, make)

    node = ros.managed("odometry", build, namespace=side)
    node.start()
    return node


def test_two_odometries_in_namespaces_take_the_packets_frames_and_metadata_of_their_own_lidar(
    ros: Any,
) -> None:
    from sensor_msgs.msg import PointCloud2
    from std_msgs.msg import String

    from ouster_sensor_msgs.msg import PacketMsg
    from subiaco_ros.messages import transform_message
    from subiaco_ros.qos import latched, reliable
    from tf2_msgs.msg import TFMessage

    fronts: dict[str, OneScanPerPacket] = {}
    drivers = ros.node("drivers")
    packets: dict[str, Any] = {}
    clouds: dict[str, list[Any]] = {}
    moving: dict[str, list[Any]] = {}
    latched_ones = []
    for side in (*SIDES, ""):  # at the root a third sensor speaks, which is nobody's
        top = f"/{side}" if side else ""
        packets[side] = drivers.create_publisher(PacketMsg, top + LIDAR_PACKETS, reliable(100))
        metadata = drivers.create_publisher(String, top + METADATA, latched(1))
        metadata.publish(String(data=side))
        frames = drivers.create_publisher(TFMessage, top + TF_STATIC, latched(1))
        places = [transform_message(np.eye(4), "base_link", f"{n}_link", 0) for n in ("lidar", "imu")]
        frames.publish(TFMessage(transforms=places))
        latched_ones += [metadata, frames]
    for side in SIDES:
        ros.apps.append(odometry(ros, side, fronts))
        clouds[side] = ros.collect(drivers, PointCloud2, f"/{side}/points_deskewed", latched=False)
        moving[side] = ros.collect(drivers, TFMessage, f"/{side}/tf", latched=False)
    at_root = ros.collect(drivers, TFMessage, "/tf", latched=False)
    for app in ros.apps:
        app.done = False
    ros.until(lambda: all(packets[side].get_subscription_count() == 1 for side in SIDES))
    ros.until(lambda: all(app.app._metadata for app in ros.apps))
    for number, side in ((1, "left"), (2, "right"), (3, "left"), (9, "")):
        packets[side].publish(packet_to_cdr(bytes([number])))
    ros.until(lambda: len(clouds["left"]) == 2 and len(clouds["right"]) == 1)
    heard = {side: [cloud.header.stamp.nanosec // 10**8 for cloud in clouds[side]] for side in SIDES}
    assert heard == {"left": [1, 3], "right": [2]}
    assert {side: fronts[side].metadata for side in SIDES} == {side: side for side in SIDES}
    ros.until(lambda: len(moving["left"]) == 2 and len(moving["right"]) == 1)
    assert at_root == []
    assert packets[""].get_subscription_count() == 0
