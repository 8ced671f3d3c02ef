"""What tells vehicles from sheds and hedges, and walls seen twice from crowns."""

import numpy as np
import pytest
from scenes import Scene, car, ground_z
from scipy.spatial import cKDTree

from subiaco_change.method_rules.switches import rules_switched_off
from subiaco_change.segmentation.classes import SemanticsConfig, label_points
from subiaco_change.segmentation.config import VehicleConfig
from subiaco_change.segmentation.vehicles import has_cabin, with_cabins, with_edges
from subiaco_geo.clouds import PointCloud, voxel_downsample
from subiaco_geo.codes import Semantic


def labels_of(thing, *others):
    """Classes of a thing (N, 3) that stands in a street with one house."""
    street = Scene(houses=[(-15, 12)], trees=[], cars=[], poles=[]).survey(4).cloud
    cloud = voxel_downsample(PointCloud(np.concatenate([street.xyz, thing, *others])), 0.25)
    found = label_points(cloud, SemanticsConfig()).semantic
    return found[cKDTree(thing).query(cloud.xyz)[0] < 0.1]


def sides(rng, middle, size, bottom, noise=0.01, count=8000):
    """Four upright sides and a flat top of a box on the ground from a bottom [m] up, with noise [m]."""
    u, v, w = rng.uniform(-0.5, 0.5, (3, count))
    side = rng.integers(0, 5, count)
    u = np.where(side == 0, 0.5, np.where(side == 1, -0.5, u))
    v = np.where(side == 2, 0.5, np.where(side == 3, -0.5, v))
    w = np.where(side == 4, 0.5, w) + 0.5
    z = ground_z(*middle) + bottom + w * (size[2] - bottom)
    xyz = np.column_stack([middle[0] + u * size[0], middle[1] + v * size[1], z])
    return xyz + rng.normal(0, noise, xyz.shape)


@pytest.mark.parametrize(("bottom", "semantic"), [(0.5, Semantic.MOBILE), (0.0, Semantic.BUILDING)])
def test_a_van_stands_on_wheels_and_a_garage_of_its_size_on_its_walls(bottom, semantic):
    found = labels_of(sides(np.random.default_rng(3), (8.0, 0.0), (6.1, 2.8, 2.6), bottom))
    assert (found == semantic).mean() > 0.8


def hedge(rng, middle, length, noise):
    return sides(rng, middle, (length, 1.1, 1.4), 0.0, noise)


def test_a_stiff_piece_of_a_hedge_is_no_car_though_it_has_the_size_of_one():
    rng = np.random.default_rng(5)
    stiff = hedge(rng, (8.0, 0.0), 3.6, 0.02)
    rest = [hedge(rng, (x, 0.0), 4.0, 0.09) for x in (4.1, 11.9)]
    assert (labels_of(stiff, *rest) == Semantic.MOBILE).mean() < 0.1


def test_a_bush_at_its_corner_makes_no_plant_of_a_car():
    bush = np.random.default_rng(2).normal((10.9, 0.9, 0.84), (0.35, 0.35, 0.3), (600, 3))
    parked = car(np.random.default_rng(3), 8.0, 0.0)
    assert (labels_of(parked) == Semantic.MOBILE).all()
    assert (labels_of(parked, bush) == Semantic.MOBILE).mean() > 0.75
    assert (labels_of(bush, parked) == Semantic.VEGETATION).mean() > 0.8


@pytest.mark.parametrize(("width", "completed"), [(1.8, True), (3.6, False)])
def test_leaves_in_a_box_wider_than_a_vehicle_are_no_edges_of_one(width, completed):
    axes = np.meshgrid(np.arange(0.0, 4.1, 0.2), np.arange(0.0, width + 0.1, 0.2))
    xy = np.stack([axis.ravel() for axis in axes], axis=1)
    rim = (xy[:, 0] < 0.1) | (xy[:, 0] > 3.9) | (xy[:, 1] < 0.1) | (xy[:, 1] > width - 0.1)
    semantic = np.where(rim, Semantic.VEGETATION, Semantic.MOBILE).astype(np.uint8)
    height = np.full(len(xy), 1.0)
    found = with_edges(
        np.column_stack([xy, height]), height, semantic, np.zeros(len(xy), bool), VehicleConfig()
    )
    assert (found[rim] == Semantic.MOBILE).all() == completed


def test_a_clipped_hedge_higher_than_a_facade_is_a_plant():
    rng = np.random.default_rng(7)
    tall = sides(rng, (8.0, 0.0), (7.0, 1.2, 2.7), 0.0, 0.06, 20000)
    assert (labels_of(tall) == Semantic.VEGETATION).mean() > 0.8


