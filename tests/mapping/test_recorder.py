"""The recorder: what comes in is on the disk, whatever happens to the disk, the clock or the process."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import yaml

from subiaco_geo.bag_files import PARTIAL
from subiaco_geo.bag_recovery import recover_bag
from subiaco_geo.bag_segments import RecordedTopic, SegmentWriter
from subiaco_geo.bags import TYPESTORE, BagMessage, BagReader, packet_to_cdr
from subiaco_geo.errors import InputError
from subiaco_geo.topics import LIDAR_PACKETS, METADATA, PACKET_TYPE, TF_STATIC
from subiaco_mapping.recording.config import RecordConfig
from subiaco_mapping.recording.definitions import Definitions
from subiaco_mapping.recording.recorder import Recorder

START_NS = 1_700_000_000_000_000_000
LOTS = 10**15
WATERMARKS = {"warn_free_gb": 0.002, "stop_free_gb": 0.001}


def topic(name: str, msg_type: str = PACKET_TYPE) -> RecordedTopic:
    text, _ = TYPESTORE.generate_msgdef(msg_type, ros_version=2)
    return RecordedTopic(name, msg_type, text, TYPESTORE.hash_rihs01(msg_type))


PACKETS = topic(LIDAR_PACKETS)


def packet(number: int, size: int = 2000) -> bytes:
    noise = random.Random(number).randbytes(size - 4)
    return packet_to_cdr(number.to_bytes(4, "little") + noise)


def until(condition: Callable[[], object], timeout: float = 20.0) -> None:
    deadline = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < deadline, "what was awaited did not come in time"
        time.sleep(0.005)


def messages(bag: Path) -> list[BagMessage]:
    with BagReader(bag) as reader:
        return list(reader.messages())


def packet_numbers(bag: Path) -> list[int]:
    return [int.from_bytes(m.raw[8:12], "little") for m in messages(bag) if m.topic == LIDAR_PACKETS]


def recorder(
    folder: Path, *, free: int | Callable[[Path], int] = LOTS, resume: bool = False, **values: object
) -> Recorder:
    config = RecordConfig.model_validate({**WATERMARKS, "flush_interval": 0.05, **values})
    return Recorder(folder, config, resume=resume, free=free if callable(free) else lambda _: free)


def between_files(recording: Recorder, messages_in: int) -> bool:
    """Tell whether so many messages are written and their file is finished."""
    status = recording.status()
    return status.messages == messages_in and not status.file


def test_every_message_comes_back_byte_for_byte_in_order_over_several_files(tmp_path: Path) -> None:
    recording = recorder(tmp_path / "drive", split_duration=0.05)
    for k in range(600):
        assert recording.add(PACKETS, packet(k), START_NS + k * 10**6, sequence=k)
        if k % 200 == 199:
            until(lambda: between_files(recording, k + 1))  # noqa: B023
    status = recording.close()
    assert (status.state, status.messages, status.dropped) == ("closed", 600, 0)
    assert status.files >= 3
    found = messages(tmp_path / "drive")
    assert [(m.raw, m.log_time_ns) for m in found] == [(packet(k), START_NS + k * 10**6) for k in range(600)]


def test_every_file_opens_with_the_last_message_of_each_latched_topic(tmp_path: Path) -> None:
    text = TYPESTORE.types["std_msgs/msg/String"]
    recording = recorder(tmp_path / "drive", split_duration=0.5)
    metadata, transforms = topic(METADATA, "std_msgs/msg/String"), topic(TF_STATIC, "tf2_msgs/msg/TFMessage")
    for word in ("old", "new"):
        cdr = bytes(TYPESTORE.serialize_cdr(text(data=word), "std_msgs/msg/String"))
        recording.add(metadata, cdr, START_NS, latched=True)
    for child in ("lidar_link", "imu_link"):
        recording.add(transforms, static_transform(child), START_NS + 1, latched=True)
    recording.add(PACKETS, packet(0), START_NS + 2)
    until(lambda: between_files(recording, 5))
    recording.add(PACKETS, packet(1), START_NS + 10**9)
    recording.close()
    second = messages(tmp_path / "drive" / "drive_0001.mcap")
    assert [m.topic for m in second] == [METADATA, TF_STATIC, TF_STATIC, LIDAR_PACKETS]
    assert {m.log_time_ns for m in second} == {START_NS + 10**9}
    assert TYPESTORE.deserialize_cdr(second[0].raw, "std_msgs/msg/String").data == "new"
    children = [
        TYPESTORE.deserialize_cdr(m.raw, m.msg_type).transforms[0].child_frame_id for m in second[1:3]
    ]
    assert children == ["lidar_link", "imu_link"]
    facts = yaml.safe_load((tmp_path / "drive" / "recording.yaml").read_text())
    assert (facts["messages"], facts["repeated_latched"]) == (6, 3)


def static_transform(child: str) -> bytes:
    """Serialise one transform from base_link."""
    types = TYPESTORE.types
    zero = types["builtin_interfaces/msg/Time"](sec=0, nanosec=0)
    header = types["std_msgs/msg/Header"](stamp=zero, frame_id="base_link")
    pose = types["geometry_msgs/msg/Transform"](
        translation=types["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=1.0),
        rotation=types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
    )
    stamped = types["geometry_msgs/msg/TransformStamped"](header=header, child_frame_id=child, transform=pose)
    message = types["tf2_msgs/msg/TFMessage"](transforms=[stamped])
    return bytes(TYPESTORE.serialize_cdr(message, "tf2_msgs/msg/TFMessage"))


def test_while_recording_the_file_has_its_temporary_name_and_the_whole_ones_are_a_bag(tmp_path: Path) -> None:
    folder = tmp_path / "drive"
    recording = recorder(folder, split_duration=0.05)
    recording.add(PACKETS, packet(0), START_NS)
    until((folder / "metadata.yaml").exists)
    recording.add(PACKETS, packet(1), START_NS + 1)
    until(lambda: (folder / f"drive_0001.mcap{PARTIAL}").exists() or (folder / "drive_0001.mcap").exists())
    assert packet_numbers(folder)[:1] == [0]
    recording.close()
    assert packet_numbers(folder) == [0, 1]


def test_a_second_start_goes_on_with_a_new_file_only_if_told(tmp_path: Path) -> None:
    first = recorder(tmp_path / "drive")
    first.add(PACKETS, packet(0), START_NS)
    with pytest.raises(InputError, match="is being recorded into"):
        recorder(tmp_path / "drive", resume=True)
    first.close()
    with pytest.raises(InputError, match=r"exists already; .*--resume"):
        recorder(tmp_path / "drive")
    again = recorder(tmp_path / "drive", resume=True)
    again.add(PACKETS, packet(1), START_NS + 1)
    again.close()
    assert sorted(p.name for p in (tmp_path / "drive").glob("*.mcap")) == [
        "drive_0000.mcap",
        "drive_0001.mcap",
    ]
    assert packet_numbers(tmp_path / "drive") == [0, 1]


def test_a_disk_below_the_lower_watermark_ends_the_recording_whole(tmp_path: Path) -> None:
    room = [LOTS]
    recording = recorder(tmp_path / "drive", free=lambda _: room[0])
    recording.add(PACKETS, packet(0), START_NS)
    until(lambda: recording.status().messages == 1)
    room[0] = 1_500_000
    until(lambda: recording.status().warnings)
    assert "GB free on the disk" in recording.status().warnings[0]
    assert not recording.stopped
    room[0] = 500_000
    until(lambda: recording.stopped)
    assert not recording.add(PACKETS, packet(1), START_NS + 1)
    status = recording.close()
    assert status.state == "disk full"
    assert "all files whole" in status.reason
    assert status.dropped == 1
    assert packet_numbers(tmp_path / "drive") == [0]


def test_a_disk_that_is_full_from_the_start_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="make room"):
        recorder(tmp_path / "drive", free=10)
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A real file system of 3 MB; skips where mounting is not allowed."""
    place = tmp_path / "disk"
    place.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=3m", "tmpfs", str(place)], capture_output=True, check=False
    )
    if mounted.returncode != 0:
        pytest.skip("a small file system cannot be mounted here")
    yield place
    subprocess.run(["umount", str(place)], check=True)


