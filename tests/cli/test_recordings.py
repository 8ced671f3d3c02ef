"""Recordings of packets that cannot be imported."""

from __future__ import annotations

import json
import shutil

import pytest


@pytest.fixture
def negative(shared_data, tmp_path):
    """Return a function that copies a damaged capture, with or without its JSON."""
    folder = shared_data / "ouster" / "negative"
    if not folder.is_dir():
        pytest.skip(f"no damaged captures: {folder} is no folder")

    def copy(name, with_json=True):
        for ending in (".pcap", ".json") if with_json else (".pcap",):
            shutil.copy(folder / f"{name}{ending}", tmp_path / f"{name}{ending}")
        return tmp_path / f"{name}.pcap"

    return copy


@pytest.mark.parametrize("name", ["empty_pcap", "crc_test"])
def test_captures_are_not_mapped_but_imported_first(refused, negative, tmp_path, name):
    recording = negative(name)
    refused(["map", recording, "-o", tmp_path / "out"], recording.name, "subiaco import")
    refused(["inspect", recording], recording.name, "subiaco import")


def test_an_empty_capture(refused, negative, tmp_path):
    refused(["import", negative("empty_pcap"), "-o", tmp_path / "bag"], "no LiDAR packet", "check")


def test_a_capture_with_holes_is_archived_and_inspection_says_what_is_lost(command, negative, tmp_path):
    ran = command("import", negative("crc_test"), "-o", tmp_path / "bag")
    assert ran.code == 0, ran.err
    assert "34 on /ouster/lidar_packets" in ran.err
    facts = json.loads(command("inspect", tmp_path / "bag", "--json").out)
    assert facts["lidar"]["packets"] == 34
    assert facts["lidar"]["lost"] == 30  # two frames of 32 packets, begun and ended in the middle
    assert any("30 LiDAR packets lost" in warning for warning in facts["warnings"])


def test_a_ros_1_bag_that_is_cut(refused, shared_data, tmp_path):
    whole = shared_data / "ouster" / "512x10_raw.bag"
    if not whole.is_file():
        pytest.skip(f"no ROS 1 recording: {whole}")
    (tmp_path / "cut.bag").write_bytes(whole.read_bytes()[:150_000])
    refused(["import", tmp_path / "cut.bag", "-o", tmp_path / "bag"], "cut.bag", "not a whole ROS 1 bag")


def test_a_capture_read_with_the_metadata_of_another_sensor(refused, shared_data, tmp_path):
    folder = shared_data / "ouster"
    recording = folder / "OS-0-32-U1_v2.2.0_1024x10.pcap"
    other = folder / "OS-0-128-U1_v2.3.0_1024x10.json"
    if not recording.is_file() or not other.is_file():
        pytest.skip(f"no captures of two sensors in {folder}")
    arguments = ["import", recording, "--metadata", other, "-o", tmp_path / "bag"]
    refused(arguments, recording.name, "no LiDAR packet of this sensor", "check")


def test_a_capture_without_its_json(refused, negative, tmp_path):
    recording = negative("crc_test", with_json=False)
    refused(["import", recording, "-o", tmp_path / "bag"], "crc_test.pcap", "--metadata FILE")


def test_a_capture_with_a_json_of_something_else(refused, negative, tmp_path):
    recording = negative("crc_test", with_json=False)
    (tmp_path / "crc_test.json").write_text('{"colour": "blue"}')
    refused(["import", recording, "-o", tmp_path / "bag"], "metadata", ";")
    (tmp_path / "crc_test.json").write_text("not json")
    refused(["import", recording, "-o", tmp_path / "bag"], "metadata", ";")


def test_metadata_that_is_missing(refused, negative, tmp_path):
    arguments = ["import", negative("crc_test"), "-o", tmp_path / "bag", "--metadata", tmp_path / "none.json"]
    refused(arguments, "none.json", "cannot be read")


def test_text_under_the_name_of_a_recording(refused, negative, tmp_path):
    recording = negative("crc_test")
    recording.write_text("no packets here\n" * 50)
    refused(["import", recording, "-o", tmp_path / "bag"], "crc_test.pcap", "check")


def test_a_missing_recording_and_one_of_another_kind(refused, tmp_path):
    refused(
        ["import", tmp_path / "none.pcap", "-o", tmp_path / "bag"], "none.pcap: no such recording", "give"
    )
    (tmp_path / "drive.mp4").write_bytes(b"film")
    refused(["import", tmp_path / "drive.mp4", "-o", tmp_path / "bag"], "drive.mp4", ".pcap")


def test_a_ros_1_bag_that_is_none(refused, tmp_path):
    (tmp_path / "drive.bag").write_bytes(b"#ROSBAG V2.0\nand then nothing")
    refused(["import", tmp_path / "drive.bag", "-o", tmp_path / "bag"], "drive.bag", "not a whole ROS 1 bag")
    (tmp_path / "drive.bag").write_bytes(b"")
    refused(["import", tmp_path / "drive.bag", "-o", tmp_path / "bag"], "drive.bag", "not a whole ROS 1 bag")
