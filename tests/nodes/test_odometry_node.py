"""The odometry node around a front end of ours."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from subiaco_geo.bags import packet_to_cdr
from subiaco_geo.errors import InputError
from subiaco_geo.frames import exp_se3
from subiaco_mapping.measurements import DeskewedScan, OdometryPose

pytestmark = pytest.mark.ros

T0_NS = 1_697_335_200_000_000_000


class FakeFrontend:
    """One scan for every four packets; what waits comes out at the end."""

    def __init__(self, extrinsics: Any, metadata: str | None) -> None:
        self.extrinsics, self.metadata = extrinsics, metadata
        self.packets: list[bytes] = []
        self.imu: list[Any] = []
        self.scans = 0
        self.behind_ns = 0

    def _output(self) -> Any:
        from subiaco_mapping.odometry.frontend import FrontendOutput

        self.scans += 1
        stamp = T0_NS + self.scans * 100_000_000
        scan = DeskewedScan(stamp, np.ones((5, 3)) * self.scans, np.zeros(5, np.float32), "gyro")
        pose = exp_se3(np.array([0, 0, 0.1, 1, 0, 0]) * self.scans)
        return FrontendOutput(
            OdometryPose(stamp, pose, np.eye(6) * 1e-4, 5, 0.1, degenerate=False, segment=0), scan
        )

    def on_packet(self, buf: memoryview) -> list[Any]:
        self.packets.append(bytes(buf))
        return [self._output()] if len(self.packets) % 4 == 0 else []

    def on_points(self, scan: Any) -> list[Any]:
        return [self._output()]

    def on_imu(self, sample: Any) -> list[Any]:
        self.imu.append(sample)
        return []

    def finish(self) -> list[Any]:
        return [self._output()] if len(self.packets) % 4 else []

    def set_metadata(self, metadata: str) -> None:
        self.metadata = metadata

    def facts(self) -> dict[str, Any]:
        return {"packets": len(self.packets)}


class Bench:
    """An odometry node with fake front ends, and a tester that plays replay and consumer."""

    def __init__(self, ros: Any, **parameters: Any) -> None:
        from nav_msgs.msg import Odometry
        from sensor_msgs.msg import Imu, PointCloud2
        from std_msgs.msg import String

        from ouster_sensor_msgs.msg import PacketMsg
        from subiaco_mapping.config import MappingConfig
        from subiaco_mapping.nodes.odometry_node import OdometryApp, OdometryParameters
        from subiaco_msgs.msg import ReplayCounts, ScanQuality
        from subiaco_ros.parameters import read_models
        from subiaco_ros.qos import latched, reliable
        from tf2_msgs.msg import TFMessage

        self.ros = ros
        self.made: list[FakeFrontend] = []
        node = ros.node("odometry", **parameters)
        own, config = read_models(node, OdometryParameters, MappingConfig)
        self.app = OdometryApp(node, own, config, self._make)
        ros.apps.append(self.app)
        user = self.user = ros.node("tester")
        self.odometry = ros.collect(user, Odometry, "odometry", latched=False)
        self.clouds = ros.collect(user, PointCloud2, "points_deskewed", latched=False)
        self.skies = ros.collect(user, PointCloud2, "points_sky", latched=False)
        self.qualities = ros.collect(user, ScanQuality, "odometry/quality", latched=False)
        self.facts = ros.collect(user, String, "odometry/facts", latched=False)
        self.tf = ros.collect(user, TFMessage, "tf", latched=False)
        self.sequences = ros.collect(user, ReplayCounts, "odometry/sequence")
        self.ends = ros.collect(user, ReplayCounts, "odometry/end")
        self.consumed = ros.collect(user, ReplayCounts, "replay/consumed")
        self.packets = user.create_publisher(PacketMsg, "ouster/lidar_packets", reliable(1000))
        self.metadata = user.create_publisher(String, "ouster/metadata", latched(1))
        self.tf_static = user.create_publisher(TFMessage, "tf_static", latched(1))
        self.imu = user.create_publisher(Imu, "imu/data", reliable(1000))
        self.marks = {
            name: user.create_publisher(ReplayCounts, f"replay/{name}", latched(1))
            for name in ("sequence", "end")
        }
        self.counts = user.create_publisher(ReplayCounts, "replay/consumed", latched(1))
        ros.until(lambda: all(p.get_subscription_count() for p in (self.packets, self.imu, self.tf_static)))

    def _make(self, extrinsics: Any, metadata: str | None) -> FakeFrontend:
        self.made.append(FakeFrontend(extrinsics, metadata))
        return self.made[-1]

    def taken(self, topic: str) -> int:
        reports = [m for m in self.consumed if m.source == "odometry"]
        if not reports:
            return -1
        return dict(zip(reports[-1].topics, reports[-1].counts, strict=True))[topic]

    def mark(self, name: str, source: str, topics: list[str]) -> None:
        from subiaco_msgs.msg import ReplayCounts

        before = self.taken(f"/replay/{name}")
        self.marks[name].publish(ReplayCounts(source=source, topics=topics, counts=[1] * len(topics)))
        self.ros.until(lambda: self.taken(f"/replay/{name}") == max(before, 0) + 1)

    def begin(self, name: str = "one", topics: tuple[str, ...] = ("/ouster/lidar_packets",)) -> None:
        from std_msgs.msg import String

        from subiaco_ros.messages import transform_message
        from tf2_msgs.msg import TFMessage

        self.mark("sequence", name, list(topics))
        before = self.taken("/tf_static")
        lever = exp_se3(np.array([0, 0, 0, 0.5, 0, 1.9]))
        self.tf_static.publish(TFMessage(transforms=[transform_message(lever, "base_link", "lidar_link", 0)]))
        self.metadata.publish(String(data="{}"))
        self.ros.until(lambda: self.taken("/tf_static") == before + 1 and self.taken("/ouster/metadata") >= 1)

    def send_packets(self, numbers: range) -> None:
        for k in numbers:
            self.packets.publish(packet_to_cdr(k.to_bytes(4, "little")))


def test_packets_reach_the_front_end_bit_by_bit_and_its_scans_come_out(ros: Any) -> None:
    bench = Bench(ros)
    bench.begin()
    bench.send_packets(range(10))
    ros.until(lambda: len(bench.clouds) == 2 and len(bench.odometry) == 2 and len(bench.tf) == 2)
    ros.until(lambda: bench.taken("/ouster/lidar_packets") == 10)
    bench.mark("end", "replay", ["/ouster/lidar_packets"])
    ros.until(lambda: len(bench.clouds) == 3 and bench.ends and bench.facts)
    assert bench.made[0].packets == [k.to_bytes(4, "little") for k in range(10)]
    assert bench.made[0].metadata == "{}"
    assert bench.taken("/ouster/lidar_packets") == 10
    counts = dict(zip(bench.ends[0].topics, bench.ends[0].counts, strict=True))
    scans = ("/odometry", "/points_deskewed", "/points_sky", "/odometry/quality")
    assert counts == dict.fromkeys(scans, 3) | {"/odometry/facts": 1}
    ros.until(lambda: len(bench.skies) == 3)
    assert [m.header for m in bench.skies] == [m.header for m in bench.clouds]
    assert json.loads(bench.facts[0].data) == {"packets": 10}
    assert [m.header.stamp.nanosec for m in bench.odometry] == [100_000_000, 200_000_000, 300_000_000]
    assert bench.tf[0].transforms[0].child_frame_id == "base_link"
    # base_link, not lidar_link: the lever arm of 1.9 m has been taken off.
    assert bench.odometry[0].pose.pose.position.z == pytest.approx(-1.9)


def test_every_sequence_has_a_front_end_of_its_own(ros: Any) -> None:
    bench = Bench(ros)
    bench.begin("one")
    bench.send_packets(range(3))
    ros.until(lambda: bench.taken("/ouster/lidar_packets") == 3)
    bench.begin("two")
    assert len(bench.clouds) == 1  # what waited of the first was flushed
    bench.send_packets(range(4))
    ros.until(lambda: len(bench.clouds) == 2)
    assert [len(front.packets) for front in bench.made] == [3, 4]
    ros.until(lambda: [m.source for m in bench.sequences] == ["one", "two"])
    assert bench.sequences[1].counts[0] == 1


def test_consumption_is_not_reported_while_the_next_node_is_behind(ros: Any) -> None:
    from subiaco_msgs.msg import ReplayCounts

    topics = [
        "/odometry", "/points_deskewed", "/points_sky", "/odometry/quality", "/odometry/sequence",
        "/odometry/facts",
    ]  # fmt: skip
    bench = Bench(ros, consumers=["pose_graph"])
    assert bench.taken("/ouster/lidar_packets") == -1  # no word before the consumer is there

    def consume(scans: int) -> None:
        counts = [scans, scans, scans, scans, 1, 0]
        bench.counts.publish(ReplayCounts(source="pose_graph", topics=topics, counts=counts))

    consume(0)
    bench.begin()
    bench.send_packets(range(40))
    ros.until(lambda: len(bench.clouds) == 10)
    assert bench.taken("/ouster/lidar_packets") < 40
    held = bench.taken("/ouster/lidar_packets")
    for k in range(1, 6):  # time for several reports, had they been allowed
        bench.imu.publish(imu_message())
        ros.until(lambda k=k: len(bench.made[0].imu) == k)
    assert bench.taken("/ouster/lidar_packets") == held
    consume(10)
    ros.until(lambda: bench.taken("/ouster/lidar_packets") == 40)


def test_a_node_answers_its_own_consumers_and_no_other_counts(ros: Any) -> None:
    """Else two nodes that report on one topic answer each other, and themselves, with every message."""
    from subiaco_mapping.nodes.counts import CONSUMED, listen_to_consumers
    from subiaco_mapping.nodes.flow import FlowControl
    from subiaco_msgs.msg import ReplayCounts
    from subiaco_ros.qos import latched

    node, answers = ros.node("odometry"), []
    listen_to_consumers(node, FlowControl(["pose_graph"]), lambda: answers.append(1))
    counts = node.create_publisher(ReplayCounts, CONSUMED, latched(10))
    for source in ("odometry", "stranger", "pose_graph"):
        counts.publish(ReplayCounts(source=source, topics=["/odometry"], counts=[1]))
    ros.until(lambda: answers)  # the last of them, in order
    assert len(answers) == 1


def imu_message() -> Any:
    from sensor_msgs.msg import Imu

    from subiaco_ros.messages import header

    return Imu(header=header(T0_NS, "imu_link"))


def test_an_imu_without_extrinsic_in_an_announced_sequence_is_bad_input(ros: Any) -> None:
    bench = Bench(ros)
    bench.begin(topics=("/ouster/lidar_packets", "/imu/data"))
    bench.send_packets(range(1))
    with pytest.raises(InputError, match="imu_link"):
        ros.until(lambda: bench.made)


def test_the_node_ends_with_the_replay_only_when_told_to(ros: Any) -> None:
    bench = Bench(ros, exit_at_end=True)
    bench.begin()
    bench.send_packets(range(4))
    ros.until(lambda: len(bench.clouds) == 1)
    assert not bench.app.done
    bench.mark("end", "replay", [])
    ros.until(lambda: bench.app.done)


def test_on_live_topics_what_was_left_out_at_the_start_is_counted_and_late_metadata_is_used(ros: Any) -> None:
    from sensor_msgs.msg import Imu
    from std_msgs.msg import String

    from subiaco_ros.messages import transform_message
    from tf2_msgs.msg import TFMessage

    bench = Bench(ros)
    bench.send_packets(range(3))
    ros.until(lambda: bench.taken("/ouster/lidar_packets") == 3)
    places = [transform_message(np.eye(4), "base_link", f"{name}_link", 0) for name in ("lidar", "imu")]
    bench.tf_static.publish(TFMessage(transforms=places))
    ros.until(lambda: bench.taken("/tf_static") >= 1)
    bench.imu.publish(Imu())  # the IMU begins the sequence, the LiDAR's driver comes later
    ros.until(lambda: bench.made)
    bench.metadata.publish(String(data="{}"))
    ros.until(lambda: bench.made[0].metadata == "{}")
    bench.send_packets(range(4))
    ros.until(lambda: len(bench.clouds) == 1)

    def arrived() -> Any:
        return json.loads(bench.facts[-1].data)["arrivals_odometry"] if bench.facts else {}

    ros.until(lambda: arrived().get("/ouster/lidar_packets", {}).get("received") == 7)
    assert arrived()["/ouster/lidar_packets"] == {"received": 7, "lost": 0, "before_start": 0, "left_out": 3}
    assert arrived()["/imu/data"]["left_out"] == 0


def test_a_live_odometry_begins_again_where_time_went_back(
    ros: Any, caplog: pytest.LogCaptureFixture
) -> None:
    from std_msgs.msg import String

    from subiaco_ros.messages import transform_message
    from tf2_msgs.msg import TFMessage

    live = Bench(ros)
    places = [transform_message(np.eye(4), "base_link", f"{name}_link", 0) for name in ("lidar", "imu")]
    live.tf_static.publish(TFMessage(transforms=places))
    live.metadata.publish(String(data="{}"))
    ros.until(lambda: live.taken("/tf_static") >= 1 and live.taken("/ouster/metadata") >= 1)
    live.send_packets(range(4))
    sent = 4
    ros.until(lambda: live.taken("/ouster/lidar_packets") == sent)
    for behind_ns, made in ((300_000_000, 1), (5_000_000_000, 2), (0, 2)):
        live.made[-1].behind_ns = behind_ns
        for _ in range(2):  # the next packet after the one that was behind begins again
            live.send_packets(range(1))
            sent += 1
            ros.until(lambda sent=sent: live.taken("/ouster/lidar_packets") == sent)
        assert len(live.made) == made
    assert caplog.text.count("time went back by 5.0 s") == 1
    assert live.made[-1].metadata == "{}"
    live.send_packets(range(4))
    ros.until(lambda: len(live.qualities) >= 3)
    first, *_, last = (quality.segment for quality in live.qualities)
    assert last - first >= 1000  # segments of one run are not those of another


def test_metadata_of_a_driver_that_keeps_nothing_for_late_listeners_are_heard_too(ros: Any) -> None:
    from std_msgs.msg import String

    from subiaco_ros.qos import reliable

    bench = Bench(ros)
    bench.user.destroy_publisher(bench.metadata)
    volatile = bench.user.create_publisher(String, "ouster/metadata", reliable(1))
    ros.until(volatile.get_subscription_count)
    volatile.publish(String(data="{}"))
    ros.until(lambda: bench.taken("/ouster/metadata") == 1)


def test_a_replay_keeps_to_its_sequence_wherever_time_goes(ros: Any) -> None:
    bench = Bench(ros)
    bench.begin()
    bench.send_packets(range(4))
    ros.until(lambda: len(bench.clouds) == 1)
    bench.made[0].behind_ns = 5_000_000_000
    bench.send_packets(range(4))
    ros.until(lambda: len(bench.clouds) == 2)
    assert len(bench.made) == 1


def test_a_live_odometry_holds_its_first_scan_back_until_its_listeners_are_matched(ros: Any) -> None:
    from nav_msgs.msg import Odometry
    from std_msgs.msg import String

    from subiaco_msgs.msg import ScanQuality
    from subiaco_ros.messages import transform_message
    from tf2_msgs.msg import TFMessage

    bench = Bench(ros, listeners=["tester", "late"])
    lever = exp_se3(np.array([0, 0, 0, 0.5, 0, 1.9]))
    places = [transform_message(lever, "base_link", frame, 0) for frame in ("lidar_link", "imu_link")]
    bench.tf_static.publish(TFMessage(transforms=places))
    bench.metadata.publish(String(data="{}"))
    bench.send_packets(range(12))
    ros.until(lambda: bench.taken("/ouster/metadata") == 1 and bench.taken("/tf_static") == 1)
    for _ in range(20):  # the tester is matched, the other does not run
        bench.app.step()
    assert bench.made == []
    late = ros.node("late")
    stamps = ros.collect(late, Odometry, "odometry", latched=False)
    assert bench.made == []
    qualities = ros.collect(late, ScanQuality, "odometry/quality", latched=False)
    ros.until(lambda: len(stamps) == len(qualities) == 3)
    assert bench.made[0].packets == [k.to_bytes(4, "little") for k in range(12)]


def test_listeners_are_waited_for_only_so_long(caplog: pytest.LogCaptureFixture) -> None:
    from subiaco_mapping.nodes.live_sources import ListenerWaiter

    now, missing = [100.0], ["pose_graph"]
    waiter = ListenerWaiter(lambda: missing, patience=10.0, clock=lambda: now[0])
    assert not waiter.over
    now[0] = 109.9
    assert not waiter.over
    now[0] = 110.0
    assert waiter.over
    assert "pose_graph: not listening after 10 s; going on" in caplog.text
    heard = ListenerWaiter(list, clock=lambda: now[0])
    assert heard.over
