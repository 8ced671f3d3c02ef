"""Rigs whose extrinsics and clocks are known, found again; what a motion does not show stays as given."""

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rig_drives import (
    ANTENNA,
    GNSS_LATE,
    HEADING,
    IMU_LATE,
    T_BASE_IMU,
    T_BASE_LIDAR,
    RigDrive,
    rig_drive,
)
from scipy.spatial.transform import Rotation

from subiaco_geo.config import load_config
from subiaco_geo.errors import InputError
from subiaco_geo.frames import invert_pose
from subiaco_mapping.calibration.antenna import AntennaFit, fit_antenna
from subiaco_mapping.calibration.config import CalibrationConfig
from subiaco_mapping.calibration.estimate import solve
from subiaco_mapping.calibration.facades import Facades, compare, find_facades
from subiaco_mapping.calibration.imu import ImuFit, ImuTrack, OdometryTrack, fit_imu
from subiaco_mapping.calibration.report import page, write_calibration
from subiaco_mapping.calibration.rig import calibrate_rig, with_rig
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.pose_graph.config import GnssConfig

T_LIDAR_IMU = invert_pose(T_BASE_LIDAR) @ T_BASE_IMU
WRONG = Rotation.from_euler("xyz", [1.5, -2.0, 3.0], degrees=True).as_matrix()
CONFIG = CalibrationConfig()


@cache
def drive(turning: bool = True, seed: int = 101) -> RigDrive:
    return rig_drive(60.0 if turning else 30.0, turning, seed)


def imu_of(made: RigDrive, offset_s: float = 0.0) -> ImuFit:
    return fit_imu(made.odometry, made.imu, WRONG @ T_LIDAR_IMU[:3, :3], T_LIDAR_IMU[:3, 3], offset_s, CONFIG)


def antenna_of(made: RigDrive, wrong: np.ndarray, headings: bool = True) -> AntennaFit | None:
    heard, up = made.headings if headings else [], T_BASE_LIDAR[2, :3]
    return fit_antenna(made.odometry, made.fixes, heard, T_BASE_LIDAR, wrong, up, GnssConfig(), CONFIG)


def turned_by(fit: ImuFit) -> np.ndarray:
    return Rotation.from_matrix(fit.R_lidar_imu @ T_LIDAR_IMU[:3, :3].T).as_rotvec()


def test_a_turned_imu_and_its_late_clock_are_found_within_three_sigma() -> None:
    fit = imu_of(drive())
    assert fit.rotation_observed.all()
    assert (np.abs(turned_by(fit)) < 3 * fit.rotation_sigma).all()
    assert np.degrees(np.abs(turned_by(fit))).max() < 0.3
    assert fit.offset_observed
    assert abs(fit.offset_s + IMU_LATE) < 3 * fit.offset_sigma < 0.002
    np.testing.assert_allclose(fit.gyro_bias, [0.002, -0.001, 0.003], atol=3e-4)


def test_the_antenna_is_found_but_for_its_height_which_a_flat_road_does_not_show() -> None:
    made, wrong = drive(), ANTENNA + np.array([0.12, -0.08, 0.1])
    fit = antenna_of(made, wrong)
    assert fit is not None
    assert fit.lever_observed.tolist() == [True, True, False]
    assert (np.abs(fit.t_base_gnss - ANTENNA)[:2] < 3 * fit.lever_sigma[:2]).all()
    assert np.abs(fit.t_base_gnss - ANTENNA)[:2].max() < 0.02
    assert fit.t_base_gnss[2] == wrong[2]
    assert abs(fit.offset_s + GNSS_LATE) < 3 * fit.offset_sigma < 0.006
    assert fit.heading_offset is not None
    assert fit.heading_offset == pytest.approx(HEADING, abs=3 * float(fit.heading_sigma))


def test_a_straight_drive_at_one_speed_keeps_everything_and_says_so() -> None:
    made = drive(turning=False)
    fit = imu_of(made, offset_s=-0.005)
    assert not fit.rotation_observed.any()
    np.testing.assert_allclose(fit.R_lidar_imu, WRONG @ T_LIDAR_IMU[:3, :3])
    assert not fit.offset_observed
    assert fit.offset_s == -0.005
    wrong = ANTENNA + np.array([0.12, -0.08, 0.1])
    found = antenna_of(made, wrong, headings=False)
    assert found is not None
    assert not found.lever_observed.any()
    np.testing.assert_array_equal(found.t_base_gnss, wrong)
    assert found.offset_s == 0.0
    assert found.heading_offset is None


def test_odometry_that_fails_for_a_moment_does_not_move_the_result() -> None:
    made = drive()
    poses = made.odometry.T_odom_lidar.copy()
    poses[300:303, :3, :3] = poses[300:303, :3, :3] @ Rotation.from_rotvec([0, 0, 0.05]).as_matrix()
    broken = OdometryTrack(made.odometry.stamps_ns, poses, made.odometry.segment)
    fit = imu_of(RigDrive(broken, made.imu, [], []))
    assert (np.abs(turned_by(fit)) < 3 * fit.rotation_sigma).all()
    assert abs(fit.offset_s + IMU_LATE) < 3 * fit.offset_sigma


