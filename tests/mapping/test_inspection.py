"""Whether a bag is usable, and why not: ours, theirs, and broken ones."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from streams import START_NS, small_sensor, turn_packets

from subiaco_geo.bags import TYPESTORE, BagReader, BagWriter, packet_to_cdr
from subiaco_geo.topics import FIX, IMU, LIDAR_PACKETS, MESSAGE_TYPES, METADATA, POINTS, TF_STATIC
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.health_monitor.flags import MEANINGS
from subiaco_mapping.inspection.inspect_bag import describe, inspect_bag
from subiaco_mapping.named_bags import NamedBagReader, open_bag
from subiaco_mapping.topic_names import TopicsConfig

T = TYPESTORE.types
Keep = Callable[[float], bool]


def header(time_ns: int, frame: str) -> Any:
    stamp = T["builtin_interfaces/msg/Time"](sec=time_ns // 10**9, nanosec=time_ns % 10**9)
    return T["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)


def imu(time_ns: int, k: int) -> Any:
    vector, turn = T["geometry_msgs/msg/Vector3"], T["geometry_msgs/msg/Quaternion"]
    return T["sensor_msgs/msg/Imu"](
        header=header(time_ns, "imu_link"),
        orientation=turn(x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=np.array([-1.0, *[0.0] * 8]),
        angular_velocity=vector(x=0.001 * (k % 7), y=0.0, z=0.0),
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=vector(x=0.0, y=0.01 * (k % 5), z=9.81),
        linear_acceleration_covariance=np.zeros(9),
    )


def fix(time_ns: int, status: int, sigma: float) -> Any:
    return T["sensor_msgs/msg/NavSatFix"](
        header=header(time_ns, "gps"),
        status=T["sensor_msgs/msg/NavSatStatus"](status=status, service=1),
        latitude=-31.95 + (time_ns - START_NS) * 1e-9 * 7e-5,
        longitude=115.83,
        altitude=20.0,
        position_covariance=np.diag([sigma, sigma, 2 * sigma]).ravel() ** 2,
        position_covariance_type=2,
    )


def cloud(time_ns: int, times: bool) -> Any:
    """Return a small PointCloud2 as ouster_ros makes it: x y z intensity, and t [ns] if so."""
    names = [("x", 7), ("y", 7), ("z", 7), ("intensity", 7)] + ([("t", 6)] if times else [])
    field = T["sensor_msgs/msg/PointField"]
    fields = [field(name=n, offset=4 * k, datatype=kind, count=1) for k, (n, kind) in enumerate(names)]
    step = 4 * len(names)
    return T["sensor_msgs/msg/PointCloud2"](
        header=header(time_ns, "os_lidar"), height=1, width=3, fields=fields, is_bigendian=False,
        point_step=step, row_step=3 * step, data=np.zeros(3 * step, np.uint8), is_dense=True,
    )  # fmt: skip


def drive_bag(
    path: Path,
    names: dict[str, str] | None = None,
    *,
    seconds: float = 8.0,
    lidar: str = "packets",
    lidar_on: Keep = lambda _s: True,
    imu_on: Keep = lambda _s: True,
    gnss_on: Keep = lambda _s: True,
    clock: float = 0.0,
    status: int = 2,
    sigma: float = 0.014,
) -> Path:
    """Write a drive; ``names`` are those of the bag for ours."""
    called = names or {}
    messages: list[tuple[int, str, Any]] = [(START_NS, TF_STATIC, T["tf2_msgs/msg/TFMessage"](transforms=[]))]
    if lidar == "packets":
        text = T["std_msgs/msg/String"](data=small_sensor().to_json_string())
        messages.append((START_NS, METADATA, text))
    for k in range(int(seconds * 100)):
        time_ns = START_NS + k * 10_000_000
        if imu_on(k / 100):
            messages.append((time_ns + 1_000_000, IMU, imu(time_ns, k)))
        if k % 20 == 0 and gnss_on(k / 100):
            messages.append((time_ns + 60_000_000, FIX, fix(time_ns, status, sigma)))
        if k % 10 == 0 and lidar_on(k / 100):
            stamp_ns = time_ns + int(clock * 1e9)
            if lidar == "packets":
                turn = turn_packets(k // 10, stamp_ns)
                messages += [
                    (time_ns + (j + 1) * 3_125_000, LIDAR_PACKETS, raw) for j, raw in enumerate(turn)
                ]
            else:
                messages.append((time_ns + 100_000_000, POINTS, cloud(stamp_ns, times=lidar == "timed")))
    with BagWriter(path) as writer:
        for time_ns, topic, message in sorted(messages, key=lambda item: item[0]):
            name, kind = called.get(topic, topic), MESSAGE_TYPES[topic]
            if isinstance(message, bytes):
                writer.write_raw(name, kind, message, time_ns)
            else:
                writer.write(name, kind, message, time_ns)
    return path


def test_a_sound_drive_is_usable_without_a_word_against_it(tmp_path: Path) -> None:
    facts = inspect_bag(drive_bag(tmp_path / "bag"))
    assert (facts["verdict"], facts["forbids"], facts["cares"]) == ("usable", [], [])
    assert facts["flagged"] == {}
    assert describe(facts).splitlines()[1] == "verdict: USABLE"
    assert len(describe(facts).splitlines()) < 24, "one screen"
    json.dumps(facts)


THEIRS = {
    LIDAR_PACKETS: "/front/lidar_packets",
    METADATA: "/front/metadata",
    IMU: "/xsens/imu/data",
    FIX: "/ublox_gps_node/fix",
}


def test_their_bag_is_recognised_by_its_types(tmp_path: Path) -> None:
    facts = inspect_bag(drive_bag(tmp_path / "bag", THEIRS))
    assert facts["taken_as"] == {theirs: ours for ours, theirs in THEIRS.items()}
    assert facts["verdict"] == "usable"
    assert "taken as /gnss/fix: /ublox_gps_node/fix" in describe(facts)


def test_their_fixes_are_judged_by_their_drivers_habits(tmp_path: Path) -> None:
    bag = drive_bag(tmp_path / "bag", {FIX: "/ublox_gps_node/fix"}, status=0, sigma=0.4)
    config = MappingConfig.model_validate({"gnss": {"driver": "ublox"}})
    assert inspect_bag(bag, config)["gnss"]["states"] == {"float": 40}
    facts = inspect_bag(bag)
    assert facts["verdict"] == "usable with care"
    assert any(text.startswith("No RTK fixed solution for longer than") for text in facts["cares"])


def test_a_configured_name_is_read_and_wins(tmp_path: Path) -> None:
    bag = drive_bag(tmp_path / "bag", {FIX: "/navsatfix"})
    with open_bag(bag, TopicsConfig(fix="/navsatfix")) as reader:
        assert reader.topics[FIX].count == 40
        assert "/navsatfix" not in reader.topics
        assert {message.topic for message in reader.messages({FIX})} == {FIX}
    with NamedBagReader(bag, {"/navsatfix": FIX, "/nobody": IMU}) as reader, BagReader(bag) as plain:
        assert reader.topics[IMU].count == plain.topics[IMU].count
        assert len(list(reader.messages())) == len(list(plain.messages()))


@pytest.mark.parametrize(
    ("faults", "word", "reason"),
    [
        ({"lidar_on": lambda s: s < 3}, "not usable", "network, driver): once, 5.0 s"),
        ({"lidar_on": lambda s: not 3 <= s < 3.7}, "usable with care", "network, driver): once, 0.8 s"),
        ({"lidar_on": lambda s: s > 3}, "not usable", "the LiDAR begins 3.1 s after the recording (39%"),
        ({"lidar_on": lambda s: s > 1.2}, "usable with care", "the LiDAR begins 1.3 s after the recording"),
        ({"imu_on": lambda _s: False}, "usable with care", "no /imu/data"),
        ({"gnss_on": lambda _s: False}, "usable with care", "no /gnss/fix: the map will be local"),
        ({"status": -1}, "usable with care", "no usable fix on /gnss/fix"),
        ({"gnss_on": lambda s: s < 4}, "usable with care", "The odometry alone gives the position there."),
        ({"clock": 37.0}, "not usable", "The clocks of two sensors disagree: once"),
        ({"clock": -START_NS * 1e-9 + 60.0}, "not usable", "not UTC (lidar): once"),
        ({"lidar": "untimed"}, "not usable", "no time for each point"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said_with_its_weight(
    tmp_path: Path, faults: dict[str, Any], word: str, reason: str
) -> None:
    facts = inspect_bag(drive_bag(tmp_path / "bag", **faults))
    reasons = facts["forbids"] if word == "not usable" else facts["cares"]
    assert facts["verdict"] == word
    assert not [text for text in reasons if any(name in text for name in MEANINGS)], "a code name"
    assert any(text.startswith(reason) or reason in text for text in reasons), (
        facts["forbids"],
        facts["cares"],
    )


def test_a_driver_that_said_that_it_lost_the_pulse_is_heard(tmp_path: Path) -> None:
    kind = "diagnostic_msgs/msg/DiagnosticArray"
    with BagWriter(tmp_path / "bag") as writer:
        for k in range(300):
            time_ns = START_NS + k * 10_000_000
            writer.write(IMU, MESSAGE_TYPES[IMU], imu(time_ns, k), time_ns)
            if k % 100 == 50:
                status = T["diagnostic_msgs/msg/DiagnosticStatus"](
                    level=2 if k == 150 else 0, name="ouster: Sync Pulse In", message="unlocked",
                    hardware_id="", values=[],
                )  # fmt: skip
                writer.write("/diagnostics", kind, T[kind](header(time_ns, ""), [status]), time_ns)
    (lost,) = inspect_bag(tmp_path / "bag")["flagged"]["pps_lost"]
    assert lost["detail"] == "ouster: Sync Pulse In: unlocked"
    assert (lost["start_s"] - START_NS * 1e-9, lost["end_s"] - START_NS * 1e-9) == pytest.approx((1.5, 2.5))


def test_clouds_of_ouster_ros_with_times_are_usable(tmp_path: Path) -> None:
    facts = inspect_bag(drive_bag(tmp_path / "bag", {POINTS: "/ouster/points"}, lidar="timed"))
    assert facts["verdict"] == "usable"
    assert facts["taken_as"] == {"/ouster/points": POINTS}


def test_a_bag_of_other_things_is_not_usable_and_says_how_to_name_a_lidar(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "talk") as writer:
        writer.write("/chatter", "std_msgs/msg/String", T["std_msgs/msg/String"](data="hi"), START_NS)
    facts = inspect_bag(tmp_path / "talk")
    assert facts["verdict"] == "not usable"
    assert "--set topics.points=" in facts["forbids"][0]


def with_messages(source: Path, bag: Path, change: Callable[[str, int, Any], Any]) -> Path:
    """Copy a bag; ``change`` gets topic, number and message (packets: bytes) and returns what is written."""
    seen: dict[str, int] = {}
    with BagReader(source) as reader, BagWriter(bag) as writer:
        for item in reader.messages():
            number = seen[item.topic] = seen.get(item.topic, -1) + 1
            packet = item.topic == LIDAR_PACKETS
            changed = change(item.topic, number, item.raw if packet else reader.deserialize(item))
            if packet:
                writer.write_raw(item.topic, item.msg_type, changed, item.log_time_ns)
            else:
                writer.write(item.topic, item.msg_type, changed, item.log_time_ns)
    return bag


def transform(parent: str, child: str, turn: tuple[float, ...] = (0, 0, 0, 1), x: float = 0.0) -> Any:
    stamped = T["geometry_msgs/msg/TransformStamped"]
    pose = T["geometry_msgs/msg/Transform"](
        translation=T["geometry_msgs/msg/Vector3"](x=x, y=0.0, z=1.0),
        rotation=T["geometry_msgs/msg/Quaternion"](*map(float, turn)),
    )
    return stamped(header=header(START_NS, parent), child_frame_id=child, transform=pose)


FRAMES = {
    "a loop": ([transform("a", "b"), transform("b", "a")], "loop"),
    "a zero quaternion": ([transform("base_link", "imu_link", (0, 0, 0, 0))], "unit quaternion"),
    "NaN": ([transform("base_link", "gnss_link", x=float("nan"))], "not finite"),
}


@pytest.mark.parametrize("name", list(FRAMES))
def test_frames_that_are_none_are_not_usable(tmp_path: Path, name: str) -> None:
    transforms, said = FRAMES[name]

    def change(topic: str, _: int, message: Any) -> Any:
        return T["tf2_msgs/msg/TFMessage"](transforms=transforms) if topic == TF_STATIC else message

    facts = inspect_bag(with_messages(drive_bag(tmp_path / "a", seconds=2.0), tmp_path / "bag", change))
    assert facts["verdict"] == "not usable"
    assert said in facts["forbids"][0]


def test_packets_that_are_all_malformed_are_not_usable(tmp_path: Path) -> None:
    def change(topic: str, _: int, message: Any) -> Any:
        return packet_to_cdr(bytes(100)) if topic == LIDAR_PACKETS else message

    facts = inspect_bag(with_messages(drive_bag(tmp_path / "a", seconds=2.0), tmp_path / "bag", change))
    assert facts["verdict"] == "not usable"
    assert "LiDAR packets are malformed" in facts["forbids"][0]


@pytest.mark.parametrize("kept", ["every eighth packet", "the first packets of a turn", "every eighth turn"])
def test_a_bag_without_most_of_its_packets_is_not_usable_and_the_loss_is_named(
    tmp_path: Path, kept: str
) -> None:
    source, turn = drive_bag(tmp_path / "a", seconds=4.0), 32
    keep: dict[str, Callable[[int], bool]] = {
        "every eighth packet": lambda n: n % 8 == 0,
        "the first packets of a turn": lambda n: n % turn < turn // 8,
        "every eighth turn": lambda n: (n // turn) % 8 == 0,
    }
    number = -1
    with BagReader(source) as reader, BagWriter(tmp_path / "bag") as writer:
        for item in reader.messages():
            number += item.topic == LIDAR_PACKETS
            if item.topic != LIDAR_PACKETS or keep[kept](number):
                writer.write_raw(item.topic, item.msg_type, item.raw, item.log_time_ns)
    facts = inspect_bag(tmp_path / "bag")
    assert facts["verdict"] == "not usable"
    assert re.search(r"8[5-8]% of the LiDAR packets lost", facts["forbids"][0]), facts["forbids"]
    assert "of the LiDAR packets lost" in describe(facts).splitlines()[2]


@pytest.mark.parametrize(
    ("every", "latitude", "longitude", "verdict", "said"),
    [
        (1, 0.0, 0.0, "not usable", "0 N 0 E"),
        (2, -22.95, 115.83, "not usable", "fixes jump, by up to 1001 km"),
        (30, -22.95, 115.83, "usable with care", "2 fixes jump, by up to 1000.7 km"),
        (1, 49.04, 8.44, "usable with care", "--set crs=EPSG:25832"),
    ],
)
def test_fixes_that_cannot_place_a_map_are_told(
    tmp_path: Path, every: int, latitude: float, longitude: float, verdict: str, said: str
) -> None:
    def change(topic: str, number: int, message: Any) -> Any:
        if topic == FIX and number % every == every - 1:
            message.latitude, message.longitude = latitude, longitude
        return message

    bag = with_messages(drive_bag(tmp_path / "a"), tmp_path / "bag", change)
    facts = inspect_bag(bag, MappingConfig(crs="EPSG:7850"))
    assert facts["verdict"] == verdict
    assert any(said in text for text in facts["forbids"] + facts["cares"])


def test_fixes_too_few_to_place_a_map_ask_for_care(tmp_path: Path) -> None:
    def keep(topic: str, number: int, message: Any) -> Any:
        if topic == FIX and number >= 7:
            message.status.status = -1
        return message

    facts = inspect_bag(with_messages(drive_bag(tmp_path / "a"), tmp_path / "bag", keep))
    assert facts["verdict"] == "usable with care"
    assert any("7 usable GNSS fixes, 10 are needed to place the map" in text for text in facts["cares"])


def test_a_second_lidar_is_named(tmp_path: Path) -> None:
    bag = drive_bag(tmp_path / "a", lidar="timed", seconds=2.0)
    with BagReader(bag) as reader, BagWriter(tmp_path / "two") as writer:
        for item in reader.messages():
            writer.write_raw(item.topic, item.msg_type, item.raw, item.log_time_ns)
            if item.topic == POINTS:
                writer.write_raw("/rear/points", item.msg_type, item.raw, item.log_time_ns)
    facts = inspect_bag(tmp_path / "two")
    assert facts["verdict"] == "usable with care"
    assert any("/rear/points is not mapped" in text for text in facts["cares"])


def test_the_command_ends_with_two_where_a_bag_is_not_usable(tmp_path: Path) -> None:
    from subiaco_bringup.cli.main import run

    assert run(["inspect", str(drive_bag(tmp_path / "sound", seconds=2.0))]) == 0
    bag = with_messages(
        tmp_path / "sound", tmp_path / "bag",
        lambda topic, _, m: packet_to_cdr(bytes(100)) if topic == LIDAR_PACKETS else m,
    )  # fmt: skip
    assert run(["inspect", str(bag)]) == 2
