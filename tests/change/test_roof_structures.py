"""What hangs over a building, or in it, is a part of it: chimneys, dormers, ceilings seen through windows."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_measures import block, voxels

from subiaco_change.decisions.hanging_parts import join_hanging_parts
from subiaco_change.decisions.object_decision import ObjectChange
from subiaco_change.decisions.rules import Decision
from subiaco_change.method_rules.switches import rules_switched_off
from subiaco_change.objects.measures import MeasureConfig, measure
from subiaco_change.objects.voxel_objects import ObjectInstance
from subiaco_change.segmentation.roof_structures import buildings_beneath
from subiaco_geo.codes import Change, Semantic

HOUSE = block((0, 0, 0), (10, 8, 5))
CHIMNEY = block((4, 3, 5), (5, 4, 7))
DORMER = block((2, 0, 4), (4, 1.5, 6))
OVERHANGING_CROWN = block((8, 2, 4), (15, 7, 9))
CEILING = block((2, 2, 3), (6, 6, 3.5))
BUSH_AT_THE_WALL = block((3, -1, 0), (6, 1, 6))
#: Most of the crown is over the roof, and cars hide all of the trunk but a few points.
TREE_OVER_THE_ROOF = np.concatenate([block((7, 2, 4), (12, 6, 8)), block((10.5, 4, 0.5), (11, 4.5, 1.5))])


def obj(xyz, instance, semantic):
    cells = voxels(xyz, instance)
    return ObjectInstance(instance, semantic, 0.9, np.arange(len(cells)), cells, 0.03)


def change_of(before, after, semantic, change):
    cells = [t.voxels for t in (*before, *after)]
    kind = "one_to_one" if before and after else "none"
    measures = measure(cells[0], cells[-1], MeasureConfig())
    return ObjectChange(before, after, semantic, kind, measures, Decision(change, "", 1.0))


def house_beneath(thing, house=HOUSE):
    """Instance of the house (number 3) that a thing is of, -1 for none."""
    labels = np.zeros(len(thing), dtype=np.int64)
    owner = buildings_beneath(labels, thing, thing[:, 2], house[:, :2], house[:, 2], np.full(len(house), 3))
    assert len(np.unique(owner)) == 1, "a thing is of one building as a whole"
    return int(owner[0])


@pytest.mark.parametrize("thing", [CHIMNEY, DORMER])
def test_what_stands_on_a_roof_is_of_the_building(thing):
    assert house_beneath(thing) == 3


@pytest.mark.parametrize("thing", [OVERHANGING_CROWN, BUSH_AT_THE_WALL, TREE_OVER_THE_ROOF])
def test_a_crown_that_overhangs_a_roof_and_a_bush_at_the_wall_are_plants(thing):
    assert house_beneath(thing) == -1


def test_a_ceiling_below_the_roof_does_not_move_the_tops_of_a_building():
    assert house_beneath(CEILING) == -1


def test_a_crown_larger_than_the_kiosk_beneath_is_a_plant():
    kiosk = block((0, 0, 2.5), (2, 2, 3))
    crown = block((-0.5, -0.5, 3), (2.5, 2.5, 8))
    assert house_beneath(crown, kiosk) == -1


def test_where_nothing_is_built_nothing_is_of_a_building():
    assert house_beneath(CHIMNEY, np.zeros((0, 3))) == -1


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_building_of_a_thing_does_not_depend_on_the_order_of_points(seed):
    rng = np.random.default_rng(seed)
    things = [CHIMNEY, OVERHANGING_CROWN, DORMER + np.array([4, 0, 0])]
    xyz = np.concatenate(things)
    labels = np.repeat(np.arange(3), [len(t) for t in things])
    order, house = rng.permutation(len(xyz)), rng.permutation(HOUSE)
    owner = buildings_beneath(
        labels[order], xyz[order], xyz[order, 2], house[:, :2], house[:, 2], np.zeros(len(house), np.int64)
    )
    assert dict(zip(labels[order].tolist(), owner.tolist(), strict=True)) == {0: 0, 1: -1, 2: 0}


def rows(thing, label=Change.INCREASED):
    """A house with a label, and a thing of the class of plants beside it or in it."""
    house, plant = obj(HOUSE, 0, Semantic.BUILDING), obj(thing, 1, Semantic.VEGETATION)
    return [
        change_of((house,), (house,), Semantic.BUILDING, label),
        change_of((plant,), (), Semantic.VEGETATION, Change.REMOVED),
    ]


@pytest.mark.parametrize("label", [Change.INCREASED, Change.UNCHANGED, Change.UNOBSERVED])
@pytest.mark.parametrize("thing", [CHIMNEY, DORMER, CEILING])
def test_what_hangs_over_a_building_or_in_it_has_no_row_of_its_own(thing, label):
    changes = rows(thing, label=label)
    (joined,) = join_hanging_parts(changes)
    assert joined.decision == changes[0].decision
    assert joined.measures == changes[0].measures
    assert len(joined.before) == 2
    assert len(joined.after) == 1


@pytest.mark.parametrize("thing", [OVERHANGING_CROWN, BUSH_AT_THE_WALL, TREE_OVER_THE_ROOF])
def test_what_stands_beside_a_building_keeps_its_row(thing):
    changes = rows(thing)
    assert join_hanging_parts(changes) == changes


def test_of_two_houses_a_part_joins_the_one_beneath_most_of_it():
    left, right = obj(HOUSE, 0, Semantic.BUILDING), obj(HOUSE + np.array([10, 0, 0]), 1, Semantic.BUILDING)
    chimney = obj(CHIMNEY + np.array([7, 0, 0]), 2, Semantic.OTHER)
    changes = [
        change_of((left,), (left,), Semantic.BUILDING, Change.INCREASED),
        change_of((right,), (right,), Semantic.BUILDING, Change.UNCHANGED),
        change_of((), (chimney,), Semantic.OTHER, Change.ADDED),
    ]
    first, second = join_hanging_parts(changes)
    assert [len(first.after), len(second.after)] == [1, 2]


def test_a_part_of_an_epoch_that_has_no_building_keeps_its_row():
    house, part = obj(HOUSE, 0, Semantic.BUILDING), obj(DORMER, 1, Semantic.OTHER)
    changes = [
        change_of((house,), (), Semantic.BUILDING, Change.REMOVED),
        change_of((part,), (part,), Semantic.OTHER, Change.UNCHANGED),
    ]
    assert join_hanging_parts(changes) == changes


def test_a_crown_larger_than_the_kiosk_beneath_keeps_its_row():
    kiosk = obj(block((0, 0, 2.5), (2, 2, 3)), 0, Semantic.BUILDING)
    crown = obj(block((-0.5, -0.5, 3), (2, 2, 8)), 1, Semantic.VEGETATION)
    changes = [
        change_of((kiosk,), (kiosk,), Semantic.BUILDING, Change.UNCHANGED),
        change_of((crown,), (crown,), Semantic.VEGETATION, Change.INCREASED),
    ]
    assert join_hanging_parts(changes) == changes


def test_without_the_rule_every_part_keeps_its_row():
    with rules_switched_off(["hanging_parts"]):
        assert len(join_hanging_parts(rows(CHIMNEY))) == 2
    with rules_switched_off(["roof_structures"]):
        assert house_beneath(CHIMNEY) == -1
