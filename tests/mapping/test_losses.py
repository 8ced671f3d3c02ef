"""Counters of the recorder: every loss shows, and nothing else does."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from mapping_scenes import pcap_bufs
from ouster.sdk import core
from pydantic import ValidationError

from subiaco_geo.bags import packet_to_cdr
from subiaco_mapping.recording.config import RecordConfig
from subiaco_mapping.recording.losses import (
    PacketCounter,
    PacketHeaders,
    SequenceCounter,
    StampCounter,
    TopicCounter,
    header_stamp_ns,
)
from subiaco_sim.config import LidarMode
from subiaco_sim.packets import sensor_info

PERIOD_NS = 10_000_000


@given(st.lists(st.booleans(), min_size=1, max_size=200))
def test_sequence_numbers_reveal_exactly_what_is_missing_between_first_and_last(kept: list[bool]) -> None:
    counter = SequenceCounter()
    numbers = [k + 1 for k, keep in enumerate(kept) if keep]
    for number in numbers:
        counter.take(number)
    expected = numbers[-1] - numbers[0] + 1 - len(numbers) if numbers else 0
    assert counter.lost == expected
    assert counter.before == (numbers[0] - 1 if numbers else 0)


def test_a_publisher_that_starts_again_and_two_at_once_are_no_loss() -> None:
    counter = SequenceCounter()
    for number in [1, 2, 3, 1, 4, 2, 5, 3, 1, 2]:
        counter.take(number)
    assert counter.lost == 0


def test_a_publisher_that_starts_again_is_told_from_a_loss_where_it_is_known_to_have_come_up() -> None:
    counter = SequenceCounter()
    for number in (1, 2, 3):
        counter.take(number)
    assert not counter.expects(9)
    counter.newcomers += 1
    for number in (9, 10, 13):  # eight before it was heard, and two of its own lost
        counter.take(number)
    assert (counter.lost, counter.before, counter.newcomers) == (2, 8, 0)


def test_a_loss_of_one_of_two_publishers_is_counted_once() -> None:
    counter = SequenceCounter()
    for number in [*range(1, 100), 1, 100, 2, 101, 5, 102, 6]:
        counter.take(number)
    assert counter.lost == 2


def test_stamps_reveal_missing_samples_under_jitter() -> None:
    rng = np.random.default_rng(5)
    counter = StampCounter()
    missing = {40, 41, 42, 90, 150}
    for k in range(200):
        if k not in missing:
            counter.take(k * PERIOD_NS + int(rng.normal(0, PERIOD_NS * 0.08)))
    assert counter.lost == len(missing)
    assert counter.period_ns == pytest.approx(PERIOD_NS, rel=0.05)


def test_a_new_rate_is_learnt_and_backward_and_repeated_stamps_are_counted() -> None:
    counter = StampCounter()
    stamps = [k * PERIOD_NS for k in range(60)]
    stamps += [stamps[-1] + (k + 1) * 4 * PERIOD_NS for k in range(100)]
    for stamp in [*stamps, stamps[-1], stamps[-1] - 7]:
        counter.take(stamp)
    assert counter.period_ns == 4 * PERIOD_NS
    assert counter.lost < 3 * 80
    assert (counter.repeated, counter.backward) == (1, 1)


@example({25, 75})
@example(set(range(25, 960, 50)))
@settings(max_examples=30)
@given(st.sets(st.integers(25, 960), max_size=20))
def test_stamps_reveal_single_losses_exactly_where_they_are_apart(missing: set[int]) -> None:
    apart = [k for k in sorted(missing) if not any(0 < k - other < 50 for other in missing)]
    counter = StampCounter()
    for k in range(1000):
        if k not in apart:
            counter.take(k * PERIOD_NS)
    assert counter.lost == len(apart)


def test_an_outage_is_lost_also_by_the_clock_of_the_host() -> None:
    counter = StampCounter()
    for k in [*range(200), *range(1200, 1400)]:
        counter.take(k * PERIOD_NS, k * PERIOD_NS + 3_000_000)
    assert (counter.lost, counter.stepped) == (1000, 0)


def test_two_milliseconds_of_jitter_are_no_loss() -> None:
    rng, period_ns = np.random.default_rng(7), 5_000_000
    stamps = np.sort(np.arange(6000) * period_ns + rng.normal(0, 2e6, 6000).astype(np.int64))
    counter = StampCounter()
    for stamp in stamps.tolist():
        counter.take(stamp)
    assert counter.lost <= 2
    assert counter.uneven > 50


@pytest.mark.parametrize("together", [2, 3, 5])
def test_samples_that_cross_the_bus_together_are_no_loss(together: int) -> None:
    counter = StampCounter()
    for k in range(6000):
        counter.take((k // together) * together * PERIOD_NS + (k % together) * 100_000)
    assert counter.lost == 0
    assert counter.uneven > 1000


def test_a_clock_that_is_set_forward_is_a_step_and_no_loss() -> None:
    counter = StampCounter()
    for k in range(400):
        step_ns = 30_000_000_000 if k >= 200 else 0
        counter.take(k * PERIOD_NS + step_ns, k * PERIOD_NS + 3_000_000)
    assert (counter.lost, counter.stepped) == (0, 1)


def test_messages_that_a_busy_host_takes_late_are_no_step() -> None:
    counter, stalled = StampCounter(), 1000 * PERIOD_NS
    for k in [*range(200), *range(500, 800)]:  # 300 were dropped while the host stood still
        counter.take(k * PERIOD_NS, max(k * PERIOD_NS, stalled if k > 190 else 0) + 3_000_000)
    assert (counter.lost, counter.stepped) == (300, 0)


def sensor() -> tuple[str, list[bytes]]:
    """Metadata of a 512x10 sensor, and its packets of six frames from the wrap of the frame id on."""
    info = sensor_info(LidarMode.COLUMNS_512, dual=False, beams=64)
    layout = core.PacketFormat(info)
    per_packet = info.format.columns_per_packet
    packets = []
    for frame in range(6):
        for first in range(0, info.format.columns_per_frame, per_packet):
            packet = core.LidarPacket(layout)
            layout.set_frame_id(packet, (layout.max_frame_id - 2 + frame) % (layout.max_frame_id + 1))
            for column in range(per_packet):
                layout.set_col_measurement_id(packet, column, first + column)
            packets.append(packet_to_cdr(bytes(packet.buf)))
    return info.to_json_string(), packets


METADATA, PACKETS = sensor()


def count(raws: list[bytes]) -> PacketCounter:
    counter = PacketCounter(METADATA)
    for raw in raws:
        counter.take(raw)
    return counter


def test_a_whole_stream_of_packets_has_no_loss_over_the_wrap_of_the_frame_id() -> None:
    counts = count(PACKETS).counts
    assert vars(counts) == {
        "lost_at_sensor": 0, "late": 0, "duplicate": 0, "malformed": 0, "restarts": 0
    }  # fmt: skip


@given(st.sets(st.integers(1, len(PACKETS) - 2), max_size=60))
def test_packet_ids_reveal_exactly_what_is_missing(missing: set[int]) -> None:
    kept = [packet for k, packet in enumerate(PACKETS) if k not in missing]
    assert count(kept).counts.lost_at_sensor == len(missing)


@given(st.integers(1, len(PACKETS) - 10), st.integers(1, 8))
def test_a_late_packet_is_given_back_and_a_duplicate_is_no_loss(place: int, delay: int) -> None:
    order = PACKETS.copy()
    order.insert(place + delay, order.pop(place))
    counts = count([*order[:50], order[49], *order[50:]]).counts
    assert (counts.lost_at_sensor, counts.late, counts.duplicate) == (0, 1, 1)


def test_whole_lost_frames_count_and_damaged_packets_are_told_apart() -> None:
    per_frame = len(PACKETS) // 6
    counts = count(
        [*PACKETS[:per_frame], *PACKETS[3 * per_frame :], b"\0\1\0\0", packet_to_cdr(bytes(9))]
    ).counts
    assert counts.lost_at_sensor == 2 * per_frame
    assert counts.malformed == 2


def test_a_count_of_frames_that_begins_again_is_a_restart_and_no_loss() -> None:
    """A bag of 50 frames in a loop: its first frames are no late ones."""
    layout = core.PacketFormat(core.SensorInfo(METADATA))
    first = {place: core.LidarPacket(layout) for place in range(32)}
    raws = []
    for frame in (*range(50), *range(50)):
        for place, packet in first.items():
            layout.set_frame_id(packet, frame)
            for column in range(16):
                layout.set_col_measurement_id(packet, column, 16 * place + column)
            raws.append(packet_to_cdr(bytes(packet.buf)))
    counts = count(raws).counts
    assert (counts.restarts, counts.lost_at_sensor, counts.late, counts.duplicate) == (1, 0, 0, 0)


def test_a_topic_adds_up_transport_sensor_and_disk() -> None:
    counter = TopicCounter(stamped=True)
    for k in range(100):
        if k not in (50, 51):
            stamp = (k * PERIOD_NS).to_bytes(8, "little")
            nanoseconds = int.from_bytes(stamp, "little")
            raw = b"\0\1\0\0" + (7).to_bytes(4, "little") + nanoseconds.to_bytes(4, "little") + bytes(20)
            counter.take(raw, k, k + 1)
    counter.dropped = 3
    facts = counter.facts()
    assert (facts["received"], facts["lost_in_transport"], facts["lost_by_stamp"]) == (98, 2, 2)
    assert facts["lost"] == 5


def test_header_stamps_are_read_from_serialised_bytes_only_where_there_are_enough() -> None:
    raw = b"\0\1\0\0" + (5).to_bytes(4, "little") + (6).to_bytes(4, "little")
    assert header_stamp_ns(raw) == 5_000_000_006
    assert header_stamp_ns(raw[:-1]) is None
    assert header_stamp_ns(b"\0\0" + raw[2:]) is None


def test_watermarks_must_be_in_order() -> None:
    with pytest.raises(ValidationError, match="warn_free_gb must not be below stop_free_gb"):
        RecordConfig(warn_free_gb=1.0, stop_free_gb=2.0)


def test_packets_that_came_before_the_metadata_are_counted_once_their_layout_is_known() -> None:
    """A cable is out meanwhile: what it cost must not depend on when the metadata come."""
    out = set(range(40, 140))
    kept = [packet for k, packet in enumerate(PACKETS) if k not in out]
    for known_after in (0, 20, 40, 60, len(kept)):
        counter = TopicCounter(headers=PacketHeaders())
        for k, packet in enumerate([*kept, b"\0\1\0\0"]):
            if k == known_after:
                counter.know_packets(METADATA)
            counter.take(packet, k, None)
        counter.know_packets(METADATA)
        facts = counter.facts()
        assert (facts["lost_at_sensor"], facts["malformed"], facts["restarts"]) == (len(out), 1, 0)
        assert "without_metadata" not in facts


@pytest.mark.parametrize(
    "name",
    [
        "OS-1-128_v2.3.0_1024x10_lb_n3.pcap OS-1-128_v2.3.0_1024x10.json",
        "OS-0-32-U1_v2.2.0_1024x10.pcap OS-0-32-U1_v2.2.0_1024x10.json",
        "OS-1-128_767798045_1024x10_20230712_120049.pcap OS-1-128_767798045_1024x10_20230712_120049.json",
    ],
    ids=["legacy", "dual", "fusa"],
)
def test_the_headers_of_every_format_tell_what_whole_packets_tell(shared_data: Path, name: str) -> None:
    recording, metadata = (shared_data / "ouster" / file for file in name.split())
    text = metadata.read_text()
    bufs = pcap_bufs(recording, text)
    raws = [packet_to_cdr(buf) for k, buf in enumerate(bufs) if k % 7]
    whole, later = TopicCounter(), TopicCounter(headers=PacketHeaders())
    whole.know_packets(text)
    for k, raw in enumerate(raws):
        whole.take(raw, k, None)
        later.take(raw, k, None)
    later.know_packets(text)
    assert later.facts() == whole.facts()
    assert later.facts()["lost_at_sensor"] >= len(bufs) // 7 - 2


def test_only_the_newest_headers_are_held_and_their_number_is_told_while_no_metadata_come() -> None:
    counter = TopicCounter(headers=PacketHeaders())
    for k in range(40_000):
        counter.take(PACKETS[k % len(PACKETS)], k, None)
    assert counter.facts()["without_metadata"] == 1 << 15
    assert sum(len(head) for _, head in counter.headers or ()) < 3_000_000


def test_packets_without_metadata_are_an_alarm_where_metadata_should_be_recorded() -> None:
    received = {"/ouster/lidar_packets": 9, "/gnss/fix": 1}
    (absent,) = RecordConfig().absent(received)
    assert absent.startswith("no LiDAR metadata (/ouster/metadata)")
    assert RecordConfig().absent({**received, "/ouster/metadata": 1}) == []
    assert RecordConfig().absent({"/lidar/points": 3, "/gnss/fix": 1}) == []
    assert RecordConfig(topics=("/ouster/lidar_packets",)).absent(received) == []
