"""Registration of sparse clouds that share the pattern of one scan; seeds name layouts and halves."""

from __future__ import annotations

import numpy as np
import pytest

from subiaco_change.registration.config import RegistrationConfig
from subiaco_change.registration.correlation import correlate, rising
from subiaco_change.registration.displaced_starts import PoseSpread, spread_of_starts, twist_between
from subiaco_change.registration.fitting import prepare_pair
from subiaco_change.registration.icp import find_pairs, make_target, measure_noise
from subiaco_change.registration.register import register
from subiaco_geo.clouds import PointCloud, voxel_downsample
from subiaco_geo.frames import exp_se3, transform_points

SHIFT = np.array([0.3, -0.25, 0.1])


def scanned(size, crowns, seed, spacing=1.15):
    """One airborne scan (N, 3) [m]: rows of points over rolling ground, and on crowns where they stand."""
    rng = np.random.default_rng(seed)
    steps = np.arange(0.0, size, spacing)
    x, y = (side.ravel() for side in np.meshgrid(steps, 1.1 * steps))
    xy = np.column_stack([x + 0.3 * y, y]) + rng.normal(0.0, 0.08, (len(x), 2))
    z = 0.8 * np.sin(xy[:, 0] / 25.0) + 0.6 * np.cos(xy[:, 1] / 31.0) + rng.normal(0.0, 0.01, len(xy))
    layout = np.random.default_rng(1000 + seed)
    places = np.column_stack([layout.uniform(0, 1.3 * size, crowns), layout.uniform(0, 1.1 * size, crowns)])
    through = rng.random(len(xy)) < 0.25  # pulses that reach the ground between the leaves
    for place in places:
        radius, top = layout.uniform(1.5, 4.0), layout.uniform(6.0, 18.0)
        apart = np.linalg.norm(xy - place, axis=1)
        inside = (apart < radius) & ~through
        crown = top - 0.6 * apart[inside] ** 2 / radius - rng.exponential(0.8, inside.sum())
        z[inside] = np.maximum(z[inside], crown)
    return np.column_stack([xy, z])


def houses(size, seed, spacing=1.15):
    """The same scan of ground with gabled houses."""
    points = scanned(size, 0, seed, spacing)
    layout = np.random.default_rng(2000 + seed)
    for east in np.arange(20.0, 1.2 * size, 35.0):
        for north in np.arange(15.0, size, 35.0):
            turn, (long, wide) = layout.uniform(0, np.pi), layout.uniform((8.0, 5.0), (12.0, 7.0))
            offset = points[:, :2] - (east, north)
            along = offset @ [np.cos(turn), np.sin(turn)]
            across = np.abs(offset @ [-np.sin(turn), np.cos(turn)])
            inside = (np.abs(along) < long) & (across < wide)
            points[inside, 2] = 9.0 - 0.8 * across[inside]
    return points


def halves(points, seed, shift=SHIFT):
    """Two halves without a point in common, the second one moved, as clouds of one CRS."""
    first = np.random.default_rng(seed).random(len(points)) < 0.5
    return tuple(
        voxel_downsample(PointCloud(part, crs="EPSG:25832"), 0.25)
        for part in (points[first], points[~first] + shift)
    )


@pytest.mark.parametrize("seed", [2, 3])
def test_halves_of_one_scan_of_a_wood_do_not_lock_onto_its_pattern(seed):
    """Fits to the nearest points end a point spacing aside, and promise centimetres."""
    found = register(*halves(scanned(180.0, 500, seed), 1), RegistrationConfig())
    error = transform_points(found.T_local, np.zeros((1, 3)))[0] - SHIFT
    assert found.details["spacing_before_m"] > 1.4
    assert np.abs(error[:2]).max() < 0.25
    assert np.all(np.abs(error[:2]) < 4.0 * found.pose_std[3:5])
    assert abs(error[2]) < 0.03
    assert any("horizontal position is known to 0.1" in text for text in found.warnings)


def test_the_spread_over_displaced_starts_is_wide_where_leaves_alone_hold_the_fit_and_narrow_at_walls():
    config = RegistrationConfig()
    spreads = {}
    for name, points in (("wood", scanned(180.0, 500, 3)), ("houses", houses(100.0, 3, 0.6))):
        sides, scaled = prepare_pair(*halves(points, 1, np.zeros(3)), config)
        level, target = sides[0].levels[-1], make_target(sides[1].levels[-1])
        pose = np.eye(4)
        pose[:3, 3] = sides[0].centre - sides[1].centre
        pairs = find_pairs(level.xyz, level.planes, target, pose, 2.0 * level.leaf)
        noise = measure_noise(pairs, scaled.polish, 0.02, scaled.tukey)
        spreads[name] = spread_of_starts(level, target, pose, noise, sides[0].spacing, scaled).level
    assert spreads["wood"] > 0.2
    assert spreads["houses"] < 0.05


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_correlation_brings_back_a_shift_and_states_its_error(seed):
    points = scanned(150.0, 350, seed)
    before, after = (cloud.xyz for cloud in halves(points, seed))
    found = correlate(before, after, np.eye(4), 1.7, 20.0, 0)
    assert found is not None
    error = found.pose[:2, 3] + (found.pose[:2, :2] - np.eye(2)) @ found.spread.centre[:2] - SHIFT[:2]
    assert np.linalg.norm(error) < 4.0 * found.spread.level
    assert found.spread.level < 0.25


def test_level_ground_correlates_with_nothing():
    points = scanned(100.0, 0, 5)
    assert not rising(points, 1.7).any()
    assert correlate(points, points, np.eye(4), 1.7, 20.0, 0) is None


def test_a_spread_about_another_centre_is_that_of_the_same_motions():
    rng = np.random.default_rng(6)
    near, far = np.array([1.0, 2.0, 3.0]), np.array([-40.0, 25.0, 9.0])
    poses = [exp_se3(1e-3 * rng.normal(size=6)) for _ in range(50)]
    about = [np.array([twist_between(pose, np.eye(4), centre) for pose in poses]) for centre in (near, far)]
    spread = PoseSpread(about[0].T @ about[0] / 50, near)
    np.testing.assert_allclose(spread.about(far), about[1].T @ about[1] / 50, rtol=2e-2, atol=1e-7)
