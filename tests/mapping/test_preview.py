"""Path and map between two solutions, and one chain of an odometry that was restarted."""

from __future__ import annotations

import numpy as np

from subiaco_geo.frames import exp_se3, make_pose
from subiaco_mapping.fusion.preview import LivePreview, OdometrySegments


def at(x: float, yaw: float = 0.0) -> np.ndarray:
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1.0]])
    return make_pose(turn, [x, 0.0, 0.0])


def test_a_place_seen_twice_stands_once_in_the_preview() -> None:
    preview = LivePreview(0.5, 1000)
    wall = np.array([[10.1, 0.1, 0.1], [10.1, 1.1, 0.1]])
    preview.add(1, at(0.0), wall)
    preview.add(2, at(2.0), wall - [2.0, 0.0, 0.0])
    preview.add(3, at(4.0), np.array([[10.1, 0.1, 0.1]]))
    np.testing.assert_allclose(preview.points(), [*wall, [14.1, 0.1, 0.1]], atol=1e-5)
    times, poses = preview.path()
    assert times.tolist() == [1, 2, 3]
    np.testing.assert_allclose(poses[:, 0, 3], [0.0, 2.0, 4.0])


def test_a_solution_moves_path_and_points_and_carries_newer_scans() -> None:
    preview = LivePreview(0.5, 1000)
    for k in range(3):
        preview.add(k, at(float(k)), np.array([[5.2, 0.2, 0.2 + k]]))
    north = at(0.0, np.pi / 2)
    preview.solved(np.array([0, 1]), np.array([north @ at(0.0), north @ at(1.0)]), north)
    preview.add(3, at(3.0), np.array([[5.2, 0.2, 3.2]]))
    np.testing.assert_allclose(preview.path()[1][:, 1, 3], [0, 1, 2, 3], atol=1e-9)
    np.testing.assert_allclose(preview.points()[:, 1], [5.2, 6.2, 7.2, 8.2], atol=1e-5)


def test_the_oldest_points_go_when_there_are_too_many() -> None:
    preview = LivePreview(0.5, 50)
    rng = np.random.default_rng(4)
    for k in range(20):
        preview.add(k, at(20.0 * k), rng.uniform(-9, 9, (10, 3)))
    points = preview.points()
    assert 40 <= len(points) <= 50
    assert points[:, 0].min() > 200.0


def test_a_restarted_odometry_goes_on_where_it_ended() -> None:
    chain = OdometrySegments()
    taken = [
        chain.take(5000 + s, exp_se3(np.array([0, 0, 0.1 * k, k, 0, 0]))) for k, s in enumerate([0, 0, 1, 1])
    ]
    assert [segment for segment, _ in taken] == [0, 0, 1, 1]
    last = taken[-1][1]
    np.testing.assert_allclose(last, exp_se3(np.array([0, 0, 0.3, 3, 0, 0])))  # its own break moves nothing
    again = [chain.take(9000, exp_se3(np.array([0, 0, 0, float(k), 0, 0]))) for k in range(3)]
    assert [segment for segment, _ in again] == [2, 2, 2]
    np.testing.assert_allclose(again[0][1], last, atol=1e-12)
    np.testing.assert_allclose(np.linalg.inv(last) @ again[2][1], at(2.0), atol=1e-12)
    np.testing.assert_allclose(chain.T_chain_odom, last, atol=1e-12)
