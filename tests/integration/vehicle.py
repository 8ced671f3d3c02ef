"""A vehicle for tests: plays a bag as drivers (or ``ros2 bag play --clock``) would, knowing nothing of ours.

    python vehicle.py BAG [--listeners N] [--mute TOPIC FROM TO] [--save DIR] [--rate R] [--turns N]
        [--statuses] [--ros-args ...]

Names are relative, so that a namespace holds. Messages go out at the pace of their log times (a fraction of
it, for busy machines) with the quality that such publishers offer, whoever listens; nobody's counts are
waited for. At the end it waits until the map has caught up, and asks the service for the map.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from importlib import import_module
from pathlib import Path
from typing import Any

import rclpy
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Path as PathMessage
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from rclpy.utilities import remove_ros_args
from rosgraph_msgs.msg import Clock

from subiaco_geo.bags import BagReader
from subiaco_geo.topics import FIX, IMU, LATCHED, LIDAR_PACKETS, METADATA, TF_STATIC
from subiaco_msgs.srv import SaveMap
from subiaco_ros.qos import latched

CLOCK_HZ = 40.0


def message_class(name: str) -> Any:
    package, _, kind = name.split("/")
    return getattr(import_module(f"{package}.msg"), kind)


def quality(topic: str) -> QoSProfile:
    if topic in LATCHED:
        return latched(1)
    return qos_profile_sensor_data if topic == IMU else QoSProfile(depth=100)


class Vehicle:
    """Publishers, a clock, and an eye on the path."""

    def __init__(self, node: Node, reader: BagReader) -> None:
        self._node = node
        self._reader = reader
        self._out = {
            topic: node.create_publisher(message_class(info.msg_type), topic.lstrip("/"), quality(topic))
            for topic, info in reader.topics.items()
        }
        self._clock = node.create_publisher(Clock, "/clock", QoSProfile(depth=10))
        self.paths: list[Any] = []
        node.create_subscription(PathMessage, "path", self.paths.append, latched(1))
        self.statuses: set[str] = set()
        node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 100)

    def _on_diagnostics(self, message: Any) -> None:
        self.statuses |= {status.name for status in message.status}

    def heard(self, listeners: int) -> bool:
        """Whether so many listen to each topic: monitor and mapping are two, with the recorder three."""
        wanted = (LIDAR_PACKETS, IMU, FIX, METADATA, TF_STATIC)
        counts = [self._out[topic].get_subscription_count() for topic in wanted if topic in self._out]
        return min(counts) >= listeners

    def caught_up(self, end_ns: int) -> bool:
        """Whether the path has come to the end of the bag, but for the scan that no packet closes."""
        if not self.paths or not self.paths[-1].poses:
            return False
        last = self.paths[-1].poses[-1].header.stamp
        return last.sec * 10**9 + last.nanosec > end_ns - 450_000_000

    def spin(self, seconds: float) -> None:
        end = time.monotonic() + max(seconds, 0.0)
        while (left := end - time.monotonic()) > 0:
            rclpy.spin_once(self._node, timeout_sec=left)

    def wait(self, condition: Any, seconds: float) -> bool:
        end = time.monotonic() + seconds
        while not condition() and time.monotonic() < end:
            self.spin(0.05)
        return bool(condition())

    def play(self, mute: tuple[str | None, float, float], rate: float) -> None:
        begun, start = time.monotonic(), self._reader.start_ns
        due_clock = 0.0
        topic, since, until = mute
        for message in self._reader.messages():
            seconds = (message.log_time_ns - start) * 1e-9
            while (ahead := seconds / rate - (time.monotonic() - begun)) > 0 or seconds >= due_clock:
                if seconds >= due_clock:
                    self.tell(start + int(due_clock * 1e9))
                    due_clock += 1.0 / CLOCK_HZ
                self.spin(min(ahead, 1.0 / CLOCK_HZ))
            if not (message.topic == topic and since <= seconds < until):
                self._out[message.topic].publish(message.raw)

    def settle(self) -> None:
        """Wait until listeners have what is still on its way: what ends with this process is lost."""
        for publisher in self._out.values():
            publisher.wait_for_all_acked(Duration(seconds=5.0))

    def tell(self, time_ns: int) -> None:
        self._clock.publish(Clock(clock=Time(sec=time_ns // 10**9, nanosec=time_ns % 10**9)))

    def save(self, directory: str) -> str:
        client = self._node.create_client(SaveMap, "pose_graph/save_map")
        if not self.wait(client.service_is_ready, 60.0):
            return "no service"
        future = client.call_async(SaveMap.Request(directory=directory))
        self.wait(future.done, 120.0)
        return "" if future.done() and future.result().success else f"refused: {future.result()}"


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("bag", type=Path)
    parser.add_argument("--mute", nargs=3, metavar=("TOPIC", "FROM", "TO"), default=(None, "0", "0"))
    parser.add_argument("--save")
    parser.add_argument("--statuses", action="store_true")
    parser.add_argument("--listeners", type=int, default=2)
    parser.add_argument("--rate", type=float, default=0.5)
    parser.add_argument("--turns", type=int, default=1)  # as `ros2 bag play --loop`
    given = parser.parse_args(remove_ros_args(sys.argv)[1:])
    rclpy.init(args=sys.argv)
    with BagReader(given.bag) as reader:
        vehicle = Vehicle(Node("vehicle"), reader)
        if not vehicle.wait(lambda: vehicle.heard(given.listeners), 60.0):
            sys.stderr.write("nobody listens\n")
            return 1
        for _ in range(given.turns):
            vehicle.play((given.mute[0], float(given.mute[1]), float(given.mute[2])), given.rate)
        vehicle.wait(lambda: vehicle.caught_up(reader.end_ns), 90.0)
        vehicle.settle()
        count = len(vehicle.paths[-1].poses) if vehicle.paths else 0
        sys.stdout.write(f"path {count} of {len(vehicle.paths)} messages\n")
        if given.statuses:
            sys.stdout.write(f"{json.dumps(sorted(vehicle.statuses))}\n")
        complaint = vehicle.save(given.save) if given.save else ""
    rclpy.try_shutdown()
    if complaint:
        sys.stderr.write(complaint + "\n")
    return 1 if complaint else 0


if __name__ == "__main__":
    sys.exit(main())
