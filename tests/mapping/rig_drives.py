"""Tracks of a rig with known extrinsics and clocks, straight from formulae."""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from subiaco_geo.crs import EnuFrame
from subiaco_geo.frames import invert_pose, make_pose
from subiaco_mapping.calibration.imu import ImuTrack, OdometryTrack
from subiaco_mapping.measurements import GnssFix, HeadingSample

START_NS = 1_760_000_000_000_000_000
HOME = EnuFrame(-31.95, 115.83, 20.0)


def mounted(angles: list[float], place: list[float]) -> np.ndarray:
    """Pose from roll, pitch, yaw [deg], fixed axes."""
    return make_pose(Rotation.from_euler("xyz", angles, degrees=True).as_matrix(), np.array(place))


T_BASE_LIDAR = mounted([-0.4, 0.8, 1.5], [0.9, 0.03, 2.0])
T_BASE_IMU = mounted([1.0, -2.0, -88.0], [0.5, -0.2, 1.7])
ANTENNA = np.array([-0.4, 0.3, 2.1])
IMU_LATE, GNSS_LATE = 0.012, 0.03  # seconds that stamps are too late
HEADING = np.radians(7.0)


@dataclass(frozen=True)
class RigDrive:
    """What the rig measured."""

    odometry: OdometryTrack
    imu: ImuTrack
    fixes: list[GnssFix]
    headings: list[HeadingSample]


def rig_drive(duration: float = 60.0, turning: bool = True, seed: int = 101) -> RigDrive:
    """A car on a nearly flat road that turns and changes speed, or holds both."""
    rng = np.random.default_rng(seed)
    t = np.arange(-1.0, duration + 1.0, 0.02)
    yaw = 0.5 + (0.8 * np.sin(0.35 * t) + 0.3 * np.sin(0.9 * t) if turning else 0.0 * t)
    speed = 6.0 + (3.0 * np.sin(0.5 * t) if turning else 0.0 * t)
    step = np.column_stack([speed * np.cos(yaw), speed * np.sin(yaw)])
    xy = np.cumsum(step, axis=0) * 0.02
    swing = 0.006 if turning else 0.0
    angles = CubicSpline(
        t, np.column_stack([swing * np.sin(9 * t), swing * np.sin(11 * t + 1), yaw])
    )  # roll pitch yaw
    place = CubicSpline(t, np.column_stack([xy, 0.005 * np.sin(7 * t)]))

    def base(s: np.ndarray) -> np.ndarray:
        return make_pose(Rotation.from_euler("xyz", angles(s)).as_matrix(), place(s))

    scans = np.arange(0.0, duration, 0.1)
    poses = base(scans) @ T_BASE_LIDAR
    wobble = Rotation.from_rotvec(rng.normal(0, 3e-4, (len(scans), 3))).as_matrix()
    poses[:, :3, :3] = poses[:, :3, :3] @ wobble
    poses[:, :3, 3] += rng.normal(0, 0.004, (len(scans), 3))
    odometry = OdometryTrack(_ns(scans), invert_pose(poses[0]) @ poses, np.zeros(len(scans), np.int64))
    fixes = _fixes(base, duration, rng)
    return RigDrive(odometry, _imu(base, duration, rng), fixes, _headings(angles, duration, rng))


def _ns(seconds: np.ndarray) -> np.ndarray:
    return START_NS + np.round(seconds * 1e9).astype(np.int64)


def _imu(base, duration: float, rng: np.random.Generator) -> ImuTrack:
    s, h = np.arange(-0.5, duration + 0.5, 0.01) + 0.0013, 1e-3
    middle, before, after = (base(s + d) @ T_BASE_IMU for d in (0.0, -h, h))
    turned = np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3]
    gyro = Rotation.from_matrix(turned).as_rotvec() / (2 * h)
    world = (after[:, :3, 3] - 2 * middle[:, :3, 3] + before[:, :3, 3]) / h**2 + [0, 0, 9.794]
    accel = np.einsum("nji,nj->ni", middle[:, :3, :3], world)
    gyro += np.array([0.002, -0.001, 0.003]) + rng.normal(0, 0.002, gyro.shape)
    accel += np.array([0.02, -0.03, 0.01]) + rng.normal(0, 0.02, accel.shape)
    return ImuTrack(_ns(s + IMU_LATE), gyro, accel)


def _fixes(base, duration: float, rng: np.random.Generator) -> list[GnssFix]:
    s = np.arange(0.05, duration, 0.2)
    enu = base(s)[:, :3, :3] @ ANTENNA + base(s)[:, :3, 3] + rng.normal(0, [0.012, 0.012, 0.02], (len(s), 3))
    geodetic = HOME.to_geodetic(enu)
    covariance = np.diag([0.012, 0.012, 0.02]) ** 2
    stamps = _ns(s + GNSS_LATE)
    return [GnssFix(int(n), *map(float, row), covariance, 2) for n, row in zip(stamps, geodetic, strict=True)]


def _headings(angles, duration: float, rng: np.random.Generator) -> list[HeadingSample]:
    s = np.arange(0.05, duration, 0.2)
    yaw = angles(s)[:, 2] + HEADING + rng.normal(0, 0.003, len(s))
    return [HeadingSample(int(n), float(y), 0.003) for n, y in zip(_ns(s + GNSS_LATE), yaw, strict=True)]
