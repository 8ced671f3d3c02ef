"""Clouds of Livox drivers: every point and its time as the driver wrote them, in maps as in inspections."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from livox_bags import PACKAGES, livox_message, livox_typestore, write_livox, write_ros1_livox
from mapping_scenes import SECOND, START_NS, point_cloud_message, room_scan, turning_pose
from rosbags.rosbag2 import StoragePlugin

from subiaco_geo.bags import TYPESTORE, BagWriter
from subiaco_geo.errors import InputError
from subiaco_geo.topics import MESSAGE_TYPES, POINTS
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.importers.packets import import_recording
from subiaco_mapping.inspection.inspect_bag import inspect_bag
from subiaco_mapping.named_bags import open_bag
from subiaco_mapping.odometry.config import OdometryConfig
from subiaco_mapping.pipeline import map_survey
from subiaco_mapping.preprocessing.livox import livox_points, scan_from_livox
from subiaco_mapping.topic_names import TopicsConfig

STORE = livox_typestore()
TYPE = "livox_ros_driver2/msg/CustomMsg"
COUNT = 400
OFFSETS_NS = np.linspace(0, SECOND // 10, COUNT).astype(np.int64)
XYZ = np.stack([5 + np.cos(OFFSETS_NS * 1e-8), 3 * np.sin(OFFSETS_NS * 1e-8), OFFSETS_NS * 1e-8], axis=1)
TOPICS = TopicsConfig(points="/livox/lidar")


def moving_room(sweeps: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Sweeps of a box-shaped room from a sensor that drives a circle, points measured at 40 times each."""
    clouds = []
    for k in range(sweeps):
        blocks, times = [], []
        for j in range(40):  # poses within the sweep
            offset_ns = j * SECOND // 400
            pose = turning_pose(np.array([START_NS + k * SECOND // 10 + offset_ns]), speed=2.0, rate=0.3)[0]
            blocks.append(room_scan(pose, 100, 1000 * k + j, 0.005))
            times.append(np.full(100, offset_ns))
        clouds.append((np.concatenate(blocks), np.concatenate(times)))
    return clouds


@given(frame=st.text("abcdefgh_/", max_size=30), count=st.integers(0, 30), big=st.booleans())
def test_any_frame_name_and_byte_order_gives_the_points_that_rosbags_wrote(
    frame: str, count: int, big: bool
) -> None:
    cloud = livox_message(STORE, XYZ[:count], OFFSETS_NS[:count], frame=frame)
    raw = STORE.serialize_cdr(cloud, TYPE, little_endian=not big)
    points, header_ns = livox_points(raw)
    assert header_ns == START_NS
    assert len(points) == count
    np.testing.assert_array_equal(points["offset_time"], OFFSETS_NS[:count])
    np.testing.assert_array_equal(
        np.stack([points[name] for name in "xyz"], axis=1), XYZ[:count].astype(np.float32)
    )
    np.testing.assert_array_equal(points["reflectivity"], np.arange(count) % 256)
    np.testing.assert_array_equal(points["line"], np.arange(count) % 4)
    assert set(points["tag"].tolist()) <= {16}


def test_points_keep_their_times_and_directions_without_return_are_left_out() -> None:
    xyz = XYZ.copy()
    xyz[::4] = 0.0
    scan = scan_from_livox(STORE.serialize_cdr(livox_message(STORE, xyz, OFFSETS_NS), TYPE), MappingConfig())
    seen = xyz.any(axis=1)
    np.testing.assert_array_equal(scan.first.times_ns, START_NS + OFFSETS_NS[seen])
    np.testing.assert_allclose(scan.first.xyz, xyz[seen], atol=1e-6)
    assert not scan.deskewed


def test_a_header_without_a_stamp_gives_way_to_the_time_of_the_first_point() -> None:
    cloud = livox_message(STORE, XYZ, OFFSETS_NS, stamp_ns=0, timebase_ns=START_NS)
    assert livox_points(STORE.serialize_cdr(cloud, TYPE))[1] == START_NS


@pytest.mark.parametrize("kept", [0, 3, 11, 20, 40, 70, 500, -1])
def test_a_cut_cloud_is_refused_in_one_line(kept: int) -> None:
    raw = STORE.serialize_cdr(livox_message(STORE, XYZ, OFFSETS_NS), TYPE)
    with pytest.raises(InputError, match="damaged") as refused:
        livox_points(raw[:kept])
    assert "\n" not in str(refused.value)
    assert "/lidar/points" in str(refused.value)


def test_times_that_are_all_the_same_are_refused_unless_the_clouds_are_deskewed() -> None:
    raw = STORE.serialize_cdr(livox_message(STORE, XYZ, np.zeros(COUNT, np.int64)), TYPE)
    with pytest.raises(InputError, match="same for all points"):
        scan_from_livox(raw, MappingConfig())
    assert len(scan_from_livox(raw, MappingConfig(deskewed=True)).first) == COUNT


@pytest.mark.parametrize("package", PACKAGES)
@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_a_bag_of_every_driver_generation_is_recognised_and_usable(
    tmp_path: Path, package: str, storage: StoragePlugin
) -> None:
    write_livox(tmp_path / "drive", [(XYZ, OFFSETS_NS)] * 5, package=package, storage=storage)
    facts = inspect_bag(tmp_path / "drive")
    assert facts["taken_as"] == {"/livox/lidar": "/lidar/points"}
    assert facts["topics"]["/lidar/points"]["type"] == f"{package}/msg/CustomMsg"
    assert not facts["forbids"]


def test_the_map_is_that_of_point_clouds_with_the_same_points_and_times(tmp_path: Path) -> None:
    sweeps = moving_room(6)
    write_livox(tmp_path / "livox" / "drive", sweeps)
    with BagWriter(tmp_path / "clouds" / "drive") as writer:
        for k, (xyz, offsets_ns) in enumerate(sweeps):
            stamp = START_NS + k * SECOND // 10
            count = np.arange(len(xyz))
            columns = {"t": offsets_ns.astype("<u4"), "intensity": (count % 256).astype("<f4")}
            message = point_cloud_message(xyz, stamp, **columns, ring=(count % 4).astype("<u2"))
            writer.write(POINTS, MESSAGE_TYPES[POINTS], message, stamp)
    odometry = OdometryConfig(voxel=0.5)
    livox = map_survey([tmp_path / "livox" / "drive"], MappingConfig(topics=TOPICS, odometry=odometry))
    clouds = map_survey([tmp_path / "clouds" / "drive"], MappingConfig(odometry=odometry))
    np.testing.assert_array_equal(livox.cloud.xyz, clouds.cloud.xyz)
    np.testing.assert_array_equal(livox.trajectory.poses, clouds.trajectory.poses)
    truth = turning_pose(START_NS + np.arange(6) * SECOND // 10, speed=2.0, rate=0.3)
    driven, found = (np.linalg.norm(p[-1][:3, 3] - p[0][:3, 3]) for p in (truth, livox.trajectory.poses))
    assert found == pytest.approx(driven, abs=0.1)


def test_a_topic_of_another_type_is_refused_with_the_types_that_are_read(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "drive") as writer:
        text = TYPESTORE.types["std_msgs/msg/String"](data="")
        writer.write("/livox/lidar", "std_msgs/msg/String", text, START_NS)
    with pytest.raises(InputError, match="sensor_msgs/msg/PointCloud2 or livox_ros_driver2/msg/CustomMsg"):
        map_survey([tmp_path / "drive"], MappingConfig(topics=TOPICS))


def test_a_ros_1_bag_of_clouds_is_mapped_after_the_conversion_that_its_refusal_names(tmp_path: Path) -> None:
    recording, target = tmp_path / "drive.bag", tmp_path / "drive"
    write_ros1_livox(recording, [(XYZ, OFFSETS_NS)] * 5)
    with pytest.raises(InputError, match="rosbags-convert") as refused:
        import_recording(recording, tmp_path / "bag")
    assert "\n" not in str(refused.value)
    assert f"--dst {target}" in str(refused.value)
    assert "--set topics.points=/livox/lidar" in str(refused.value)
    told = re.search(r"'rosbags-convert (.*?)'", str(refused.value))
    assert told is not None
    subprocess.run([sys.executable, "-m", "rosbags.convert", *shlex.split(told[1])], check=True)
    facts = inspect_bag(target, MappingConfig(topics=TOPICS))
    assert facts["topics"]["/lidar/points"]["count"] == 5
    with open_bag(target, TOPICS) as reader:
        points, header_ns = livox_points(next(reader.messages({POINTS})).raw)
    assert header_ns == START_NS
    np.testing.assert_array_equal(points["offset_time"], OFFSETS_NS)
