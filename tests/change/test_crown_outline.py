"""The outline of a crown: how far it moved, whatever was seen of it."""

from dataclasses import replace

import numpy as np
import pytest
from test_measures import voxels

from subiaco_change.decisions.plant_measures import (
    OutlineConfig,
    PlantConfig,
    change_of_base,
    compare_outlines,
    part_on_side,
)
from subiaco_change.objects.voxel_objects import ObjectInstance
from subiaco_geo.codes import Semantic


def crown(count, radius, seed, side=None):
    """Leaves in the outer fifth of a ball 5 m up; ``side`` keeps those with x above it."""
    rng = np.random.default_rng(seed)
    way = rng.normal(size=(count, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    xyz = way * (radius * rng.uniform(0.8, 1.0, (count, 1))) + (0.0, 0.0, 5.0)
    return xyz if side is None else xyz[xyz[:, 0] > side]


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("change", [0.3, -0.3])
def test_a_crown_that_grew_or_was_pruned_by_a_third_of_a_metre_is_measured(seed, change):
    found = compare_outlines(crown(900, 2.0, seed), crown(900, 2.0 + change, seed + 10), OutlineConfig())
    assert found.shift == pytest.approx(change, abs=0.06)
    assert found.relative == pytest.approx(change / (2.0 + change / 2), abs=0.03)
    assert found.sigma < 0.03


@pytest.mark.parametrize("seed", range(4))
def test_fewer_leaves_of_the_same_crown_move_nothing(seed):
    found = compare_outlines(crown(2000, 2.0, seed), crown(300, 2.0, seed + 10), OutlineConfig())
    assert abs(found.relative) < 0.04


def test_a_crown_seen_from_one_side_in_one_epoch_did_not_move():
    found = compare_outlines(crown(2000, 2.0, 1), crown(2000, 2.0, 2, side=0.0), OutlineConfig())
    assert found.known
    assert abs(found.relative) < 0.04


def test_too_few_directions_tell_nothing():
    assert not compare_outlines(crown(20, 2.0, 1), crown(900, 2.0, 2), OutlineConfig()).known


@pytest.mark.parametrize("lifted", [0.0, 1.0, -0.6])
def test_the_base_of_a_crown_tells_how_far_its_lower_branches_were_cut(lifted):
    """The trunk says nothing, nor does a bin beneath the crown that one epoch alone has."""
    trunk = np.column_stack([np.full((40, 2), 0.1), np.linspace(0.0, 4.0, 40)])
    bin_ = np.random.default_rng(3).uniform((1.0, 1.0, 0.0), (1.5, 1.5, 1.2), (100, 3))
    before, after = (
        np.concatenate([np.random.default_rng(seed).uniform((-2, -2, low), (2, 2, 6), (n, 3)), trunk])
        for seed, low, n in ((1, 3.0, 4000), (2, 3.0 + lifted, 3000))
    )
    fall, sigma = change_of_base(before, np.concatenate([after, bin_]), PlantConfig())
    assert fall == pytest.approx(-lifted, abs=0.1)
    assert 0.0 < sigma < 0.1


def test_few_columns_say_nothing_of_the_base_of_a_crown():
    fall, sigma = change_of_base(crown(60, 0.5, 1), crown(60, 0.5, 2), PlantConfig())
    assert np.isnan([fall, sigma]).all()


def tree(xyz, lost):
    """A crown whose voxels (N, 3) the other epoch saw free where they are ``lost`` (N,)."""
    cells = replace(voxels(xyz), occupied_in_other=~lost)
    return ObjectInstance(0, Semantic.VEGETATION, 0.8, np.arange(len(xyz)), cells, 0.05, xyz)


def parted(xyz, lost):
    """Return which fraction of a crown was lost on one side, and the same of the epochs in turn."""
    before, after = tree(xyz, lost), tree(xyz[~lost], np.zeros(np.count_nonzero(~lost), dtype=bool))
    return part_on_side([before], [after], PlantConfig()), part_on_side([after], [before], PlantConfig())


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [1, -1])
def test_the_side_that_was_cut_from_a_crown_is_the_part_that_is_missing(axis, sign):
    xyz = crown(1500, 3.0, 1)
    lost = sign * (xyz - (0.0, 0.0, 5.0))[:, axis] > 0.6
    cut, grown = parted(xyz, lost)
    assert 0.2 < cut < np.mean(lost)
    assert grown == 0.0


@pytest.mark.parametrize("share", [0.3, 0.6, 0.9])
def test_leaves_that_fell_all_over_a_crown_are_no_side_of_it(share):
    xyz = crown(1500, 3.0, 2)
    lost = np.random.default_rng(3).uniform(size=len(xyz)) < share
    assert parted(xyz, lost) == (0.0, 0.0)


def test_another_plant_in_the_instance_of_a_crown_is_no_side_of_it():
    xyz = np.concatenate([crown(1500, 2.0, 1), np.add(crown(700, 1.5, 2), (6.0, 0.0, 0.0))])
    lost = np.repeat([False, True], [1500, 700])
    assert parted(xyz, lost) == (0.0, 0.0)


def test_surface_of_one_epoch_alone_that_nobody_looked_through_is_no_cut():
    xyz = crown(1500, 3.0, 1)
    kept = tree(xyz[xyz[:, 0] < 0.6], np.zeros(np.count_nonzero(xyz[:, 0] < 0.6), dtype=bool))
    assert part_on_side([tree(xyz, np.zeros(len(xyz), dtype=bool))], [kept], PlantConfig()) == 0.0


def test_what_stood_beneath_a_crown_is_no_part_of_it():
    xyz = crown(1500, 3.0, 1)
    car = np.random.default_rng(4).uniform((2.0, -2.0, 0.2), (5.0, 2.0, 1.4), (500, 3))
    lost = np.repeat([False, True], [len(xyz), len(car)])
    assert parted(np.concatenate([xyz, car]), lost)[0] == 0.0
