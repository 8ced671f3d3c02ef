"""A tree that was cut down to its trunk shrank; one of which a stump is left was felled."""

import numpy as np
import pytest
from test_parts_in_other_instances import compared, epoch, plant

from subiaco_change.method_rules.switches import rules_switched_off
from subiaco_geo.codes import Change, Semantic

STEP = 0.1


def survey(seed, *things):
    """An epoch of things (class, corner, size), each an instance of its own [m]."""
    rng = np.random.default_rng(seed)
    return epoch(
        rng,
        [
            (*plant(rng, np.array(corner, dtype=float), np.array(size, dtype=float), STEP), semantic)
            for semantic, corner, size in things
        ],
        STEP,
    )


def crown(foot, top, width=4.0):
    """A crown about (2, 2)."""
    return Semantic.VEGETATION, (2.0 - width / 2, 2.0 - width / 2, foot), (width, width, top - foot)


def trunk(top, x=2.0, y=2.0):
    return Semantic.OTHER, (x - 0.15, y - 0.15, 0.0), (0.3, 0.3, top)


def labels(changes):
    """Labels of the rows that have a crown or a trunk."""
    return sorted(change.decision.change.name for change in changes)


@pytest.mark.parametrize("swapped", [False, True])
@pytest.mark.parametrize("of_tree", [False, True], ids=["trunk by itself", "trunk and crown are one"])
def test_a_tree_and_the_trunk_that_is_left_of_it_are_one_plant(of_tree, swapped):
    things = [crown(2.0, 6.0), (Semantic.VEGETATION if of_tree else Semantic.OTHER, *trunk(2.0)[1:])]
    tree, left = survey(1, *things), survey(2, trunk(1.5))
    changes = compared(left, tree) if swapped else compared(tree, left)
    (row,) = [c for c in changes if c.decision.change is not Change.UNCHANGED]
    assert row.decision.change is (Change.INCREASED if swapped else Change.DECREASED)
    assert row.semantic is Semantic.VEGETATION
    assert row.before
    assert row.after
    assert "the trunk of the plant" in row.decision.reason
    with rules_switched_off(("standing_trunks",)):
        changes = compared(left, tree) if swapped else compared(tree, left)
    assert (Change.ADDED if swapped else Change.REMOVED).name in labels(changes)


@pytest.mark.parametrize(
    "left",
    [
        trunk(0.6),  # a stump
        trunk(1.5, 3.4),  # a post at the edge of the crown
        (Semantic.OTHER, (1.0, 1.0, 0.0), (2.0, 2.0, 1.5)),  # as wide as a shed
        trunk(5.6),  # a lamp as high as the tree
    ],
    ids=["stump", "beside", "wide", "as high"],
)
def test_a_tree_beside_something_else_that_stands_in_both_epochs_was_felled(left):
    changes = compared(survey(3, crown(2.0, 6.0), left), survey(4, left))
    assert Change.REMOVED.name in labels(changes)
    assert not {Change.DECREASED.name, Change.INCREASED.name} & set(labels(changes))


def test_a_tree_beside_a_pole_whose_foot_is_an_object_of_its_own_was_felled():
    pole = trunk(1.5), (Semantic.OTHER, (1.85, 1.85, 1.8), (0.3, 0.3, 7.0))
    changes = compared(survey(7, crown(2.0, 6.0), *pole), survey(8, *pole))
    assert Change.REMOVED.name in labels(changes)
    assert not {Change.DECREASED.name, Change.INCREASED.name} & set(labels(changes))


@pytest.mark.parametrize("swapped", [False, True])
def test_a_palm_whose_crown_rose_above_its_old_crown_is_one_plant(swapped):
    low = survey(5, crown(3.0, 4.0), trunk(3.0))
    high = survey(6, crown(5.5, 6.5), trunk(5.5))
    changes = compared(high, low) if swapped else compared(low, high)
    (row,) = changes
    assert row.decision.change is (Change.DECREASED if swapped else Change.INCREASED)
    assert len(row.before) == len(row.after) == 2
    rise = float(row.measures.delta_v)
    assert np.isfinite(rise)
