"""A place is free only where the other epoch has nothing, of whatever class."""

from dataclasses import replace

import numpy as np
import pytest

from subiaco_change.objects.measures import MeasureConfig, measure, same_place
from subiaco_change.objects.voxel_objects import NO_OBJECT, EpochView, build_voxels
from subiaco_geo.codes import Semantic

REACH = same_place(MeasureConfig())


def epoch(xyz, semantic, height=None):
    """Points of one class; what is no ground is one object."""
    n = len(xyz)
    instance = np.full(n, -1 if semantic is Semantic.GROUND else 0, dtype=np.int32)
    return EpochView(
        xyz, np.tile([0.0, 0, 1], (n, 1)), np.full(n, semantic, dtype=np.uint8), instance,
        xyz[:, 2] if height is None else height, np.full(n, 0.03), np.ones(n),
    )  # fmt: skip


def everywhere(xyz):
    return np.ones(len(xyz), dtype=bool)


def nowhere(xyz):
    return np.zeros(len(xyz), dtype=bool)


def bank(rng, count=3000):
    """A bank 1.2 m high and 3 m wide at a slope of 0.4, with a rough surface."""
    xy = rng.uniform([0, 0], [8, 3], (count, 2))
    return np.column_stack([xy, 0.4 * xy[:, 1] + rng.normal(0, 0.04, count)])


def field(rng, spacing):
    """Flat ground at z = 0 with points about ``spacing`` [m] apart."""
    count = int(20 * 20 / spacing**2)
    return np.column_stack([rng.uniform(-6, 14, (count, 2)), rng.normal(0, 0.01, count)])


def car(rng, top=1.4):
    """Sides and roof of a box of 4.2 m by 1.8 m that ends a hand above the ground."""
    u = rng.uniform([0, 0, 0.15], [4.2, 1.8, top], (4000, 3))
    side = rng.integers(0, 5, 4000)
    u[side == 0, 0], u[side == 1, 0], u[side == 2, 1], u[side == 3, 1], u[side == 4, 2] = 0, 4.2, 0, 1.8, top
    return u


def test_a_bank_that_the_other_epoch_calls_ground_is_occupied_in_both():
    plant = epoch(bank(np.random.default_rng(1)), Semantic.VEGETATION)
    ground = epoch(bank(np.random.default_rng(2)), Semantic.GROUND)
    voxels = build_voxels(plant, ground, everywhere, 0.5, REACH)
    high = voxels.height > REACH.standing
    assert voxels.occupied_in_other[high].mean() > 0.98
    measures = measure(voxels, voxels.select(nowhere(voxels.xyz)), MeasureConfig())
    assert measures.gone_share < 0.02


@pytest.mark.parametrize("spacing", [0.25, 0.9])
def test_the_ground_under_a_car_does_not_occupy_its_place_however_sparse_it_is(spacing):
    rng = np.random.default_rng(3)
    voxels = build_voxels(
        epoch(car(rng), Semantic.MOBILE), epoch(field(rng, spacing), Semantic.GROUND), everywhere, 0.5, REACH
    )
    high = voxels.height > REACH.standing
    assert not voxels.occupied_in_other.any()
    assert voxels.observed[high].all()


def test_of_a_thing_on_the_ground_its_foot_is_no_evidence():
    rng = np.random.default_rng(4)
    voxels = build_voxels(
        epoch(car(rng), Semantic.MOBILE), epoch(field(rng, 0.25), Semantic.GROUND), everywhere, 0.5, REACH
    )
    low = voxels.height <= REACH.foot
    assert low.any()
    assert not voxels.observed[low].any()
    measures = measure(voxels, voxels.select(nowhere(voxels.xyz)), MeasureConfig())
    assert measures.observed_fraction == 1.0
    assert measures.gone_share == 1.0


def test_what_hangs_in_the_air_above_ground_is_not_held_by_it():
    rng = np.random.default_rng(5)
    crown = epoch(bank(rng) + np.array([0, 0, 3.0]), Semantic.VEGETATION)
    voxels = build_voxels(crown, epoch(field(rng, 0.25), Semantic.GROUND), everywhere, 0.5, REACH)
    assert not voxels.occupied_in_other.any()


@pytest.mark.parametrize(("passed", "still"), [(None, True), (5.0, False)])
def test_a_trail_by_shape_alone_occupies_its_place_and_one_that_beams_crossed_does_not(passed, still):
    """Both epochs have points at one place; one calls them a plant, the other a trail."""
    rng = np.random.default_rng(3)
    xyz = rng.uniform([0, 0, 0.5], [4, 2, 1.6], (2000, 3))
    plant = epoch(xyz, Semantic.VEGETATION)
    n = len(xyz)
    trail = replace(
        epoch(xyz + rng.normal(0, 0.02, xyz.shape), Semantic.MOBILE),
        instance=np.full(n, NO_OBJECT, dtype=np.int32),
        moved=np.full(n, 0.9),
        passed=None if passed is None else np.full(n, passed),
    )
    voxels = build_voxels(plant, trail, everywhere, 0.5, REACH)
    assert voxels.occupied_in_other.all() == still
    assert voxels.occupied_in_other.any() == still


@pytest.mark.parametrize(("beside", "occupies"), [(0.6, False), (0.15, True)])
def test_a_sparse_trail_in_the_lane_does_not_occupy_the_car_that_is_parked_beside_it(beside, occupies):
    """Traffic left points 0.7 m apart; the same number of points of an object would count as far as that."""
    along, up = np.meshgrid(np.arange(-8.0, 12.0, 0.7), [0.5, 1.2])
    xyz = np.column_stack([along.ravel(), np.full(along.size, -beside), up.ravel()])
    parked = epoch(car(np.random.default_rng(6)), Semantic.MOBILE)
    thing = epoch(xyz, Semantic.MOBILE)
    trail = replace(thing, instance=np.full(len(xyz), NO_OBJECT, dtype=np.int32))
    by_trail, by_thing = (build_voxels(parked, other, everywhere, 0.5, REACH) for other in (trail, thing))
    side = by_trail.xyz[:, 1] < 0.3
    assert by_trail.occupied_in_other[side].any() == occupies
    assert by_thing.occupied_in_other[side].mean() > 0.5
