"""Absolute and relative errors of trajectories whose answer is known by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from subiaco_geo.errors import InputError
from subiaco_geo.frames import exp_se3, make_pose
from subiaco_geo.trajectories import Trajectory
from subiaco_geo.trajectory_errors import absolute_error, aligned, pose_errors, relative_error


def straight(offset=(0.0, 0.0, 0.0), scale=1.0):
    steps = np.arange(101)
    positions = np.outer(steps * scale, [1.0, 0, 0]) + offset
    return Trajectory(steps * 100_000_000, make_pose(np.tile(np.eye(3), (101, 1, 1)), positions))


def test_an_offset_is_an_absolute_error_but_no_relative_one():
    absolute = absolute_error(straight(offset=(0.0, 0.3, 0.4)), straight())
    assert absolute["ate_rmse_m"] == pytest.approx(0.5)
    assert absolute["ate_vertical_rmse_m"] == pytest.approx(0.4)
    assert absolute["rotation_rmse_deg"] == pytest.approx(0.0, abs=1e-6)
    relative = relative_error(straight(offset=(0.0, 0.3, 0.4)), straight(), 10.0)
    assert relative["rpe_translation_rmse_m"] == pytest.approx(0.0, abs=1e-9)
    assert relative["pairs"] == 91


def test_a_scale_of_one_percent_is_a_drift_of_one_percent():
    relative = relative_error(straight(scale=1.01), straight(), 10.0)
    assert relative["rpe_translation_percent"] == pytest.approx(1.0)


def test_trajectories_that_share_no_time_are_refused():
    late = Trajectory(straight().times_ns + 10**12, straight().poses)
    with pytest.raises(InputError, match="clock"):
        absolute_error(late, straight())


def round_a_block(seed: int) -> Trajectory:
    rng = np.random.default_rng(seed)
    steps = np.cumsum(rng.normal(0, 1.0, (50, 3)), axis=0)
    poses = np.array([exp_se3(np.concatenate([rng.normal(0, 0.5, 3), step])) for step in steps])
    return Trajectory(np.arange(50) * 100_000_000, poses)


@given(st.integers(0, 50), st.lists(st.floats(-3, 3), min_size=6, max_size=6))
def test_alignment_takes_any_rigid_motion_away(seed, motion):
    reference = round_a_block(seed)
    moved = Trajectory(reference.times_ns, exp_se3(np.array(motion)) @ reference.poses)
    found, move = aligned(moved, reference)
    np.testing.assert_allclose(move @ exp_se3(np.array(motion)), np.eye(4), atol=1e-8)
    assert pose_errors(found, reference).distance.max() < 1e-8


def test_alignment_of_a_straight_line_is_refused():
    with pytest.raises(InputError, match="one line"):
        aligned(straight(), straight())
