"""Bags: what is written is read back; what is wrong is said in one line."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from mcap.writer import Writer as RawMcapWriter

from subiaco_geo import topics
from subiaco_geo.bags import (
    TYPESTORE,
    BagMessage,
    BagReader,
    BagWriter,
    hash_bag,
    packet_from_cdr,
    packet_to_cdr,
    require_topic,
)
from subiaco_geo.errors import InputError

PACKETS = [bytes(range(i, i + 40)) for i in range(5)]


def string_message(text: str) -> object:
    return TYPESTORE.types["std_msgs/msg/String"](data=text)


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """Five packets at 10, 20 ... ns and the sensor's metadata at 5 ns."""
    path = tmp_path / "survey"
    with BagWriter(path) as writer:
        writer.write(topics.METADATA, "std_msgs/msg/String", string_message("{}"), 5, latched=True)
        for i, packet in enumerate(PACKETS):
            writer.write_raw(topics.LIDAR_PACKETS, topics.PACKET_TYPE, packet_to_cdr(packet), 10 * (i + 1))
    return path


def test_messages_come_back_in_log_time_order_with_their_bytes(bag: Path) -> None:
    with BagReader(bag) as reader:
        messages = list(reader.messages())
    assert [m.log_time_ns for m in messages] == [5, 10, 20, 30, 40, 50]
    assert [bytes(packet_from_cdr(m.raw)) for m in messages[1:]] == PACKETS


def test_messages_written_out_of_order_are_read_in_log_time_order(tmp_path: Path) -> None:
    times = np.random.default_rng(1).permutation(3000)
    with BagWriter(tmp_path / "b") as writer:
        for t in times.tolist():
            writer.write_raw(topics.LIDAR_PACKETS, topics.PACKET_TYPE, packet_to_cdr(bytes(2000)), t + 1)
    with BagReader(tmp_path / "b") as reader:
        assert [m.log_time_ns for m in reader.messages()] == list(range(1, 3001))


def test_summary_tells_topics_types_counts_and_span(bag: Path) -> None:
    with BagReader(bag) as reader:
        assert (reader.start_ns, reader.end_ns) == (5, 50)
        assert reader.topics[topics.LIDAR_PACKETS].count == 5
        assert require_topic(reader, topics.METADATA, "std_msgs/msg/String").count == 1


def test_only_the_topics_asked_for_are_read(bag: Path) -> None:
    with BagReader(bag) as reader:
        assert [m.topic for m in reader.messages([topics.METADATA])] == [topics.METADATA]
        assert list(reader.messages(["/nothing"])) == []


def test_a_message_is_deserialised_on_demand(bag: Path) -> None:
    with BagReader(bag) as reader:
        message = next(reader.messages([topics.METADATA]))
        assert reader.deserialize(message).data == "{}"


def test_the_same_bag_is_found_as_folder_file_and_simulated_epoch(bag: Path, tmp_path: Path) -> None:
    epoch = tmp_path / "before"
    shutil.copytree(bag, epoch / "bag")
    bare = tmp_path / "bare"
    bare.mkdir()
    shutil.copy(bag / "survey.mcap", bare / "x.mcap")
    for path in (bag / "survey.mcap", epoch, bare):
        with BagReader(path) as reader:
            assert len(list(reader.messages())) == 6
        assert hash_bag(path) == hash_bag(bag)


