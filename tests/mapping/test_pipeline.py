"""Bags in, one map out; bad input in, one line out."""

from pathlib import Path

import numpy as np
import pytest
from kitti import kitti_scans_to_bag
from mapping_scenes import (
    SECOND,
    START_NS,
    point_cloud_message,
    room_scan,
    transform_message,
    turning_pose,
    write_clouds,
)

from subiaco_geo.bags import TYPESTORE, BagWriter
from subiaco_geo.config import load_config
from subiaco_geo.errors import InputError
from subiaco_geo.frames import make_pose
from subiaco_geo.free_space.sensor_view import described_view
from subiaco_geo.topics import IMU, LIDAR_PACKETS, MESSAGE_TYPES, METADATA, POINTS
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.importers.packets import import_recording
from subiaco_mapping.inspection.inspect_bag import describe, inspect_bag
from subiaco_mapping.odometry.config import OdometryConfig
from subiaco_mapping.pipeline import map_survey
from subiaco_mapping.preprocessing.config import FramePose, SensorsConfig
from subiaco_mapping.preprocessing.conversions import extrinsics_from_tf, scan_from_points

ROOM = MappingConfig(deskewed=True, odometry=OdometryConfig(voxel=0.5))


def one_line(error: BaseException) -> bool:
    return "\n" not in str(error)


