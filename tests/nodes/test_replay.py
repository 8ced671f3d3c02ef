"""The replay's order and pacing, with a list in place of publishers."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest

from subiaco_geo.bag_files import sequence_name
from subiaco_geo.bags import TYPESTORE, BagMessage, BagWriter, packet_to_cdr
from subiaco_geo.errors import InputError
from subiaco_geo.topics import IMU, LIDAR_PACKETS, METADATA, PACKET_TYPE
from subiaco_mapping.named_bags import open_bag
from subiaco_mapping.nodes.flow import FlowControl
from subiaco_mapping.nodes.replay import END, SEQUENCE, Replay
from subiaco_mapping.topic_names import TopicsConfig

CONSUMED = (METADATA, LIDAR_PACKETS, SEQUENCE, END)


def write_bag(path: Path, packets: int, metadata_last: bool = False) -> Path:
    """Write packets of one number each, a millisecond apart, and the metadata."""
    text = TYPESTORE.types["std_msgs/msg/String"](data="{}")
    with BagWriter(path) as writer:
        if not metadata_last:
            writer.write(METADATA, "std_msgs/msg/String", text, 1_000_000_000, latched=True)
        for k in range(packets):
            cdr = packet_to_cdr(k.to_bytes(4, "little"))
            writer.write_raw(LIDAR_PACKETS, PACKET_TYPE, cdr, 1_000_000_001 + k * 1_000_000)
        if metadata_last:
            writer.write(METADATA, "std_msgs/msg/String", text, 9_000_000_000, latched=True)
    return path


class Recorder:
    """Keep what is published; consume on demand."""

    def __init__(self, flow: FlowControl, connected: int = 1) -> None:
        self.flow = flow
        self.sent: list[tuple[str, object]] = []
        self.clocks: list[int] = []
        self.subscribers = connected

    def mark(self, topic: str, name: str, counts: Mapping[str, int]) -> None:
        self.sent.append((topic, (name, dict(counts))))

    def publish(self, message: BagMessage) -> None:
        self.sent.append((message.topic, bytes(message.raw)))

    def clock(self, time_ns: int) -> None:
        self.clocks.append(time_ns)

    def connected(self, topic: str) -> int:
        return self.subscribers

    def consume_all(self) -> None:
        """Answer with the counts of everything sent."""
        topics = [topic for topic, _ in self.sent]
        self.flow.on_counts("c", CONSUMED, [topics.count(topic) for topic in CONSUMED])


def make(bags: list[Path], rate: float = 0.0, window: int = 128) -> tuple[Replay, Recorder]:
    flow = FlowControl(["c"], {LIDAR_PACKETS: window, SEQUENCE: 1, END: 1})
    port = Recorder(flow)
    return Replay(bags, flow, port, rate=rate), port


def run(replay: Replay, port: Recorder) -> None:
    for _ in range(100_000):
        if replay.done:
            return
        if not replay.step():
            port.consume_all()
    raise AssertionError("the replay did not end")


def test_every_packet_is_sent_once_in_order_and_the_end_carries_the_counts(tmp_path: Path) -> None:
    replay, port = make([write_bag(tmp_path / "one", 300)])
    run(replay, port)
    packets = [raw for topic, raw in port.sent if topic == LIDAR_PACKETS]
    assert packets == [packet_to_cdr(k.to_bytes(4, "little")) for k in range(300)]
    assert port.sent[0] == (SEQUENCE, ("one", {METADATA: 1, LIDAR_PACKETS: 300}))
    assert port.sent[-1] == (END, ("replay", {METADATA: 1, LIDAR_PACKETS: 300}))


def test_a_bag_with_the_names_of_its_drivers_is_played_under_ours(tmp_path: Path) -> None:
    theirs = "/os_node/lidar_packets"
    with BagWriter(tmp_path / "theirs") as writer:
        text = TYPESTORE.types["std_msgs/msg/String"](data="{}")
        writer.write(METADATA, "std_msgs/msg/String", text, 10**9, latched=True)
        writer.write_raw(theirs, PACKET_TYPE, packet_to_cdr(b"1234"), 10**9 + 1)
    flow = FlowControl(["c"], {SEQUENCE: 1, END: 1})
    port = Recorder(flow)
    names = TopicsConfig(lidar_packets=theirs)
    run(Replay([tmp_path / "theirs"], flow, port, open_bag=lambda bag: open_bag(bag, names)), port)
    assert (LIDAR_PACKETS, packet_to_cdr(b"1234")) in port.sent
    assert port.sent[0] == (SEQUENCE, ("theirs", {METADATA: 1, LIDAR_PACKETS: 1}))


def test_nothing_is_sent_before_the_consumers_are_there(tmp_path: Path) -> None:
    replay, port = make([write_bag(tmp_path / "one", 3)])
    assert not any(replay.step() for _ in range(20))
    port.subscribers = 0
    port.consume_all()
    assert not any(replay.step() for _ in range(20))
    assert port.sent == []
    port.subscribers = 1
    run(replay, port)
    assert port.sent


def test_no_more_than_the_window_is_in_flight(tmp_path: Path) -> None:
    replay, port = make([write_bag(tmp_path / "one", 50)], window=7)
    seen = 0
    for _ in range(100_000):
        if replay.done:
            break
        busy = replay.step()
        assert port.flow.in_flight(LIDAR_PACKETS) <= 7
        seen = max(seen, port.flow.in_flight(LIDAR_PACKETS))
        if not busy:
            port.consume_all()
    assert replay.done
    assert seen == 7


def test_latched_topics_come_before_the_data_wherever_they_lie_in_the_bag(tmp_path: Path) -> None:
    replay, port = make([write_bag(tmp_path / "late", 5, metadata_last=True)])
    run(replay, port)
    assert [topic for topic, _ in port.sent] == [SEQUENCE, METADATA, *[LIDAR_PACKETS] * 5, END]


def test_the_next_sequence_waits_until_the_one_before_is_consumed(tmp_path: Path) -> None:
    bags = [write_bag(tmp_path / name, 4) for name in ("one", "two")]
    replay, port = make(bags)
    port.consume_all()
    while replay.step() or not port.flow.settled:
        before = len([t for t, _ in port.sent if t == SEQUENCE])
        if before == 2:
            break
        if not port.flow.settled and port.flow.totals[LIDAR_PACKETS] == 4:
            assert before == 1
            for _ in range(10):
                replay.step()
            assert [t for t, _ in port.sent].count(SEQUENCE) == 1
        port.consume_all()
    run(replay, port)
    assert [v[0] for t, v in port.sent if t == SEQUENCE and isinstance(v, tuple)] == ["one", "two"]


def test_a_rate_holds_messages_back_until_they_are_due(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [100.0]
    monkeypatch.setattr("subiaco_mapping.nodes.replay.time.monotonic", lambda: now[0])
    replay, port = make([write_bag(tmp_path / "one", 11)], rate=2.0)
    for _ in range(50):
        replay.step()
        port.consume_all()
    assert port.flow.totals[LIDAR_PACKETS] == 0
    now[0] += 0.0025  # 5 ms of the log at twice the speed
    for _ in range(50):
        replay.step()
        port.consume_all()
    assert port.flow.totals[LIDAR_PACKETS] == 5
    now[0] += 1.0
    run(replay, port)
    assert port.flow.totals[LIDAR_PACKETS] == 11


def test_the_clock_follows_the_log(tmp_path: Path) -> None:
    replay, port = make([write_bag(tmp_path / "one", 100)])
    run(replay, port)
    assert port.clocks == sorted(port.clocks)
    assert port.clocks[0] == 1_000_000_000
    assert port.clocks[-1] >= 1_080_000_000
    assert len(port.clocks) <= 11


def test_a_missing_bag_is_bad_input(tmp_path: Path) -> None:
    replay, _ = make([tmp_path / "nothing"])
    with pytest.raises(InputError, match="nothing: no such bag"):
        replay.step()


def test_a_wrong_type_under_one_of_our_names_is_named(tmp_path: Path) -> None:
    text = TYPESTORE.types["std_msgs/msg/String"](data="x")
    with BagWriter(tmp_path / "odd") as writer:
        writer.write(IMU, "std_msgs/msg/String", text, 1)
    replay, _ = make([tmp_path / "odd"])
    with pytest.raises(InputError, match="/imu/data is std_msgs/msg/String, expected sensor_msgs/msg/Imu"):
        replay.step()


def test_a_bag_without_survey_topics_is_bad_input(tmp_path: Path) -> None:
    text = TYPESTORE.types["std_msgs/msg/String"](data="x")
    with BagWriter(tmp_path / "chatter") as writer:
        writer.write("/chatter", "std_msgs/msg/String", text, 1)
    replay, _ = make([tmp_path / "chatter"])
    with pytest.raises(InputError, match="none of"):
        replay.step()


def test_a_sequence_is_named_after_its_bag_or_its_epoch_folder(tmp_path: Path) -> None:
    assert sequence_name(tmp_path / "before" / "bag") == "before"
    assert sequence_name(tmp_path / "drive_3.mcap") == "drive_3"
    assert sequence_name(tmp_path / "drive_4") == "drive_4"
