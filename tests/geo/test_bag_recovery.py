"""Recordings that were cut or damaged: what can be read is kept, the original stays, the loss is said."""

from __future__ import annotations

import shutil
from io import BytesIO
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import Reader

from subiaco_geo.bag_files import PARTIAL
from subiaco_geo.bag_metadata import describe_segment, write_bag_metadata
from subiaco_geo.bag_records import RecordWalk
from subiaco_geo.bag_recovery import recover_bag
from subiaco_geo.bag_segments import RecordedTopic, SegmentWriter, natural_order, qos_text, sole_writer
from subiaco_geo.bags import TYPESTORE, BagReader, packet_to_cdr
from subiaco_geo.errors import InputError
from subiaco_geo.topics import IMU_PACKETS, LIDAR_PACKETS, PACKET_TYPE

FOREVER = QosTime(9223372036, 854775807)
START_NS = 1_700_000_000_000_000_000
CHUNK = 20


def topic(name: str) -> RecordedTopic:
    """A packet topic as the recorder describes it."""
    offered = Qos(
        QosHistory.UNKNOWN,
        0,
        QosReliability.RELIABLE,
        QosDurability.VOLATILE,
        FOREVER,
        FOREVER,
        QosLiveliness.AUTOMATIC,
        FOREVER,
        avoid_ros_namespace_conventions=False,
    )
    text, _ = TYPESTORE.generate_msgdef(PACKET_TYPE, ros_version=2)
    return RecordedTopic(name, PACKET_TYPE, text, TYPESTORE.hash_rihs01(PACKET_TYPE), qos_text([offered]))


def payload(number: int) -> bytes:
    return packet_to_cdr(number.to_bytes(4, "little") * 64)


def write_segment(path: Path, first: int, count: int, *, close: bool = True) -> SegmentWriter:
    """Write packets ``first``.. alternately on two topics, a chunk every twenty."""
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = SegmentWriter(path)
    for k in range(first, first + count):
        name = IMU_PACKETS if k % 5 == 4 else LIDAR_PACKETS
        writer.write(topic(name), payload(k), START_NS + k * 10**6, START_NS + k * 10**6, k)
        if k % CHUNK == CHUNK - 1:
            writer.flush()
    if close:
        writer.close()
    return writer


