"""Two objects that were matched by place, and are not one object that changed."""

import numpy as np
import pytest

from subiaco_change.association.costs import AssociationConfig
from subiaco_change.decisions.config import DecisionConfig
from subiaco_change.decisions.measures import MeasureConfig
from subiaco_change.decisions.object_decision import ObjectRules, decide_object
from subiaco_change.decisions.voxel_objects import ObjectInstance, Voxels
from subiaco_change.instance_splitting.split_merge import split_low_overlap_matches
from subiaco_geo.codes import Change, Semantic

RULES = ObjectRules(MeasureConfig(), AssociationConfig(), DecisionConfig())


def box(width, depth, height):
    """Voxels (N, 3) of the walls and the roof of a box whose corner is the origin [m]."""
    axes = [np.arange(0.25, size, 0.5) for size in (width, depth, height)]
    xyz = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    index = np.round((xyz - 0.25) / 0.5).astype(int)
    last = [len(axis) - 1 for axis in axes]
    shell = (
        (index[:, 0] % max(last[0], 1) == 0) | (index[:, 1] % max(last[1], 1) == 0) | (index[:, 2] == last[2])
    )
    return xyz[shell]


def obj(xyz, occupied_in_other):
    """A building; ``occupied_in_other`` (N,): the other epoch has points there; elsewhere it saw none."""
    yes = np.ones(len(xyz), dtype=bool)
    normal = np.tile([1.0, 0.0, 0.0], (len(xyz), 1))
    voxels = Voxels(
        np.zeros(len(xyz), int), xyz, normal, xyz[:, 2], yes, occupied_in_other, ~occupied_in_other
    )
    return ObjectInstance(0, Semantic.BUILDING, 0.9, np.arange(len(xyz)), voxels, 0.05, xyz)


def matched(before, after):
    """The row of two box-like buildings, matched."""
    near = [(a[:, None] == b[None]).all(axis=2).any(axis=1) for a, b in ((before, after), (after, before))]
    return decide_object([obj(before, near[0])], [obj(after, near[1])], Semantic.BUILDING, RULES)


@pytest.mark.parametrize(("first", "label"), [(True, Change.ADDED), (False, Change.REMOVED)])
def test_a_house_that_stands_around_a_short_wall_came_or_went_by_itself(first, label):
    wall, house = box(0.5, 4.0, 1.0), box(10.0, 8.0, 5.0)
    row = matched(wall, house) if first else matched(house, wall)
    assert row.decision.change is Change.UNCHANGED  # too little overlap to compare
    rows = split_low_overlap_matches([row], RULES)
    assert [len(r.before) + len(r.after) for r in rows] == [1, 1]
    assert label in {r.decision.change for r in rows}


@pytest.mark.parametrize("added", [True, False])
def test_a_house_whose_absence_is_assumed_came_or_went_with_its_whole_volume(added):
    house = [obj(box(10.0, 8.0, 5.0), np.zeros(len(box(10.0, 8.0, 5.0)), dtype=bool))]
    sides = ([], house) if added else (house, [])
    measures = decide_object(*sides, Semantic.BUILDING, RULES).measures
    sign = 1.0 if added else -1.0
    assert 300.0 < sign * measures.delta_v < 400.0
    assert measures.volume_bounds.low == measures.volume_bounds.high == measures.delta_v


def test_a_house_that_lost_most_of_itself_stays_one_row():
    row = matched(box(10.0, 8.0, 5.0), box(3.0, 8.0, 2.5))
    assert split_low_overlap_matches([row], RULES) == [row]


def test_a_house_that_did_not_change_stays_one_row():
    row = matched(box(10.0, 8.0, 5.0), box(10.0, 8.0, 5.0))
    assert split_low_overlap_matches([row], RULES) == [row]
