"""The IMU's clock against the odometry's turns, as every mapping run reports it."""

import logging

import numpy as np
import pytest
from rig_drives import IMU_LATE, T_BASE_IMU, T_BASE_LIDAR, rig_drive

from subiaco_geo.frames import invert_pose
from subiaco_mapping.measurements import ImuSample, OdometryPose
from subiaco_mapping.preprocessing.imu_clock import ClockEstimate, ImuClock

R_LIDAR_IMU = (invert_pose(T_BASE_LIDAR) @ T_BASE_IMU)[:3, :3]


def clock_of(shift_ns: int, turning: bool = True, hole: bool = False, scans: int | None = None) -> ImuClock:
    """Feed a drive as the front end does: a scan once the IMU reaches over its end."""
    made = rig_drive(30.0, turning)
    clock = ImuClock(R_LIDAR_IMU, shift_ns)
    samples = iter(range(len(made.imu.times_ns)))
    for stamp, pose in list(zip(made.odometry.stamps_ns, made.odometry.T_odom_lidar, strict=True))[:scans]:
        for k in samples:
            seconds = (made.imu.times_ns[k] - made.imu.times_ns[0]) * 1e-9
            if not (hole and 10.0 < seconds < 12.0):
                clock.push_imu(ImuSample(int(made.imu.times_ns[k]), made.imu.gyro[k], made.imu.accel[k]))
            if made.imu.times_ns[k] + shift_ns > stamp:
                break
        clock.push_pose(OdometryPose(int(stamp), pose, np.eye(6), 0, 0.0, False, 0))
    return clock


@pytest.mark.parametrize("hole", [False, True])
def test_a_late_clock_is_estimated_and_warned_of(hole: bool, caplog: pytest.LogCaptureFixture) -> None:
    clock = clock_of(0, hole=hole)
    found = clock.estimate()
    assert found is not None
    assert abs(found.offset_ms + IMU_LATE * 1e3) < 3 * found.sigma_ms + 0.2
    assert found.sigma_ms < 1.0
    with caplog.at_level(logging.WARNING, logger="subiaco_mapping"):
        facts = clock.facts()["imu_clock"]
    assert facts["off"]
    assert "calibrate-rig" in caplog.text


def test_a_clock_put_right_is_not_warned_of(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING, logger="subiaco_mapping"):
        facts = clock_of(round(-IMU_LATE * 1e9)).facts()["imu_clock"]
    assert not facts["off"]
    assert abs(facts["offset_ms"]) < 2.0
    assert caplog.text == ""


def test_a_straight_drive_states_a_sigma_that_claims_nothing() -> None:
    found = clock_of(0, turning=False).estimate()
    assert found is not None
    assert found.sigma_ms > 2.0
    assert not found.off


def test_a_few_scans_or_no_imu_give_no_estimate() -> None:
    assert clock_of(0, scans=20).facts() == {}
    nothing = ImuClock(None)
    nothing.push_imu(ImuSample(1, np.zeros(3), np.zeros(3)))
    assert nothing.facts() == {}


def test_an_offset_within_chance_is_not_called_off() -> None:
    assert not ClockEstimate(5.0, 2.0, 100).off
    assert ClockEstimate(-7.0, 2.0, 100).off
    assert not ClockEstimate(1.5, 0.1, 100).off


def test_a_mapping_run_notes_the_clock_in_its_manifest(two_drives) -> None:
    for facts in two_drives.survey.manifest["sequences"].values():
        clock = facts["imu_clock"]
        assert abs(clock["offset_ms"]) < max(2.0, 3 * clock["sigma_ms"])
        assert not clock["off"]
    assert "imu_clock" in two_drives.survey.manifest["legend"]