@pytest.fixture
def room_bag(tmp_path: Path) -> Path:
    poses = turning_pose(START_NS + np.arange(6) * SECOND // 10, speed=2.0, rate=0.3)
    write_clouds(tmp_path / "room", [room_scan(pose, 8000, k, 0.01) for k, pose in enumerate(poses)])
    return tmp_path / "room"


def test_a_bag_without_gnss_gives_a_local_map_that_says_so(room_bag: Path) -> None:
    survey = map_survey([room_bag], ROOM)
    assert survey.cloud.crs is None
    assert survey.manifest["reason"] == "no usable GNSS fix"
    assert survey.info["georeferenced"] is False
    sensor = described_view(survey.info)
    assert sensor is not None
    assert sensor.elevation_min < 0 < sensor.elevation_max
    assert len(survey.trajectory) == 6
    assert list(survey.odometry) == ["room"]
    assert survey.visibility.observed(survey.cloud.world()).mean() > 0.5


def test_two_runs_give_bitwise_the_same_map(room_bag: Path) -> None:
    first, second = (map_survey([room_bag], ROOM) for _ in range(2))
    np.testing.assert_array_equal(first.cloud.xyz, second.cloud.xyz)
    np.testing.assert_array_equal(first.cloud.fields["normals"], second.cloud.fields["normals"])
    np.testing.assert_array_equal(first.visibility.passes, second.visibility.passes)
    np.testing.assert_array_equal(first.trajectory.poses, second.trajectory.poses)


def test_two_sequences_without_gnss_are_refused(room_bag: Path, tmp_path: Path) -> None:
    write_clouds(tmp_path / "other", [room_scan(np.eye(4), 3000, 1)] * 2)
    with pytest.raises(InputError, match="cannot be georeferenced"):
        map_survey([room_bag, tmp_path / "other"], ROOM)


def test_clouds_without_point_times_need_deskewed(room_bag: Path) -> None:
    with pytest.raises(InputError, match="deskewed: true") as caught:
        map_survey([room_bag], MappingConfig())
    assert one_line(caught.value)


def test_a_missing_bag_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nowhere"):
        map_survey([tmp_path / "nowhere"], MappingConfig())


def test_an_unknown_crs_is_refused_before_any_work(room_bag: Path) -> None:
    with pytest.raises(InputError, match="EPSG:1"):
        map_survey([room_bag], MappingConfig(crs="EPSG:1"))


def string(text: str) -> object:
    return TYPESTORE.types[MESSAGE_TYPES[METADATA]](data=text)


def test_a_bag_without_lidar_is_refused(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "b") as writer:
        writer.write(METADATA, MESSAGE_TYPES[METADATA], string("{}"), START_NS)
    with pytest.raises(InputError, match="no LiDAR topic"):
        map_survey([tmp_path / "b"], MappingConfig())


def test_packets_without_metadata_are_refused(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "b") as writer:
        writer.write_raw(LIDAR_PACKETS, MESSAGE_TYPES[LIDAR_PACKETS], b"\0\1\0\0\0\0\0\0", START_NS)
    with pytest.raises(InputError, match="/ouster/metadata"):
        map_survey([tmp_path / "b"], MappingConfig())


def test_a_lidar_topic_of_the_wrong_type_is_refused(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "b") as writer:
        writer.write(POINTS, "std_msgs/msg/String", string("x"), START_NS)
    with pytest.raises(InputError, match="expected sensor_msgs/msg/PointCloud2"):
        map_survey([tmp_path / "b"], MappingConfig())


def test_an_imu_without_an_extrinsic_is_refused(tmp_path: Path) -> None:
    types = TYPESTORE.types
    vector = types["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
    stamp = types["builtin_interfaces/msg/Time"](sec=START_NS // SECOND, nanosec=0)
    imu = types[MESSAGE_TYPES[IMU]](
        header=types["std_msgs/msg/Header"](stamp=stamp, frame_id="imu_link"),
        orientation=types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=np.zeros(9),
        angular_velocity=vector,
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=vector,
        linear_acceleration_covariance=np.zeros(9),
    )
    with BagWriter(tmp_path / "b") as writer:
        cloud = point_cloud_message(room_scan(np.eye(4), 100, 1), START_NS)
        writer.write(POINTS, MESSAGE_TYPES[POINTS], cloud, START_NS)
        writer.write(IMU, MESSAGE_TYPES[IMU], imu, START_NS)
    with pytest.raises(InputError, match=r"config/sensors.yaml") as caught:
        map_survey([tmp_path / "b"], ROOM)
    assert one_line(caught.value)


def test_extrinsics_come_from_tf_and_config_fills_or_overrides() -> None:
    T_base_mast = make_pose(np.eye(3), [0.0, 0.0, 1.5])
    transforms = [
        transform_message("base_link", "mast", T_base_mast),
        transform_message("mast", "lidar_link", make_pose(np.diag([-1.0, -1.0, 1.0]), [0.2, 0.0, 0.4])),
    ]
    filled = SensorsConfig(
        gnss=FramePose(translation=(1.0, 2.0, 3.0)), lidar=FramePose(translation=(9.0, 9.0, 9.0))
    )
    found = extrinsics_from_tf(transforms, filled, {"gnss"})
    np.testing.assert_allclose(found.T_base_lidar[:3, 3], [0.2, 0.0, 1.9])
    np.testing.assert_allclose(found.t_base_gnss, [1.0, 2.0, 3.0])
    overridden = extrinsics_from_tf(transforms, filled.model_copy(update={"override": True}), {"gnss"})
    np.testing.assert_allclose(overridden.T_base_lidar[:3, 3], [9.0, 9.0, 9.0])
    with pytest.raises(InputError, match="imu_link"):
        extrinsics_from_tf(transforms, filled, {"imu"})


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("t", np.array([0, 50_000_000], "<u4")),
        ("time", np.array([0.0, 0.05], "<f4")),
        ("timestamp", START_NS / 1e9 + np.array([0.0, 0.05])),
        ("offset_time", np.array([0, 50_000_000], "<u4")),
    ],
)
def test_point_times_of_any_driver_are_understood(name: str, values: np.ndarray) -> None:
    message = point_cloud_message(np.array([[5.0, 0, 0], [0, 6.0, 0]]), START_NS, **{name: values})
    scan = scan_from_points(message, MappingConfig())
    np.testing.assert_allclose(scan.first.times_ns - START_NS, [0, 50_000_000], atol=300)
    assert scan.end_ns == scan.first.times_ns[1]


def test_nan_points_are_dropped_and_counted() -> None:
    xyz = np.array([[5.0, 0, 0], [np.nan, 0, 0], [0, np.inf, 0], [0, 0.1, 0]])
    scan = scan_from_points(point_cloud_message(xyz, START_NS), MappingConfig(deskewed=True))
    assert len(scan.first) == 1
    assert scan.dropped_points == 2


def test_an_imported_pcap_holds_every_packet(shared_data: Path, tmp_path: Path) -> None:
    recording = shared_data / "ouster" / "OS-1-128_v2.3.0_1024x10_lb_n3.pcap"
    counts = import_recording(recording, tmp_path / "bag")
    assert counts[LIDAR_PACKETS] == 192
    facts = inspect_bag(tmp_path / "bag")
    assert facts["lidar"]["scans"] == 3
    assert facts["lidar"]["lost"] == 0
    assert "192 ouster_sensor_msgs" in describe(facts)
    with pytest.raises(InputError, match="exists"):
        import_recording(recording, tmp_path / "bag")


def test_an_imported_ros1_bag_decodes(shared_data: Path, tmp_path: Path) -> None:
    counts = import_recording(shared_data / "ouster" / "512x10_raw.bag", tmp_path / "bag")
    assert counts[LIDAR_PACKETS] == 32
    assert inspect_bag(tmp_path / "bag")["lidar"]["lost"] == 0


@pytest.mark.parametrize("name", ["empty_pcap.pcap", "crc_test.json"])
def test_broken_recordings_are_refused_and_leave_nothing(
    shared_data: Path, tmp_path: Path, name: str
) -> None:
    metadata = shared_data / "ouster" / "OS-1-128_v2.3.0_1024x10.json"
    with pytest.raises(InputError) as caught:
        import_recording(shared_data / "ouster" / "negative" / name, tmp_path / "bag", metadata=metadata)
    assert one_line(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_kitti_scans_give_a_local_map(shared_data: Path, tmp_path: Path) -> None:
    kitti_scans_to_bag(shared_data / "kitti_scans", tmp_path / "kitti", scans=10)
    survey = map_survey([tmp_path / "kitti"], MappingConfig(deskewed=True))
    assert survey.cloud.crs is None
    assert len(survey.trajectory) == 10
    assert len(survey.cloud) > 20_000


def test_the_files_in_config_validate(repository: Path) -> None:
    config = load_config(MappingConfig, [repository / "config" / n for n in ("mapping.yaml", "sensors.yaml")])
    assert config == MappingConfig()