def test_a_large_rough_plane_is_a_wall():
    rng = np.random.default_rng(8)
    wall = np.column_stack([rng.uniform(2, 14, 20000), rng.normal(0, 0.06, 20000), rng.uniform(0, 5, 20000)])
    wall[:, 2] += ground_z(wall[:, 0], wall[:, 1])
    assert (labels_of(wall) == Semantic.BUILDING).mean() > 0.85


def test_a_fence_that_ends_in_a_hedge_is_no_plant():
    """Their points touch, and those of the hedge are more."""
    rng = np.random.default_rng(9)
    fence = np.column_stack([rng.uniform(2, 9, 4000), rng.normal(0, 0.015, 4000), rng.uniform(0, 1.7, 4000)])
    leaves = rng.uniform((9.0, -1.0, 0.0), (16.0, 1.0, 3.0), (24000, 3))
    for thing in (fence, leaves):
        thing[:, 2] += ground_z(thing[:, 0], thing[:, 1])
    of_fence = labels_of(fence, leaves)
    assert (of_fence == Semantic.OTHER).mean() > 0.7
    assert (labels_of(leaves, fence) == Semantic.VEGETATION).mean() > 0.9
    with rules_switched_off(["walls_beside_plants"]):
        assert (labels_of(fence, leaves) == Semantic.VEGETATION).mean() > 0.7


def test_a_wall_that_a_bent_map_saw_twice_is_a_building():
    rng = np.random.default_rng(6)
    wall = np.column_stack([rng.uniform(2, 14, 20000), np.zeros(20000), rng.uniform(0, 5, 20000)])
    wall[:, 1] += rng.choice([0.0, 0.3], 20000) + rng.normal(0, 0.02, 20000)
    wall[:, 2] += ground_z(wall[:, 0], wall[:, 1])
    assert (labels_of(wall) == Semantic.BUILDING).mean() > 0.85


def rectangle(places):
    return places * (4.5, 1.8)


def oval(places):
    return rectangle(places[np.linalg.norm(places, axis=1) < 0.5])


def rounded(places, power=2.2):
    """Corners as round as those of a small car."""
    return rectangle(places[(np.abs(places) ** power).sum(axis=1) < 0.5**power])


def cabin(xy):
    return np.where(np.abs(xy[:, 0] + 0.3) < 1.2, 1.5, 0.9)


def soft_body(rng, outline, top):
    """A body as rough as leaves: points from a quarter of its height to its top above level ground."""
    xy = outline(rng.uniform(-0.5, 0.5, (2500, 2)))
    return np.column_stack([xy, rng.uniform(0.25, 1.0, len(xy)) * top(xy)])


def cabins_among_plants(xyz):
    """Classes of points (N, 3) on level ground that look like plants, cars with cabins found."""
    plants = np.full(len(xyz), Semantic.VEGETATION, dtype=np.uint8)
    return with_cabins(xyz, xyz[:, 2], plants, VehicleConfig())


