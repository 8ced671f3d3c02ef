"""The replay node over real topics: nothing lost, however slow the consumer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from subiaco_geo.bags import TYPESTORE, BagWriter, packet_to_cdr
from subiaco_geo.errors import InputError, SubiacoError
from subiaco_geo.topics import IMU, LIDAR_PACKETS, METADATA, PACKET_TYPE

pytestmark = pytest.mark.ros

PACKETS = 400
SIZE = 24_832


def write_bag(path: Path) -> Path:
    """Write 400 single-return packets, each with its number, and the metadata."""
    with BagWriter(path) as writer:
        text = TYPESTORE.types["std_msgs/msg/String"](data='{"sensor": 1}')
        writer.write(METADATA, "std_msgs/msg/String", text, 1_000_000_000, latched=True)
        for k in range(PACKETS):
            cdr = packet_to_cdr(k.to_bytes(4, "little") + bytes(SIZE - 4))
            writer.write_raw(LIDAR_PACKETS, PACKET_TYPE, cdr, 1_000_000_001 + k * 781_250)
    return path


def start(ros: Any, **parameters: Any) -> Any:
    """Make the node as its process does."""
    from subiaco_mapping.nodes.replay_node import build

    app = build(ros.node("replay", **parameters))
    ros.apps.append(app)
    return app


class SlowConsumer:
    """Take a few packets at a time from a queue that holds few, and report them."""

    def __init__(self, ros: Any) -> None:
        from std_msgs.msg import String

        from ouster_sensor_msgs.msg import PacketMsg
        from subiaco_mapping.nodes.counts import ConsumptionReporter
        from subiaco_mapping.nodes.flow import ConsumedCounter
        from subiaco_msgs.msg import ReplayCounts
        from subiaco_ros.qos import latched, reliable

        topics = (METADATA, LIDAR_PACKETS, "/replay/sequence", "/replay/end")
        self.packets: list[bytes] = []
        self.order: list[str] = []
        self.marks: list[Any] = []
        node = ros.node("consumer")
        reporter = ConsumptionReporter(node, ConsumedCounter(topics, batch=50))

        def take(topic: str) -> Any:
            def taken(message: Any) -> None:
                self.order.append(topic)
                if topic == LIDAR_PACKETS:
                    self.packets.append(bytes(message))
                elif topic.startswith("/replay"):
                    self.marks.append(message)
                reporter.consumed(topic)

            return taken

        kinds = {METADATA: String, "/replay/sequence": ReplayCounts, "/replay/end": ReplayCounts}
        for topic, kind in kinds.items():
            node.create_subscription(kind, topic, take(topic), latched(1))
        node.create_subscription(PacketMsg, LIDAR_PACKETS, take(LIDAR_PACKETS), reliable(128), raw=True)


def test_every_byte_of_every_packet_arrives_through_a_queue_of_one_window(ros: Any, tmp_path: Path) -> None:
    consumer = SlowConsumer(ros)
    app = start(ros, bags=[str(write_bag(tmp_path / "drive"))], consumers=["consumer"])
    ros.until(lambda: app.done, timeout=60)
    expected = [packet_to_cdr(k.to_bytes(4, "little") + bytes(SIZE - 4)) for k in range(PACKETS)]
    assert [bytes(p[: SIZE + 8]) for p in consumer.packets] == expected
    assert consumer.order[:3] == ["/replay/sequence", METADATA, LIDAR_PACKETS]
    assert consumer.order[-1] == "/replay/end"
    end = consumer.marks[-1]
    assert dict(zip(end.topics, end.counts, strict=True)) == {METADATA: 1, LIDAR_PACKETS: PACKETS}


def test_a_late_listener_still_learns_the_counts_of_the_end(ros: Any, tmp_path: Path) -> None:
    from subiaco_msgs.msg import ReplayCounts

    app = start(ros, bags=[str(write_bag(tmp_path / "drive"))])
    ros.until(lambda: app.done, timeout=60)
    ends = ros.collect(ros.node("late"), ReplayCounts, "replay/end", 1)
    ros.until(lambda: ends)
    assert dict(zip(ends[0].topics, ends[0].counts, strict=True))[LIDAR_PACKETS] == PACKETS


def test_the_clock_is_the_log_time(ros: Any, tmp_path: Path) -> None:
    from rosgraph_msgs.msg import Clock

    clocks = ros.collect(ros.node("listener"), Clock, "/clock", latched=False)
    app = start(ros, bags=[str(write_bag(tmp_path / "drive"))])
    ros.until(lambda: app.done and clocks, timeout=60)
    assert clocks[-1].clock.sec == 1


def test_a_consumer_that_never_comes_is_named(ros: Any, tmp_path: Path) -> None:
    app = start(ros, bags=[str(write_bag(tmp_path / "drive"))], consumers=["ghost"], consumer_timeout=0.2)
    with pytest.raises(SubiacoError, match="no sign of ghost"):
        ros.until(lambda: app.done)


def test_a_missing_bag_and_an_unknown_topic_are_bad_input(ros: Any, tmp_path: Path) -> None:
    app = start(ros, bags=[str(tmp_path / "none")])
    with pytest.raises(InputError, match="no such bag"):
        ros.until(lambda: app.done)
    ros.apps.clear()
    with pytest.raises(InputError, match="/chatter: not a survey topic"):
        start(ros, bags=[str(tmp_path / "none")], topics=["/chatter", IMU])
