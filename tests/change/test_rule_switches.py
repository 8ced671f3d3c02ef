"""Rules switched off one at a time on the smallest case that each of them decides."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from subiaco_change.decisions.config import DecisionConfig
from subiaco_change.decisions.ground_cells import GroundCells, GroundChangeConfig
from subiaco_change.decisions.ground_change import find_patches
from subiaco_change.decisions.plant_decisions import decide_plant
from subiaco_change.decisions.plant_measures import PlantConfig
from subiaco_change.decisions.rules import decide
from subiaco_change.decisions.vegetation_null import PlantMeasures, no_null
from subiaco_change.method_rules.switches import rules_switched_off
from subiaco_change.objects.measures import Measures, porous_chance
from subiaco_change.objects.space_carving import Interval
from subiaco_change.segmentation.instances import InstanceConfig, split_crowns, split_hedge
from subiaco_geo.codes import Change, Semantic

CONFIG = DecisionConfig()
NEW = Measures(
    iou=0.0, d_perp=math.nan, delta_c=math.nan, delta_h=math.nan, delta_v=50.0, delta_v_surface=0.0,
    volume=50.0, gone_share=0.0, new_share=1.0, observed_fraction=0.9, observed_voxels=200,
)  # fmt: skip
HOUSE = replace(NEW, iou=0.8, delta_h=0.0, delta_v=0.0, volume=1000.0, new_share=0.1)
CROWN = PlantMeasures(
    kind="crown", density=0.0, size=2.0, voxels=300, reach=2.0, outline=0.0, outline_sigma=0.03,
    top=0.0, volume=0.0, surface=0.0, rise=math.nan, rise_sigma=math.nan,
)  # fmt: skip

#: Rule, class, measures of one epoch alone, label with the rule, label without.
SINGLES = [
    ("probably_free", Semantic.OTHER, replace(NEW, free=0.6), Change.UNOBSERVED, Change.ADDED),
    ("enclosed_volume", Semantic.BUILDING, replace(NEW, delta_v=0.5), Change.UNOBSERVED, Change.ADDED),
    (
        "enclosed_volume",
        Semantic.BUILDING,
        replace(NEW, volume_bounds=Interval(1.0, 99.0)),
        Change.UNOBSERVED,
        Change.ADDED,
    ),
]


@pytest.mark.parametrize(("rule", "semantic", "measures", "usual", "without"), SINGLES)
def test_rules_of_objects_of_one_epoch(rule, semantic, measures, usual, without):
    def label():
        return decide(semantic, False, True, measures, 0.05, CONFIG).change

    assert label() is usual
    with rules_switched_off([rule]):
        assert label() is without


@pytest.mark.parametrize(
    ("rule", "height", "volume"),
    [
        ("sign_certain", Interval(-0.5, 3.0), Interval(0.0, 60.0)),
        ("volume_supports_height", Interval(1.0, 2.0), Interval(0.0, 0.0)),
    ],
)
def test_rules_of_buildings_hold_back_a_claim_that_comes_without_them(rule, height, volume):
    measures = replace(HOUSE, height_bounds=height, volume_bounds=volume)

    def label():
        return decide(Semantic.BUILDING, True, True, measures, 0.05, CONFIG).change

    assert label() is Change.UNCHANGED
    with rules_switched_off([rule]):
        assert label() is Change.INCREASED


def test_new_walls_carry_a_change_of_height_of_a_house_whose_volume_nobody_knows():
    """A roof that was lifted by half a metre shows in its eaves alone."""
    lifted = replace(HOUSE, height_bounds=Interval(0.6, 0.9), volume_bounds=Interval(0.0, 0.0))
    for surface, change in ((1.0, Change.UNCHANGED), (3.0, Change.INCREASED)):
        walls = replace(lifted, gained_surface=surface)
        assert decide(Semantic.BUILDING, True, True, walls, 0.05, CONFIG).change is change


#: Rule, plant, label with the rule, label without.
PLANTS = [
    ("outline_of_plants", replace(CROWN, outline=0.8), Change.INCREASED, Change.UNCHANGED),
    ("surface_carries_change", replace(CROWN, outline=math.nan, top=2.0), Change.UNCHANGED, Change.INCREASED),
    ("extent_carries_surface", replace(CROWN, surface=0.4), Change.UNCHANGED, Change.INCREASED),
    (
        "unseen_tops_of_plants",
        replace(CROWN, outline=math.nan, top=2.0, surface=0.12, tops_unseen=True),
        Change.UNCHANGED,
        Change.INCREASED,
    ),
    ("surface_was_free", replace(CROWN, outline=0.8, free_gained=0.4), Change.UNCHANGED, Change.INCREASED),
    (
        "own_error_of_plants",
        replace(CROWN, outline=math.nan, voxels=6, volume=0.9, surface=0.9),
        Change.UNCHANGED,
        Change.INCREASED,
    ),
]


@pytest.mark.parametrize(("rule", "plant", "usual", "without"), PLANTS)
def test_rules_of_plants(rule, plant, usual, without):
    def label():
        return decide_plant(plant, 0.03, CONFIG, no_null(PlantConfig().null_model)).change

    assert label() is usual
    with rules_switched_off([rule]):
        assert label() is without


def test_a_beam_that_crosses_a_porous_object_proves_less_until_the_rule_is_off():
    chance = np.array([0.75, 0.9])
    assert (porous_chance(chance, 0.2) < chance).all()
    with rules_switched_off(["porous_absence"]):
        assert np.array_equal(porous_chance(chance, 0.2), chance)


def area(rise, other=False):
    """Ground of 20 m x 20 m of which 10 m x 10 m rose [m]; ``other``: both epochs hold both surfaces."""
    shape = (40, 40)
    dz, none = np.zeros(shape), np.zeros(shape, dtype=bool)
    dz[10:30, 10:30] = rise
    held = dz > 0 if other else none
    return GroundCells(dz, np.full(shape, 0.05), none, dz, held, held, none, none)


def patches(cells):
    return len(find_patches(cells, np.zeros(2), GroundChangeConfig())[1])


def test_ground_under_another_class_is_no_change_until_the_rule_is_off():
    cells = area(0.4, other=True)
    assert patches(area(0.4)) == 1
    assert patches(cells) == 0
    with rules_switched_off(["other_surface"]):
        assert patches(cells) == 1


def test_a_large_gap_in_a_patch_counts_towards_its_area_until_the_rule_is_off():
    cells = area(0.4)
    dz = cells.dz.copy()
    dz[:, :] = 0.0
    dz[10:30, 10:14] = 0.18
    dz[10:30, 14:30] = np.nan
    cells = replace(cells, dz=dz)
    assert patches(cells) == 1
    with rules_switched_off(["possible_area"]):
        assert patches(cells) == 0


def crowns_on_trunks():
    """Return two trees whose crowns meet in a shallow dip, each on its trunk, with heights."""
    rng = np.random.default_rng(3)
    parts = []
    for east in (0.0, 4.0):
        ball = rng.normal(size=(1500, 3))
        ball *= 2.2 / np.linalg.norm(ball, axis=1, keepdims=True)
        trunk = np.column_stack([rng.normal(scale=0.05, size=(60, 2)), np.linspace(0.3, 2.0, 60)])
        parts += [ball * (1.2, 1.0, 0.4) + np.array([east, 0.0, 4.5]), trunk + np.array([east, 0.0, 0.0])]
    xyz = np.concatenate(parts)
    return xyz, xyz[:, 2]


def test_two_crowns_with_a_trunk_each_are_two_trees_until_the_rule_is_off():
    xyz, height = crowns_on_trunks()
    config = InstanceConfig(crown_drop=3.0)
    assert len(np.unique(split_crowns(xyz, height, config))) == 2
    with rules_switched_off(["crowns_by_trunks"]):
        assert len(np.unique(split_crowns(xyz, height, config))) == 1


def test_a_hedge_is_split_at_the_step_of_its_clipped_top_until_the_rule_is_off():
    rng = np.random.default_rng(1)
    xyz = rng.uniform((0.0, 0.0, 0.0), (12.0, 0.8, 1.0), size=(6000, 3))
    xyz[xyz[:, 0] > 6.0, 2] *= 1.8
    assert len(np.unique(split_hedge(xyz, xyz[:, 2], InstanceConfig()))) == 2
    with rules_switched_off(["hedges_by_steps"]):
        assert len(np.unique(split_hedge(xyz, xyz[:, 2], InstanceConfig()))) == 1