def test_the_hash_changes_with_the_messages(bag: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    with BagWriter(other) as writer:
        writer.write_raw(topics.LIDAR_PACKETS, topics.PACKET_TYPE, packet_to_cdr(b"x"), 10)
    assert hash_bag(other) != hash_bag(bag)


def test_latched_topics_offer_transient_local_to_ros2_bag_play(bag: Path) -> None:
    document = yaml.safe_load((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    offered = {
        t["topic_metadata"]["name"]: t["topic_metadata"]["offered_qos_profiles"][0]
        for t in document["topics_with_message_count"]
    }
    assert document["version"] == 9
    assert offered[topics.METADATA]["durability"] == "transient_local"
    assert offered[topics.METADATA]["depth"] == 1
    assert offered[topics.LIDAR_PACKETS]["durability"] == "volatile"
    assert {q["reliability"] for q in offered.values()} == {"reliable"}


def test_every_recorded_type_is_known() -> None:
    assert set(topics.MESSAGE_TYPES.values()) <= set(TYPESTORE.fielddefs)
    assert set(topics.MESSAGE_TYPES) >= topics.LATCHED


def test_packet_cdr_is_what_the_typestore_writes() -> None:
    message = TYPESTORE.types[topics.PACKET_TYPE](buf=np.frombuffer(PACKETS[0], np.uint8))
    assert bytes(TYPESTORE.serialize_cdr(message, topics.PACKET_TYPE)) == packet_to_cdr(PACKETS[0])


def test_a_cut_packet_message_is_refused() -> None:
    with pytest.raises(InputError, match="says 40 bytes, holds 30"):
        packet_from_cdr(packet_to_cdr(PACKETS[0])[:-10])
    with pytest.raises(InputError, match="CDR"):
        packet_from_cdr(b"\x00\x00")


def record_until_the_cable_is_pulled(path: Path) -> None:
    with BagWriter(path) as writer:
        writer.write_raw(topics.LIDAR_PACKETS, topics.PACKET_TYPE, packet_to_cdr(b"x"), 1)
        raise RuntimeError("cable pulled")


def test_a_failed_writer_leaves_nothing_behind(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="cable"):
        record_until_the_cable_is_pulled(tmp_path / "b")
    assert list(tmp_path.iterdir()) == []


def test_an_existing_bag_is_not_overwritten(bag: Path) -> None:
    with pytest.raises(InputError, match="exists already"):
        BagWriter(bag)


def test_writing_an_unknown_type_is_refused(tmp_path: Path) -> None:
    with (
        BagWriter(tmp_path / "b") as writer,
        pytest.raises(InputError, match="/odd: unknown message type odd_"),
    ):
        writer.write_raw("/odd", "odd_msgs/msg/Odd", b"", 1)


def test_a_missing_bag_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nowhere: no such bag; give a rosbag2 folder"):
        BagReader(tmp_path / "nowhere")


@pytest.mark.parametrize("name", ["folder", "notes.txt", "old.bag"])
def test_what_is_not_a_bag_is_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    if "." in name:
        path.write_text("hello")
    else:
        path.mkdir()
    with pytest.raises(InputError, match="subiaco import" if name.endswith(".bag") else "not a bag"):
        BagReader(path)


def test_several_mcaps_without_metadata_ask_for_a_reindex(bag: Path) -> None:
    (bag / "metadata.yaml").unlink()
    shutil.copy(bag / "survey.mcap", bag / "second.mcap")
    with pytest.raises(InputError, match="subiaco recover"):
        BagReader(bag)


@pytest.mark.parametrize("keep", [0.99, 0.5, 0.02])
@pytest.mark.parametrize("as_file", [True, False])
def test_a_truncated_mcap_is_said_to_be_cut(bag: Path, keep: float, as_file: bool) -> None:
    file = bag / "survey.mcap"
    data = file.read_bytes()
    file.write_bytes(data[: max(12, int(len(data) * keep))])
    with pytest.raises(InputError, match=r"survey\.mcap: the recording is cut.*subiaco recover") as caught:
        BagReader(file if as_file else bag).__enter__()
    assert "\n" not in str(caught.value)


def test_text_named_mcap_is_not_an_mcap(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_text("hello, I am no recording at all, but rather long for a text of its kind")
    with pytest.raises(InputError, match="not an mcap file"):
        BagReader(path).__enter__()


def test_a_chunk_that_does_not_unpack_is_damage(bag: Path) -> None:
    file = bag / "survey.mcap"
    data = file.read_bytes()
    frame = data.index(b"\x28\xb5\x2f\xfd")  # where the zstd frame of the chunk begins
    file.write_bytes(data[:frame] + bytes(8) + data[frame + 8 :])
    with BagReader(bag) as reader, pytest.raises(InputError, match=r"the bag is damaged.*subiaco recover"):
        list(reader.messages())


def test_an_empty_bag_is_refused(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "b"):
        pass
    with pytest.raises(InputError, match="the bag is empty; record again"):
        BagReader(tmp_path / "b").__enter__()


def test_a_missing_topic_is_named_with_those_present(bag: Path) -> None:
    with BagReader(bag) as reader, pytest.raises(InputError, match=r"no topic /gnss/fix \(it has /ouster"):
        require_topic(reader, topics.FIX, topics.MESSAGE_TYPES[topics.FIX])


def test_a_wrong_topic_type_names_both_types(bag: Path) -> None:
    with (
        BagReader(bag) as reader,
        pytest.raises(
            InputError, match=r"/ouster/metadata is std_msgs/msg/String, expected sensor_msgs/msg/Imu"
        ),
    ):
        require_topic(reader, topics.METADATA, "sensor_msgs/msg/Imu")


def foreign_mcap(path: Path, definition: str) -> None:
    """Write one message of a type that is not in Jazzy, with a definition of its own."""
    with path.open("wb") as stream:
        writer = RawMcapWriter(stream)
        writer.start(profile="ros2", library="test")
        encoding = "ros2msg" if definition else ""
        schema = writer.register_schema("odd_msgs/msg/Odd", encoding, definition.encode())
        channel = writer.register_channel("/odd", "cdr", schema)
        writer.add_message(channel, 7, b"\x00\x01\x00\x00\x2a\x00\x00\x00", 7)
        writer.finish()


def test_a_type_that_the_bag_defines_is_decoded(tmp_path: Path) -> None:
    foreign_mcap(tmp_path / "odd.mcap", "int32 answer\n")
    with BagReader(tmp_path / "odd.mcap") as reader:
        assert reader.deserialize(next(reader.messages())).answer == 42


def test_a_type_that_nobody_defines_is_refused(tmp_path: Path) -> None:
    foreign_mcap(tmp_path / "odd.mcap", "")
    with BagReader(tmp_path / "odd.mcap") as reader:
        message = next(reader.messages())
        assert message.msg_type == "odd_msgs/msg/Odd"
        with pytest.raises(InputError, match="/odd: unknown message type odd_msgs/msg/Odd"):
            reader.deserialize(message)


def test_a_payload_that_does_not_decode_is_refused(bag: Path) -> None:
    with BagReader(bag) as reader, pytest.raises(InputError, match="cannot be decoded"):
        reader.deserialize(BagMessage(topics.IMU, "sensor_msgs/msg/Imu", 1, b"\x00\x01\x00\x00\x01"))
