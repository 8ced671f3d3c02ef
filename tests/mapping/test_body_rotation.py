"""The rotation of the LiDAR in the body of an INS, from motions with a known answer."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, invert_pose, make_pose
from subiaco_mapping.calibration.attitude import BodyTrack, fit_body_rotation, sharing
from subiaco_mapping.calibration.config import CalibrationConfig
from subiaco_mapping.calibration.imu import OdometryTrack

CONFIG = CalibrationConfig()
LEVER = np.array([0.8, -0.3, 0.8])


def drive(turning: float, moving: float, seconds: float = 60.0) -> BodyTrack:
    """A body at 20 Hz that swings its heading by ``turning`` [rad], rolls and pitches a little, and moves."""
    t = np.arange(0.0, seconds, 0.05)
    yaw = turning * np.sin(2 * np.pi * t / 15.0)
    pitch, roll = 0.01 * np.sin(2 * np.pi * t / 7.0), 0.01 * np.sin(2 * np.pi * t / 5.0)
    turn = Rotation.from_euler("ZYX", np.stack([yaw, pitch, roll], axis=1)).as_matrix()
    step = moving * 0.05 * turn[:, :, 0]
    path = np.cumsum(step, axis=0)
    return BodyTrack((t * 1e9).astype(np.int64), make_pose(turn, path))


def odometry_of(body: BodyTrack, T_body_lidar: Floats, offset_s: float, seed: int) -> OdometryTrack:
    """Odometry at 10 Hz with 0.5 mrad and 1 cm of noise, its frame turned; the body's clock is ``offset_s``
    behind."""
    rng = np.random.default_rng(seed)
    which = np.arange(0, len(body.times_ns), 2)
    start = make_pose(Rotation.from_euler("z", 70, degrees=True).as_matrix(), np.array([3.0, -2.0, 1.0]))
    poses = start @ body.T_enu_body[which] @ T_body_lidar
    poses[:, :3, :3] = (
        poses[:, :3, :3] @ Rotation.from_rotvec(rng.normal(0, 5e-4, (len(which), 3))).as_matrix()
    )
    poses[:, :3, 3] += rng.normal(0, 0.01, (len(which), 3))
    stamps_ns = body.times_ns[which] + round(offset_s * 1e9)
    return OdometryTrack(stamps_ns, poses, np.zeros(len(which), dtype=np.int64))


def error_deg(found: Floats, true: Floats) -> Floats:
    """Rotation about body axes (3,) [deg]."""
    return np.degrees(Rotation.from_matrix(found @ true.T).as_rotvec())


@pytest.mark.parametrize("angles", [(0.0, 0.0, 0.0), (1.5, -2.0, 3.0), (-0.7, 0.4, -4.0)])
@pytest.mark.parametrize("seed", [1, 2])
def test_a_known_rotation_is_found_within_its_sigma(angles: tuple[float, float, float], seed: int) -> None:
    true = make_pose(Rotation.from_euler("xyz", angles, degrees=True).as_matrix(), LEVER)
    body = drive(0.8, 10.0)
    found = fit_body_rotation(odometry_of(body, true, 0.02, seed), body, make_pose(np.eye(3), LEVER), CONFIG)
    assert found.observed.all()
    error = error_deg(found.R_body_lidar, true[:3, :3])
    assert (np.abs(error) < 4.0 * np.degrees(found.sigma)).all()
    assert np.abs(error).max() < 0.15
    assert found.offset_s == pytest.approx(0.02, abs=4.0 * found.offset_sigma)


def test_standing_and_turning_leaves_the_yaw_open_and_driving_shows_it() -> None:
    """A body that turns in its place shows roll and pitch of the LiDAR alone; its yaw stays as given."""
    true = make_pose(Rotation.from_euler("xyz", (1.0, -1.0, 3.0), degrees=True).as_matrix(), LEVER)
    t = np.arange(0.0, 60.0, 0.05)
    turn = Rotation.from_euler("z", np.sin(2 * np.pi * t / 15.0)[:, None]).as_matrix()
    standing = BodyTrack((t * 1e9).astype(np.int64), make_pose(turn, np.zeros((len(t), 3))))
    given = make_pose(np.eye(3), LEVER)
    found = fit_body_rotation(odometry_of(standing, true, 0.0, 3), standing, given, CONFIG)
    assert found.observed.tolist() == [True, True, False]
    assert np.degrees(found.sigma[2]) > 2.0


def test_driving_straight_leaves_the_roll_open() -> None:
    true = make_pose(Rotation.from_euler("xyz", (2.0, -1.0, 1.0), degrees=True).as_matrix(), LEVER)
    t = np.arange(0.0, 60.0, 0.05)
    straight = BodyTrack(
        (t * 1e9).astype(np.int64),
        make_pose(np.tile(np.eye(3), (len(t), 1, 1)), np.outer(10.0 * t, [1, 0, 0])),
    )
    given = make_pose(np.eye(3), LEVER)
    found = fit_body_rotation(odometry_of(straight, true, 0.0, 4), straight, given, CONFIG)
    assert found.observed.tolist() == [False, True, True]
    error = error_deg(found.R_body_lidar, true[:3, :3])
    assert np.abs(error[1:]).max() < 0.15


@pytest.mark.parametrize(("along", "least", "most"), [(0.0, 1.0, 3.0), (0.9, 10.0, 30.0)])
def test_errors_that_wander_count_as_few(along: float, least: float, most: float) -> None:
    """Autoregressive errors share one error for (1 + a) / (1 - a) samples: 1 and 19."""
    steps = np.random.default_rng(6).normal(0.0, 1.0, (4000, 2))
    wandering = steps.copy()
    for k in range(1, len(steps)):
        wandering[k] += along * wandering[k - 1]
    assert least <= sharing(wandering) <= most


def test_a_short_recording_says_so() -> None:
    body = drive(0.5, 10.0, seconds=3.0)
    given = make_pose(np.eye(3), LEVER)
    with pytest.raises(InputError, match="record longer"):
        fit_body_rotation(odometry_of(body, given, 0.0, 5), body, invert_pose(invert_pose(given)), CONFIG)
