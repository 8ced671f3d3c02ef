"""Topics of a running graph reach Foxglove with their definitions, while somebody looks at them."""

from __future__ import annotations

import asyncio
import json
import struct
from typing import Any

import pytest
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory

pytestmark = pytest.mark.ros


class FakeServer:
    """Keeps what is offered and sent; viewers come and go by hand."""

    def __init__(self, host: str, port: int) -> None:
        self.host, self.port = host, port
        self.offered: dict[str, tuple[str, str]] = {}
        self.sent: list[tuple[str, bytes, int]] = []
        self.waiting: list[tuple[str, bool]] = []
        self.stopped = False

    def open(self, topic: str, msg_type: str, definition: str) -> Any:
        """Offer a topic."""
        self.offered[topic] = (msg_type, definition)
        server = self

        class Outlet:
            def log(self, msg: bytes, *, log_time: int | None = None) -> None:
                server.sent.append((topic, msg, log_time or 0))

        return Outlet()

    def events(self) -> list[tuple[str, bool]]:
        """Return what viewers did."""
        found, self.waiting = self.waiting, []
        return found

    def stop(self) -> None:
        """End."""
        self.stopped = True


def start(ros: Any, **parameters: Any) -> tuple[Any, FakeServer]:
    from subiaco_bringup.nodes.foxglove_node import make_build

    made: list[FakeServer] = []

    def make(host: str, port: int) -> FakeServer:
        made.append(FakeServer(host, port))
        return made[0]

    node = ros.node("foxglove", **parameters)
    app = make_build(make)(node)
    ros.apps.append(app)
    return app, made[0]


def test_a_topic_is_offered_with_its_definition_and_sent_while_somebody_looks(ros: Any) -> None:
    from nav_msgs.msg import Odometry
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import Imu

    app, server = start(ros)
    assert server.host == "127.0.0.1"
    driver = ros.node("driver")
    odometry = driver.create_publisher(Odometry, "odometry", 10)
    imu = driver.create_publisher(Imu, "imu/data", qos_profile_sensor_data)  # best effort
    ros.until(lambda: server.offered.keys() >= {"/odometry", "/imu/data"})
    assert odometry.get_subscription_count() == 0  # nobody looks
    server.waiting.append(("/odometry", True))
    server.waiting.append(("/imu/data", True))
    ros.until(lambda: odometry.get_subscription_count() and imu.get_subscription_count())
    message = Odometry(child_frame_id="base_link")
    message.pose.pose.position.x = 4.5
    ros.until(lambda: odometry.publish(message) or server.sent)
    topic, raw, time_ns = server.sent[0]
    assert (topic, time_ns > 0) == ("/odometry", True)
    msg_type, definition = server.offered["/odometry"]
    schema = Schema(1, definition.encode(), "ros2msg", msg_type)
    decoded = DecoderFactory().decoder_for("cdr", schema)(raw)
    assert (decoded.child_frame_id, decoded.pose.pose.position.x) == ("base_link", 4.5)
    server.waiting.append(("/odometry", False))
    ros.until(lambda: odometry.get_subscription_count() == 0)
    app.close()
    assert server.stopped


def test_whoever_comes_later_gets_what_is_latched(ros: Any) -> None:
    from nav_msgs.msg import Path

    from subiaco_ros.qos import latched

    _, server = start(ros)
    path = ros.node("driver").create_publisher(Path, "path", latched(1))
    path.publish(Path())
    ros.until(lambda: "/path" in server.offered)
    server.waiting.append(("/path", True))
    ros.until(lambda: len(server.sent) == 1)
    server.waiting.append(("/path", True))  # a second viewer
    ros.until(lambda: len(server.sent) == 2)
    assert server.sent[0][1] == server.sent[1][1]
    server.waiting += [("/path", False), ("/path", False)]
    ros.until(lambda: path.get_subscription_count() == 0)


class Viewer:
    """Speaks the WebSocket protocol of Foxglove by hand: asks for one topic, keeps one message."""

    def __init__(self, port: int, topic: str) -> None:
        self.port, self.topic = port, topic
        self.channel: dict[str, Any] = {}
        self.payload = b""

    async def run(self) -> None:
        """Connect, subscribe, take the first message."""
        reader, writer = await asyncio.open_connection("127.0.0.1", self.port)
        key = "dGhlIHNhbXBsZSBub25jZQ=="
        writer.write(
            f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{self.port}\r\nUpgrade: websocket\r\n"
            f"Connection: Upgrade\r\nSec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n"
            "Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n".encode()
        )
        assert b" 101 " in await reader.readline()
        await reader.readuntil(b"\r\n\r\n")
        while not self.payload:
            opcode, data = await self._frame(reader)
            if opcode == 1:
                self._on_text(json.loads(data), writer)
            elif opcode == 2 and data[0] == 1:  # message data: subscription, time, payload
                self.payload = data[13:]
        writer.close()

    @staticmethod
    async def _frame(reader: asyncio.StreamReader) -> tuple[int, bytes]:
        first, second = await reader.readexactly(2)
        length = second & 127
        if length == 126:
            (length,) = struct.unpack(">H", await reader.readexactly(2))
        elif length == 127:
            (length,) = struct.unpack(">Q", await reader.readexactly(8))
        return first & 15, await reader.readexactly(length)

    def _on_text(self, message: dict[str, Any], writer: asyncio.StreamWriter) -> None:
        for channel in message.get("channels", []):
            if channel["topic"] == self.topic:
                self.channel = channel
                subscriptions = [{"id": 7, "channelId": channel["id"]}]
                text = json.dumps({"op": "subscribe", "subscriptions": subscriptions}).encode()
                assert len(text) < 126
                writer.write(bytes([0x81, 0x80 | len(text)]) + bytes(4) + text)  # masked with zeros


def test_a_viewer_gets_a_message_through_the_sdk_of_foxglove_on_loopback(ros: Any) -> None:
    pytest.importorskip("foxglove", reason="foxglove-sdk is not installed: run make setup")
    import threading

    from nav_msgs.msg import Odometry

    from subiaco_bringup.nodes.foxglove_node import FoxgloveServer, make_build

    servers: list[FoxgloveServer] = []

    def make(host: str, port: int) -> FoxgloveServer:
        servers.append(FoxgloveServer(host, port))
        return servers[0]

    app = make_build(make)(ros.node("foxglove", port=0))
    ros.apps.append(app)
    odometry = ros.node("driver").create_publisher(Odometry, "odometry", 10)
    ros.until(lambda: app.offered)  # a viewer that is there before may ask for a topic too early
    viewer = Viewer(servers[0].port, "/odometry")
    thread = threading.Thread(target=lambda: asyncio.run(asyncio.wait_for(viewer.run(), 10)), daemon=True)
    thread.start()
    ros.until(odometry.get_subscription_count)
    ros.until(lambda: odometry.publish(Odometry(child_frame_id="base_link")) or viewer.payload)
    thread.join(5)
    assert (viewer.channel["encoding"], viewer.channel["schemaName"]) == ("cdr", "nav_msgs/msg/Odometry")
    schema = Schema(1, viewer.channel["schema"].encode(), "ros2msg", viewer.channel["schemaName"])
    decoded = DecoderFactory().decoder_for("cdr", schema)(viewer.payload)
    assert decoded.child_frame_id == "base_link"
    app.close()
