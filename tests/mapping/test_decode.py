"""Packets to scans: nothing invented, nothing lost without being counted."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mapping_scenes import pcap_bufs, sdk_frames
from ouster.sdk import core

from subiaco_geo.errors import InputError
from subiaco_mapping.preprocessing.config import DecodeConfig
from subiaco_mapping.preprocessing.decode import PacketDecoder, complete_times

EVERYTHING = DecodeConfig(min_range=0.0, max_range=1000.0)
SINGLE = ("OS-1-128_v2.3.0_1024x10_lb_n3.pcap", "OS-1-128_v2.3.0_1024x10.json")
DUAL = ("OS-0-32-U1_v2.2.0_1024x10.pcap", "OS-0-32-U1_v2.2.0_1024x10.json")
FUSA = (
    "OS-1-128_767798045_1024x10_20230712_120049.pcap",
    "OS-1-128_767798045_1024x10_20230712_120049.json",
)


def recorded(shared_data: Path, names: tuple[str, str]) -> tuple[list[bytes], str]:
    metadata = (shared_data / "ouster" / names[1]).read_text()
    return pcap_bufs(shared_data / "ouster" / names[0], metadata), metadata


def decode(bufs: list[bytes], metadata: str, config: DecodeConfig = EVERYTHING):
    decoder = PacketDecoder(metadata, config)
    scans = [scan for buf in bufs for scan in decoder.push(buf)] + decoder.flush()
    return scans, decoder.counts


def synthetic(
    columns: int = 512, frames: int = 3, fill: int = 10_000, step: tuple[int, int] = (0, 0)
) -> tuple[list[bytes], str]:
    """Packets of a sensor that sees everything at one range; column k of frame f holds fill + k + f.

    ``step``: the clock is set at this column, counted over all frames, by so much [ns].
    """
    info = core.SensorInfo.from_default(core.LidarMode(columns, 10))
    form, settings = info.format, info.config
    form.udp_profile_lidar = settings.udp_profile_lidar = core.UDPProfileLidar.RNG19_RFL8_SIG16_NIR16
    settings.udp_port_lidar, settings.udp_port_imu = 7502, 7503
    info.format, info.config = form, settings
    metadata = info.to_json_string()
    info = core.SensorInfo(metadata)
    layout = core.PacketFormat(info)
    bufs = []
    for number in range(frames):
        frame = core.LidarFrame(info)
        frame.frame_id = number + 7
        spacing = 100_000_000 // columns
        frame.timestamp[:] = 10**18 + number * 100_000_000 + np.arange(columns) * spacing
        frame.timestamp[max(0, step[0] - number * columns) :] += step[1]
        frame.measurement_id[:] = np.arange(columns)
        frame.status[:] = 1
        frame.field("RANGE")[:] = fill + np.arange(columns)[None, :] * 8 + number * 8
        bufs += [bytes(p.buf) for p in core.frame_to_packets(frame, layout, info.init_id, int(info.sn or 0))]
    return bufs, metadata


@pytest.mark.parametrize("names", [SINGLE, DUAL, FUSA], ids=["single", "dual", "fusa"])
def test_points_equal_the_sdk_reading_the_same_pcap(shared_data: Path, names: tuple[str, str]) -> None:
    bufs, metadata = recorded(shared_data, names)
    scans, counts = decode(bufs, metadata)
    info = core.SensorInfo(metadata)
    lut = core.XYZLut(info, use_extrinsics=False)
    frames = sdk_frames(bufs, metadata)
    assert counts.packets == len(bufs)
    assert len(scans) - len(frames) in {0, 1}  # the SDK gives the last frame with the packet after it
    for scan, frame in zip(scans, frames, strict=False):
        distance = frame.field("RANGE")
        assert len(scan.first) == int((distance > 0).sum())
        np.testing.assert_allclose(scan.first.xyz, lut(distance)[distance > 0], atol=1e-9)


def test_the_three_scans_of_the_real_os1_have_the_known_point_counts(shared_data: Path) -> None:
    scans, counts = decode(*recorded(shared_data, SINGLE))
    assert [len(scan.first) for scan in scans] == [107647, 107357, 107532]
    assert (counts.lost, counts.late, counts.duplicate) == (0, 0, 0)


def test_both_returns_of_the_dual_profile_are_decoded(shared_data: Path) -> None:
    bufs, metadata = recorded(shared_data, DUAL)
    (scan,), _ = decode(bufs, metadata)
    layout = core.PacketFormat(core.SensorInfo(metadata))
    counted = sum(
        int((layout.packet_field("RANGE2", np.frombuffer(buf, np.uint8)) > 0).sum()) for buf in bufs
    )
    assert scan.last is not None
    assert len(scan.last) == counted > 0


def test_a_lost_packet_is_counted_and_its_neighbours_stay_right() -> None:
    bufs, metadata = synthetic()
    whole, _ = decode(bufs, metadata)
    scans, counts = decode(bufs[:3] + bufs[4:], metadata)
    per_packet = core.SensorInfo(metadata).format.columns_per_packet
    assert counts.lost == 1
    assert [scan.lost_columns for scan in scans] == [per_packet, 0, 0]
    assert scans[0].end_ns == whole[0].end_ns
    kept = np.isin(whole[0].first.times_ns, scans[0].first.times_ns)
    np.testing.assert_array_equal(scans[0].first.xyz, whole[0].first.xyz[kept])


def test_a_lost_last_packet_does_not_shift_the_stamp() -> None:
    bufs, metadata = synthetic()
    per_frame = len(bufs) // 3
    whole, _ = decode(bufs, metadata)
    scans, counts = decode([b for i, b in enumerate(bufs) if i != per_frame - 1], metadata)
    assert counts.lost == 1
    assert abs(scans[0].end_ns - whole[0].end_ns) < 1000


def test_duplicates_are_counted_and_change_nothing() -> None:
    bufs, metadata = synthetic()
    whole, _ = decode(bufs, metadata)
    scans, counts = decode([bufs[0], bufs[0], *bufs[1:]], metadata)
    assert counts.duplicate == 1
    np.testing.assert_array_equal(scans[0].first.xyz, whole[0].first.xyz)


@settings(max_examples=20)
@given(st.randoms(use_true_random=False))
def test_packets_reordered_within_the_window_give_the_same_scans(random) -> None:
    bufs, metadata = synthetic(frames=2)
    keyed = sorted(range(len(bufs)), key=lambda i: i + random.uniform(0, 5))
    whole, _ = decode(bufs, metadata)
    scans, counts = decode([bufs[i] for i in keyed], metadata)
    assert (counts.lost, counts.late, counts.duplicate) == (0, 0, 0)
    for scan, expected in zip(scans, whole, strict=True):
        np.testing.assert_array_equal(scan.first.xyz, expected.first.xyz)
        np.testing.assert_array_equal(scan.first.times_ns, expected.first.times_ns)


def test_packets_that_changed_places_are_counted() -> None:
    bufs, metadata = synthetic(frames=2)
    assert decode(bufs, metadata)[1].reordered == 0
    swapped = [*bufs[:3], bufs[4], bufs[3], *bufs[5:]]
    assert decode(swapped, metadata)[1].reordered == 1


def test_a_packet_after_its_frame_was_closed_is_late() -> None:
    bufs, metadata = synthetic()
    _, counts = decode([*bufs[:3], *bufs[4:], bufs[3]], metadata)
    assert (counts.late, counts.lost) == (1, 1)


def test_frames_that_are_counted_from_the_start_again_are_decoded_however_few_there_were() -> None:
    """The sensor restarts after a second and a half, or a bag is played in a loop."""
    bufs, metadata = synthetic(frames=15)
    scans, counts = decode(bufs * 2, metadata)
    assert (len(scans), counts.restarts, counts.late, counts.lost) == (30, 1, 0, 0)
    for first, again in zip(scans[:15], scans[15:], strict=True):
        assert first.end_ns == again.end_ns
        np.testing.assert_array_equal(first.first.xyz, again.first.xyz)


def test_a_whole_lost_frame_counts_all_its_packets() -> None:
    bufs, metadata = synthetic()
    per_frame = len(bufs) // 3
    scans, counts = decode(bufs[:per_frame] + bufs[2 * per_frame :], metadata)
    assert len(scans) == 2
    assert counts.lost == per_frame


def test_a_scan_without_a_valid_column_is_dropped_and_counted() -> None:
    bufs, metadata = synthetic(frames=1)
    info = core.SensorInfo(metadata)
    layout = core.PacketFormat(info)
    invalid = []
    for buf in bufs:
        packet = core.LidarPacket(layout)
        packet.buf[:] = np.frombuffer(buf, np.uint8)
        for column in range(layout.columns_per_packet):
            layout.set_col_status(packet, column, 0)
        invalid.append(bytes(packet.buf))
    scans, counts = decode(invalid, metadata)
    assert scans == []
    assert counts.empty_scans == 1


def test_range_limits_drop_what_is_outside() -> None:
    bufs, metadata = synthetic(frames=1, fill=10_000)
    scans, _ = decode(bufs, metadata, DecodeConfig(min_range=11.0, max_range=12.0))
    reach = np.linalg.norm(scans[0].first.xyz, axis=1)
    assert len(scans[0].first) > 0
    assert reach.min() > 10.9
    assert reach.max() < 12.1


@pytest.mark.parametrize(("base", "shift_s"), [("utc", 0), ("tai", -37), ("gps", -18)])
def test_the_clock_of_the_sensor_is_brought_to_utc(base: str, shift_s: int) -> None:
    bufs, metadata = synthetic(frames=1)
    (scan,), _ = decode(bufs, metadata, DecodeConfig(time_base=base, time_offset_ns=5))
    assert scan.start_ns == 10**18 + shift_s * 10**9 + 5


def test_zeroed_and_jumping_stamps_are_interpolated_anew() -> None:
    truth = 10**18 + np.arange(512, dtype=np.int64) * 195_312
    stamps = truth.copy()
    stamps[100:116] = 0
    stamps[200:216] += 10**9
    filled, bad = complete_times(stamps, np.ones(512, dtype=bool), 195_312.5, 20_000_000)
    assert bad == 32
    assert np.abs(filled - truth).max() < 2000


@pytest.mark.parametrize("at", [255, 256, 257])
@pytest.mark.parametrize("step_ns", [3 * 10**9, -3 * 10**9, 10**18 // 2])
def test_a_clock_that_is_set_in_the_very_middle_of_a_turn_leaves_one_line_of_times(
    at: int, step_ns: int
) -> None:
    """Half of the columns carry either clock, as where PPS lock is found: no median lies on one of them."""
    truth = 10**18 + np.arange(512, dtype=np.int64) * 195_312
    stamps = truth + np.where(np.arange(512) < at, 0, step_ns)
    filled, bad = complete_times(stamps, np.ones(512, dtype=bool), 195_312.5, 20_000_000)
    clock = 0 if abs(filled[0] - truth[0]) < 2000 else step_ns  # before the step, or after it
    assert bad == (512 - at if clock == 0 else at)
    assert np.abs(filled - truth - clock).max() < 2000


def test_a_recording_whose_clock_is_set_in_the_middle_of_a_turn_decodes_whole() -> None:
    bufs, metadata = synthetic()
    whole, _ = decode(bufs, metadata)
    stepped, metadata = synthetic(step=(512 + 256, 3 * 10**9))
    scans, counts = decode(stepped, metadata)
    assert counts.bad_stamps == 256
    assert [len(scan.first) for scan in scans] == [len(scan.first) for scan in whole]
    turns = [scan.end_ns - scan.start_ns for scan in scans]
    assert turns == pytest.approx([whole[0].end_ns - whole[0].start_ns] * 3, abs=2000)
    assert scans[2].start_ns - whole[2].start_ns == 3 * 10**9


def test_a_packet_of_the_wrong_size_is_malformed_not_fatal() -> None:
    bufs, metadata = synthetic(frames=1)
    scans, counts = decode([bufs[0][:100], *bufs], metadata)
    assert counts.malformed == 1
    assert len(scans) == 1


def test_metadata_that_is_none_is_refused_in_one_line() -> None:
    with pytest.raises(InputError, match="/ouster/metadata") as caught:
        PacketDecoder("{not json", EVERYTHING)
    assert "\n" not in str(caught.value)
