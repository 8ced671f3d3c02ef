"""Volumes of objects in two epochs, of which either saw a part."""

from dataclasses import replace

import numpy as np
import pytest

from subiaco_change.decisions.config import DecisionConfig
from subiaco_change.decisions.rules import decide
from subiaco_change.objects.column_volumes import (
    BUILT_UP,
    NO_COLUMNS,
    OpenGround,
    compare_volumes,
    exists_in_one_epoch,
)
from subiaco_change.objects.measures import MeasureConfig, measure
from subiaco_change.objects.voxel_objects import Voxels
from subiaco_geo.codes import Change, Semantic

CELL, CLOSING = 0.5, 1.5


def block(low, high):
    axes = [np.arange(a, b, CELL) + CELL / 2 for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def voxels(xyz, owner=0, occupied_in_other=True, observed=True, free_space_confirmed=False):
    count = len(xyz)
    flags = [np.full(count, value) for value in (observed, occupied_in_other, free_space_confirmed)]
    return Voxels(np.full(count, owner), xyz, np.tile([0.0, 0.0, 1.0], (count, 1)), xyz[:, 2], *flags)


def volumes(before, after, **ground):
    return compare_volumes(before, after, CELL, CLOSING, replace(BUILT_UP, **ground))


HOUSE = voxels(block((0, 0, 0), (10, 8, 4)))
TOP = 3.75  # middle of the highest voxel [m]


def wing(length, seen_length):
    """A wing of 3 m by a length, of which the other epoch saw the front part, and looked across it."""
    new = {"owner": 1, "occupied_in_other": False}
    front = voxels(block((10, 0, 0), (13, seen_length, 4)), free_space_confirmed=True, **new)
    return front.add(voxels(block((10, seen_length, 0), (13, length, 4)), observed=False, **new))


@pytest.mark.parametrize("seen_length", [3.0, 6.0])
def test_a_new_wing_is_as_large_as_its_own_epoch_saw_it(seen_length):
    found = volumes(HOUSE, HOUSE.add(wing(6.0, seen_length)), empty=(lambda xyz: xyz[:, 1] < 3.0, None))
    assert found.change == pytest.approx(3 * 6 * TOP)
    assert found.whole == pytest.approx(10 * 8 * TOP, rel=0.02)
    gone = volumes(HOUSE.add(wing(6.0, seen_length)), HOUSE)
    assert gone.change == pytest.approx(-3 * 6 * TOP)


def test_a_part_that_the_other_epoch_never_looked_across_does_not_stand_alone():
    new = wing(6.0, 3.0)
    assert exists_in_one_epoch(new).all()
    assert not exists_in_one_epoch(replace(new, free_space_confirmed=np.zeros(len(new), dtype=bool))).any()
    assert not exists_in_one_epoch(HOUSE).any()


def test_columns_that_one_epoch_saw_neither_standing_nor_open_are_no_change():
    behind = voxels(block((0, 8, 0), (10, 10, 4)), occupied_in_other=False)
    after = HOUSE.add(behind)
    assert volumes(HOUSE, after, empty=(lambda xyz: np.zeros(len(xyz), dtype=bool), None)).change == 0.0
    assert volumes(HOUSE, after).change == pytest.approx(10 * 2 * TOP)


def test_a_gap_that_the_survey_looked_through_is_not_filled():
    """Two sheds a metre apart, and one that covers both."""
    sheds = voxels(np.concatenate([block((0, 0, 0), (2.5, 2, 2)), block((3.5, 0, 0), (6, 2, 2))]))
    between = voxels(block((2.5, 0, 0), (3.5, 2, 2)), occupied_in_other=False, free_space_confirmed=True)
    assert (
        volumes(sheds, sheds.add(between), empty=(lambda xyz: np.zeros(len(xyz), bool), None)).change == 0.0
    )

    def gap(xyz):
        return (xyz[:, 0] > 2.5) & (xyz[:, 0] < 3.5)

    assert volumes(sheds, sheds.add(between), empty=(gap, None)).change == pytest.approx(1 * 2 * 1.75)


def test_the_share_is_one_of_what_stood_before():
    storey = HOUSE.add(voxels(block((0, 0, 4), (10, 8, 7)), occupied_in_other=False))
    assert volumes(HOUSE, storey).whole == pytest.approx(10 * 8 * TOP, rel=0.02)
    assert volumes(storey, HOUSE).whole == pytest.approx(10 * 8 * 6.75, rel=0.02)
    only = volumes(
        voxels(np.zeros((0, 3))), replace(HOUSE, occupied_in_other=np.zeros(len(HOUSE), dtype=bool))
    )
    assert (only.change, only.whole) == pytest.approx((10 * 8 * TOP, 10 * 8 * TOP), rel=0.02)


def test_ground_that_was_met_is_open_for_both():
    court = OpenGround(NO_COLUMNS, NO_COLUMNS)
    assert compare_volumes(HOUSE, HOUSE, CELL, CLOSING, court).change == 0.0


def test_a_gap_that_closes_is_a_volume_although_as_much_wall_is_hidden_as_is_new():
    """Two sheds two metres apart that became one: walls of the gap are gone, its ends are new."""
    solid = block((0, 0, 0), (6, 2, 2))
    inner = (solid[:, 0] > 2) & (solid[:, 0] < 4)
    sheds, between = (
        voxels(solid[~inner]),
        voxels(solid[inner], occupied_in_other=False, free_space_confirmed=True),
    )
    ends = (solid[~inner, 0] > 1.5) & (solid[~inner, 0] < 4.5)
    before = replace(sheds, occupied_in_other=~ends, free_space_confirmed=ends)
    after = sheds.add(between)

    def gap(xyz):
        return (xyz[:, 0] > 2) & (xyz[:, 0] < 4)

    ground = OpenGround(NO_COLUMNS, NO_COLUMNS, (gap, gap))
    measures = measure(before, after, MeasureConfig(), ground, building=True)
    decision = decide(Semantic.BUILDING, True, True, measures, 0.05, DecisionConfig())
    assert decision.change is Change.INCREASED
    back = measure(after, before, MeasureConfig(), ground, building=True)
    assert decide(Semantic.BUILDING, True, True, back, 0.05, DecisionConfig()).change is Change.DECREASED
