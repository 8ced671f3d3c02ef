"""Odometry that is a little short does not pass for a clock or a lever arm."""

from __future__ import annotations

import numpy as np
import pytest
from mapping_scenes import SECOND, START_NS

from subiaco_geo.crs import EnuFrame
from subiaco_geo.frames import invert_pose, make_pose
from subiaco_mapping.calibration.antenna import fit_antenna
from subiaco_mapping.calibration.config import CalibrationConfig
from subiaco_mapping.calibration.imu import OdometryTrack
from subiaco_mapping.measurements import GnssFix
from subiaco_mapping.pose_graph.config import GnssConfig

FRAME = EnuFrame(-31.948, 115.825, 12.0)
LEVER = np.array([-0.4, 0.3, 0.9])


def course(times_s: np.ndarray) -> np.ndarray:
    """Poses (N, 4, 4) of a car that turns both ways, with 8 to 12 m/s."""
    fine = np.linspace(-1.0, 61.0, 62001)
    yaw, speed = 0.8 * np.sin(fine / 3.0), 10.0 + 2.0 * np.sin(fine / 2.0)
    step = np.stack([speed * np.cos(yaw), speed * np.sin(yaw)], axis=1) * (fine[1] - fine[0])
    path = np.cumsum(step, axis=0)
    at = [np.interp(times_s, fine, values) for values in (*path.T, yaw)]
    zero, one = np.zeros_like(times_s), np.ones_like(times_s)
    turn = np.array([[np.cos(at[2]), -np.sin(at[2]), zero], [np.sin(at[2]), np.cos(at[2]), zero]])
    turn = np.concatenate([turn, np.array([[zero, zero, one]])])
    return make_pose(np.moveaxis(turn, 2, 0), np.stack([at[0], at[1], zero], axis=1))


@pytest.mark.parametrize(("scale", "clock_s"), [(0.0, 0.03), (0.005, 0.03), (-0.004, 0.0)])
def test_scale_clock_and_lever_arm_are_told_apart(scale: float, clock_s: float) -> None:
    rng, scans, stamps = np.random.default_rng(6), np.arange(0.0, 60.0, 0.1), np.arange(0.5, 59.0, 0.2)
    odometry = invert_pose(course(scans)[0]) @ course(scans)
    odometry[:, :3, 3] *= 1.0 - scale
    antenna = course(stamps)
    places = antenna[:, :3, :3] @ LEVER + antenna[:, :3, 3] + rng.normal(0, 0.01, (len(stamps), 3))
    geodetic = FRAME.to_geodetic(places)
    times_ns = START_NS + np.round((stamps - clock_s) * SECOND).astype(np.int64)
    fixes = [
        GnssFix(int(t), *row.tolist(), np.eye(3) * 1e-4, 2) for t, row in zip(times_ns, geodetic, strict=True)
    ]
    scans_ns = START_NS + np.round(scans * SECOND).astype(np.int64)
    track = OdometryTrack(scans_ns, odometry, np.zeros(len(scans), np.int64))
    up = np.array([0.0, 0.0, 1.0])
    found = fit_antenna(track, fixes, [], np.eye(4), LEVER + 0.1, up, GnssConfig(), CalibrationConfig())
    assert found is not None
    assert found.scale == pytest.approx(scale, abs=4 * found.scale_sigma + 1e-4)
    assert found.scale_sigma < 0.001
    assert found.offset_s == pytest.approx(clock_s, abs=0.004)
    np.testing.assert_allclose(found.t_base_gnss[:2], LEVER[:2], atol=0.05)
