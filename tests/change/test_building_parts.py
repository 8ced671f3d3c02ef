"""What belongs to a building and what only stands at it: one house among things with known classes."""

import numpy as np
import pytest
from scenes import NOISE, Scene, car, ground_z, rectangle
from scipy.spatial import cKDTree

from subiaco_change.segmentation.classes import SemanticsConfig, label_points
from subiaco_geo.clouds import PointCloud, voxel_downsample
from subiaco_geo.codes import Semantic

HOUSE = (-15.0, 12.0)  # 10 m x 8 m, its facade at y = 8


def standing(*things, seed=0):
    """The house and things at it, at the working leaf, with their labels; the things' shares by class."""
    scene = Scene(houses=[HOUSE], trees=[], cars=[], poles=[])
    rng = np.random.default_rng(seed)
    parts = [scene.cloud(seed).xyz, *(t + rng.normal(scale=NOISE, size=t.shape) for t in things)]
    cloud = voxel_downsample(PointCloud(np.concatenate(parts)), 0.25)
    return cloud, label_points(cloud, SemanticsConfig()).semantic


def share(cloud, found, thing, semantic, lowest=0.25):
    """Share of a class among the points at a thing, without the lowest."""
    mine = cKDTree(thing).query(cloud.xyz)[0] < 0.12
    mine &= cloud.xyz[:, 2] > ground_z(cloud.xyz[:, 0], cloud.xyz[:, 1]) + lowest
    return (found[mine] == semantic).mean()


def wall(x, y, dx, dy, height, bottom=0.0, seed=1):
    return rectangle(
        np.random.default_rng(seed), (x, y, ground_z(x, y) + bottom), (dx, dy, 0), (0, 0, height), 80
    )


def test_a_car_under_a_carport_is_a_vehicle_and_the_roof_over_it_is_building():
    rng = np.random.default_rng(2)
    roof = rectangle(rng, (-9.9, 9.0, ground_z(-7, 10) + 2.5), (6.0, 0, 0), (0, 3.4, 0), 80)
    parked = car(rng, -6.8, 10.7)
    cloud, found = standing(roof, parked)
    assert share(cloud, found, roof, Semantic.BUILDING) > 0.9
    assert share(cloud, found, parked, Semantic.MOBILE) > 0.85


@pytest.mark.parametrize("length", [4.0, 9.0])
def test_a_fence_in_line_with_the_facade_is_no_building(length):
    fence = wall(-10.0, 8.0, length, 0.0, 1.8)
    cloud, found = standing(fence)
    beyond = fence[fence[:, 0] > -8.5]
    assert share(cloud, found, beyond, Semantic.OTHER) > 0.9


def test_a_low_gable_beyond_a_larger_plane_is_part_of_the_house():
    bay = np.concatenate([wall(-18.0, 6.9, 1.6, 0.0, 2.6), wall(-18.0, 6.9, 0.0, 1.1, 2.6)])
    cloud, found = standing(bay)
    assert share(cloud, found, bay, Semantic.BUILDING) > 0.9


def shelter(x, y, length, width, eaves, bottom=0.0):
    """Three walls up to 2.4 m and a roof that stands out by its eaves."""
    z = ground_z(x, y)
    roof = rectangle(
        np.random.default_rng(3),
        (x - eaves, y - eaves, z + 2.45),
        (length + 2 * eaves, 0, 0),
        (0, width + 2 * eaves, 0),
        80,
    )
    sides = [
        wall(a, y, dx, dy, 2.4 - bottom, bottom)
        for a, dx, dy in ((x, length, 0), (x, 0, width), (x + length, 0, width))
    ]
    return np.concatenate([roof, *sides])


def test_a_shelter_with_eaves_is_other_and_a_box_on_wheels_that_narrows_is_a_vehicle():
    van = shelter(5.0, -10.0, 4.6, 1.9, -0.1, 0.4)
    cloud, found = standing(shelter(5.0, 0.0, 4.0, 1.5, 0.3), van)
    assert share(cloud, found, shelter(5.0, 0.0, 4.0, 1.5, 0.3), Semantic.OTHER) > 0.9
    assert share(cloud, found, van, Semantic.MOBILE) > 0.8


def test_two_fences_that_meet_are_no_vehicle():
    corner = np.concatenate([wall(2.0, 0.0, 4.0, 0.0, 1.7), wall(6.0, 0.0, 0.0, 1.9, 1.7)])
    cloud, found = standing(corner)
    assert share(cloud, found, corner, Semantic.MOBILE) == 0.0


def test_a_crown_of_fronds_is_a_plant_and_no_roof():
    rng = np.random.default_rng(4)
    count = 1400
    turn = rng.integers(0, 14, count) * 2 * np.pi / 14 + rng.normal(0, 0.05, count)
    out = rng.uniform(0.1, 2.2, count)
    z = ground_z(5.0, 0.0) + 6.0 - 0.25 * out**2 + 0.35 * out + rng.normal(0, 0.05, count)
    crown = np.column_stack([5.0 + out * np.cos(turn), out * np.sin(turn), z])
    trunk = np.column_stack([np.full((300, 2), (5.0, 0.0)), ground_z(5, 0) + rng.uniform(0, 6, 300)])
    trunk[:, :2] += rng.normal(scale=0.08, size=(300, 2))
    cloud, found = standing(crown, trunk)
    assert share(cloud, found, crown, Semantic.BUILDING) == 0.0
    assert share(cloud, found, crown, Semantic.VEGETATION) > 0.8