def numbers(bag: Path) -> list[int]:
    """Return the numbers of the packets in a bag, in reading order."""
    with BagReader(bag) as reader:
        return [int.from_bytes(m.raw[8:12], "little") for m in reader.messages()]


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Two whole files of 100 packets, and a third one that was killed after 90 of which 80 were flushed."""
    folder = tmp_path / "drive"
    for index in range(2):
        write_segment(folder / f"drive_{index:04d}.mcap", index * 100, 100)
    write_bag_metadata(folder, [describe_segment(p) for p in sorted(folder.glob("*.mcap"))])
    write_segment(folder / "drive_0002.mcap", 200, 90, close=False).abandon()
    return folder


def spoil_chunk(path: Path, number: int) -> None:
    """Overwrite thirty bytes in the middle of one chunk of a whole file."""
    with path.open("rb") as file:
        chunk = make_reader(file).get_summary().chunk_indexes[number]
    data = bytearray(path.read_bytes())
    middle = chunk.chunk_start_offset + chunk.chunk_length // 2
    data[middle : middle + 30] = bytes(30)
    path.write_bytes(data)


def everything_in(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_several_files_are_read_as_one_bag_before_and_after_recovery(recording: Path) -> None:
    assert numbers(recording) == list(range(200))
    result = recover_bag(recording)
    assert numbers(result.target) == list(range(280))
    with BagReader(result.target) as reader:
        assert reader.topics[LIDAR_PACKETS].count == 224
        assert reader.topics[IMU_PACKETS].count == 56
        assert (reader.start_ns, reader.end_ns) == (START_NS, START_NS + 279 * 10**6)


def test_reading_a_recording_with_a_cut_file_says_that_it_is_left_out(
    recording: Path, caplog: pytest.LogCaptureFixture
) -> None:
    numbers(recording)
    assert f"run 'subiaco recover {recording}'" in caplog.text
    caplog.clear()
    recover_bag(recording, in_place=True)
    numbers(recording)
    assert not caplog.records


def test_recovery_says_what_was_kept_and_leaves_the_original_alone(recording: Path) -> None:
    before = everything_in(recording)
    with (recording / f"drive_0002.mcap{PARTIAL}").open("ab") as file:
        file.write(b"\x06" + (5000).to_bytes(8, "little") + bytes(123))
    before[f"drive_0002.mcap{PARTIAL}"] += b"\x06" + (5000).to_bytes(8, "little") + bytes(123)
    result = recover_bag(recording)
    assert everything_in(recording) == before
    assert result.target == recording.with_name("drive.recovered")
    cut = result.files[2]
    assert (cut.messages, cut.bytes_lost, cut.whole) == (80, 132, False)
    assert cut.counts == {LIDAR_PACKETS: 64, IMU_PACKETS: 16}
    assert cut.end_ns == START_NS + 279 * 10**6
    assert [file.whole for file in result.files[:2]] == [True, True]


def test_in_place_the_cut_file_becomes_whole_and_a_second_run_has_nothing_to_do(recording: Path) -> None:
    result = recover_bag(recording, in_place=True)
    assert result.target == recording
    assert sorted(p.name for p in recording.iterdir()) == [
        "drive_0000.mcap",
        "drive_0001.mcap",
        "drive_0002.mcap",
        "metadata.yaml",
    ]
    assert numbers(recording) == list(range(280))
    assert not recover_bag(recording).changed


def test_a_recording_cut_in_its_first_file_says_how_to_mend_it(tmp_path: Path) -> None:
    write_segment(tmp_path / "drive" / "drive_0000.mcap", 0, 50, close=False).abandon()
    with pytest.raises(InputError, match="subiaco recover"), BagReader(tmp_path / "drive"):
        pass
    assert numbers(recover_bag(tmp_path / "drive").target) == list(range(40))


def test_a_file_alone_is_recovered_beside_itself(recording: Path) -> None:
    result = recover_bag(recording / f"drive_0002.mcap{PARTIAL}")
    assert result.target.name == "drive_0002.recovered.mcap"
    assert numbers(result.target) == list(range(200, 280))


def test_lost_metadata_is_written_anew_in_the_order_of_the_numbers(tmp_path: Path) -> None:
    folder = tmp_path / "drive"
    for index in (2, 9, 10):
        write_segment(folder / f"drive_{index}.mcap", index * 100, 20)
    assert [p.name for p in sorted(folder.iterdir(), key=natural_order)] == [
        "drive_2.mcap",
        "drive_9.mcap",
        "drive_10.mcap",
    ]
    recover_bag(folder, in_place=True)
    assert numbers(folder) == [*range(200, 220), *range(900, 920), *range(1000, 1020)]


def test_a_damaged_chunk_in_the_middle_costs_only_itself(tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    write_segment(path, 0, 100)
    spoil_chunk(path, 1)
    result = recover_bag(path)
    kept = numbers(result.target)
    assert set(range(100)) - set(kept) == set(range(20, 40))
    assert result.files[0].damaged_chunks == 1
    assert result.files[0].bytes_lost > 0
    assert result.files[0].messages_lost == {LIDAR_PACKETS: 16, IMU_PACKETS: 4}


def test_the_messages_of_a_damaged_chunk_are_counted_by_its_index_where_no_summary_tells(
    tmp_path: Path,
) -> None:
    walk = RecordWalk(BytesIO(), 0)
    walk.ended, walk.damaged_chunks = True, 1
    assert walk.lost({}) is None
    walk.indexed.update({7: 16})
    assert walk.lost({}) == {"channel 7": 16}


def test_the_messages_behind_a_cut_are_not_known(recording: Path) -> None:
    assert recover_bag(recording).files[2].messages_lost is None


def test_topics_described_in_a_damaged_first_chunk_come_from_the_summary(tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    write_segment(path, 0, 100)
    spoil_chunk(path, 0)
    assert numbers(recover_bag(path).target) == list(range(20, 100))


def test_a_file_of_which_nothing_can_be_kept_is_reported_without_a_target(tmp_path: Path) -> None:
    path = tmp_path / f"drive.mcap{PARTIAL}"
    path.write_bytes(b"\x89MCAP0\r\n")
    result = recover_bag(path)
    assert result.files[0].target is None
    assert result.messages == 0
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    recover_bag(path, in_place=True)
    assert not list(tmp_path.iterdir()), "a file that was opened and never written to goes"


def test_recovery_refuses_what_is_no_recording(tmp_path: Path) -> None:
    (tmp_path / "notes.mcap").write_text("not a bag at all")
    for path, words in [
        (tmp_path / "none", "no such recording"),
        (tmp_path, "wrong first bytes"),
        (tmp_path / "notes.mcap", "wrong first bytes"),
    ]:
        with pytest.raises(InputError, match=words):
            recover_bag(path)
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="no mcap files"):
        recover_bag(tmp_path / "empty")


def test_recovery_keeps_off_a_recording_in_progress(recording: Path) -> None:
    with sole_writer(recording), pytest.raises(InputError, match="is being recorded into"):
        recover_bag(recording)


def test_an_existing_output_is_not_replaced(recording: Path) -> None:
    recover_bag(recording)
    with pytest.raises(InputError, match="exists already"):
        recover_bag(recording)


def test_offered_qos_is_what_rosbag2_and_rosbags_read(recording: Path) -> None:
    with Reader(recording) as reader:
        connection = next(c for c in reader.connections if c.topic == LIDAR_PACKETS)
    (offered,) = connection.ext.offered_qos_profiles
    assert offered.reliability is QosReliability.RELIABLE
    assert offered.durability is QosDurability.VOLATILE
    assert connection.digest.startswith("RIHS01_")


@pytest.fixture(scope="module")
def whole_file(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("whole") / "x.mcap"
    write_segment(path, 0, 200)
    return path.read_bytes()


@settings(max_examples=30)
@given(cut=st.floats(0.01, 1.0))
def test_wherever_a_file_is_cut_a_gapless_beginning_is_kept(
    whole_file: bytes, tmp_path_factory: pytest.TempPathFactory, cut: float
) -> None:
    folder = tmp_path_factory.mktemp("cut")
    path = folder / f"x.mcap{PARTIAL}"
    length = max(8, int(len(whole_file) * cut))
    path.write_bytes(whole_file[:length])
    result = recover_bag(path)
    kept = [] if result.files[0].target is None else numbers(result.target)
    assert kept == list(range(len(kept)))
    assert len(kept) % CHUNK == 0
    assert result.messages == len(kept)
    shutil.rmtree(folder)


@settings(max_examples=30)
@given(data=st.data())
def test_bytes_changed_anywhere_never_crash_recovery(
    whole_file: bytes, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    folder = tmp_path_factory.mktemp("noise")
    damaged = bytearray(whole_file)
    for place in data.draw(st.lists(st.integers(8, len(damaged) - 1), min_size=1, max_size=20)):
        damaged[place] = data.draw(st.integers(0, 255))
    path = folder / f"x.mcap{PARTIAL}"
    path.write_bytes(damaged)
    result = recover_bag(path)
    assert 0 <= result.messages <= 200
    shutil.rmtree(folder)
