"""A scan taken on the move looks like one taken at once."""

import numpy as np
import pytest
from mapping_scenes import SECOND, START_NS, cast, turning_pose
from scipy.spatial.transform import Rotation

from subiaco_geo.frames import invert_pose, make_pose
from subiaco_mapping.measurements import Extrinsics, ImuSample, Returns, Scan
from subiaco_mapping.preprocessing.config import DeskewConfig
from subiaco_mapping.preprocessing.deskew import Deskewer, body_twist

PERIOD = SECOND // 10
R_IMU = Rotation.from_euler("xyz", [180.0, 10.0, 90.0], degrees=True).as_matrix()
WITH_IMU = Extrinsics(np.eye(4), make_pose(R_IMU, [0.1, 0.2, 0.3]))
TWIST = np.array([0.0, 0.0, 0.4, 3.0, 0.0, 0.0])


def moving_scan(seed: int = 1, count: int = 4000) -> tuple[Scan, np.ndarray]:
    """A scan of the turning sensor in the room, and the points as seen at its end."""
    rng = np.random.default_rng(seed)
    times = np.sort(START_NS + PERIOD + rng.integers(0, PERIOD, count))
    times[-1] = START_NS + 2 * PERIOD
    beams = rng.normal(size=(count, 3))
    beams /= np.linalg.norm(beams, axis=1, keepdims=True)
    poses = turning_pose(times)
    xyz = cast(poses, beams)
    end = turning_pose(np.array([times[-1]]))[0]
    world = np.einsum("nij,nj->ni", poses[:, :3, :3], xyz) + poses[:, :3, 3]
    seen = world @ invert_pose(end)[:3, :3].T + invert_pose(end)[:3, 3]
    returns = Returns(xyz, times, np.zeros(count, np.float32), np.zeros(count, np.uint16))
    return Scan(START_NS + PERIOD, int(times[-1]), returns), seen


def feed(deskewer: Deskewer, rate: float = 0.4, bias: float = 0.0) -> None:
    for k in range(40):
        gyro = R_IMU.T @ np.array([0.0, 0.0, rate]) + bias
        deskewer.push_imu(ImuSample(START_NS + k * SECOND // 73, gyro, R_IMU.T @ np.array([0.0, 0.0, 9.8])))


def test_the_gyro_straightens_a_turning_scan_to_a_millimetre() -> None:
    scan, expected = moving_scan()
    assert np.linalg.norm(scan.first.xyz - expected, axis=1).max() > 0.4
    deskewer = Deskewer(DeskewConfig(), WITH_IMU)
    feed(deskewer)
    result = deskewer.deskew(scan, np.array([0, 0, 0, 3.0, 0, 0]), START_NS + PERIOD)
    assert result.mode == "gyro"
    assert np.linalg.norm(result.xyz - expected, axis=1).max() < 1e-3


def test_constant_velocity_does_where_the_imu_is_missing() -> None:
    scan, expected = moving_scan()
    result = Deskewer(DeskewConfig(), Extrinsics()).deskew(scan, TWIST, START_NS + PERIOD)
    assert result.mode == "constant_velocity"
    assert np.linalg.norm(result.xyz - expected, axis=1).max() < 1e-3


def test_a_hole_in_the_imu_falls_back_and_says_so() -> None:
    scan, _ = moving_scan()
    deskewer = Deskewer(DeskewConfig(), WITH_IMU)
    for t in (START_NS, START_NS + 3 * PERIOD):
        deskewer.push_imu(ImuSample(t, np.zeros(3), np.zeros(3)))
    assert deskewer.deskew(scan, TWIST, START_NS + PERIOD).mode == "constant_velocity"


def test_an_unknown_motion_leaves_the_points_and_says_so() -> None:
    scan, _ = moving_scan()
    result = Deskewer(DeskewConfig(), Extrinsics()).deskew(scan, None)
    assert result.mode == "none"
    assert result.motion is None
    np.testing.assert_array_equal(result.xyz, scan.first.xyz)


def test_the_predicted_motion_scales_with_the_true_time_step() -> None:
    scan, _ = moving_scan()
    late = Scan(scan.start_ns + 3 * PERIOD, scan.end_ns + 3 * PERIOD, scan.first)
    result = Deskewer(DeskewConfig(), Extrinsics()).deskew(late, TWIST, START_NS + PERIOD)
    poses = turning_pose(np.array([START_NS + PERIOD, late.end_ns]))
    np.testing.assert_allclose(result.motion, invert_pose(poses[0]) @ poses[1], atol=2e-3)


def test_a_body_twist_gives_its_motion_back() -> None:
    poses = turning_pose(np.array([START_NS, START_NS + PERIOD]))
    np.testing.assert_allclose(body_twist(invert_pose(poses[0]) @ poses[1], 0.1), TWIST, atol=1e-4)


def test_a_scan_waits_for_the_imu_but_not_forever() -> None:
    scan, _ = moving_scan()
    deskewer = Deskewer(DeskewConfig(imu_wait_ns=SECOND), WITH_IMU)
    assert not deskewer.ready(scan, scan.end_ns)
    assert deskewer.ready(scan, scan.end_ns + SECOND)
    feed(deskewer)
    assert deskewer.ready(scan, scan.end_ns)


def test_the_gyro_bias_is_learned_standing_only() -> None:
    standing, driving = (Deskewer(DeskewConfig(), WITH_IMU) for _ in range(2))
    for deskewer, twist in ((standing, np.zeros(6)), (driving, TWIST)):
        for k in range(120):
            deskewer.push_imu(
                ImuSample(START_NS + k * SECOND // 100, np.full(3, 0.004), np.array([0, 0, 9.8]))
            )
        for k in range(1, 11):
            empty = Returns(
                np.zeros((1, 3)),
                np.array([START_NS + k * PERIOD]),
                np.zeros(1, np.float32),
                np.zeros(1, np.uint16),
            )
            deskewer.deskew(Scan(START_NS + (k - 1) * PERIOD, START_NS + k * PERIOD, empty), twist)
    assert standing.gyro_bias == pytest.approx(np.full(3, 0.004), abs=1e-3)
    assert driving.gyro_bias == pytest.approx(np.zeros(3))


def test_nan_and_backward_samples_are_counted_and_dropped() -> None:
    deskewer = Deskewer(DeskewConfig(), WITH_IMU)
    deskewer.push_imu(ImuSample(START_NS, np.zeros(3), np.zeros(3)))
    deskewer.push_imu(ImuSample(START_NS - 1, np.zeros(3), np.zeros(3)))
    deskewer.push_imu(ImuSample(START_NS + 1, np.full(3, np.nan), np.zeros(3)))
    assert deskewer.out_of_order == 2
    assert deskewer.latest_imu_ns == START_NS


def test_points_moved_by_their_columns_equal_points_moved_by_their_times() -> None:
    rng = np.random.default_rng(21)
    column = rng.integers(0, 64, 500)
    column_ns = START_NS + np.arange(64) * 1_500_000
    xyz = rng.normal(0, 20, (500, 3))
    rest = (xyz, column_ns[column], np.zeros(500, np.float32), np.zeros(500, np.uint16))
    twist = np.array([0.1, -0.05, 0.4, 9.0, 0.3, -0.1])
    found = [
        Deskewer(DeskewConfig(), Extrinsics()).deskew(
            Scan(int(column_ns[0]), int(column_ns[-1]), returns), twist
        )
        for returns in (Returns(*rest), Returns(*rest, column, column_ns))
    ]
    np.testing.assert_allclose(found[0].xyz, found[1].xyz, atol=1e-12)
    assert np.abs(found[0].xyz - xyz).max() > 0.5
