"""What became of one house of a row is a change of that house, not of the row."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from random_houses import Box, Sensor, Street, compare, survey
from test_space_carving import sheet, walls_of
from test_space_carving import voxels as surfaces

from subiaco_change.instance_splitting.changed_houses import changed_houses
from subiaco_change.method_rules.switches import rules_switched_off
from subiaco_change.objects.voxel_objects import Voxels
from subiaco_geo.codes import Change

CELL, WIDTH, DEPTH = 0.5, 5.0, 9.0
VERANDAH = 2.0  # in front of all houses of a row [m]


def roofs(tops, other):
    """Voxels of a row along x, as far as a street shows them: roofs of these heights in every slot [m].

    Places of which the ``other`` epoch has a roof half a metre lower or higher, or none, were observed empty.
    """
    tops, other = np.asarray(tops), np.asarray(other)
    x = (np.arange(len(tops)) + 0.5) * CELL
    y = (np.arange(round(DEPTH / CELL)) + 0.5) * CELL
    height = np.where(y[None, :] < VERANDAH, 1.9, tops[:, None])
    same = np.where(y[None, :] < VERANDAH, other[:, None] > 0, np.abs(tops - other)[:, None] < 0.5)
    xyz = np.column_stack([np.repeat(x, len(y)), np.tile(y, len(x)), height.ravel()])
    up, yes = np.tile([0.0, 0.0, 1.0], (len(xyz), 1)), np.ones(len(xyz), dtype=bool)
    voxels = Voxels(np.zeros(len(xyz), dtype=int), xyz, up, xyz[:, 2], yes, same.ravel(), yes)
    return voxels.select(np.repeat(tops > 0, len(y)))


def houses(heights):
    return np.repeat(heights, round(WIDTH / CELL))


def changed(before, after, shown=lambda voxels: slice(None)):
    """Which places of a row, numbered from 0, are of a house that changed between two rows of tops [m]."""
    return changed_places(v.select(shown(v)) for v in (roofs(before, after), roofs(after, before)))


def changed_places(pair):
    """Which places of a row, numbered from 0, are of a house that changed between two epochs of voxels."""
    before, after = pair
    house = changed_houses(before, after)[1]
    x = np.concatenate([before.xyz[:, 0], after.xyz[:, 0]])[house > 0]
    return sorted(set((x // WIDTH).astype(int).tolist()))


@pytest.mark.parametrize("place", [0, 1, 2])
@pytest.mark.parametrize("sign", [1, -1], ids=["built", "taken off"])
def test_a_row_is_parted_at_the_walls_of_the_house_that_changed(place, sign):
    rows = houses((4.0, 4.0, 4.0)), houses(np.where(np.arange(3) == place, 6.8, 4.0))
    assert changed(*rows[::sign]) == [place]


@pytest.mark.parametrize("place", [0, 1, 2, 3])
@pytest.mark.parametrize("sign", [1, -1], ids=["built", "demolished"])
def test_a_house_that_stands_in_one_epoch_alone_is_parted_also_at_the_end_of_a_row(place, sign):
    rows = houses([4.0] * 4), houses(np.where(np.arange(4) == place, 0.0, 4.0))
    assert changed(*rows[::-sign]) == [place]


def test_the_walls_of_a_demolished_house_above_its_lower_neighbours_are_of_that_house():
    """Its walls stand in the outermost slots, in columns in which the lower neighbours have theirs."""
    before, after = houses((4.0, 4.0, 4.0)), houses((4.0, 0.0, 4.0))
    before[9:21] = 7.0  # the house and one slot of its walls on either side
    pair = roofs(before, after), roofs(after, before)
    house = changed_houses(*pair)[1][: len(pair[0])]
    above = pair[0].height > 6.0
    assert len(set(house[above].tolist())) == 1
    assert (house[above] > 0).all()


def test_a_lower_wing_at_the_end_of_a_row_is_no_house_of_the_row():
    assert changed(houses((4.0, 4.0, 4.0, 0.0)), houses((4.0, 4.0, 4.0, 2.8))) == []


@pytest.mark.parametrize(("top", "places"), [(3.0, []), (4.0, [1])], ids=["garage", "house"])
@pytest.mark.parametrize("sign", [1, -1], ids=["built", "demolished"])
def test_what_fills_the_gap_between_two_houses_and_is_as_low_as_a_garage_is_no_house(top, places, sign):
    rows = houses((4.5, 0.0, 4.5)), houses((4.5, top, 4.5))
    assert changed(*rows[::sign]) == places


@pytest.mark.parametrize("sign", [1, -1], ids=["built", "demolished"])
@pytest.mark.parametrize(
    ("front", "is_house"), [(4.0, True), (6.0, True), (2.8, False)], ids=["as high", "higher", "lower"]
)
def test_a_house_at_the_end_of_a_row_is_as_high_as_the_fronts_that_were_seen_of_it(front, is_house, sign):
    """Its roof shows, and rises by 2 m behind its front; of its neighbours no roof was seen."""
    before, after = houses([4.0] * 4), houses([4.0, 4.0, 4.0, 0.0])

    def shown(voxels):
        end, depth = voxels.xyz[:, 0] > 3 * WIDTH, voxels.xyz[:, 1] - VERANDAH
        height = np.where(end & (depth > 0), front + np.where(depth > 1.0, 2.0, 0.0), voxels.height)
        xyz = np.column_stack([voxels.xyz[:, :2], height])
        return replace(voxels, xyz=xyz, height=height).select(end | (depth < 1.0))

    pair = shown(roofs(before, after)), shown(roofs(after, before))
    assert changed_places(pair[::-sign]) == ([3] if is_house else [])


def test_fronts_of_which_no_column_is_seen_in_most_slots_are_compared_by_their_tops():
    """The front of the row recedes by a column in every slot, up to the end house."""
    before, after = houses([4.0] * 4), houses([4.0, 4.0, 4.0, 0.0])

    def shown(voxels):
        slot, column = (np.floor(voxels.xyz[:, k] / CELL) for k in (0, 1))
        return (voxels.xyz[:, 0] > 3 * WIDTH) | (column == VERANDAH / CELL + slot % 14)

    assert changed(after, before, shown) == [3]


@pytest.mark.parametrize("sign", [1, -1], ids=["built", "demolished"])
@pytest.mark.parametrize(
    ("gap", "top", "width", "is_house"),
    [(1.5, 7.0, 6.0, True), (0.0, 7.0, 6.0, False), (1.5, 2.8, 6.0, False), (1.5, 7.0, 4.0, False)],
    ids=["apart", "touching", "garage", "narrow"],
)
def test_what_stands_apart_from_the_garage_of_a_house_is_a_house_of_its_own(gap, top, width, is_house, sign):
    sizes = np.array([10.0, 4.0, gap, width])
    rows = [np.repeat([5.0, 2.8, 0.0, end], np.round(sizes / CELL).astype(int)) for end in (0.0, top)]
    assert bool(changed(*rows[::sign])) == is_house


@pytest.mark.parametrize(("width", "is_house"), [(3.5, False), (5.0, True)])
def test_a_narrow_part_at_the_end_of_a_row_may_be_an_extension_though_as_high_as_the_row(width, is_house):
    slots = round(width / CELL)
    rows = [np.concatenate([houses((4.0, 4.0, 4.0)), np.full(slots, top)]) for top in (0.0, 4.0)]
    assert changed(*rows) == ([3] if is_house else [])


def test_a_half_of_a_pair_is_a_house_and_a_shorter_part_of_a_house_is_not():
    before = np.full(28, 6.0)
    half, part = before.copy(), before.copy()
    half[14:], part[17:] = 0.0, 0.0
    assert set(changed(before, half)) == {1, 2}
    assert changed(before, part) == []
    assert changed(before[:24], np.where(np.arange(24) < 12, 6.0, 0.0)) == []  # as high as wide
    assert changed(before[:24] + 1.0, np.where(np.arange(24) < 12, 7.0, 0.0)) == [1, 2]  # higher than wide
    assert changed(before[:20], np.where(np.arange(20) < 10, 6.0, 0.0)) == []  # a house that lost its half


@pytest.mark.parametrize("sign", [1, -1], ids=["built", "taken off"])
def test_a_house_that_rose_beside_its_own_carport_is_no_house_of_a_row(sign):
    for beside, places in ((2.6, []), (4.6, [0, 1])):
        rows = [np.repeat([top, beside], [20, 12]) for top in (5.0, 7.5)]
        assert changed(*rows[::sign]) == places


@pytest.mark.parametrize("sign", [1, -1], ids=["built", "taken off"])
def test_a_house_of_which_hardly_anything_was_seen_to_rise_in_its_middle_is_one_house(sign):
    """All of its top rose, but most of the middle was hidden from the other epoch."""
    before, after = np.full(36, 5.0), np.full(36, 7.5)

    def shown(voxels):
        middle = (voxels.xyz[:, 0] >= 6.0) & (voxels.xyz[:, 0] < 12.0)
        return ~middle | (voxels.height < 3.0) | (voxels.xyz[:, 1] > DEPTH - CELL)

    assert changed(*(before, after)[::sign], shown) == []


def detached(tall, storey):
    """A house with a verandah: facade, one side, and what of a set-back ``storey`` [m] stands on it."""

    def facing(voxels, normal):
        return replace(voxels, normal=np.tile(normal, (len(voxels), 1)))

    front, side = (0.0, -1.0, 0.0), (1.0, 0.0, 0.0)
    verandah = surfaces(sheet((0, -2.5, 2.5), (12, 0, 3)))
    facade = facing(surfaces(sheet((0, 0, 0), (12, CELL, tall))), front)
    wall = facing(surfaces(sheet((0, CELL, 0), (CELL, 10, tall))), side)
    parts = [verandah, facade, wall]
    if storey:
        kinds = {"occupied_in_other": False}
        set_back = sheet((CELL, 2, tall), (12, 2 + CELL, tall + storey))
        parts.append(facing(surfaces(set_back, **kinds), front))
        parts.append(facing(surfaces(sheet((0, 2, tall), (CELL, 10, tall + storey)), **kinds), side))
    return Voxels.joined(parts)


@pytest.mark.parametrize("sign", [1, -1], ids=["built", "taken off"])
def test_the_facade_of_a_house_that_was_built_upon_behind_it_is_no_house_beside_it(sign):
    """Seen from its side, a facade with its verandah is as deep as a house of a row is wide."""
    pair = (detached(4.0, 0.0), detached(4.0, 2.5))[::sign]
    assert not changed_houses(*pair)[1].any()


def fronts(tops, other):
    """Voxels of a row of tall houses: of fronts the ``other`` epoch saw free what exceeds its own tops.

    The roofs behind them were not observed by the other epoch.
    """
    above = roofs(tops, other)
    x, z = (a.ravel() for a in np.meshgrid((np.arange(len(tops)) + 0.5) * CELL, np.arange(0.25, 20.0, CELL)))
    slot = (x / CELL).astype(int)
    xyz = np.column_stack([x, np.full(len(x), CELL / 2), z])[z < tops[slot]]
    same = (z < other[slot])[z < tops[slot]]
    yes = np.ones(len(xyz), dtype=bool)
    front = Voxels(
        np.zeros(len(xyz), int), xyz, np.tile([0.0, -1.0, 0.0], (len(xyz), 1)), xyz[:, 2], yes, same, yes
    )
    return replace(above, observed=np.zeros(len(above), dtype=bool)).add(front)


def beside_a_raised_house(front, top, house=12.0):
    """A house that rose by 3 m, and a building of a front and a top [m] that was built beside it."""
    wall = round(house / CELL)
    before, after = (np.full(wall + round(front / CELL), height) for height in (12.0, 15.0))
    before[wall:], after[wall:] = 0.0, top
    return fronts(before, after), fronts(after, before)


@pytest.mark.parametrize("sign", [1, -1], ids=["built", "demolished"])
@pytest.mark.parametrize(("top", "house"), [(19.0, 12.0), (11.0, 12.0), (15.0, 17.0)])
def test_a_tall_building_beside_a_house_that_rose_or_fell_is_a_house(top, house, sign):
    pair = beside_a_raised_house(11.0, top, house)[::sign]
    changed_one = changed_houses(*pair)[1] > 0
    x = np.concatenate([voxels.xyz[:, 0] for voxels in pair])
    assert changed_one[x > house].all()
    assert not changed_one[x < house - 1.0].any()


@pytest.mark.parametrize(("front", "top"), [(6.0, 15.0), (11.0, 8.0)], ids=["narrow", "low"])
def test_a_narrow_or_low_part_beside_a_house_that_rose_is_an_extension(front, top):
    assert not changed_houses(*beside_a_raised_house(front, top))[1].any()


def lowered(share):
    """Voxels of a row of which the later epoch shows a verandah of the middle house, and nothing above.

    The later epoch saw this share free of what stood there.
    """
    before, after = houses((6.8, 6.8, 6.8)), houses((6.8, 4.0, 6.8))
    pair = roofs(before, after), roofs(after, before)
    above = [(v.xyz[:, 0] // WIDTH == 1) & (v.height > VERANDAH) for v in pair]
    free = np.random.default_rng(1).uniform(size=len(pair[0])) < share
    old = replace(pair[0], occupied_in_other=pair[0].occupied_in_other | (above[0] & ~free))
    return old, pair[1].select(~above[1])


@pytest.mark.parametrize("sign", [1, -1], ids=["taken off", "built"])
def test_a_house_that_was_lowered_is_parted_also_where_nothing_above_its_foot_was_seen(sign):
    assert changed_places(lowered(1.0)[::sign]) == [1]


def test_a_house_of_which_most_was_seen_to_stand_was_not_lowered():
    assert changed_places(lowered(0.3)) == []


def test_a_house_was_taken_from_a_row_also_where_its_neighbour_was_hidden_beside_it():
    before, after = houses([4.0] * 5), houses((4.0, 4.0, 0.0, 4.0, 4.0))
    after[30:32] = 0.0
    before[30:32] = 0.0
    assert changed(before, after) == [2]


def with_wing(count, width=WIDTH, depth=DEPTH):
    """A row of houses, seen so deep [m], and that row with a wing of two storeys before the third of them."""
    before, after = (roofs(houses([4.0] * count), houses([4.0] * count)) for _ in range(2))
    before, after = (v.select(v.xyz[:, 1] < VERANDAH + depth) for v in (before, after))
    x, z = (
        a.ravel() for a in np.meshgrid(2 * WIDTH + np.arange(0.25, width, CELL), np.arange(0.25, 5.0, CELL))
    )
    xyz = np.column_stack([x, np.full(len(x), -2.0), z])
    yes = np.ones(len(xyz), dtype=bool)
    wing = Voxels(np.zeros(len(xyz), int), xyz, np.tile([0.0, -1.0, 0.0], (len(xyz), 1)), z, yes, ~yes, yes)
    return before, after.add(wing)


def test_a_wing_before_a_house_of_a_long_row_is_of_that_house():
    before, after = with_wing(6)
    house = changed_houses(before, after)[1]
    x = np.concatenate([v.xyz[:, 0] for v in (before, after)])[house > 0]
    assert set((x // WIDTH).astype(int).tolist()) == {2}
    assert np.count_nonzero(house[: len(before)]) > 0
    with rules_switched_off(["parts_of_long_buildings"]):
        assert not changed_houses(before, after)[1].any()


@pytest.mark.parametrize(
    "case", [(3,), (6, 2.0), (6, WIDTH, 1.5)], ids=["a short building", "a narrow part", "a facade alone"]
)
def test_no_part_of_a_short_building_or_facade_and_no_narrow_part_is_an_object_of_its_own(case):
    assert not changed_houses(*with_wing(*case))[1].any()


def test_what_was_taken_down_between_a_house_and_its_garage_is_a_part_of_the_house():
    assert changed(houses((2.4, 4.0, 4.0)), houses((2.4, 0.0, 4.0))) == []


def test_of_two_neighbours_that_fared_differently_each_is_a_house():
    before, after = houses([4.0] * 5), houses((4.0, 6.8, 0.0, 4.0, 4.0))
    house = changed_houses(roofs(before, after), roofs(after, before))[1]
    assert len(set(house.tolist())) == 3


def test_of_a_house_that_was_seen_to_its_front_alone_the_storey_shows_in_its_front():
    """A lower verandah stands in front of it."""
    before, after = houses((4.0, 4.0, 4.0)), houses((4.0, 6.8, 4.0))
    assert changed(
        before, after, lambda v: (v.xyz[:, 0] // WIDTH != 1) | (v.xyz[:, 1] < VERANDAH + CELL)
    ) == [1]


def test_scaffolding_before_one_house_of_a_row_does_not_hide_that_its_neighbour_rose():
    """All houses have a balcony before the front, and the scaffolding stands around that of the first."""
    tops = houses((4.0, 4.0, 4.0)), houses((4.0, 6.8, 4.0))
    fronts = walls_of(surfaces(sheet((0, -CELL / 2, 0), (3 * WIDTH, CELL / 2, 4))))
    both = fronts.add(surfaces(sheet((0, -1.5, 2), (3 * WIDTH, -1, 2.5))))
    scaffolding = surfaces(sheet((0, -1.5, 2.5), (WIDTH - 1, -1, 4)), occupied_in_other=False)
    row = roofs(*tops).add(both), roofs(*tops[::-1]).add(both)
    assert changed_places((row[0].add(scaffolding), row[1])) == [1]
    with rules_switched_off(("layers_before_walls",)):
        assert changed_places((row[0].add(scaffolding), row[1])) != [1]


def test_a_roof_that_rose_by_more_than_a_building_must_change_parts_its_house():
    assert changed(houses((4.0, 4.0, 4.0)), houses((4.0, 4.9, 4.0))) == [1]


def test_a_front_that_rose_shows_also_where_one_survey_saw_much_more_behind_it():
    """The fronts are 6 m high, the middle one 6.6 m later; the roofs behind them were seen later alone."""
    tops = houses((6.0, 6.0, 6.0)), houses((6.0, 6.6, 6.0))
    before, after = (v.select(v.xyz[:, 1] < CELL) for v in (fronts(*tops), fronts(*tops[::-1])))
    behind = roofs(tops[1], tops[1])
    behind = behind.select(behind.xyz[:, 1] > VERANDAH)
    seen = replace(behind, occupied_in_other=np.ones(len(behind), dtype=bool))
    assert changed_places((before, after.add(seen))) == [1]


@pytest.mark.parametrize("sign", [1, -1], ids=["built", "taken off"])
@pytest.mark.parametrize(("storey", "places"), [(6.8, [1]), (4.5, [])], ids=["a storey", "no storey"])
def test_a_storey_that_stands_back_behind_the_front_of_a_house_is_of_that_house(storey, places, sign):
    """Of all houses the street shows the front alone; of the middle one later also the wall of the storey."""
    before, after = (v.select(v.xyz[:, 1] < CELL) for v in [fronts(houses([4.0] * 3), houses([4.0] * 3))] * 2)
    x, z = (
        a.ravel() for a in np.meshgrid(WIDTH + np.arange(0.25, WIDTH, CELL), np.arange(2.25, storey, CELL))
    )
    xyz = np.column_stack([x, np.full(len(x), 2.25), z])
    yes = np.ones(len(xyz), dtype=bool)
    wall = Voxels(np.zeros(len(xyz), int), xyz, np.tile([0.0, -1.0, 0.0], (len(xyz), 1)), z, yes, ~yes, yes)
    assert changed_places((before, after.add(wall))[::sign]) == places


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ((4.0, 4.0, 4.0), (6.8, 6.8, 6.8)),
        ((4.0, 4.0, 4.0), (5.5, 7.0, 5.5)),
        ((4.0, 4.0, 4.0), (4.0, 4.3, 4.0)),
        ((4.0, 4.0, 4.0), (4.0, 4.0, 4.0)),
    ],
    ids=["all rose", "neighbours rose too", "a roof made anew", "nothing"],
)
def test_what_is_no_change_of_one_house_parts_nothing(before, after):
    assert changed(houses(before), houses(after)) == []


def test_an_upper_floor_that_ends_in_a_slope_belongs_to_the_house_below():
    sloped = np.interp(np.arange(30) + 0.5, [0, 6, 13, 17, 24, 30], [4.0, 4.0, 6.8, 6.8, 4.0, 4.0])
    assert changed(houses((4.0, 4.0, 4.0)), sloped) == []


@cache
def drives(raised):
    """A row of three houses before and after one of them is raised by a storey."""
    heights = (3.2, 3.2, 3.2)
    rows = [
        tuple(
            Box(-9.0 + 6.0 * k, 8.0, 6.0, 9.0, h + (2.8 if k == up else 0.0)) for k, h in enumerate(heights)
        )
        for up in (None, raised)
    ]
    sensors = Sensor(beams=96), Sensor(beams=96, lane=0.7)
    return [
        survey(Street(row), sensor, seed)
        for seed, (row, sensor) in enumerate(zip(rows, sensors, strict=True))
    ]


@pytest.mark.parametrize("raised", [1, 2])
def test_of_a_row_of_three_houses_the_one_that_was_raised_has_a_row_of_its_own(raised):
    found = compare(*drives(raised), "observed")
    told = [c.decision.change for c in found]
    assert told.count(Change.INCREASED) == 1
    assert set(told) == {Change.INCREASED, Change.UNCHANGED}
    house = found[told.index(Change.INCREASED)]
    x = np.concatenate([t.voxels.xyz[:, 0] for t in (*house.before, *house.after)])
    low, high = -9.0 + 6.0 * raised, -3.0 + 6.0 * raised
    assert ((x > low - 0.6) & (x < high + 0.6)).mean() > 0.97


def test_a_house_built_over_the_remains_of_a_wall_is_new():
    """A wall of 4 m stood where a house of 12 m now has its front: they overlap too little to compare."""
    wall, house = Box(-6.0, 8.0, 4.0, 0.4, 1.8), Box(-6.0, 8.0, 12.0, 9.0, 6.0)
    before, after = (survey(Street((box,)), Sensor(beams=96), seed) for seed, box in enumerate((wall, house)))
    built = {c.decision.change for c in compare(before, after, "observed") if c.after}
    taken = {c.decision.change for c in compare(after, before, "observed") if c.before}
    assert (built, taken) == ({Change.ADDED}, {Change.REMOVED})