def test_on_a_real_small_disk_the_recording_ends_whole_at_the_watermark(small_disk: Path) -> None:
    config = RecordConfig(warn_free_gb=0.002, stop_free_gb=0.001, flush_interval=0.05)
    recording = Recorder(small_disk / "drive", config)
    taken = fill(recording, rate=50)
    status = recording.close()
    assert status.state == "disk full"
    kept = packet_numbers(small_disk / "drive")
    assert kept == list(range(len(kept)))
    assert len(kept) + status.dropped == taken
    assert not list((small_disk / "drive").glob(f"*{PARTIAL}"))


def fill(recording: Recorder, rate: int) -> int:
    """Add 20 kB packets, so many a second, until the recording stops; return how many."""
    taken = 0
    begun = time.monotonic()
    while not recording.stopped:
        assert time.monotonic() < begun + 30.0, "the disk never ran full"
        while taken < (time.monotonic() - begun) * rate:
            recording.add(PACKETS, packet(taken, 20_000), START_NS + taken * 10**7)
            taken += 1
        time.sleep(0.005)
    return taken


def test_a_disk_filled_by_somebody_else_costs_the_last_chunk_alone(small_disk: Path, tmp_path: Path) -> None:
    recording = recorder(small_disk / "drive")  # its own look at the disk is blind
    taken = fill(recording, rate=100)
    status = recording.close()
    assert status.state == "failed"
    assert "no space left on device" in status.reason
    assert "subiaco recover" in status.reason
    result = recover_bag(small_disk / "drive", tmp_path / "whole")
    kept = packet_numbers(result.target)
    assert kept == list(range(status.messages))
    assert len(kept) + status.dropped == taken


