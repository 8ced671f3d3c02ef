"""Pose covariances at the tiles of a map."""

import numpy as np

from subiaco_geo.tile_uncertainty import tile_uncertainty

LINE = np.column_stack([np.arange(0.0, 100.0, 1.0), np.zeros(100), np.full(100, 2.0)])


def diagonal(rotation: float, translation: float) -> np.ndarray:
    return np.diag(np.repeat([rotation**2, translation**2], 3))


def test_a_tile_beside_the_way_has_the_sigma_of_the_way_and_what_yaw_adds() -> None:
    covariances = np.tile(diagonal(0.0, 0.02), (100, 1, 1))
    covariances[:, 2, 2] = 0.001**2  # yaw [rad2]
    east, north, *sigmas, nearest = tile_uncertainty(np.array([[50.0, 30.0, 0.0]]), LINE, covariances)[0]
    assert (east, north, nearest) == (50.0, 30.0, 30.0)
    np.testing.assert_allclose(sigmas, [np.hypot(0.02, 0.03), 0.02, 0.02], rtol=0.01)


def test_tilt_moves_what_is_far_up_and_down() -> None:
    covariances = np.tile(np.diag([0.01**2, 0, 0, 0, 0, 0]), (100, 1, 1))  # about east
    row = tile_uncertainty(np.array([[50.0, -20.0, 2.0]]), LINE, covariances)[0]
    np.testing.assert_allclose(row[2:5], [0.0, 0.0, 0.2], atol=1e-12)


def test_sigma_follows_the_way_from_a_good_stretch_to_a_bad_one() -> None:
    sigma = np.linspace(0.01, 0.10, 100)
    covariances = np.array([diagonal(0.0, s) for s in sigma])
    centres = np.column_stack([[5.0, 50.0, 95.0], [3.0] * 3, [np.nan] * 3])
    found = tile_uncertainty(centres, LINE, covariances)[:, 2]
    np.testing.assert_allclose(found, np.interp([5.0, 50.0, 95.0], LINE[:, 0], sigma), rtol=0.1)


def test_a_single_pose_is_enough() -> None:
    found = tile_uncertainty(np.array([[3.0, 4.0, np.nan]]), np.zeros((1, 3)), diagonal(0.0, 0.03)[None])
    np.testing.assert_allclose(found, [[3.0, 4.0, 0.03, 0.03, 0.03, 5.0]])
