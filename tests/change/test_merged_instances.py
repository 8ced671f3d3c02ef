"""Houses wall to wall that the two epochs part at other walls."""

from dataclasses import replace

import numpy as np
import pytest

from subiaco_change.association.config import AssociationConfig
from subiaco_change.decisions.config import DecisionConfig
from subiaco_change.decisions.object_decision import ObjectRules, decide_object, is_roof_on_posts
from subiaco_change.decisions.split_merge import split_row_houses
from subiaco_change.instance_splitting.merged_instances import group_row_houses
from subiaco_change.method_rules.switches import rules_switched_off
from subiaco_change.objects.column_volumes import NO_COLUMNS, OpenGround, ground_columns
from subiaco_change.objects.measures import MeasureConfig
from subiaco_change.objects.voxel_objects import ObjectInstance, Voxels
from subiaco_geo.codes import Change, Semantic

RULES = ObjectRules(MeasureConfig(), AssociationConfig(), DecisionConfig())
WIDTH, DEPTH = 6.0, 8.0


def house(place, height):
    """Voxels (N, 3) of the front, the party walls and the roof of a house of a row along x [m]."""
    x, y, z = (np.arange(0.25, size, 0.5) for size in (WIDTH, DEPTH, height))
    xyz = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).reshape(-1, 3)
    index = np.round((xyz - 0.25) / 0.5).astype(int)
    last = (len(x) - 1, len(z) - 1)
    shell = (index[:, 0] % last[0] == 0) | (index[:, 1] == 0) | (index[:, 2] == last[1])
    return xyz[shell] + (WIDTH * place, 0.0, 0.0)


def row(heights, groups):
    """Things of one epoch: ``groups`` of places that its semantics holds for one house."""
    assert all(heights[place] > 0 for group in groups for place in group)
    return [np.concatenate([house(place, heights[place]) for place in group]) for group in groups]


def objects(own, other):
    there = np.concatenate(other)
    found = []
    for number, xyz in enumerate(own):
        occupied_in_other = np.array([np.abs(there - p).max(axis=1).min() < 0.1 for p in xyz])
        yes = np.ones(len(xyz), dtype=bool)
        normal = np.tile([1.0, 0.0, 0.0], (len(xyz), 1))
        voxels = Voxels(
            np.full(len(xyz), number), xyz, normal, xyz[:, 2], yes, occupied_in_other, ~occupied_in_other
        )
        points = np.arange(len(xyz))
        found.append(ObjectInstance(number, Semantic.BUILDING, 0.9, points, voxels, 0.05, xyz))
    return found


def labels(heights, groups, matches):
    """Label of every place of a row, from the middles of the rows of the table."""
    sides = [row(h, g) for h, g in zip(heights, groups, strict=True)]
    before, after = objects(*sides), objects(*sides[::-1])
    changes = [
        decide_object([before[i] for i in b], [after[j] for j in a], Semantic.BUILDING, RULES)
        for b, a in matches
    ]
    return by_place(changes)


def by_place(changes):
    """Labels of every place of a row, once its houses are parted."""
    found = {}
    for change in split_row_houses(changes, RULES):
        xyz = np.concatenate([t.xyz for t in (*change.before, *change.after)])
        for place in np.unique(np.floor(xyz[:, 0] / WIDTH).astype(int)).tolist():
            found.setdefault(place, set()).add(change.decision.change)
    return [found[place] for place in sorted(found)]


GREW, SAME = {Change.INCREASED}, {Change.UNCHANGED}


def test_a_middle_house_that_each_epoch_holds_with_another_neighbour_grew_alone():
    before, after = (5.0, 3.5, 3.5), (5.0, 6.5, 3.5)
    told = labels((before, after), ([[0], [1, 2]], [[0, 1], [2]]), [((0,), (0,)), ((1,), (1,))])
    assert told == [SAME, GREW, SAME]


def test_a_storey_on_one_of_two_houses_that_neither_epoch_parts_is_of_that_house():
    told = labels(((4.0, 4.0), (4.0, 7.0)), ([[0, 1]], [[0, 1]]), [((0,), (0,))])
    assert told == [SAME, GREW]


@pytest.mark.parametrize("after", [(4.0, 4.0), (7.0, 7.0)])
def test_a_row_that_fared_alike_stays_as_it_was(after):
    told = labels(((4.0, 4.0), after), ([[0, 1]], [[0, 1]]), [((0,), (0,))])
    assert told == [GREW if after[0] > 4.0 else SAME] * 2


GONE, NEW = {Change.REMOVED}, {Change.ADDED}


