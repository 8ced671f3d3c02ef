"""Drivers of a standing car for tests, in a process that can be killed: stamps are the host's clock.

    python sensors.py lidar imu pps [--ros-args ...]
    python sensors.py gnss

The LiDAR (16 beams, 512x10) sees a room. A line on standard input changes something and is answered:

    stop lidar          its cable is pulled: nothing comes, and the sensor goes on counting
    go lidar            it is back
    step 0.2 lidar imu  their clocks jump
    heard 3 lidar       answered once so many listen to it, and have its metadata
"""

from __future__ import annotations

import sys
import threading
import time
from typing import Any

import numpy as np
import rclpy
from ouster.sdk import core
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.utilities import remove_ros_args
from sensor_msgs.msg import Imu, NavSatFix, TimeReference
from std_msgs.msg import String

from ouster_sensor_msgs.msg import PacketMsg
from subiaco_geo.bags import TYPESTORE, packet_to_cdr
from subiaco_geo.topics import FIX, IMU, LIDAR_PACKETS, METADATA, TF_STATIC
from subiaco_mapping.topic_names import TIME_REFERENCE
from subiaco_ros.qos import latched
from subiaco_sim.config import LidarMode
from subiaco_sim.packets import sensor_info
from subiaco_sim.recording import tf_message
from tf2_msgs.msg import TFMessage

ROOM = np.array([14.0, 9.0, 6.0])  # half length, half width, height above the sensor [m]
FLOOR = 2.0  # below the sensor [m]
COLUMNS = 16
HOME = (-31.95, 115.83, 20.0)
RATES = {"lidar": 320.0, "imu": 100.0, "pps": 1.0, "gnss": 5.0}


def room_packets(info: core.SensorInfo) -> list[core.LidarPacket]:
    """Return the packets of one turn in the room."""
    frame = core.LidarFrame(info)
    away = core.XYZLut(info, use_extrinsics=False)(np.full((info.h, info.w), 10_000, np.uint32))
    with np.errstate(divide="ignore"):
        reach = np.where(away[..., 2:] > 0, ROOM, [*ROOM[:2], FLOOR]) / np.abs(away)
    frame.field("RANGE")[:] = np.round(10_000 * reach.min(axis=-1)).astype(np.uint32)
    frame.measurement_id[:] = np.arange(info.w)
    frame.status[:] = 1
    return list(core.frame_to_packets(frame, core.PacketFormat(info), info.init_id, int(info.sn or 0)))


class Car:
    """Publishers, each at its own pace, until standard input ends."""

    def __init__(self, node: Node, sensors: list[str]) -> None:
        self._info = sensor_info(LidarMode.COLUMNS_512, dual=False, beams=16)
        self._layout = core.PacketFormat(self._info)
        self._packets = room_packets(self._info)
        self._rng = np.random.default_rng(5)
        kinds = {"lidar": PacketMsg, "imu": Imu, "pps": TimeReference, "gnss": NavSatFix}
        topics = {"lidar": LIDAR_PACKETS, "imu": IMU, "pps": TIME_REFERENCE, "gnss": FIX}
        self._out = {s: node.create_publisher(kinds[s], topics[s], QoSProfile(depth=1000)) for s in sensors}
        self._step = dict.fromkeys(sensors, 0)
        self.stopped: set[str] = set()
        if "lidar" in sensors:
            self._metadata = node.create_publisher(String, METADATA, latched())
            self._metadata.publish(String(data=self._info.to_json_string()))
            self._frames = node.create_publisher(TFMessage, TF_STATIC, latched())
            frames = TYPESTORE.serialize_cdr(tf_message(time.time_ns()), "tf2_msgs/msg/TFMessage")
            self._frames.publish(bytes(frames))

    def obey(self) -> None:
        """Take commands until there are no more."""
        for line in sys.stdin:
            verb, *words = line.split()
            if verb == "stop":
                self.stopped.update(words)
            elif verb == "go":
                self.stopped.difference_update(words)
            elif verb == "heard":
                self._await_listeners(int(words[0]), words[1:])
            else:
                for sensor in words[1:]:
                    self._step[sensor] += int(float(words[0]) * 1e9)
            sys.stdout.write(line)
            sys.stdout.flush()

    def _await_listeners(self, count: int, sensors: list[str]) -> None:
        heard = [self._out[sensor] for sensor in sensors]
        heard += [self._metadata] if "lidar" in sensors else []
        while any(publisher.get_subscription_count() < count for publisher in heard):
            time.sleep(0.02)
        if "lidar" in sensors:
            self._metadata.wait_for_all_acked(Duration(seconds=60.0))

    def run(self, ends: threading.Thread) -> None:
        """Publish what is due."""
        begun_ns, sent = time.time_ns(), dict.fromkeys(self._out, 0)
        while ends.is_alive():
            elapsed = (time.time_ns() - begun_ns) * 1e-9
            for sensor, publisher in self._out.items():
                while sent[sensor] < elapsed * RATES[sensor]:
                    if sensor not in self.stopped:
                        taken_ns = begun_ns + int(sent[sensor] / RATES[sensor] * 1e9) + self._step[sensor]
                        publisher.publish(self.message(sensor, sent[sensor], taken_ns))
                    sent[sensor] += 1
            time.sleep(0.002)

    def message(self, sensor: str, number: int, time_ns: int) -> Any:
        """Return what a sensor says."""
        if sensor == "lidar":
            return self._lidar(number, time_ns)
        if sensor == "imu":
            said: Any = Imu()
            turn, force = self._rng.normal(0.0, 0.001, 3), self._rng.normal(0.0, 0.02, 3)
            said.angular_velocity.x, said.angular_velocity.y, said.angular_velocity.z = turn.tolist()
            said.linear_acceleration.x, said.linear_acceleration.y = force[:2].tolist()
            said.linear_acceleration.z = 9.81 + float(force[2])
        elif sensor == "gnss":
            said = NavSatFix(latitude=HOME[0], longitude=HOME[1], altitude=HOME[2])
            said.status.status, said.position_covariance_type = 2, 2
            said.position_covariance = np.diag([2e-4, 2e-4, 8e-4]).ravel()
        else:
            said = TimeReference(source="pulse")
        said.header.stamp.sec, said.header.stamp.nanosec = divmod(time_ns, 10**9)
        return said

    def _lidar(self, number: int, time_ns: int) -> bytes:
        turn, place = divmod(number, len(self._packets))
        packet = self._packets[place]
        self._layout.set_frame_id(packet, turn % (self._layout.max_frame_id + 1))
        for column in range(COLUMNS):
            ago = (COLUMNS - column) * 100_000_000 // self._info.w
            self._layout.set_col_timestamp(packet, column, time_ns - ago)
        return packet_to_cdr(bytes(packet.buf))


def main() -> None:
    rclpy.init(args=sys.argv)
    sensors = remove_ros_args(sys.argv)[1:]
    node = rclpy.create_node("driver_of_" + "_".join(sensors))
    car = Car(node, sensors)
    commands = threading.Thread(target=car.obey, daemon=True)
    commands.start()
    car.run(commands)
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
