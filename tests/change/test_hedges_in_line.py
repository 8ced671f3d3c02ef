"""A hedge that was shortened is one row; a hedge beside another one that was removed is a row of its own."""

import numpy as np
import pytest
from test_parts_in_other_instances import compared, epoch, plant

from subiaco_change.method_rules.switches import rules_switched_off
from subiaco_geo.codes import Change, Semantic

HEDGE = ((0.0, 0.0, 0.0), (4.0, 1.0, 1.5))  # corner and size [m]
GREEN = Semantic.VEGETATION


def survey(seed, *boxes):
    """An epoch in which all boxes of leaves are one instance."""
    rng = np.random.default_rng(seed)
    parts = [plant(rng, np.array(corner), np.array(size), 0.1) for corner, size in boxes]
    return epoch(rng, [(*(np.concatenate(column) for column in zip(*parts, strict=True)), GREEN)], 0.1)


def changed(changes):
    return [c for c in changes if c.decision.change is not Change.UNCHANGED]


@pytest.mark.parametrize("swapped", [False, True])
def test_a_hedge_that_lost_or_gained_a_part_of_its_length_is_one_row(swapped):
    whole = survey(1, HEDGE, ((4.0, 0.0, 0.0), (4.0, 1.0, 1.5)))
    part = survey(2, HEDGE)
    changes = compared(part, whole) if swapped else compared(whole, part)
    (row,) = changes
    label, word = (Change.INCREASED, "gained") if swapped else (Change.DECREASED, "lost")
    assert row.decision.change is label
    assert f"it {word} " in row.decision.reason
    assert row.before
    assert row.after
    assert len(row.points("before")) + len(row.points("after")) > 0.95 * sum(
        np.count_nonzero(view.semantic == GREEN) for view in (whole, part)
    )
    with rules_switched_off(("hedges_in_line",)):
        changes = compared(part, whole) if swapped else compared(whole, part)
    assert [c.decision.change for c in changed(changes)] == [Change.ADDED if swapped else Change.REMOVED]


@pytest.mark.parametrize(
    ("corner", "size"),
    [
        ((4.0, 0.0, 0.0), (4.0, 1.0, 2.1)),  # higher: the hedge of the neighbour
        ((4.0, -2.5, 0.0), (1.0, 5.0, 1.5)),  # across: it meets the hedge at its end
    ],
)
def test_another_plant_that_touches_a_hedge_is_a_row_of_its_own(corner, size):
    changes = compared(survey(3, HEDGE, (corner, size)), survey(4, HEDGE))
    assert [c.decision.change for c in changed(changes)] == [Change.REMOVED]
    assert any(c.decision.change is Change.UNCHANGED and c.after for c in changes)