@pytest.mark.parametrize(("before", "after", "middle"), [(5.0, 0.0, GONE), (0.0, 5.0, NEW)])
def test_a_house_in_the_middle_of_a_row_is_removed_or_added_and_its_neighbours_stay(before, after, middle):
    whole, parted = [[0, 1, 2]], [[0], [2]]
    heights = [(5.0, height, 5.0) for height in (before, after)]
    groups = [whole if height else parted for height in (before, after)]
    matches = [((0,), (0, 1))] if before else [((0, 1), (0,))]
    assert labels(tuple(heights), groups, matches) == [SAME, middle, SAME]


@pytest.mark.parametrize("earlier", [True, False])
def test_a_house_between_others_that_its_own_epoch_joins_with_one_of_them_has_a_row_of_its_own(earlier):
    """The other epoch holds two houses apart that the house between them joins into one row."""
    full, parted = ((5.0, 5.0, 5.0), [[0], [1, 2]]), ((5.0, 0.0, 5.0), [[0], [2]])
    heights, groups = zip(*((full, parted) if earlier else (parted, full)), strict=True)
    told = labels(heights, groups, [((0,), (0,)), ((1,), (1,))])
    assert told == [SAME, GONE if earlier else NEW, SAME]


@pytest.mark.parametrize("earlier", [True, False])
def test_a_fence_on_the_plot_of_a_house_that_is_gone_is_no_part_of_the_house(earlier):
    """The other epoch has a fence of 1.5 m in the gap, and the party walls of the neighbours."""
    full, parted = ((5.0, 5.0, 5.0), [[0, 1, 2]]), ((5.0, 1.5, 5.0), [[0], [1], [2]])
    heights, groups = zip(*((full, parted) if earlier else (parted, full)), strict=True)
    matches = [((0,), (0, 1, 2))] if earlier else [((0, 1, 2), (0,))]
    told = labels(heights, groups, matches)
    assert told[0] == told[2] == SAME
    assert (Change.REMOVED if earlier else Change.ADDED) in told[1]
    assert not told[1] & {Change.INCREASED, Change.DECREASED}


def test_the_wall_above_a_lower_neighbour_is_of_the_house_that_was_removed():
    heights = ((4.0, 8.0, 4.0), (4.0, 0.0, 4.0))
    assert labels(heights, ([[0, 1, 2]], [[0], [2]]), [((0,), (0, 1))]) == [SAME, GONE, SAME]


def test_what_is_gone_between_two_houses_is_of_their_row_and_a_part_of_one_house_is_of_none():
    before = objects(row((5.0, 5.0, 5.0), [[0], [1], [2]]), row((5.0, 0.0, 5.0), [[0], [2]]))
    left, gone, right = (([t], [t]) for t in before)
    gone = (gone[0], [])
    assert group_row_houses([left, right, gone], [False, False, True], RULES.association) == [[0, 1, 2]]
    assert group_row_houses([left, gone], [False, True], RULES.association) == [[0], [1]]


def test_a_part_built_onto_the_end_of_a_house_is_no_house_of_a_row():
    told = labels(((5.0, 0.0), (5.0, 5.0)), ([[0]], [[0, 1]]), [((0,), (0,))])
    assert told[0] == told[1]  # one row of the table
    assert Change.ADDED not in told[1]


def test_a_stretch_of_a_row_that_nobody_saw_is_no_house_that_was_removed():
    """The later epoch saw nothing of the middle house, free or not."""
    sides = [row((5.0, 5.0, 5.0), [[0, 1, 2]]), row((5.0, 5.0, 5.0), [[0], [2]])]
    before, after = objects(*sides), objects(*sides[::-1])
    hidden = before[0].voxels.occupied_in_other
    before = [
        replace(
            before[0],
            voxels=replace(before[0].voxels, observed=hidden, free_space_confirmed=hidden & ~hidden),
        )
    ]
    whole = decide_object(before, after, Semantic.BUILDING, RULES)
    found = split_row_houses([whole], RULES)
    assert Change.REMOVED not in {change.decision.change for change in found}


def test_in_a_long_row_that_neither_epoch_parts_each_house_between_changed_ones_has_a_row_of_its_own():
    """Each of eleven houses is a tenth of the row, less than a fragment of a match must be."""
    before = (5.0,) * 11
    after = tuple(8.0 if place % 2 else 5.0 for place in range(11))
    sides = [row(heights, [list(range(11))]) for heights in (before, after)]
    whole = decide_object(objects(*sides), objects(*sides[::-1]), Semantic.BUILDING, RULES)
    for change in split_row_houses([whole], RULES):
        x = np.concatenate([t.xyz[:, 0] for t in (*change.before, *change.after)])
        assert np.ptp(x) <= WIDTH + 2.0  # with the walls of its neighbours
    told = labels((before, after), ([list(range(11))],) * 2, [((0,), (0,))])
    assert all((Change.INCREASED in told[place]) == bool(place % 2) for place in range(11))