def test_a_disk_too_slow_for_the_queue_drops_counts_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    busy, ready = threading.Event(), threading.Event()

    def stalled(self: SegmentWriter, *, sync: bool = False) -> None:
        busy.set()
        assert ready.wait(20.0)
        original(self, sync=sync)

    original = SegmentWriter.flush
    monkeypatch.setattr(SegmentWriter, "flush", stalled)
    recording = recorder(tmp_path / "drive", queue_mb=16)
    recording.add(PACKETS, packet(0), START_NS)
    until(busy.is_set)
    big = packet_to_cdr(bytes(6_000_000))
    assert [recording.add(PACKETS, big, START_NS + k) for k in range(4)] == [True, True, False, False]
    assert any("disk is too slow: 12 MB wait" in text for text in recording.status().warnings)
    assert recording.status().queued_bytes <= 16 * 10**6  # what waits in memory is bounded
    ready.set()
    status = recording.close()
    assert (status.messages, status.dropped) == (3, 2)


def test_a_step_of_the_clock_loses_nothing(tmp_path: Path) -> None:
    recording = recorder(tmp_path / "drive", split_duration=0.05)
    times = [START_NS, START_NS + 10**6, START_NS - 3600 * 10**9, START_NS - 3600 * 10**9 + 10**6]
    for k, log_time in enumerate(times):
        recording.add(PACKETS, packet(k), log_time)
        until(lambda: between_files(recording, k + 1))  # noqa: B023
    recording.close()
    assert packet_numbers(tmp_path / "drive") == [0, 1, 2, 3]
    with BagReader(tmp_path / "drive") as reader:
        assert (reader.start_ns, reader.end_ns) == (min(times), max(times))


