"""Real Ouster recordings: imported, replayed through the nodes and decoded, every point as the SDK has it."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ouster.sdk import core, open_source
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader

from subiaco_bringup.cli.main import run
from subiaco_bringup.jobs import run_mapping_graph
from subiaco_geo.bags import BagReader, packet_from_cdr
from subiaco_geo.cloud_io import read_cloud
from subiaco_geo.maps import read_map
from subiaco_geo.topics import IMU_PACKETS, LIDAR_PACKETS
from subiaco_mapping.measurements import Returns, Scan
from subiaco_mapping.pipeline import read_metadata
from subiaco_mapping.preprocessing.config import DecodeConfig
from subiaco_mapping.preprocessing.decode import DecodeCounts, PacketDecoder
from subiaco_mapping.request import MappingRequest

OS1 = "OS-1-128_v2.3.0_1024x10_lb_n3.pcap"
OS1_DUAL = "OS-1-128_767798045_1024x10_20230712_120049.pcap"
OS0_DUAL = "OS-0-32-U1_v2.2.0_1024x10.pcap"
OS0_ROS1 = "512x10_raw.bag"

#: Recording, LiDAR packets, packets that are missing in it.
RECORDINGS = ((OS1, 192, 0), (OS1_DUAL, 8, 56), (OS0_DUAL, 64, 0), (OS0_ROS1, 32, 0))
ALL_RANGES = DecodeConfig(min_range=0.0, max_range=1000.0)


@pytest.fixture(autouse=True)
def rosbags_as_it_was() -> Iterator[None]:
    """Undo what the SDK's own bag reader does to rosbags: its readers are replaced for the whole process."""
    kept = Reader.__init__, AnyReader.__init__
    yield
    Reader.__init__, AnyReader.__init__ = kept  # type: ignore[method-assign]


def imported(shared_data: Path, name: str, folder: Path) -> Path:
    """Run ``subiaco import`` and return the bag."""
    bag = folder / Path(name).name.removesuffix(".pcap").removesuffix(".bag")
    assert run(["import", str(shared_data / "ouster" / name), "-o", str(bag)]) == 0
    return bag


def decoded(bag: Path) -> tuple[list[Scan], DecodeCounts]:
    """Decode every packet of a bag, all ranges kept."""
    with BagReader(bag) as reader:
        decoder = PacketDecoder(str(read_metadata(reader)), ALL_RANGES)
        scans = [s for m in reader.messages({LIDAR_PACKETS}) for s in decoder.push(packet_from_cdr(m.raw))]
    return scans + decoder.flush(), decoder.counts


def sdk_scans(shared_data: Path, name: str) -> list[Any]:
    """Read the scans with ouster-sdk straight from the recording."""
    frames = open_source(str(shared_data / "ouster" / name))
    return [scan for frame in frames for scan in frame if scan is not None]


def assert_same_points(ours: Returns, scan: Any, field: str) -> None:
    """Compare one return with the SDK's: number, order and place of the points, and their columns' times."""
    distance = scan.field(field)
    hit = distance > 0
    xyz = core.XYZLut(scan.sensor_info, use_extrinsics=False)(distance)
    assert len(ours) == hit.sum()
    np.testing.assert_allclose(ours.xyz, xyz[hit], atol=1e-4)
    np.testing.assert_array_equal(ours.times_ns, scan.timestamp[np.nonzero(hit)[1]].astype(np.int64))


@pytest.mark.parametrize(("name", "packets", "lost"), RECORDINGS, ids=[r[0][:22] for r in RECORDINGS])
def test_imported_recording_decodes_to_the_points_that_the_sdk_reads_from_it(
    shared_data: Path, tmp_path: Path, name: str, packets: int, lost: int
) -> None:
    scans, counts = decoded(imported(shared_data, name, tmp_path))
    expected = sdk_scans(shared_data, name)
    assert (counts.packets, counts.lost, counts.late, counts.malformed) == (packets, lost, 0, 0)
    assert [s.frame_id for s in scans] == [s.frame_id for s in expected]
    for ours, theirs in zip(scans, expected, strict=True):
        assert_same_points(ours.first, theirs, "RANGE")


def test_points_of_the_os1_recording_are_as_many_as_measured(shared_data: Path, tmp_path: Path) -> None:
    scans, _ = decoded(imported(shared_data, OS1, tmp_path))
    assert [len(s.first) for s in scans] == [107_647, 107_357, 107_532]


@pytest.mark.parametrize(("name", "second"), [(OS0_DUAL, 172), (OS1_DUAL, 1089)])
def test_both_returns_of_a_dual_recording_are_decoded(
    shared_data: Path, tmp_path: Path, name: str, second: int
) -> None:
    (scan,), _ = decoded(imported(shared_data, name, tmp_path))
    (expected,) = sdk_scans(shared_data, name)
    assert scan.last is not None
    assert len(scan.last) == second
    assert_same_points(scan.last, expected, "RANGE2")


def test_second_returns_are_archived_beside_the_map(shared_data: Path, tmp_path: Path) -> None:
    bag = imported(shared_data, OS0_DUAL, tmp_path)
    (expected,) = sdk_scans(shared_data, OS0_DUAL)
    assert run(["map", str(bag), "-o", str(tmp_path / "map"), "-q"]) == 0
    last = read_cloud(tmp_path / "map" / "last.laz")
    kept = expected.field("RANGE2") >= 1000  # [mm], decode.min_range
    xyz = core.XYZLut(expected.sensor_info, use_extrinsics=False)(expected.field("RANGE2"))[kept]
    voxels = np.unique(np.floor(xyz / 0.25).astype(int), axis=0)
    ours = np.unique(np.floor(last.world() / 0.25).astype(int), axis=0)
    assert abs(len(ours) - len(voxels)) <= 1  # LAZ rounds to 1 mm: a point may cross a voxel's face
    assert int(last.fields["n"].sum()) == int(kept.sum())


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.parametrize(("name", "packets", "scans"), [(OS1, 192, 3), (OS0_ROS1, 32, 1)])
def test_replay_brings_every_real_packet_through_the_nodes(
    shared_data: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, name: str, packets: int, scans: int
) -> None:
    bag = imported(shared_data, name, tmp_path)
    with BagReader(bag) as reader:
        imu_packets = reader.topics[IMU_PACKETS].count
    with caplog.at_level(logging.INFO, logger="subiaco_bringup.supervisor"):
        run_mapping_graph(MappingRequest(bags=(bag,), output=tmp_path / "map"))
    played = next(m for m in caplog.messages if "played and consumed" in m)
    counts = {topic: int(n) for topic, n in re.findall(r"(/\S+) (\d+)", played)}
    assert counts[LIDAR_PACKETS] == packets
    assert counts[IMU_PACKETS] == imu_packets
    survey = read_map(tmp_path / "map")
    (sequence,) = survey.manifest["sequences"].values()
    assert sequence["packets"]["packets"] == packets
    assert sequence["packets"]["lost"] == 0
    assert sequence["scans"] == scans
    assert survey.crs is None


def test_sequence_keeps_the_whole_name_of_a_recording_with_dots(shared_data: Path, tmp_path: Path) -> None:
    bag = imported(shared_data, OS0_DUAL, tmp_path)
    assert run(["map", str(bag), "-o", str(tmp_path / "map"), "-q"]) == 0
    assert (tmp_path / "map" / "odometry" / "OS-0-32-U1_v2.2.0_1024x10.txt").is_file()
