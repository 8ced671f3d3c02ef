"""The velocity filter: odometry's noisy steps and the accelerometer make one steady velocity."""

import numpy as np
from scipy.spatial.transform import Rotation

from subiaco_geo.frames import make_pose
from subiaco_mapping.measurements import DeskewedScan, Extrinsics, ImuSample, Returns, Scan
from subiaco_mapping.preprocessing.config import DeskewConfig
from subiaco_mapping.preprocessing.deskew import Deskewer, body_twist
from subiaco_mapping.preprocessing.velocity_filter import VelocityFilter, imu_stretch

START_NS, SECOND = 1_760_000_000_000_000_000, 1_000_000_000
GRAVITY = np.array([0.0, 0.0, 9.79])
R_IMU = Rotation.from_euler("xyz", [180.0, 10.0, 90.0], degrees=True).as_matrix()
LEVER = np.array([0.4, -0.3, -0.2])
RIG = Extrinsics(np.eye(4), make_pose(R_IMU, LEVER))


def speed(t: float | np.ndarray) -> np.ndarray:
    """Stands for 2 s, pulls away with 2 m/s2, goes on at 8 m/s, brakes for 2 s with 3 m/s2."""
    return np.interp(t, [0, 2, 6, 10, 12], [0, 0, 8, 8, 2])


def yaw_rate(t: float | np.ndarray) -> np.ndarray:
    """Turns between 6 and 9 s."""
    return np.interp(t, [6.0, 6.5, 8.5, 9.0], [0.0, 0.4, 0.4, 0.0])


FINE = np.arange(0.0, 12.0, 1e-3)
YAW = np.append(0.0, np.cumsum(yaw_rate(FINE[:-1] + 5e-4)) * 1e-3)
STEP = speed(FINE[:-1] + 5e-4)[:, None] * np.stack([np.cos(YAW[:-1]), np.sin(YAW[:-1])], axis=1) * 1e-3
WAY = np.vstack([np.zeros(2), np.cumsum(STEP, axis=0)])


def pose_at(t: float) -> np.ndarray:
    turn = Rotation.from_rotvec([0.0, 0.0, np.interp(t, FINE, YAW)]).as_matrix()
    return make_pose(turn, [np.interp(t, FINE, WAY[:, 0]), np.interp(t, FINE, WAY[:, 1]), 0.0])


def imu_at(t: float, rng: np.random.Generator) -> ImuSample:
    """What an IMU away from the LiDAR reads, with a bias of 0.05 m/s2 and noise."""
    rate, spin = yaw_rate(t), (yaw_rate(t + 1e-3) - yaw_rate(t - 1e-3)) / 2e-3
    pull = (speed(t + 1e-3) - speed(t - 1e-3)) / 2e-3
    turn, spun = np.array([0.0, 0.0, rate]), np.array([0.0, 0.0, spin])
    force = GRAVITY + np.array([pull, rate * speed(t), 0.0])
    force += np.cross(spun, LEVER) + np.cross(turn, np.cross(turn, LEVER)) + 0.05 + rng.normal(0, 0.05, 3)
    gyro = R_IMU.T @ turn + rng.normal(0, 1e-3, 3)
    return ImuSample(START_NS + round(t * SECOND), gyro, R_IMU.T @ force)


def driven(noise: float, scale: float = 1.0, hole: tuple[float, float] = (99.0, 99.0)) -> list[DeskewedScan]:
    """Deskew scans of one point, the odometry knowing each pose to ``noise`` [m]; seed 4."""
    rng = np.random.default_rng(4)
    deskewer = Deskewer(DeskewConfig(), RIG)
    for t in np.arange(0.0, 11.99, 0.01):
        sample = imu_at(t, rng)
        if not hole[0] <= t < hole[1]:
            deskewer.push_imu(ImuSample(sample.time_ns, sample.gyro, scale * sample.accel))
    found, twist, previous_ns, before = [], None, None, np.eye(4)
    ends = np.arange(1, 119) * 0.1
    for k, end in enumerate(ends):
        stamps = START_NS + np.round(np.array([end - 0.1, end]) * SECOND).astype(np.int64)
        point = Returns(np.ones((1, 3)), stamps[:1], np.zeros(1, np.float32), np.zeros(1, np.uint16))
        found.append(deskewer.deskew(Scan(*stamps.tolist(), point), twist, previous_ns))
        previous_ns = int(stamps[1])
        registered = pose_at(end)
        registered[:3, 3] += rng.normal(0, noise, 3)
        if k > 0:
            twist = body_twist(np.linalg.inv(before) @ registered, 0.1)
        before = registered
    return found


def errors(scans: list[DeskewedScan], begin: float) -> np.ndarray:
    """Length (K,) of the error of the predicted motions after some seconds [m]."""
    ends = np.arange(1, 119) * 0.1
    found = [
        scan.motion[:3, 3] - (np.linalg.inv(pose_at(end - 0.1)) @ pose_at(end))[:3, 3]
        for scan, end in zip(scans, ends, strict=True)
        if end > begin and scan.motion is not None
    ]
    return np.linalg.norm(found, axis=1)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).mean()))


def test_noise_of_the_odometry_does_not_reach_the_predicted_motion() -> None:
    scans = driven(noise=0.015)
    assert {scan.mode for scan in scans[20:]} == {"gyro_accelerometer"}
    assert rms(errors(scans, 2.0)) < 0.008  # with the last step instead: 26 mm and the acceleration


def test_pulling_away_and_braking_are_foreseen() -> None:
    scans = driven(noise=1e-4)
    assert np.max(errors(scans, 2.0)) < 0.008  # 2 m/s2 and 3 m/s2 for 0.1 s are 20 and 30 mm


def test_an_accelerometer_in_other_units_is_not_used() -> None:
    scans = driven(noise=1e-3, scale=1.0 / 9.81)
    assert {scan.mode for scan in scans} == {"gyro"}


def test_after_a_hole_in_the_imu_the_filter_is_found_again() -> None:
    scans = driven(noise=0.005, hole=(4.0, 5.0))
    modes = [scan.mode for scan in scans]
    assert set(modes[41:49]) == {"constant_velocity"}
    assert set(modes[75:]) == {"gyro_accelerometer"}
    assert rms(errors(scans, 7.0)) < 0.006


def test_a_stretch_at_rest_gives_gravity_back() -> None:
    knots_ns = START_NS + np.arange(11, dtype=np.int64) * 10_000_000
    stretch = imu_stretch(knots_ns, np.zeros((11, 3)), np.tile(GRAVITY, (11, 1)), LEVER)
    np.testing.assert_allclose(stretch.gained[-1], 0.1 * GRAVITY, atol=1e-12)
    np.testing.assert_allclose(stretch.path(np.array([3.0, 0, 0]), GRAVITY)[-1], [0.3, 0, 0], atol=1e-12)


def test_a_stretch_that_was_never_noted_makes_the_filter_forget() -> None:
    knots_ns = START_NS + np.arange(11, dtype=np.int64) * 10_000_000
    found = VelocityFilter(DeskewConfig())
    for _ in range(60):
        found.hold(imu_stretch(knots_ns, np.zeros((11, 3)), np.tile(GRAVITY, (11, 1)), LEVER))
        found.advance(np.zeros(3))
    assert found.state is not None
    np.testing.assert_allclose(found.state[0], 0.0, atol=1e-6)
    np.testing.assert_allclose(found.state[1], GRAVITY, atol=1e-3)
    found.advance(np.zeros(3))
    assert found.state is None