def test_a_house_at_the_end_of_a_row_that_the_other_epoch_did_not_see_does_not_hide_that_another_is_gone():
    sides = [row((5.0, 5.0, 5.0, 5.0), [[0, 1, 2], [3]]), row((5.0, 0.0, 5.0), [[0], [2]])]
    before, after = objects(*sides), objects(*sides[::-1])
    unseen = np.zeros(len(before[1].voxels), dtype=bool)
    hidden = replace(before[1].voxels, observed=unseen, free_space_confirmed=unseen)
    before[1] = replace(before[1], voxels=hidden)
    whole = decide_object(before, after, Semantic.BUILDING, RULES)
    found = by_place([whole])
    assert found[1] == GONE
    assert found[0] == found[2] == SAME
    assert not found[3] & {Change.REMOVED, Change.DECREASED}


def test_scaffolding_before_two_houses_makes_no_row_of_them():
    sides = row((5.0, 5.0), [[0], [1]])
    x, z = (a.ravel() for a in np.meshgrid(np.arange(1.25, 2 * WIDTH - 1, 0.5), np.arange(0.25, 5.0, 0.5)))
    scaffolding = np.column_stack([x, np.full(len(x), -0.25), z])
    left, right, new = objects([*sides, scaffolding], sides)

    def facing(house):
        front = np.where((house.xyz[:, 1] < 0.5)[:, None], (0.0, -1.0, 0.0), (1.0, 0.0, 0.0))
        return replace(house, voxels=replace(house.voxels, normal=front))

    new = replace(new, xyz=scaffolding)
    houses = [([h], [h]) for h in map(facing, (left, right))]
    claimed = [False, False, True]
    assert group_row_houses([*houses, ([], [new])], claimed, RULES.association) == [[0], [1], [2]]
    with rules_switched_off(["layers_before_walls"]):
        assert group_row_houses([*houses, ([], [new])], claimed, RULES.association) == [[0, 1, 2]]


@pytest.mark.parametrize("earlier", [True, False])
def test_a_garage_that_is_left_of_a_demolished_house_is_no_part_of_the_house(earlier):
    """The neighbour was built upon, so that the garage is all of the row that did not change."""
    garage = house(2, 3.5)
    garage = garage[(garage[:, 0] < 2 * WIDTH + 4.0) & (garage[:, 1] < 1.5)]
    full, left = np.concatenate([house(0, 4.0), house(1, 5.0), garage]), [house(0, 7.0), garage]
    sides = ([full], left) if earlier else (left, [full])
    before, after = objects(*sides), objects(*sides[::-1])
    told = by_place([decide_object(before, after, Semantic.BUILDING, RULES)])
    grew, gone = (Change.INCREASED, Change.REMOVED) if earlier else (Change.DECREASED, Change.ADDED)
    assert grew in told[0]
    assert gone in told[1]
    assert told[2] == SAME


@pytest.mark.parametrize("earlier", [True, False])
def test_a_few_points_of_a_party_wall_do_not_hide_that_a_house_of_a_pair_is_gone(earlier):
    """Its own epoch holds it apart; the pair is too narrow to be parted by what changed."""
    few = house(1, 5.0)
    few = few[(few[:, 0] < WIDTH + 0.5) & (np.abs(few[:, 2] - 3.0) < 1.0) & (few[:, 1] < 2.0)]
    full, left = [house(0, 5.0), house(1, 5.0)], [np.concatenate([house(0, 5.0), few])]
    assert len(few) < RULES.association.parts.points
    sides = (full, left) if earlier else (left, full)
    told = by_place([decide_object(objects(*sides), objects(*sides[::-1]), Semantic.BUILDING, RULES)])
    assert told[0] == SAME
    assert (Change.REMOVED if earlier else Change.ADDED) in told[1]


def between_houses(roof_alone=False):
    """A garage 0.45 m from the houses at places 0 to 1 and 3 of a row, or a roof on posts that meets both."""
    gap = 0.0 if roof_alone else 0.45
    x, y, z = np.linspace(12.0 + gap, 17.99 - gap, 11), np.arange(0.25, 6.0, 0.5), np.arange(0.25, 2.8, 0.5)
    xyz = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).reshape(-1, 3)
    roof, rim = xyz[:, 2] == z[-1], np.isin(xyz[:, 0], x[[0, -1]]) | np.isin(xyz[:, 1], y[[0, -1]])
    posts = np.isin(xyz[:, 0], x[[0, -1]]) & np.isin(xyz[:, 1], y[[0, -1]])
    made = xyz[roof | (posts if roof_alone else rim)]
    return made, np.where((made[:, 2] == z[-1])[:, None], (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))


