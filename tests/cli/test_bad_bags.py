"""Bags that cannot be mapped: exit 2, one line, the remedy, nothing left."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from small_bags import START_NS, cloud, points_bag, room, text, text_bag

from subiaco_geo.bags import BagReader, BagWriter
from subiaco_geo.topics import IMU, LIDAR_PACKETS, MESSAGE_TYPES, METADATA, POINTS

PERTH = (-31.948, 115.825, 20.0)


def test_a_missing_bag(refused, tmp_path):
    refused(["map", tmp_path / "none", "-o", tmp_path / "out"], "none: no such bag", "give a rosbag2 folder")
    refused(["inspect", tmp_path / "none"], "none: no such bag", "give a rosbag2 folder")


def test_a_folder_that_is_no_bag(refused, tmp_path):
    (tmp_path / "photos").mkdir()
    refused(
        ["map", tmp_path / "photos", "-o", tmp_path / "out"], "photos: not a bag", "give a rosbag2 folder"
    )
    refused(["inspect", tmp_path / "photos"], "photos: not a bag", "give a rosbag2 folder")


@pytest.mark.parametrize("kept", [0.5, 0.02])
@pytest.mark.parametrize("as_folder", [True, False])
def test_a_cut_recording(refused, tmp_path, survey, kept, as_folder):
    bag = tmp_path / "cut"
    shutil.copytree(survey / "before" / "bag", bag)
    (file,) = bag.glob("*.mcap")
    data = file.read_bytes()
    file.write_bytes(data[: int(len(data) * kept)])
    path = bag if as_folder else file
    refused(["map", path, "-o", tmp_path / "out"], file.name, "is cut", "subiaco recover")
    refused(["inspect", path], file.name, "is cut", "subiaco recover")


def test_a_recording_with_damaged_bytes_in_the_middle(refused, tmp_path, survey):
    bag = tmp_path / "damaged"
    shutil.copytree(survey / "before" / "bag", bag)
    (file,) = bag.glob("*.mcap")
    data = bytearray(file.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 400] = bytes(400)
    file.write_bytes(data)
    refused(["map", bag, "-o", tmp_path / "out"], "damaged", "subiaco recover")


def packets_without_metadata(path: Path, survey: Path, as_type: str | None = None) -> Path:
    """Copy the first packets of the simulated bag; ``as_type`` puts text on the metadata topic's place."""
    with BagReader(survey / "before") as reader, BagWriter(path) as writer:
        for number, message in enumerate(reader.messages({LIDAR_PACKETS})):
            if number == 20:
                break
            writer.write_raw(message.topic, message.msg_type, message.raw, message.log_time_ns)
        if as_type is not None:
            writer.write(METADATA, as_type, text('{"not": "a sensor"}'), START_NS, latched=True)
    return path


def test_packets_without_metadata(refused, tmp_path, survey):
    bag = packets_without_metadata(tmp_path / "mute", survey)
    refused(["map", bag, "-o", tmp_path / "out"], "mute: no topic /ouster/metadata", "record it")
    refused(["inspect", bag], "mute: no topic /ouster/metadata", "record it")


def test_metadata_of_no_sensor(refused, tmp_path, survey):
    bag = packets_without_metadata(tmp_path / "odd", survey, "std_msgs/msg/String")
    refused(["map", bag, "-o", tmp_path / "out", "--set", "sensors.lidar={}"], "/ouster/metadata", ";")
    refused(["inspect", bag], "/ouster/metadata", ";")


@pytest.mark.parametrize("topic", [LIDAR_PACKETS, POINTS])
def test_a_lidar_topic_of_the_wrong_type(refused, tmp_path, topic):
    bag = text_bag(tmp_path / "wrong", topic)
    expected = f"{topic} is std_msgs/msg/String, expected {MESSAGE_TYPES[topic]}"
    refused(["map", bag, "-o", tmp_path / "out"], "wrong", expected, "remap")


def test_an_imu_topic_of_the_wrong_type(refused, tmp_path):
    with BagWriter(tmp_path / "wrong") as writer:
        writer.write(POINTS, MESSAGE_TYPES[POINTS], cloud(START_NS, room()), START_NS)
        writer.write(IMU, "std_msgs/msg/String", text("hello"), START_NS)
    refused(["map", tmp_path / "wrong", "-o", tmp_path / "out"], IMU, "std_msgs/msg/String", "remap")
    refused(["inspect", tmp_path / "wrong"], IMU, "std_msgs/msg/String", "remap")


