"""A tree that was felled, or planted, over a shrub that stayed is no shrub that shrank or grew."""

from dataclasses import replace

import numpy as np
import pytest
from random_houses import KINDS, labels
from random_houses import compare as compare_drives
from random_plants import draw_tree_over_shrub
from test_measures import block
from test_one_epoch_parts import obj
from test_parts_in_other_instances import compared, epoch, plant, share_said

from subiaco_change.association.config import PartConfig
from subiaco_change.instance_splitting.one_epoch_parts import split_one_epoch_parts
from subiaco_change.instance_splitting.trees_over_shrubs import split_trees_over_shrubs
from subiaco_change.method_rules.switches import rules_switched_off
from subiaco_geo.codes import Change, Semantic

CONFIG = PartConfig()
SHRUB = block((0, 0, 0), (2, 2, 1.5))
CROWN = block((-1, -1, 2.5), (2, 2, 7))


def parted(pieces, below_view=None):
    return split_trees_over_shrubs([obj(pieces)], below_view, CONFIG)


def test_a_crown_of_one_epoch_over_a_shrub_of_both_is_an_object_of_its_own():
    """Its trunk is hidden in the shrub, so that the crown does not begin at the ground."""
    whole = obj([(SHRUB, True), (CROWN, False)])
    assert split_one_epoch_parts([whole], CONFIG) == [whole]
    shrub, tree = parted([(SHRUB, True), (CROWN, False)])
    assert (len(shrub.voxels), len(tree.voxels)) == (len(SHRUB), len(CROWN))
    assert (shrub.is_part, tree.is_part) == (False, True)
    assert sorted([*shrub.points, *tree.points]) == list(range(4 * (len(SHRUB) + len(CROWN))))
    assert split_trees_over_shrubs([whole], None, PartConfig(points=0)) == [whole]


def test_a_shrub_of_a_twentieth_of_the_points_is_no_reason_to_keep_a_felled_tree_with_it():
    tree = np.concatenate([block((0, 0, 0), (0.5, 0.5, 2)), block((-3, -3, 2), (3, 3, 6))])
    shrub = block((1, 1, 0), (2, 2, 1.5))
    whole = obj([(shrub, True), (tree, False)])
    assert split_one_epoch_parts([whole], CONFIG) == [whole]
    assert [len(part.voxels) for part in parted([(shrub, True), (tree, False)])] == [len(shrub), len(tree)]


def test_two_trees_over_one_hedge_are_two_objects_and_a_twig_is_none():
    hedge, twig = block((0, 0, 0), (12, 1, 1.5)), block((6, 0, 3), (6.5, 0.5, 4))
    crowns = [block((x, -1, 2.5), (x + 3, 2, 7)) for x in (0, 9)]
    parts = parted([(hedge, True), (crowns[0], False), (crowns[1], False), (twig, False)])
    assert [len(part.voxels) for part in parts[1:]] == [len(crowns[0]), len(crowns[1])]
    assert [part.instance for part in parts] == [3, 4, 5]


@pytest.mark.parametrize(
    ("common", "alone"),
    [
        (np.concatenate([SHRUB, block((-1, -1, 2.5), (2, 2, 4))]), block((-1, -1, 4), (2, 2, 8))),
        (np.concatenate([SHRUB, block((-1, -1, 2.5), (0, 2, 7))]), block((0, -1, 2.5), (2, 2, 7))),
        (block((0, 0, 0), (2, 2, 2)), block((-1, -1, 2), (3, 3, 4))),
        (SHRUB, block((0, 0, 2.5), (1, 1, 7))),
        (block((0, 0, 0), (5, 1, 1)), block((0, 1, 1), (5, 3.5, 3.5))),
        (block((0, 0, 0), (5, 5, 0.5)), CROWN),
    ],
    ids=[
        "its top was cut off",
        "a side was cut off",
        "a shrub grew",
        "a shoot or a pole",
        "a lorry",
        "the ground",
    ],
)
def test_a_plant_of_which_more_than_a_shrub_stands_is_not_parted(common, alone):
    assert len(parted([(common, True), (alone, False)])) == 1


def test_a_crown_above_the_view_of_the_other_epoch_is_not_parted():
    pieces = [(SHRUB, True), (CROWN, False)]
    assert len(parted(pieces, lambda xyz: xyz[:, 2] < 2.0)) == 1
    assert len(parted(pieces, lambda xyz: xyz[:, 2] < 4.0)) == 2


def test_a_crown_that_the_other_epoch_hardly_observed_is_not_parted():
    whole = obj([(SHRUB, True), (CROWN, False)])
    observed = whole.voxels.occupied_in_other | (whole.voxels.height > 6.0)
    hidden = replace(whole, voxels=replace(whole.voxels, observed=observed))
    assert split_trees_over_shrubs([hidden], None, CONFIG) == [hidden]


@pytest.mark.parametrize("felled", [True, False], ids=["felled", "planted"])
@pytest.mark.parametrize("size", [(2.0, 2.0, 1.5), (8.0, 1.0, 1.6)], ids=["a shrub", "a hedge"])
def test_a_tree_over_what_stayed_is_removed_or_added_and_the_rest_is_unchanged(size, felled):
    rng = np.random.default_rng(5)
    crown = plant(rng, np.array([-1.0, -1.0, 2.3]), np.array([3.0, 3.0, 4.5]), 0.25)
    low = [plant(rng, np.zeros(3), np.array(size), spacing) for spacing in (0.25, 0.3)]
    both = [np.concatenate([a, b]) for a, b in zip(low[0], crown, strict=True)]
    kind = Semantic.VEGETATION
    with_tree, without = epoch(rng, [(*both, kind)], 0.25), epoch(rng, [(*low[1], kind)], 0.3)
    views = (with_tree, without) if felled else (without, with_tree)
    name, label = ("before", Change.REMOVED) if felled else ("after", Change.ADDED)
    tree = with_tree.height > 2.5
    shrub = (with_tree.instance >= 0) & (with_tree.height < 1.2)
    changes = compared(*views)
    assert share_said(changes, name, with_tree, tree, label) > 0.9
    assert share_said(changes, name, with_tree, shrub, Change.UNCHANGED) > 0.9
    with rules_switched_off(["trees_over_shrubs"]):
        assert share_said(compared(*views), name, with_tree, tree, label) == 0.0


@pytest.mark.parametrize("seed", range(1, 5))
def test_of_two_drives_past_a_felled_tree_one_row_is_the_tree_and_one_the_shrub(seed):
    before, after = draw_tree_over_shrub(seed, "felled").surveys
    assert labels(compare_drives(before, after, "observed")) == [Change.REMOVED, Change.UNCHANGED]
    assert labels(compare_drives(after, before, "observed")) == [Change.ADDED, Change.UNCHANGED]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("what", ["pruned", "narrow view"])
@pytest.mark.parametrize("seed", range(1, 4))
def test_a_pruned_tree_and_one_that_a_sensor_cuts_at_the_shrub_are_never_removed_or_added(seed, what, kind):
    before, after = draw_tree_over_shrub(seed, what).surveys
    single = {Change.ADDED, Change.REMOVED}
    assert not single & {
        *labels(compare_drives(before, after, kind)),
        *labels(compare_drives(after, before, kind)),
    }