def test_a_piece_of_a_trail_of_the_size_of_a_car_is_no_car():
    """Every metre a sweep met the front of a vehicle that passed."""
    fronts = [np.column_stack([np.full(9, x), np.linspace(-0.9, 0.9, 9)]) for x in np.arange(-2.1, 2.2, 1.05)]
    xy = np.repeat(np.concatenate(fronts), 2, axis=0)
    height = np.tile([0.5, 0.9], len(xy) // 2)
    height[:2] = 1.5
    assert (cabins_among_plants(np.column_stack([xy, height])) == Semantic.VEGETATION).all()


@pytest.mark.parametrize(
    ("outline", "top", "semantic"),
    [
        (rectangle, cabin, Semantic.MOBILE),
        (rounded, cabin, Semantic.MOBILE),
        (rectangle, lambda xy: np.full(len(xy), 1.5), Semantic.VEGETATION),
        (oval, lambda xy: 1.5 - 0.4 * np.abs(xy[:, 0]), Semantic.VEGETATION),
    ],
    ids=["car", "car with round corners", "hedge", "shrub"],
)
def test_a_soft_body_with_a_cabin_is_a_car(outline, top, semantic):
    """Seats behind windows make a car as rough as leaves; its corners are found as its edges."""
    xyz = soft_body(np.random.default_rng(4), outline, top)
    height, still = xyz[:, 2], np.zeros(len(xyz), dtype=bool)
    found = with_edges(xyz, height, cabins_among_plants(xyz), still, VehicleConfig())
    assert (found[height > VehicleConfig().split_band] == semantic).all()


def soft_car(rng, x, y):
    """A saloon as rough as leaves, at a place [m]."""
    return soft_body(rng, rectangle, cabin) + np.array([x, y, 0.0])


@pytest.mark.parametrize(
    ("low", "high"),
    [
        ((2.2, -0.3, 0.3), (9.0, 0.3, 1.4)),
        ((-3.0, 0.85, 0.3), (6.0, 1.15, 1.8)),
        ((2.2, -4.0, 0.3), (2.9, 4.0, 1.2)),
    ],
    ids=["a narrow hedge in line", "a pedestrian along its side", "a hedge across its end"],
)
def test_a_soft_car_that_something_thinner_touches_is_a_car(low, high):
    rng = np.random.default_rng(5)
    car_, beside = soft_car(rng, 0.0, 0.0), rng.uniform(low, high, (1500, 3))
    xyz = np.concatenate([car_, beside])
    found = cabins_among_plants(xyz)
    body = car_[:, 2] > VehicleConfig().split_band
    assert (found[: len(car_)][body] == Semantic.MOBILE).mean() > 0.85
    assert (found[len(car_) :] == Semantic.MOBILE).mean() < 0.55  # half of the way lies in the car's outline


def test_soft_cars_parked_bumper_to_bumper_are_cars_each():
    rng = np.random.default_rng(6)
    xyz = np.concatenate([soft_car(rng, x, 0.0) for x in (0.0, 4.9, 9.8)])
    found = cabins_among_plants(xyz)
    assert (found[xyz[:, 2] > VehicleConfig().split_band] == Semantic.MOBILE).mean() > 0.95


def test_soft_cars_that_nearly_touch_are_cars_each_though_scattered_points_fill_their_gap():
    rng = np.random.default_rng(8)
    gap = rng.uniform((2.2, -0.8, 0.3), (2.5, 0.8, 0.8), (60, 3))
    xyz = np.concatenate([soft_car(rng, 0.0, 0.0), soft_car(rng, 4.7, 0.0), gap])
    found = cabins_among_plants(xyz)
    assert (found[xyz[:, 2] > VehicleConfig().split_band] == Semantic.MOBILE).mean() > 0.95


def test_a_soft_car_below_branches_is_a_car():
    rng = np.random.default_rng(9)
    car_, branches = soft_car(rng, 0.0, 0.0), rng.uniform((-3.0, 0.6, 1.7), (3.0, 4.0, 2.6), (3000, 3))
    found = cabins_among_plants(np.concatenate([car_, branches]))[: len(car_)]
    assert (found[car_[:, 2] > VehicleConfig().split_band] == Semantic.MOBILE).mean() > 0.95


def test_a_soft_car_of_which_the_street_shows_no_body_beneath_its_roof_is_a_car():
    """Seen past its near side, its cabin is a hole in what is lower than a roof."""
    rng = np.random.default_rng(12)
    car_ = soft_car(rng, 0.0, 0.0)
    beneath = (np.abs(car_[:, 0] + 0.3) < 1.2) & (np.abs(car_[:, 1]) < 0.65) & (car_[:, 2] < 1.25)
    alone = cabins_among_plants(car_[~beneath])
    assert (alone[car_[~beneath, 2] > VehicleConfig().split_band] == Semantic.MOBILE).all()
    hedge_ = rng.uniform((-4.0, 0.9, 0.3), (5.0, 1.3, 1.4), (1500, 3))
    found = cabins_among_plants(np.concatenate([car_[~beneath], hedge_]))[: np.count_nonzero(~beneath)]
    assert (found[car_[~beneath, 2] > VehicleConfig().split_band] == Semantic.MOBILE).mean() > 0.85


def test_an_uneven_hedge_as_wide_as_a_car_is_no_row_of_cars():
    rng = np.random.default_rng(10)
    xy = rng.uniform((0.0, -0.9), (12.0, 0.9), (6000, 2))
    top = 1.5 + 0.15 * np.sin(xy[:, 0])
    hedge_ = np.column_stack([xy, rng.uniform(0.25, 1.0, len(xy)) * top])
    assert (cabins_among_plants(hedge_) == Semantic.VEGETATION).all()


def test_what_a_car_left_that_moved_has_no_cabin():
    """Its roof passed over every place along the trail, the ends as well."""
    rng = np.random.default_rng(7)
    passed = np.concatenate([soft_car(rng, x, 0.0) for x in np.arange(0.0, 12.0, 0.5)])
    piece = passed[(passed[:, 0] > 4.0) & (passed[:, 0] < 8.4)]
    assert not has_cabin(piece, piece[:, 2], VehicleConfig())
    standing = soft_car(rng, 0.0, 0.0)
    assert has_cabin(standing, standing[:, 2], VehicleConfig())