def test_a_bag_without_any_lidar(refused, tmp_path):
    bag = text_bag(tmp_path / "talk", "/chatter")
    refused(["map", bag, "-o", tmp_path / "out"], "talk: no LiDAR topic", "/chatter", "remap")


def test_a_graph_names_the_bag_without_any_lidar_and_its_topics(refused, tmp_path):
    bag = text_bag(tmp_path / "talk", "/chatter")
    run = ["graph", "mapping", bag, "-o", tmp_path / "out"]
    refused(run, "talk: no LiDAR topic", "it has /chatter", "remap")


def test_an_empty_bag(refused, tmp_path):
    with BagWriter(tmp_path / "empty"):
        pass
    refused(["map", tmp_path / "empty", "-o", tmp_path / "out"], "empty: the bag is empty", "record again")
    refused(["inspect", tmp_path / "empty"], "empty: the bag is empty", "record again")


def test_fixes_that_are_all_nan_are_no_reference_where_one_is_required(refused, tmp_path):
    nothing = (np.nan, np.nan, np.nan)
    bag = points_bag(tmp_path / "blind", [room(i) for i in range(4)], [nothing] * 4)
    options = ["--set", "deskewed=true", "--set", "gnss.required=true", "--threads", "1"]
    line = refused(
        ["map", bag, "-o", tmp_path / "out", *options], "blind: cannot be georeferenced", "gnss.required"
    )
    assert "usable" in line or "fixes" in line


def test_fixes_that_are_all_nan_otherwise_give_a_local_map_that_says_so(command, tmp_path):
    nothing = (np.nan, np.nan, np.nan)
    bag = points_bag(tmp_path / "blind", [room(i) for i in range(4)], [nothing] * 4)
    ran = command("map", bag, "-o", tmp_path / "out", "--set", "deskewed=true", "--threads", "1")
    assert ran.code == 0, ran.err
    assert "a local frame without CRS" in ran.err
    assert "crs: null" in (tmp_path / "out" / "map.yaml").read_text()


def test_fixes_without_a_lever_arm(refused, tmp_path):
    bag = points_bag(tmp_path / "armless", [room()], [PERTH], children=("lidar_link",))
    words = ("gnss_link", "/tf_static", "sensors.gnss")
    refused(["map", bag, "-o", tmp_path / "out", "--set", "deskewed=true"], *words)


def test_fixes_without_any_extrinsics(refused, tmp_path):
    bag = points_bag(tmp_path / "loose", [room()], [PERTH], children=())
    refused(["map", bag, "-o", tmp_path / "out", "--set", "deskewed=true"], "/tf_static", "sensors.")


def test_points_without_times_that_are_not_said_to_be_deskewed(refused, tmp_path):
    bag = points_bag(tmp_path / "timeless", [room()])
    refused(["map", bag, "-o", tmp_path / "out"], "/lidar/points: no per-point time", "deskewed: true")


def test_clouds_without_points(refused, tmp_path):
    bag = points_bag(tmp_path / "hollow", [np.zeros((0, 3))] * 3)
    words = ("hollow: no scan", "/lidar/points", "check")
    refused(["map", bag, "-o", tmp_path / "out", "--set", "deskewed=true"], *words)


def test_clouds_of_nan_points(refused, tmp_path):
    bag = points_bag(tmp_path / "foggy", [np.full((50, 3), np.nan)] * 3)
    words = ("foggy: no scan", "/lidar/points", "check")
    refused(["map", bag, "-o", tmp_path / "out", "--set", "deskewed=true"], *words)


def test_a_map_crs_that_does_not_exist(refused, tmp_path):
    bag = points_bag(tmp_path / "bag", [room()])
    refused(
        ["map", bag, "-o", tmp_path / "out", "--set", "crs=EPSG:999999"], "EPSG:999999", "give an EPSG code"
    )


def test_a_map_crs_in_degrees(refused, tmp_path):
    bag = points_bag(tmp_path / "bag", [room()])
    refused(["map", bag, "-o", tmp_path / "out", "--set", "crs=EPSG:7844"], "crs", "choose one in metres")


def test_two_bags_of_one_name(refused, tmp_path):
    for place in ("monday", "tuesday"):
        points_bag(tmp_path / place / "drive", [room(i) for i in range(3)])
    bags = [tmp_path / place / "drive" for place in ("monday", "tuesday")]
    refused(["map", *bags, "-o", tmp_path / "out", "--set", "deskewed=true"], "'drive'", "rename")
