"""Registration of synthetic streets whose transform is known; seeds name layouts."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from subiaco_change.registration.config import RegistrationConfig
from subiaco_change.registration.icp import Pairs, jacobian, pair_weights, solve
from subiaco_change.registration.ndt import align_ndt, distributions
from subiaco_change.registration.plausibility import estimate_uncertainty
from subiaco_change.registration.register import given_registration, register
from subiaco_geo.clouds import PointCloud, voxel_downsample
from subiaco_geo.errors import InputError, RegistrationError

sys.path.insert(0, str(Path(__file__).parent))
from registration_scene import Street, errors, pose, rectangle

CONFIG = RegistrationConfig()
MGA = np.array([391_000.0, 6_464_000.0, 12.0])


def cloud(points, crs=None, origin=(0.0, 0.0, 0.0)):
    return voxel_downsample(PointCloud(points, np.array(origin), crs), 0.25)


def moved(points, T_after_before):
    """Points of *before* whose registration is ``T_after_before``."""
    inverse = np.linalg.inv(T_after_before)
    return points @ inverse[:3, :3].T + inverse[:3, 3]


@pytest.fixture(scope="module")
def street():
    return Street(seed=4, length=100.0, width=56.0)


def test_a_small_transform_in_map_coordinates_is_recovered_to_a_centimetre(street):
    truth = pose((0.3, -0.2, 1.0), (0.8, -0.6, 0.4))
    before = cloud(moved(street.sample(1), truth), "EPSG:7850", MGA)
    after = cloud(street.sample(2), "EPSG:7850", MGA)
    result = register(before, after, CONFIG)
    world = np.eye(4)
    world[:3, :3] = truth[:3, :3]
    world[:3, 3] = truth[:3, 3] + MGA - truth[:3, :3] @ MGA
    shift, angle = errors(result.T_after_before, world, result.origin)
    assert shift < 0.01
    assert angle < 0.02
    place = result.origin - MGA
    assert np.allclose(result.T_local[:3, 3], truth[:3, :3] @ place + truth[:3, 3] - place, atol=0.01)
    assert result.degenerate == ()
    assert result.inlier_ratio > 0.9
    assert np.all(result.pose_std > 0)


def test_clouds_without_a_frame_are_levelled_found_and_registered():
    half = Street(seed=7, length=160.0, width=60.0)
    truth = pose((7.0, -8.0, 133.0), (150.0, -120.0, 14.0))
    before, after = half.sample(1), half.sample(2)
    before = cloud(moved(before[before[:, 0] > -27], truth))
    after = cloud(after[after[:, 0] < 27])
    result = register(before, after, CONFIG)
    shift, angle = errors(result.T_after_before, truth, result.origin)
    assert shift < 0.01
    assert angle < 0.02
    assert result.method.startswith("coarse")


def test_a_changed_half_of_the_scene_does_not_pull(street):
    """Every second house gone, ground of one half raised by 12 cm, cars elsewhere."""
    truth = pose((0.0, 0.0, 0.5), (0.4, 0.3, -0.1))
    changed = Street(seed=4, length=100.0, width=56.0)
    changed.houses = changed.houses[::2]
    changed.cars = [((x + 7.0, y), yaw) for (x, y), yaw in changed.cars]
    points = changed.sample(2)
    patch = (points[:, 0] > 0) & (points[:, 0] < 25) & (np.abs(points[:, 1]) < 12)
    points[patch, 2] += 0.12
    before, after = cloud(moved(street.sample(1), truth)), cloud(points)
    result = register(before, after, CONFIG)
    shift, angle = errors(result.T_after_before, truth, result.origin)
    wide = register(before, after, CONFIG.model_copy(update={"polish": 0.0}))
    wide_shift, _ = errors(wide.T_after_before, truth, wide.origin)
    assert shift < 0.01
    assert angle < 0.01
    assert shift < 0.6 * wide_shift, "the literal width lets a rise of 12 cm pull"
    mask = (after.xyz[:, 0] > -1) & (after.xyz[:, 0] < 26) & (np.abs(after.xyz[:, 1]) < 13)
    second = register(before, after, CONFIG, exclude_after=mask)
    shift, angle = errors(second.T_after_before, truth, second.origin)
    assert shift < 0.01
    assert angle < 0.02


def test_different_places_are_an_error_that_says_why(street):
    other = Street(seed=12, length=100.0, width=56.0)
    words = r"identity: .* of the walls .* coarse: .*(of the walls|ambiguous)"
    with pytest.raises(RegistrationError, match=words):
        register(cloud(street.sample(1)), cloud(other.sample(2)), CONFIG)
    with pytest.raises(RegistrationError, match="disjoint"):
        register(
            cloud(street.sample(1), "EPSG:7850"),
            cloud(street.sample(2) + np.array([500.0, 0, 0]), "EPSG:7850"),
            CONFIG,
        )


def with_and_without_a_hall(seed):
    """A street of trees and cars, and the same with a hall of 24 x 16 m, its only building."""
    with_hall, without = (Street(seed=seed, length=120.0, width=60.0) for _ in range(2))
    with_hall.houses = [((0.0, 12.0), np.array([24.0, 16.0, 9.0]), 0.1)]
    without.houses = []
    return with_hall, without


@pytest.mark.parametrize("is_built", [False, True])
def test_a_street_whose_only_building_was_taken_down_or_built_is_registered(is_built):
    truth = pose((0.1, -0.1, 0.4), (0.5, -0.4, 0.2))
    with_hall, without = with_and_without_a_hall(seed=4)
    before, after = (without, with_hall) if is_built else (with_hall, without)
    result = register(cloud(moved(before.sample(1), truth)), cloud(after.sample(2)), CONFIG)
    shift, angle = errors(result.T_after_before, truth, result.origin)
    assert shift < 0.01
    assert angle < 0.02


def test_ways_that_end_apart_are_refused_without_a_prior_and_widen_the_uncertainty_with_one():
    truth = pose((0.1, -0.1, 0.4), (0.5, -0.4, 0.2))
    with_hall, without = with_and_without_a_hall(seed=1)
    before, after = moved(without.sample(1), truth), with_hall.sample(2)
    with pytest.raises(RegistrationError, match="NDT and ICP disagree"):
        register(cloud(before), cloud(after), CONFIG)
    result = register(cloud(before, "EPSG:7850"), cloud(after, "EPSG:7850"), CONFIG)
    apart = result.details["ndt_icp_m"]
    assert CONFIG.max_disagreement < apart < 3.0 * CONFIG.max_disagreement
    assert any(f"end {apart:.2f} m" in warning for warning in result.warnings)
    assert np.linalg.norm(result.pose_std[3:]) > 0.9 * apart
    assert errors(result.T_after_before, truth, result.origin)[0] < apart


def test_a_corridor_keeps_the_prior_along_its_axis_and_says_so():
    def corridor(seed):
        rng = np.random.default_rng(seed)
        walls = [rectangle(rng, (-40, y, 0), (80, 0, 0), (0, 0, 5), 25) for y in (-5, 5)]
        points = np.vstack([rectangle(rng, (-40, -5, 0), (80, 0, 0), (0, 10, 0), 25), *walls])
        return points + rng.normal(0, 0.01, points.shape)

    truth = pose((0, 0, 0.3), (0.0, 0.2, 0.1))
    result = register(cloud(moved(corridor(1), truth), "EPSG:7850"), cloud(corridor(2), "EPSG:7850"), CONFIG)
    assert result.degenerate == ("x",)
    assert "x is not fixed" in result.warnings[0]
    shift = result.T_after_before[:3, 3] - truth[:3, 3]
    assert abs(shift[0]) < 0.05
    assert np.abs(shift[1:]).max() < 0.02


def test_the_same_input_gives_the_same_transform():
    small = Street(seed=9, length=60.0, width=50.0)
    clouds = cloud(moved(small.sample(1), pose((2, 3, 80), (20, 0, 5)))), cloud(small.sample(2))
    first, second = register(*clouds, CONFIG), register(*clouds, CONFIG)
    assert np.array_equal(first.T_local, second.T_local)
    assert first.sigma_reg_m == second.sigma_reg_m


def test_the_true_error_stays_within_the_stated_uncertainty_in_repeated_trials():
    small = Street(seed=9, length=60.0, width=50.0)
    for trial in range(4):
        truth = pose((0, 0, 0.2 * trial), (0.1 * trial, -0.2, 0.05))
        before, after = cloud(moved(small.sample(10 + trial), truth)), cloud(small.sample(50 + trial))
        result = register(before, after, RegistrationConfig(coarse="never"))
        assert errors(result.T_after_before, truth, result.origin)[0] <= 2.0 * result.sigma_reg_m


def test_a_given_transform_is_measured_but_not_moved(street):
    before, after = cloud(street.sample(1), origin=MGA), cloud(street.sample(2), origin=MGA)
    result = given_registration(np.eye(4), before, after, CONFIG, "identity")
    assert np.allclose(result.T_after_before, np.eye(4), atol=1e-6)
    assert result.method == "identity"
    assert 0 < result.rmse_m < 0.05
    off = np.eye(4)
    off[2, 3] = 0.1
    assert given_registration(off, before, after, CONFIG).rmse_m > 2 * result.rmse_m
    away = np.eye(4)
    away[0, 3] = 400.0
    with pytest.raises(RegistrationError, match="overlap"):
        given_registration(away, before, after, CONFIG)
    with pytest.raises(InputError, match="rigid"):
        given_registration(2.0 * np.eye(4), before, after, CONFIG)


def test_ndt_alone_finds_the_pose_from_four_metres(street):
    a, b = street.sample(1), street.sample(2)
    start = pose((1.0, 1.0, 3.0), (3.0, -2.5, 0.8))
    for cell in (8.0, 4.0, 2.0, 1.0):
        start = align_ndt(distributions(a, cell), distributions(b, cell), start).pose
    shift, angle = errors(start, np.eye(4), (0, 0, 0))
    assert shift < 0.03
    assert angle < 0.05


def _pairs(rng, n=400):
    normals = rng.normal(size=(n, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Pairs(
        rng.uniform(-20, 20, (n, 3)), normals, rng.normal(0, 0.02, n), np.full(n, 0.1), np.arange(n), 1.0
    )


def test_the_analytic_jacobian_is_the_numerical_one():
    rng = np.random.default_rng(3)
    pairs, centre, step = _pairs(rng), np.array([1.0, -2.0, 0.5]), 1e-6
    for axis in range(6):
        twist = np.zeros(6)
        twist[axis] = step
        turn = Rotation.from_rotvec(twist[:3]).as_matrix()
        after = (pairs.points - centre) @ turn.T + centre + twist[3:]
        numeric = np.einsum("ni,ni->n", pairs.normals, after - pairs.points) / step
        assert np.allclose(jacobian(pairs, centre)[:, axis], numeric, atol=1e-4)


def test_tukey_ignores_what_is_beyond_tau_and_huber_weighs_long_pairs_less():
    pairs = _pairs(np.random.default_rng(4), 3)
    pairs.residuals[:] = (0.0, 0.31, 0.0)
    pairs.distances[:] = (0.1, 0.1, 1.0)
    assert np.allclose(pair_weights(pairs, 0.3, 0.5), (1.0, 0.0, 0.5))


def test_one_gauss_newton_step_removes_a_rigid_offset_and_skips_a_missing_direction():
    rng = np.random.default_rng(5)
    pairs = _pairs(rng)
    twist = np.array([0.001, -0.002, 0.003, 0.02, -0.01, 0.03])
    pairs.residuals[:] = -jacobian(pairs, np.zeros(3)) @ twist
    step = solve(pairs, np.ones(400), np.zeros(3), 1e-3)
    assert np.allclose(step.twist, twist, atol=1e-9)
    pairs.normals[:] = (0, 0, 1)
    pairs.residuals[:] = -0.02
    step = solve(pairs, np.ones(400), np.zeros(3), 1e-3)
    assert set(step.degenerate) == {"x", "y", "yaw"}
    assert np.allclose(step.twist, (0, 0, 0, 0, 0, 0.02), atol=1e-9)


def test_blocks_of_common_bias_widen_the_uncertainty_that_the_hessian_states():
    rng = np.random.default_rng(6)
    n = 60_000
    points = rng.uniform(0, 200, (n, 3)) * (1, 1, 0.02)
    normals = np.eye(3)[rng.integers(0, 3, n)]
    block = (points[:, 0] // 20 * 10 + points[:, 1] // 20).astype(int)
    bias = rng.normal(0, 0.02, 100)[block]
    pairs = Pairs(points, normals, rng.normal(0, 0.01, n) + bias, np.full(n, 0.1), np.arange(n), 1.0)
    spread = estimate_uncertainty(pairs, np.ones(n), points.mean(axis=0), 1e-4, 20.0, 200, 0)
    assert spread.sigma_blocks > 5 * spread.sigma_hessian
    assert 0.014 < spread.block_bias < 0.028
    assert spread.blocks == 100
