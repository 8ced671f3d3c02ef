"""Registration of clouds of every density and kind at the defaults; seeds name layouts and samplings."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from subiaco_change.geometry import build_pyramid
from subiaco_change.registration.config import RegistrationConfig
from subiaco_change.registration.icp import make_target
from subiaco_change.registration.plausibility import measure_quality, measure_support, planar
from subiaco_change.registration.register import given_registration, register
from subiaco_geo.clouds import PointCloud, voxel_downsample
from subiaco_geo.errors import RegistrationError
from subiaco_geo.frames import transform_points

sys.path.insert(0, str(Path(__file__).parent))
from registration_scene import Park, Street, Wood, box, errors, pose, rectangle

CONFIG = RegistrationConfig()
SMALL = pose((0.1, -0.1, 0.5), (0.5, -0.4, 0.2))


def sparse_street(layout, seed):
    """Street with 0.5 m between its points, as some mobile scans are delivered."""
    return Street(seed=layout, length=90.0, width=56.0).sample(seed, density=4.0)


def dense_park(layout, seed):
    return Park(seed=layout).sample(seed, density=6.0)


def sparse_park(layout, seed):
    """Airborne cloud with a point a square metre."""
    return Park(seed=layout, size=140.0).sample(seed, density=1.0)


def wood(layout, seed):
    return Wood(seed=layout).sample(seed)


KINDS = [sparse_street, dense_park, sparse_park, wood]


def cloud(points, crs=None):
    return voxel_downsample(PointCloud(points, crs=crs), 0.25)


def moved(points, T_after_before):
    return transform_points(np.linalg.inv(T_after_before), points)


def test_clouds_with_three_metres_between_their_points_are_refused_for_their_density():
    """A given transform stays possible."""
    park = Park(seed=3, size=260.0)
    before, after = cloud(moved(park.sample(1, density=0.1), SMALL)), cloud(park.sample(2, density=0.1))
    with pytest.raises(RegistrationError, match=r"too sparse .*before 3\.\d+ m, after 3\.\d+ m.*--transform"):
        register(before, after, CONFIG)
    given = given_registration(SMALL, before, after, CONFIG)
    assert errors(given.T_after_before, SMALL, given.origin) == pytest.approx((0.0, 0.0), abs=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_two_samplings_of_a_place_are_registered_from_a_small_offset(kind):
    before, after = cloud(moved(kind(3, 1), SMALL)), cloud(kind(3, 2))
    result = register(before, after, CONFIG)
    shift, angle = errors(result.T_after_before, SMALL, result.origin)
    assert shift < 0.02
    assert angle < 0.03
    assert result.method.startswith("identity")
    assert result.details["structure_match"] > result.details["structure_chance"] + 0.15


@pytest.mark.parametrize("kind", KINDS)
def test_another_place_of_the_same_kind_is_refused(kind):
    with pytest.raises(RegistrationError, match="identity: "):
        register(cloud(kind(3, 1)), cloud(kind(8, 2)), CONFIG)


@pytest.mark.parametrize("kind", KINDS)
def test_a_true_transform_is_accepted_without_a_word_and_a_wrong_one_warns(kind):
    before, after = cloud(kind(3, 1)), cloud(kind(3, 2))
    true = given_registration(np.eye(4), before, after, CONFIG, "identity")
    assert true.warnings == ()
    assert true.sigma_reg_m < 0.03
    wrong = given_registration(pose((0, 0, 0), (0.4, 0.1, 0.0)), before, after, CONFIG)
    assert any("would move before by 0.4" in text for text in wrong.warnings)
    assert wrong.pose_std[3] > 0.35
    assert wrong.sigma_reg_m > 2.0 * true.sigma_reg_m
    far = given_registration(pose((0, 0, 0), (9.0, 5.0, 0.0)), before, after, CONFIG)
    assert any("not supported" in text for text in far.warnings)


def leafy(park, seed):
    """Park with 2.5 points a square metre, in crowns scattered 2 m deep: two samplings rarely meet."""
    xyz = park.sample(seed, density=2.5)
    tall = xyz[:, 2] > 2.5
    depth = np.random.default_rng(100 + seed).exponential(2.0, tall.sum())
    xyz[tall, 2] -= np.minimum(depth, xyz[tall, 2] - 2.0)
    return xyz


def test_a_sparse_park_in_which_most_trees_were_felled_or_planted_is_registered():
    """Each epoch has 40 % of its trees in common with the other."""
    before, after = (Park(seed=3, size=140.0) for _ in range(2))
    others = Park(seed=8, size=140.0).trees
    shared, half = int(0.4 * len(before.trees)), len(others) // 2
    before.trees = before.trees[:shared] + others[:half]
    after.trees = after.trees[:shared] + others[half:]
    result = register(cloud(moved(leafy(before, 1), SMALL)), cloud(leafy(after, 2)), CONFIG)
    shift, angle = errors(result.T_after_before, SMALL, result.origin)
    assert shift < 0.05
    assert angle < 0.05


def test_a_transform_that_is_wrong_in_height_alone_warns_too():
    before, after = cloud(sparse_park(3, 1)), cloud(sparse_park(3, 2))
    result = given_registration(pose((0, 0, 0), (0.0, 0.0, 0.15)), before, after, CONFIG)
    assert any("would move before by 0.1" in text for text in result.warnings)
    assert result.pose_std[5] == pytest.approx(0.15, abs=0.02)


def test_clouds_of_different_places_given_as_registered_are_not_supported():
    result = given_registration(
        np.eye(4), cloud(sparse_street(3, 1)), cloud(sparse_street(8, 2)), CONFIG, "identity"
    )
    assert any("could not be verified" in text for text in result.warnings)


def terrace(seed, shift):
    """Row of equal houses 12 m apart with trees of their own in front, ``shift`` houses along."""
    rng = np.random.default_rng(seed)
    layout = np.random.default_rng(5)
    parts = [rectangle(rng, (-60, -20, 0), (120, 0, 0), (0, 40, 0), 16)]
    for i in range(-5, 5):
        for side in (-1, 1):
            parts.append(box(rng, (12.0 * i + 6.0, 14.0 * side, 0.0), (9.0, 8.0, 6.0), 16))
    for x, y, radius in layout.uniform((-60, -8, 1.0), (60, 8, 2.2), (25, 3)):
        size = (rng.poisson(60 * radius**2), 3)
        parts.append(rng.normal((x, y, 3.0 + radius), 0.5 * radius, size))
    points = np.vstack(parts) + np.array([12.0 * shift, 0.0, 0.0])
    return points + rng.normal(0, 0.015, points.shape)


def test_a_row_of_equal_houses_shifted_by_one_is_refused_with_a_prior_and_found_without():
    before, after = terrace(1, 0), terrace(2, 1)
    with pytest.raises(RegistrationError, match=r"a pose 1[12]\.\d m away fits"):
        register(cloud(before, "EPSG:7850"), cloud(after, "EPSG:7850"), CONFIG)
    result = register(cloud(before), cloud(after), RegistrationConfig(max_rival=0.99))
    assert errors(result.T_after_before, pose((0, 0, 0), (12.0, 0, 0)), result.origin)[0] < 0.02
    assert register(cloud(terrace(1, 1)), cloud(after), CONFIG).method.startswith("identity")


def test_leaves_are_no_walls_however_few_points_make_a_flat_neighbourhood():
    rng = np.random.default_rng(4)
    level = build_pyramid(rng.random((4000, 3)) * (40.0, 40.0, 6.0), (0.5,), 1.0)[0]
    assert (level.planes.curvature[level.planes.count >= 4] < 0.03).mean() > 0.02
    assert planar(level.planes).mean() < 0.002


def test_structure_matches_beyond_chance_at_the_true_pose_alone():
    first, second = (build_pyramid(wood(3, seed), (0.5,))[0] for seed in (1, 2))
    target = make_target(second)
    here = measure_support(first, target, np.eye(4), 0.3)
    aside = measure_support(first, target, pose((0, 0, 0), (3.0, 2.0, 0.0)), 0.3)
    assert here.excess > 10.0 * here.excess_error > 0.0
    assert abs(aside.excess) < 0.1
    assert measure_quality(first, target, np.eye(4), 0.3).score > 0.0


def test_a_refusal_names_the_density_where_the_clouds_are_sparse():
    with pytest.raises(RegistrationError, match=r"density: points lie apart by before \d\.\d\d m, after"):
        register(cloud(sparse_park(3, 1)), cloud(sparse_park(8, 2)), CONFIG)
    with pytest.raises(RegistrationError) as dense:
        register(cloud(wood(3, 1)), cloud(wood(8, 2)), CONFIG)
    assert "density" not in str(dense.value)


def test_lengths_follow_the_sparser_epoch_and_stay_those_of_a_street_where_both_are_dense():
    assert CONFIG.scaled(1.0) is CONFIG
    wide = CONFIG.scaled(3.0)
    assert wide.leaves == (3.0, 1.5, 0.75)
    assert wide.normal_radius == pytest.approx(2.4)
    assert wide.tukey == CONFIG.tukey, "how far a surface may lie off does not depend on the spacing"
    street = Street(seed=3, length=60.0, width=50.0)
    result = register(cloud(street.sample(1)), cloud(street.sample(2, density=3.0)), CONFIG)
    assert result.details["spacing_before_m"] < 0.36 < result.details["spacing_after_m"]
    assert result.details["length_scale"] == pytest.approx(result.details["spacing_after_m"] / 0.36)
