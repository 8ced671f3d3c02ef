"""The recorder node over real topics: what is published is in the bag, and what is not is said."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from ouster.sdk import core

from subiaco_geo.bag_recovery import recover_bag
from subiaco_geo.bags import TYPESTORE, BagReader, BagWriter, packet_to_cdr
from subiaco_geo.topics import FIX, IMU, LIDAR_PACKETS, METADATA, PACKET_TYPE, POINTS, TF_STATIC

pytestmark = pytest.mark.ros

SIZE = 5000


def packet(number: int) -> bytes:
    """Serialise noise that begins with a number, so that the size of a file tells how much it holds."""
    return packet_to_cdr(number.to_bytes(4, "little") + random.Random(number).randbytes(SIZE - 4))


@pytest.fixture
def start(ros: Any, tmp_path: Path) -> Iterator[Any]:
    """Make recorders as their process does; they are closed at the end whatever happens."""
    apps: list[Any] = []

    def made(folder: str = "drive", **parameters: Any) -> Any:
        from subiaco_mapping.nodes.recorder_node import build

        given = {"record__warn_free_gb": 0.0, "record__stop_free_gb": 0.0, **parameters}
        app = build(ros.node(f"recorder{len(apps)}", output=str(tmp_path / folder), **given))
        apps.append(app)
        ros.apps.append(app)
        return app

    yield made
    for app in apps:
        app.close()


def publisher(ros: Any, topic: str, kind: Any = None, **qos: Any) -> Any:
    """Make a publisher of packets, or of another kind, on a node of its own."""
    from rclpy.qos import QoSProfile

    from ouster_sensor_msgs.msg import PacketMsg

    node = ros.node("driver" + topic.replace("/", "_"))
    return node.create_publisher(kind or PacketMsg, topic, QoSProfile(depth=500, **qos))


def listening(app: Any, *topics: str) -> bool:
    return set(topics) <= set(app.listener.counters)


def received(app: Any, topic: str) -> int:
    return int(app.listener.counters[topic].received)


def recorded(folder: Path, topic: str) -> list[bytes]:
    with BagReader(folder) as reader:
        return [bytes(m.raw) for m in reader.messages([topic])]


def write_survey(path: Path) -> Path:
    """Write 300 packets, 30 IMU samples, metadata and static transforms over 0.3 s."""
    types = TYPESTORE.types
    with BagWriter(path) as writer:
        text = types["std_msgs/msg/String"](data="{}")
        writer.write(METADATA, "std_msgs/msg/String", text, 10**9, latched=True)
        none = types["tf2_msgs/msg/TFMessage"](transforms=[])
        writer.write(TF_STATIC, "tf2_msgs/msg/TFMessage", none, 10**9, latched=True)
        for k in range(300):
            writer.write_raw(LIDAR_PACKETS, PACKET_TYPE, packet(k), 10**9 + k * 10**6)
            if k % 10 == 0:
                stamp = types["builtin_interfaces/msg/Time"](sec=5, nanosec=k * 10**6)
                header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="imu_link")

                writer.write(IMU, "sensor_msgs/msg/Imu", imu(header), 10**9 + k * 10**6)
    return path


def imu(header: object) -> object:
    import numpy as np

    types = TYPESTORE.types
    vector = types["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=9.81)
    turn = types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
    nine = np.zeros(9)
    return types["sensor_msgs/msg/Imu"](
        header=header,
        orientation=turn,
        orientation_covariance=nine,
        angular_velocity=vector,
        angular_velocity_covariance=nine,
        linear_acceleration=vector,
        linear_acceleration_covariance=nine,
    )


def test_a_recorded_replay_equals_the_bag_message_by_message(ros: Any, start: Any, tmp_path: Path) -> None:
    from subiaco_mapping.nodes.replay_node import build as build_replay

    source = write_survey(tmp_path / "source")
    app = start()
    replay = build_replay(ros.node("replay", bags=[str(source)], rate=1.0))
    topics = (METADATA, TF_STATIC, LIDAR_PACKETS, IMU)
    ros.until(lambda: listening(app, *topics))
    ros.apps.append(replay)
    ros.until(lambda: replay.done and received(app, LIDAR_PACKETS) == 300 and received(app, IMU) == 30)
    app.close()
    for topic in topics:
        assert recorded(tmp_path / "drive", topic) == recorded(source, topic)
    assert [counter.lost for counter in app.listener.counters.values()] == [0] * len(app.listener.counters)


def test_the_offered_quality_is_adopted_and_written_for_bag_play(
    ros: Any, start: Any, tmp_path: Path
) -> None:
    from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
    from sensor_msgs.msg import NavSatFix
    from std_msgs.msg import String

    latched = publisher(ros, METADATA, String, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    latched.publish(String(data="said before anybody listened"))
    weak = publisher(ros, FIX, NavSatFix, reliability=ReliabilityPolicy.BEST_EFFORT)
    app = start()
    ros.until(lambda: listening(app, METADATA, FIX) and weak.get_subscription_count())
    weak.publish(NavSatFix())
    ros.until(lambda: received(app, METADATA) and received(app, FIX))
    app.close()
    document = yaml.safe_load((tmp_path / "drive" / "metadata.yaml").read_text())
    offered = {
        t["topic_metadata"]["name"]: t["topic_metadata"]["offered_qos_profiles"][0]
        for t in document["rosbag2_bagfile_information"]["topics_with_message_count"]
    }
    assert offered[METADATA]["durability"] == "transient_local"
    assert offered[METADATA]["reliability"] == "reliable"
    assert offered[FIX]["reliability"] == "best_effort"
    assert len(recorded(tmp_path / "drive", METADATA)) == 1


def test_a_driver_that_comes_back_with_another_quality_is_heard_again(
    ros: Any, start: Any, tmp_path: Path
) -> None:
    from rclpy.qos import ReliabilityPolicy

    app = start()
    first = publisher(ros, LIDAR_PACKETS)
    ros.until(lambda: listening(app, LIDAR_PACKETS) and first.get_subscription_count())
    first.publish(packet(0))
    ros.until(lambda: received(app, LIDAR_PACKETS) == 1)
    ros._nodes[-1].destroy_publisher(first)
    second = publisher(ros, LIDAR_PACKETS, reliability=ReliabilityPolicy.BEST_EFFORT)
    ros.until(second.get_subscription_count)
    assert "best effort" in " ".join(app.listener.complaints())
    second.publish(packet(1))
    ros.until(lambda: received(app, LIDAR_PACKETS) == 2)
    app.close()
    assert recorded(tmp_path / "drive", LIDAR_PACKETS) == [packet(0), packet(1)]


def test_a_remapped_driver_is_recorded_under_our_name(ros: Any, start: Any, tmp_path: Path) -> None:
    theirs = publisher(ros, "/their/packets")
    app = start(record__topics=["/their/packets"], record__all_topics=False)
    ros.until(lambda: listening(app, "/their/packets") and theirs.get_subscription_count())
    theirs.publish(packet(3))
    ros.until(lambda: received(app, "/their/packets") == 1)
    app.close()
    assert recorded(tmp_path / "drive", "/their/packets") == [packet(3)]


def test_losses_appear_on_diagnostics_by_topic(ros: Any, start: Any) -> None:
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
    from sensor_msgs.msg import Imu

    reports = ros.collect(ros.node("reader"), DiagnosticArray, "/diagnostics", latched=False)
    driver = publisher(ros, IMU, Imu)
    app = start()
    ros.until(lambda: listening(app, IMU) and driver.get_subscription_count())
    for k in range(60):
        if k not in (40, 41):
            message = Imu()
            message.header.stamp.nanosec = k * 10_000_000
            driver.publish(message)
    ros.until(lambda: received(app, IMU) == 58)

    def told() -> list[Any]:
        ours = [s for r in reports for s in r.status if s.name == "recorder0: recording"]
        return [s for s in ours if s.level == DiagnosticStatus.WARN and "2 messages lost" in s.message]

    ros.until(told)
    values = {value.key: value.value for value in told()[-1].values}
    assert "lost_by_stamp=2" in values[IMU]
    assert "lost_in_transport=0" in values[IMU]


def test_packets_that_came_before_the_metadata_are_counted_too(ros: Any, start: Any, tmp_path: Path) -> None:
    """A driver may send its metadata late, and its cable may be out meanwhile."""
    from rclpy.qos import DurabilityPolicy
    from std_msgs.msg import String

    from subiaco_sim.config import LidarMode
    from subiaco_sim.packets import sensor_info

    info = sensor_info(LidarMode.COLUMNS_512, dual=False, beams=16)
    layout = core.PacketFormat(info)

    def sent(frame: int) -> bytes:
        packet = core.LidarPacket(layout)
        layout.set_frame_id(packet, frame)
        return packet_to_cdr(bytes(packet.buf))

    driver = publisher(ros, LIDAR_PACKETS)
    app = start()
    ros.until(lambda: listening(app, LIDAR_PACKETS) and driver.get_subscription_count())
    for frame in (1, 11):  # frames of 32 packets, of which each first one is sent
        driver.publish(sent(frame))
    ros.until(lambda: received(app, LIDAR_PACKETS) == 2)
    assert app.listener.facts()[LIDAR_PACKETS]["without_metadata"] == 2
    latched = publisher(ros, METADATA, String, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    latched.publish(String(data=info.to_json_string()))
    ros.until(lambda: "lost_at_sensor" in app.listener.facts()[LIDAR_PACKETS])
    assert app.listener.facts()[LIDAR_PACKETS]["lost_at_sensor"] == 10 * 32 - 1
    app.close()
    facts = yaml.safe_load((tmp_path / "drive" / "recording.yaml").read_text())
    assert facts["topics"][LIDAR_PACKETS]["lost_at_sensor"] == 10 * 32 - 1


def test_every_other_topic_is_recorded_where_asked(ros: Any, start: Any, tmp_path: Path) -> None:
    from subiaco_msgs.msg import ReplayCounts

    driver = publisher(ros, "/our/counts", ReplayCounts)
    app = start(record__all_topics=True)
    ros.until(lambda: listening(app, "/our/counts") and driver.get_subscription_count())
    driver.publish(ReplayCounts(source="x", topics=["/a"], counts=[4]))
    ros.until(lambda: received(app, "/our/counts") == 1)
    app.close()
    with BagReader(tmp_path / "drive") as reader:
        (message,) = reader.messages(["/our/counts"])
        assert list(reader.deserialize(message).counts) == [4]


def test_a_recorder_in_a_namespace_takes_our_topics_from_it_and_others_by_their_full_name(
    ros: Any, start: Any, tmp_path: Path
) -> None:
    from subiaco_msgs.msg import ReplayCounts

    inside, outside = publisher(ros, "/left/ouster/lidar_packets"), publisher(ros, LIDAR_PACKETS)
    others = [publisher(ros, topic, ReplayCounts) for topic in ("/left/counts", "/right/counts")]
    app = start(namespace="left", record__all_topics=True)
    ros.until(lambda: listening(app, LIDAR_PACKETS, "/left/counts", "/right/counts"))
    ros.until(lambda: all(p.get_subscription_count() for p in (inside, *others)))
    assert outside.get_subscription_count() == 0
    for sender, number in ((inside, 1), (outside, 2)):
        sender.publish(packet(number))
    for sender in others:
        sender.publish(ReplayCounts(source=sender.topic_name))
    ros.until(lambda: all(received(app, t) == 1 for t in (LIDAR_PACKETS, "/left/counts", "/right/counts")))
    app.close()
    assert recorded(tmp_path / "drive", LIDAR_PACKETS) == [packet(1)]
    with BagReader(tmp_path / "drive") as reader:
        said = {m.topic: reader.deserialize(m).source for m in reader.messages(["/left/counts"])}
    assert said == {"/left/counts": "/left/counts"}


def test_a_full_disk_ends_the_process_with_its_reason_or_stays_and_says_so(ros: Any, start: Any) -> None:
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

    from subiaco_geo.errors import InputError

    reports = ros.collect(ros.node("reader"), DiagnosticArray, "/diagnostics", latched=False)
    ending, staying = start("a"), start("b", record__exit_when_stopped=False)
    for app in (ending, staying):
        app.recorder._stop("disk full", "stopped, all files whole: only 0.1 GB are free")
    with pytest.raises(InputError, match=r"only 0\.1 GB are free"):
        ending.step()
    ros.apps.remove(ending)

    def told() -> bool:
        found = [s for r in reports for s in r.status if s.name == "recorder1: recording"]
        return any(s.level == DiagnosticStatus.ERROR and "only 0.1 GB" in s.message for s in found)

    ros.until(told)


class Recording:
    """``subiaco record`` as people run it, in a domain of its own."""

    def __init__(self, folder: Path, domain: int, *options: str) -> None:
        values = ("stop_free_gb=0", "warn_free_gb=0", f'topics=["{LIDAR_PACKETS}"]')
        settings = [word for value in values for word in ("--set", f"record.{value}")]
        self.process = subprocess.Popen(
            [
                sys.executable,
                "-m",
                "subiaco_bringup.cli.main",
                "record",
                "-o",
                str(folder),
                *settings,
                *options,
            ],
            env={**os.environ, "ROS_DOMAIN_ID": str(domain)},
            stderr=subprocess.PIPE,
            text=True,
        )

    def node(self) -> int | None:
        """Return the process id of the node, once it runs."""
        import psutil

        children = psutil.Process(self.process.pid).children()
        return children[0].pid if children else None

    def finish(self) -> tuple[int, str]:
        """Wait for the end; return the exit code and what was said."""
        _, said = self.process.communicate(timeout=60)
        return self.process.returncode, said


def feed(ros: Any, driver: Any, numbers: range, listeners: int = 1) -> None:
    """Publish packets a few at a time once so many listen; one that was killed counts for a while."""
    ros.until(lambda: driver.get_subscription_count() >= listeners, timeout=60)
    for k in numbers:
        driver.publish(packet(k))
        if k % 10 == 0:
            ros.executor.spin_once(timeout_sec=0.002)


def written(folder: Path) -> int:
    """Return the bytes of all files so far."""
    return sum(path.stat().st_size for path in folder.glob("*.mcap*")) if folder.is_dir() else 0


def test_a_killed_recorder_goes_on_with_a_new_file_and_ctrl_c_ends_it_whole(ros: Any, tmp_path: Path) -> None:
    domain, folder = ros.context.get_domain_id(), tmp_path / "drive"
    driver = publisher(ros, LIDAR_PACKETS)
    recording = Recording(folder, domain)
    feed(ros, driver, range(200))
    ros.until(lambda: written(folder) > 200 * SIZE, timeout=60)
    killed = recording.node()
    os.kill(killed, signal.SIGKILL)
    ros.until(lambda: recording.node() not in (None, killed), timeout=60)
    feed(ros, driver, range(200, 300), listeners=2)  # the killed one counts for a while
    ros.until(lambda: written(folder) > 300 * SIZE, timeout=60)
    recording.process.send_signal(signal.SIGINT)
    code, said = recording.finish()
    assert code == 0, said
    assert "recorder was killed by SIGKILL" in said
    assert "starting it again" in said
    assert "nothing was lost" in said

    result = recover_bag(folder)
    kept = result.files[0].counts[LIDAR_PACKETS]
    assert kept >= 195  # what was on the disk when it was killed, a few at most on their way
    assert recorded(result.target, LIDAR_PACKETS) == [packet(k) for k in (*range(kept), *range(200, 300))]


def test_a_recording_to_which_no_sensor_speaks_says_so_with_its_exit_code(ros: Any, tmp_path: Path) -> None:
    recording = Recording(tmp_path / "drive", ros.context.get_domain_id(), "--duration", "1")
    code, said = recording.finish()
    assert code == 2
    assert f"no LiDAR data ({LIDAR_PACKETS}, {POINTS}) was recorded" in said
