"""Recordings of packets that cannot be imported."""

from __future__ import annotations

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
    refused(
        ["import", negative("empty_pcap"), "-o", tmp_path / "bag"], "no LiDAR packet", "check"
    )


def test_a_capture_of_damaged_packets(command, negative, tmp_path):
    """Whatever a packet's checksum says, its bytes are archived as they came: the decoder judges them."""
    ran = command("import", negative("crc_test"), "-o", tmp_path / "bag")
    assert "Traceback" not in ran.err
    assert ran.code in (0, 2)
    assert (tmp_path / "bag").exists() == (ran.code == 0)


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
