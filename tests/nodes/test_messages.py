"""Numpy to rclpy messages and back, through the wire format."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from subiaco_geo.errors import InputError
from subiaco_geo.frames import exp_se3, invert_pose
from subiaco_mapping.measurements import DeskewedScan, OdometryPose
from subiaco_mapping.preprocessing.conversions import cloud_array, stamp_ns

pytestmark = pytest.mark.ros

STAMP_NS = 1_697_335_200_123_456_789
T_BASE_LIDAR = exp_se3(np.array([0.1, -0.2, 0.3, 0.5, 0.0, 1.9]))


@pytest.fixture(autouse=True)
def workspace() -> None:
    pytest.importorskip("subiaco_msgs.msg", reason="workspace not sourced: source ros2_ws/env.sh")


def through_wire(message: Any) -> Any:
    from rclpy.serialization import deserialize_message, serialize_message

    return deserialize_message(serialize_message(message), type(message))


def make_scan(seed: int = 1, accel: np.ndarray | None = None) -> DeskewedScan:
    rng = np.random.default_rng(seed)
    return DeskewedScan(
        stamp_ns=STAMP_NS,
        xyz=rng.uniform(-100, 100, (500, 3)),
        intensity=rng.uniform(0, 4000, 500).astype(np.float32),
        mode="gyro",
        last_xyz=rng.uniform(-100, 100, (40, 3)),
        last_intensity=rng.uniform(0, 4000, 40).astype(np.float32),
        sky_xyz=rng.uniform(-40, 40, (30, 3)),
        accel=accel,
        columns=1024,
        lost_columns=16,
        dropped_points=3,
    )


def make_pose(stamp_ns_: int = STAMP_NS, twist: float = 0.3) -> OdometryPose:
    rng = np.random.default_rng(2)
    root = rng.normal(size=(6, 6))
    return OdometryPose(
        stamp_ns_,
        exp_se3(np.full(6, twist)),
        root @ root.T,
        812,
        0.034,
        degenerate=True,
        segment=2,
        predicted=True,
    )


@pytest.mark.parametrize("accel", [None, np.array([0.1, -0.2, 9.81])])
def test_a_scan_survives_the_wire_to_a_hundredth_of_a_millimetre(accel: np.ndarray | None) -> None:
    from subiaco_mapping.nodes.messages import (
        quality_message,
        scan_from_messages,
        scan_message,
        sky_message,
    )

    scan, pose = make_scan(accel=accel), make_pose()
    cloud = through_wire(scan_message(scan, "lidar_link"))
    quality = through_wire(quality_message(pose, scan, "lidar_link"))
    sky = through_wire(sky_message(scan, "lidar_link"))
    assert cloud.width == len(scan.xyz) + len(scan.last_xyz)  # no beam that met nothing
    assert sky.width == len(scan.sky_xyz)
    back = scan_from_messages(cloud, sky, quality)
    assert back.stamp_ns == STAMP_NS
    np.testing.assert_allclose(back.xyz, scan.xyz, atol=1e-5)  # float32 at 100 m
    np.testing.assert_allclose(back.last_xyz, scan.last_xyz, atol=1e-5)
    np.testing.assert_allclose(back.sky_xyz, scan.sky_xyz, atol=1e-5)
    np.testing.assert_array_equal(back.intensity, scan.intensity)
    np.testing.assert_array_equal(back.last_intensity, scan.last_intensity)
    assert (back.mode, back.columns, back.lost_columns, back.dropped_points) == ("gyro", 1024, 16, 3)
    assert (back.accel is None) == (accel is None)
    if accel is not None:
        np.testing.assert_array_equal(back.accel, accel)


def test_a_pose_survives_the_wire_in_doubles() -> None:
    from subiaco_mapping.nodes.messages import odometry_message, pose_from_messages, quality_message

    pose = make_pose()
    odometry = through_wire(odometry_message(pose, T_BASE_LIDAR, np.eye(6), "odom", "base_link"))
    quality = through_wire(quality_message(pose, make_scan(), "lidar_link"))
    back = pose_from_messages(odometry, quality, T_BASE_LIDAR)
    np.testing.assert_allclose(back.T_odom_lidar, pose.T_odom_lidar, atol=1e-12)
    np.testing.assert_array_equal(back.covariance, pose.covariance)
    sent = np.reshape(quality.covariance, (6, 6))  # translation first, as in every message of REP 103
    np.testing.assert_array_equal(sent[:3, :3], pose.covariance[3:, 3:])
    np.testing.assert_array_equal(sent[3:, :3], pose.covariance[:3, 3:])
    assert (back.stamp_ns, back.inliers, back.segment) == (STAMP_NS, 812, 2)
    assert (back.residual_rmse, back.degenerate, back.predicted) == (0.034, True, True)


def test_odometry_is_that_of_the_vehicle_not_of_the_sensor() -> None:
    from subiaco_mapping.nodes.messages import odometry_message
    from subiaco_ros.messages import pose_array

    pose = make_pose()
    message = odometry_message(pose, T_BASE_LIDAR, np.eye(6), "odom", "base_link")
    expected = pose.T_odom_lidar @ invert_pose(T_BASE_LIDAR)
    np.testing.assert_allclose(pose_array(message.pose.pose), expected, atol=1e-12)
    assert (message.header.frame_id, message.child_frame_id) == ("odom", "base_link")


def test_every_field_type_of_a_cloud_survives_the_wire() -> None:
    from subiaco_ros.messages import cloud_message

    kinds = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
    points = np.zeros(7, np.dtype([(kind, f"<{kind}") for kind in kinds]))
    for kind in kinds:
        points[kind] = np.arange(7)
    message = through_wire(cloud_message(points, "map", STAMP_NS))
    assert stamp_ns(message.header.stamp) == STAMP_NS
    back = cloud_array(message)
    for kind in kinds:
        np.testing.assert_array_equal(back[kind], points[kind])


def test_map_grid_coordinates_never_become_float32() -> None:
    from subiaco_ros.messages import xyz_cloud

    with pytest.raises(InputError, match="local coordinates"):
        xyz_cloud(np.array([[390_000.0, 6_460_000.0, 20.0]]))


def test_an_accumulated_covariance_is_that_of_many_noisy_walks() -> None:
    from subiaco_mapping.nodes.covariance import PoseCovariance

    rng = np.random.default_rng(3)
    step = exp_se3(np.array([0.0, 0.0, 0.2, 1.0, 0.0, 0.0]))
    sigmas = np.array([1e-3, 2e-3, 5e-3, 0.01, 0.02, 0.03])
    steps, walks = 8, 4000
    ends = np.broadcast_to(np.eye(4), (walks, 4, 4))
    for _ in range(steps):
        ends = ends @ step @ exp_se3(rng.normal(size=(walks, 6)) * sigmas)
    ends = ends @ invert_pose(T_BASE_LIDAR)
    accumulated = PoseCovariance(T_BASE_LIDAR)
    pose = np.eye(4)
    for k in range(steps + 1):
        covariance = accumulated.step(
            OdometryPose(k, pose, np.diag(sigmas**2), 0, 0.0, degenerate=False, segment=0)
        )
        pose = pose @ step
    sampled = ends[:, :3, 3].std(axis=0)
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)[:3]), sampled, rtol=0.06)
    yaw = np.arctan2(ends[:, 1, 0], ends[:, 0, 0])
    assert np.sqrt(covariance[5, 5]) == pytest.approx(np.unwrap(yaw).std(), rel=0.1)


def test_the_velocity_of_the_vehicle_is_that_of_its_motion_in_its_own_axes() -> None:
    from subiaco_mapping.nodes.covariance import base_velocity
    from subiaco_mapping.nodes.messages import odometry_message

    arc = exp_se3(np.array([0.0, 0.0, 0.03, np.sin(0.03) * 5 / 0.3, (1 - np.cos(0.03)) * 5 / 0.3, 0.0]))
    noise = np.diag([1e-6] * 3 + [1e-4] * 3)
    poses = [
        OdometryPose(k * 10**8, T @ T_BASE_LIDAR, noise, 9, 0.1, degenerate=False, segment=0)
        for k, T in enumerate((np.eye(4), arc))  # 5 m/s ahead, 0.3 rad/s to the left
    ]
    velocity = base_velocity(poses[0], poses[1], T_BASE_LIDAR)
    np.testing.assert_allclose(velocity.twist, [5.0, 0.0, 0.0, 0.0, 0.0, 0.3], atol=1e-4)
    # Rotated, not scaled, by the extrinsics; the lever arm adds the part of the turn to the translation.
    np.testing.assert_allclose(np.diag(velocity.covariance)[3:], [1e-4] * 3, rtol=1e-9)
    assert (np.diag(velocity.covariance)[:3] >= 1e-2 * (1 - 1e-9)).all()
    message = odometry_message(poses[1], T_BASE_LIDAR, np.eye(6), "odom", "base_link", velocity)
    assert message.twist.twist.linear.x == pytest.approx(5.0)
    assert message.twist.covariance[0] == pytest.approx(velocity.covariance[0, 0])


def test_a_velocity_that_nothing_tells_is_not_called_standing_for_certain() -> None:
    from subiaco_mapping.nodes.covariance import base_velocity

    first = make_pose()
    for previous, pose in ((None, first), (first, replace(first, stamp_ns=STAMP_NS + 10**8, segment=3))):
        assert (np.diag(base_velocity(previous, pose, T_BASE_LIDAR).covariance) >= 1e6).all()


def test_the_local_frame_lies_on_the_earth_where_its_origin_says() -> None:
    from pyproj import Transformer

    from subiaco_geo.crs import EnuFrame
    from subiaco_ros.local_frame import earth_from_enu

    enu = EnuFrame(-31.948, 115.825, 20.0)
    points = np.array([[0.0, 0.0, 0.0], [1000.0, 0.0, 0.0], [0.0, 1000.0, 0.0], [0.0, 0.0, 100.0]])
    geodetic = enu.to_geodetic(points)
    to_ecef = Transformer.from_crs("EPSG:7843", "EPSG:7842", always_xy=True)
    expected = np.stack(to_ecef.transform(geodetic[:, 1], geodetic[:, 0], geodetic[:, 2]), axis=1)
    T_earth_map = earth_from_enu(enu)
    np.testing.assert_allclose(points @ T_earth_map[:3, :3].T + T_earth_map[:3, 3], expected, atol=1e-4)


def test_messages_of_one_stamp_are_put_together_and_torn_sets_counted() -> None:
    from subiaco_ros.stamp_matching import StampMatcher

    matcher = StampMatcher(("pose", "cloud"))
    assert matcher.add("cloud", 1, "c1") is None
    assert matcher.add("pose", 2, "p2") is None
    assert matcher.add("cloud", 2, "c2") == ("p2", "c2")
    assert matcher.dropped == 1
    assert matcher.add("pose", 3, "p3") is None
    assert matcher.add("cloud", 3, "c3") == ("p3", "c3")
    assert matcher.dropped == 1
