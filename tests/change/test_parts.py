"""Parts of an instance that stand in one epoch alone, and wings that belong to a building."""

from dataclasses import replace

import numpy as np
import pytest
from test_measures import block, voxels, walls

from subiaco_change.changes.decisions import DecisionConfig
from subiaco_change.changes.object_changes import drove_by
from subiaco_change.changes.objects import Thing, Voxels
from subiaco_change.changes.parts import PartConfig, part_things
from subiaco_change.changes.wings import find_wings
from subiaco_geo.codes import Change, Semantic

CONFIG = PartConfig()


def thing(pieces, instance=3):
    """An instance of (voxel places, whether the other epoch holds them), four points a voxel."""
    xyz = np.concatenate([np.asarray(p, dtype=float) for p, _ in pieces])
    still = np.concatenate([np.full(len(p), flag) for p, flag in pieces])
    made = voxels(xyz, instance)
    held = Voxels(*(getattr(made, n) if n != "still" else still for n in Voxels.__dataclass_fields__))
    points = np.repeat(xyz, 4, axis=0)
    return Thing(instance, Semantic.VEGETATION, 0.8, np.arange(len(points)), held, 0.03, points)


def test_a_new_hedge_that_touches_an_old_one_is_an_object_of_its_own():
    old, new = block((0, 0, 0), (5, 1, 1.5)), block((5, 0, 0), (8, 1, 1.5))
    parts = part_things([thing([(old, True), (new, False)])], CONFIG)
    assert [p.instance for p in parts] == [3, 4]
    assert [len(p.voxels) for p in parts] == [len(old), len(new)]
    assert sorted(np.concatenate([p.points for p in parts])) == list(range(4 * (len(old) + len(new))))
    assert parts[1].xyz[:, 0].min() > 5


def test_the_top_of_a_grown_hedge_stays_with_it():
    old, top = block((0, 0, 0), (5, 1, 1.5)), block((0, 0, 1.5), (5, 1, 3.0))
    assert len(part_things([thing([(old, True), (top, False)])], CONFIG)) == 1


def test_a_shell_around_a_crown_stays_with_it():
    crown = block((-2, -2, 3), (2, 2, 6))
    shell = block((-3, -3, 3), (3, 3, 6))
    shell = shell[(abs(shell[:, :2]) > 2).any(axis=1)]
    assert len(part_things([thing([(crown, True), (shell, False)])], CONFIG)) == 1


def test_an_object_that_stands_in_one_epoch_alone_is_not_parted():
    whole = thing([(block((0, 0, 0), (5, 1, 1.5)), False)])
    rest = thing([(block((0, 0, 0), (5, 1, 1.5)), False), (block((5, 0, 0), (5.5, 0.5, 0.5)), True)])
    for single in (whole, rest):
        assert part_things([single], CONFIG) == [single]


def test_parting_is_left_out_on_request():
    both = thing([(block((0, 0, 0), (5, 1, 1.5)), True), (block((5, 0, 0), (8, 1, 1.5)), False)])
    assert part_things([both], PartConfig(points=0)) == [both]


def moved(xyz, x):
    return voxels(np.add(xyz, (x, 0.0, 0.0)))


NONE = voxels(np.zeros((0, 3)))
HOUSE, WING = walls(10, 8, 5), walls(4, 6, 4)


def test_a_wing_built_onto_a_house_belongs_to_it_and_one_taken_from_it_too():
    house = (voxels(HOUSE), voxels(HOUSE))
    assert find_wings([house, (NONE, moved(WING, 10))], CONFIG) == {1: 0}
    assert find_wings([(moved(WING, 10), NONE), house], CONFIG) == {0: 1}


@pytest.mark.parametrize(("x", "body"), [(14, WING), (10, walls(14, 10, 6))], ids=["apart", "larger"])
def test_what_stands_apart_or_is_larger_is_no_wing(x, body):
    assert find_wings([(voxels(HOUSE), voxels(HOUSE)), (NONE, moved(body, x))], CONFIG) == {}


def test_a_house_between_two_others_is_no_wing_of_either():
    ends = [(moved(HOUSE, x), moved(HOUSE, x)) for x in (0, 16)]
    assert find_wings([*ends, (moved(walls(6, 8, 4), 10), NONE)], CONFIG) == {}


def test_a_house_gone_from_a_row_that_is_one_instance_was_no_wing():
    row = voxels(np.concatenate([HOUSE, np.add(HOUSE, (16, 0, 0))]))
    assert find_wings([(row, row), (moved(walls(6, 8, 4), 10), NONE)], CONFIG) == {}


@pytest.mark.parametrize(
    ("passed", "top", "trail"),
    [(6.0, 1.5, True), (1.0, 1.5, False), (6.0, 8.0, False)],
    ids=["looked through", "solid", "a tall crown"],
)
def test_what_its_own_survey_looked_through_only_drove_by(passed, top, trail):
    seen = replace(thing([(block((0, 0, 0), (4, 2, top)), False)]), passed=passed)
    decision = drove_by([seen], DecisionConfig())
    assert (decision is not None) == trail
    if decision is not None:
        assert decision.change is Change.NOT_REPORTED
        assert "6 beams passed" in decision.reason


def test_an_object_is_a_trail_only_if_all_its_parts_were_looked_through():
    parts = [replace(thing([(block((0, 0, 0), (4, 2, 1.5)), False)]), passed=p) for p in (9.0, 0.5)]
    assert drove_by(parts, DecisionConfig()) is None
