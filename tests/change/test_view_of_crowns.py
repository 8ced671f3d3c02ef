"""Crowns in which the field of view of a bare cloud ends: their tops are not known."""

from dataclasses import replace

import numpy as np
import pytest
from test_measures import block
from test_one_epoch_parts import obj

from subiaco_change.association.config import AssociationConfig
from subiaco_change.decisions.config import DecisionConfig
from subiaco_change.decisions.object_decision import ObjectRules, decide_object
from subiaco_change.decisions.view_of_crowns import goes_on_above, is_top_seen
from subiaco_change.objects.known_space import KnownSpace
from subiaco_change.objects.measures import MeasureConfig
from subiaco_geo.codes import Change, Semantic

RULES = ObjectRules(MeasureConfig(), AssociationConfig(), DecisionConfig())


def crown(cut_at: float = np.inf):
    """Points (N, 3) of the surface of a crown of 4 x 4 x 4 m, 2 m above the ground, up to a height."""
    rng = np.random.default_rng(7)
    step = rng.normal(size=(3000, 3))
    xyz = 2.0 * step / np.linalg.norm(step, axis=1)[:, None] + [0.0, 0.0, 4.0]
    return xyz[xyz[:, 2] < cut_at]


def below(height: float):
    """A view that is known to have reached so high."""
    return lambda xyz: xyz[:, 2] <= height


@pytest.mark.parametrize("turn", range(3))
def test_the_top_of_a_round_crown_is_seen_and_that_of_a_cut_one_is_not(turn):
    part = obj([(crown(), False)])
    thinned = replace(part, xyz=part.xyz[turn::3])
    assert is_top_seen([thinned])
    for height in (3.5, 4.0, 4.7):
        cut = obj([(crown(height), False)])
        assert not is_top_seen([cut])


def test_few_columns_tell_no_top():
    assert not is_top_seen([obj([(block((0, 0, 2), (1, 1, 6)), False)])])


@pytest.mark.parametrize(
    ("reach", "beside", "change"),
    [(9.0, 0.0, Change.ADDED), (2.5, 0.0, Change.UNOBSERVED), (2.5, 3.0, Change.ADDED)],
    ids=["in view", "the upper part of a cut crown", "a tree that stands alone"],
)
def test_a_cut_crown_above_the_view_of_the_other_survey_is_not_claimed(reach, beside, change):
    cut = obj([(block((0, 0, 3), (5, 5, 5)), False)])
    stem = block((5 + beside, 2, 0), (6 + beside, 3, 3))
    rules = replace(RULES, spaces=(KnownSpace(stem, below_view=below(reach)),) * 2)
    assert decide_object((), [cut], Semantic.VEGETATION, rules).decision.change is change


def test_a_crown_with_its_top_seen_is_claimed_above_all_that_surrounds_it():
    beside = np.add(crown(), (2.5, 0.0, -1.0))
    rules = replace(RULES, spaces=(KnownSpace(beside, below_view=below(0.5)),) * 2)
    whole = obj([(crown(), False)])
    assert decide_object((), [whole], Semantic.VEGETATION, rules).decision.change is Change.ADDED
    assert decide_object([whole], (), Semantic.VEGETATION, rules).decision.change is Change.REMOVED


def test_what_every_view_reaches_is_enough_to_claim_a_felled_tree():
    stem = block((0, 0, 0.5), (1, 1, 2.0))
    tree = obj([(np.concatenate([stem, block((-2, -2, 2), (3, 3, 4))]), False)])
    rules = replace(RULES, spaces=(KnownSpace(np.add(stem, 1.0), below_view=below(0.2)),) * 2)
    assert decide_object([tree], (), Semantic.VEGETATION, rules).decision.change is Change.REMOVED


@pytest.mark.parametrize(("reach", "label"), [(9.0, Change.INCREASED), (4.0, Change.UNCHANGED)])
def test_a_crown_that_both_fields_of_view_cut_did_not_grow(reach, label):
    """One view ends at 4 m, the other at 5 m."""
    low, high = block((0, 0, 2), (5, 5, 4)), block((0, 0, 4), (5, 5, 5))
    before = obj([(low, True)])
    after = obj([(low, True), (high, False)])
    free = replace(after.voxels, free_space_confirmed=~after.voxels.occupied_in_other)
    after = replace(after, voxels=free)
    rules = replace(RULES, spaces=(KnownSpace(below_view=below(reach)), KnownSpace(below_view=below(9.0))))
    assert decide_object([before], [after], Semantic.VEGETATION, rules).decision.change is label


def around(top: float):
    """Points (N, 3) of a hedge of 8 x 3 m beside the crown, up to a height."""
    return np.repeat(block((4, -4, 3), (7, 4, top)), 4, axis=0)


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [(6.0, 6.0, False), (6.0, 8.0, True), (4.0, 6.0, False), (6.0, 5.0, False)],
    ids=["ends as high in both", "goes on above", "goes on, but ends lower than the crown", "ends lower"],
)
def test_whether_the_surroundings_of_a_crown_go_on_above_it(before, after, expected):
    plant = [obj([(crown(), True)])]
    assert goes_on_above(plant, plant, (around(after), around(before))) is expected
    few = around(after)[:8], around(before)[:8]
    assert not goes_on_above(plant, plant, few)
    assert not goes_on_above(plant, plant, (np.zeros((0, 3)), around(before)))


@pytest.mark.parametrize(("top", "label"), [(6.0, Change.INCREASED), (8.0, Change.UNCHANGED)])
def test_a_round_crown_grew_only_if_its_surroundings_did_not_rise_with_it(top, label):
    """The earlier view is known to reach 5 m; the crown is 6 m high, and 8 m in the later survey."""
    old, new = (crown(), True), (block((-1, -1, 6), (1, 1, 8)), False)
    after = obj([old, new])
    free = replace(after.voxels, free_space_confirmed=~after.voxels.occupied_in_other)
    after = replace(after, voxels=free)
    spaces = KnownSpace(around(6.0), below_view=below(5.0)), KnownSpace(around(top), below_view=below(9.0))
    rules = replace(RULES, spaces=spaces)
    assert decide_object([obj([old])], [after], Semantic.VEGETATION, rules).decision.change is label