def test_too_little_imu_is_refused_in_one_line() -> None:
    made = drive()
    short = ImuTrack(made.imu.times_ns[:200], made.imu.gyro[:200], made.imu.accel[:200])
    with pytest.raises(InputError, match="record longer"):
        imu_of(RigDrive(made.odometry, short, [], []))


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10**6))
def test_what_no_residual_holds_goes_back_to_what_was_given(seed: int) -> None:
    rng = np.random.default_rng(seed)
    design = rng.normal(size=(50, 3)) * [1.0, 1.0, 1e-6]
    target = design @ np.array([0.5, -0.3, 7.0]) + rng.normal(0, 0.01, 50)
    found = solve(lambda x: (design @ x - target) / 0.01, np.zeros(3), np.ones(3), np.full(3, 0.1))
    assert found.observed.tolist() == [True, True, False]
    assert found.values[2] == 0.0
    assert (np.abs(found.values[:2] - [0.5, -0.3]) < 5 * found.sigma[:2]).all()


def wall(sigma: float, seed: int) -> np.ndarray:
    """A facade 30 m long and 5 m high beside a road."""
    rng = np.random.default_rng(seed)
    along, off, high = rng.uniform(0, 30, 30_000), rng.normal(4.5, sigma, 30_000), rng.uniform(0, 5, 30_000)
    facade = np.column_stack([along, off, high])
    road = np.column_stack([rng.uniform(0, 30, 9000), rng.uniform(-4, 4, 9000), rng.normal(-0.5, 0.01, 9000)])
    return np.concatenate([facade, road])


def test_facades_give_back_their_thickness_and_roads_are_none() -> None:
    found = find_facades(wall(0.02, 1), np.array([0.0, 0.0, 1.0]), CONFIG)
    assert len(found.key) == 150
    assert np.median(found.thickness) == pytest.approx(0.02, rel=0.03)


@pytest.mark.parametrize(
    ("before", "after", "verdict"),
    [(0.03, 0.02, "thinner"), (0.02, 0.03, "thicker"), (0.02, 0.02, "unchanged")],
)
def test_thinner_and_thicker_facades_are_told_apart(before: float, after: float, verdict: str) -> None:
    up = np.array([0.0, 0.0, 1.0])
    maps = [find_facades(wall(sigma, seed), up, CONFIG) for seed, sigma in enumerate((before, after))]
    assert compare(*maps, CONFIG).verdict == verdict


def test_without_facades_there_is_no_verdict() -> None:
    nothing = Facades(np.zeros(0, np.int64), np.zeros(0))
    assert compare(nothing, nothing, CONFIG).verdict == "no facades"


def test_a_simulated_drive_gives_back_its_rig_as_configuration(two_drives: Any, tmp_path: Path) -> None:
    """Six seconds are short, so that sigmas are large; the report must say as much."""
    lidar = {"translation": (0.92, 0.03, 1.98), "rotation_deg": (-0.4, 0.8, 1.5)}
    given_yaml = tmp_path / "given.yaml"
    given_yaml.write_text(
        json.dumps(
            {
                "/**": {
                    "ros__parameters": {
                        "sensors": {
                            "override": True,
                            "lidar": lidar,
                            "imu": {"translation": (0.55, -0.24, 1.72), "rotation_deg": (2.4, -1.4, -87.0)},
                            "gnss": {"translation": (-0.38, 0.31, 2.11)},
                        },
                        "deskew": {"imu_time_offset_ns": 8_000_000},
                        "calibration": {"max_rotation_deg": 2.0, "passes": 2},
                    }
                }
            }
        )
    )
    config = load_config(MappingConfig, [given_yaml])
    found = calibrate_rig(two_drives.bags["there"], config)
    named = {parameter.name: parameter for parameter in found.parameters}
    truth = Rotation.from_euler("xyz", [0.9, 0.6, -90.0], degrees=True).as_matrix()
    true_lidar_imu = found.rig.extrinsics.T_base_lidar[:3, :3].T @ truth
    error = np.degrees(Rotation.from_matrix(found.rig.extrinsics.R_lidar_imu @ true_lidar_imu.T).as_rotvec())
    sigma = [named[f"IMU turned about LiDAR {axis}"].sigma for axis in "xyz"]
    assert (np.abs(error) < 3 * np.array(sigma)).all()
    clock = named["added to IMU stamps"]
    assert abs(clock.value) < 3 * clock.sigma
    assert abs(clock.value) < 4.0
    write_calibration(tmp_path / "rig", found, config, "there")
    again = load_config(MappingConfig, [tmp_path / "rig" / "rig.yaml"])
    wanted = with_rig(config, found.rig).sensors
    np.testing.assert_allclose(again.sensors.imu.rotation_deg, wanted.imu.rotation_deg, atol=1e-5)
    assert again.deskew.imu_time_offset_ns == found.rig.imu_offset_ns
    assert found.facades.verdict in {"thinner", "unchanged"}
    assert "facades are" in page(found, "there").lower()
    numbers = json.loads((tmp_path / "rig" / "calibration.json").read_text())
    assert {p["name"] for p in numbers["parameters"]} == set(named)