@pytest.mark.realtime
def test_a_message_waits_for_its_flush_no_longer_than_the_interval_and_the_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a kill can cost: ``flush_interval``, and what the recorder itself has seen the machine take."""
    flushed: list[tuple[float, int]] = []

    def noted(self: SegmentWriter, *, sync: bool = False) -> None:
        original(self, sync=sync)
        flushed.append((time.monotonic(), self.messages))

    original = SegmentWriter.flush
    monkeypatch.setattr(SegmentWriter, "flush", noted)
    recording = recorder(tmp_path / "drive", flush_interval=0.2)
    given: list[float] = []
    while not given or time.monotonic() - given[0] < 1.5:
        recording.add(PACKETS, packet(len(given)), START_NS + len(given))
        given.append(time.monotonic())
        time.sleep(0.004)
    until(lambda: flushed and flushed[-1][1] == len(given))
    status = recording.close()
    waited = [next(when for when, count in flushed if count > k) - at for k, at in enumerate(given)]
    assert status.messages == len(given)
    assert len(flushed) >= 3
    assert max(waited) <= 0.2 + 3 * status.slowest_turn_s  # one taking in, one writing, one flushing
    facts = yaml.safe_load((tmp_path / "drive" / "recording.yaml").read_text())
    assert facts["slowest_turn_s"] == pytest.approx(status.slowest_turn_s, abs=0.001)


CHILD = """
import sys, time
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from test_recorder import PACKETS, packet
from subiaco_mapping.recording.config import RecordConfig
from subiaco_mapping.recording.recorder import Recorder
config = RecordConfig(warn_free_gb=0, stop_free_gb=0, split_duration=float(sys.argv[3]))
recorder, k = Recorder(Path(sys.argv[1]), config), 0
begun = time.monotonic()
while True:
    while k < (time.monotonic() - begun) * 300:
        recorder.add(PACKETS, packet(k), time.time_ns()); k += 1
    sys.stdout.write(f"{k}\\n"); sys.stdout.flush()
    time.sleep(0.005)
"""


def killed_recording(folder: Path, seconds: float, split: float) -> int:
    """Record 300 packets a second in a process of its own, kill it; return how many it had been given."""
    child = subprocess.Popen(
        [sys.executable, "-c", CHILD, str(folder), str(Path(__file__).parent), str(split)],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert child.stdout is not None
    given, begun = 0, None
    for line in child.stdout:
        given = int(line)
        begun = begun or time.monotonic()
        if time.monotonic() - begun > seconds:
            break
    os.kill(child.pid, signal.SIGKILL)
    given = max([given, *(int(line) for line in child.stdout.read().split())])
    child.wait()
    return given


@pytest.mark.realtime
@pytest.mark.parametrize("seed", range(3))
def test_a_kill_costs_at_most_a_second_and_recovery_makes_every_file_readable(
    tmp_path: Path, seed: int
) -> None:
    rng = random.Random(seed)
    folder = tmp_path / "drive"
    given = killed_recording(folder, rng.uniform(0.5, 1.6), split=rng.choice([0.3, 60.0]))
    before = {p.name: p.read_bytes() for p in folder.iterdir()}
    result = recover_bag(folder)
    kept = packet_numbers(result.target)
    assert kept == list(range(len(kept)))
    assert given - len(kept) <= 300
    assert {p.name: p.read_bytes() for p in folder.iterdir()} == before
    for file in result.target.glob("*.mcap"):
        assert messages(file)
    shutil.rmtree(result.target)


def test_types_that_jazzy_does_not_ship_are_described_from_their_packages() -> None:
    texts = {
        "our_msgs/msg/Outer": "our_msgs/Inner[] inner\nstd_msgs/Header header\n",
        "our_msgs/msg/Inner": "float64 x\n",
    }
    text, type_hash = Definitions(texts.__getitem__).describe("our_msgs/msg/Outer")
    assert "MSG: our_msgs/Inner" in text
    assert "float64 x" in text
    assert type_hash.startswith("RIHS01_")
    with pytest.raises(InputError, match="install its message package"):
        Definitions(texts.__getitem__).describe("their_msgs/msg/Unknown")