def test_a_garage_built_onto_one_of_two_houses_is_not_divided_between_both():
    """It meets the left one, and its eaves those of the right one; a third house of the row was raised."""
    made = between_houses()[0] - (0.45, 0.0, 0.0)
    eaves = np.column_stack([np.full(12, 17.9), np.arange(0.25, 6.0, 0.5), np.full(12, 2.75)])
    old, new = (row((high, 5.0, 0.0, 5.0), [[0, 1], [3]]) for high in (5.0, 8.0))
    sides = (old, [*new, np.concatenate([made, eaves])])
    before, after = objects(*sides), objects(*sides[::-1])
    pairs = [([before[0]], [after[0]]), ([before[1]], [after[1]]), ([], [after[2]])]
    found = split_row_houses([decide_object(*pair, Semantic.BUILDING, RULES) for pair in pairs], RULES)
    assert len(found) > 2
    garage = [len(t.xyz) for c in found for t in c.after if 12 < t.xyz[:, 0].mean() < 18]
    assert garage == [len(made) + len(eaves)]


@pytest.mark.parametrize("roof_alone", [False, True], ids=["garage", "carport"])
@pytest.mark.parametrize("earlier", [False, True], ids=["new", "gone"])
def test_what_is_built_between_two_houses_has_a_row_of_its_own_though_a_third_one_was_raised(
    roof_alone, earlier
):
    """An open gap parts a garage from both houses; a carport meets both, with open ground below its roof."""
    made, normal = between_houses(roof_alone)
    old, new = (row((high, 5.0, 0.0, 5.0), [[0, 1], [3]]) for high in (5.0, 8.0))
    sides = (old, [*new, made])
    before, after = objects(*sides), objects(*sides[::-1])
    after[2] = replace(after[2], voxels=replace(after[2].voxels, normal=normal))
    x, y = (a.ravel() for a in np.meshgrid(np.arange(11.75, 18.5, 0.25), np.arange(0.0, 6.5, 0.25)))
    met = ground_columns(np.column_stack([x, y, np.zeros(len(x))]), 0.5)
    rules = replace(RULES, ground=OpenGround(*((met, NO_COLUMNS) if earlier else (NO_COLUMNS, met))))
    pairs = [([before[0]], [after[0]]), ([before[1]], [after[1]]), ([], [after[2]])]
    pairs = [pair[::-1] for pair in pairs] if earlier else pairs
    found = split_row_houses([decide_object(*pair, Semantic.BUILDING, rules) for pair in pairs], rules)
    own = [c for c in found if c.decision.change is (Change.REMOVED if earlier else Change.ADDED)]
    assert [len(t.xyz) for c in own for t in (*c.before, *c.after)] == [len(made)]
    raised = Change.DECREASED if earlier else Change.INCREASED
    assert sorted(c.decision.change for c in found if c not in own) == sorted(
        [raised, *2 * [Change.UNCHANGED]]
    )


@pytest.mark.parametrize(("width", "wide"), [(3.0, True), (1.0, False)], ids=["carport", "eaves"])
def test_a_new_roof_over_open_ground_is_claimed_though_it_encloses_nothing_and_eaves_are_none(width, wide):
    x, y = (a.ravel() for a in np.meshgrid(np.arange(0.25, 6.0, 0.5), np.arange(0.25, width, 0.5)))
    post = np.column_stack([np.full((5, 2), 0.25), np.arange(0.0, 2.5, 0.5)])
    roof = np.concatenate([np.column_stack([x, y, np.full(len(x), 2.6)]), post])
    (new,) = objects([roof], [roof + 50.0])
    normal = np.where(roof[:, 2:] > 2.5, (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
    new = replace(new, voxels=replace(new.voxels, normal=normal))
    met = ground_columns(np.column_stack([x, y, np.zeros(len(x))]), 0.5)
    seen = (
        lambda p: p[:, 2] > -1.0,
        lambda p: p[:, 2] < 2.3,
    )  # free: all of it before, the space below after
    rules = replace(RULES, ground=OpenGround(NO_COLUMNS, met, seen))
    assert is_roof_on_posts([], [new], rules) is wide
    if wide:
        assert decide_object([], [new], Semantic.BUILDING, rules).decision.change is Change.ADDED
    with rules_switched_off(["open_roofs"]):
        assert not is_roof_on_posts([], [new], rules)
        if wide:
            assert decide_object([], [new], Semantic.BUILDING, rules).decision.change is Change.UNOBSERVED
