"""Space carving of buildings: what was seen bounds what can have changed."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from subiaco_change.method_rules.switches import rules_switched_off
from subiaco_change.objects.carving_config import CarvingConfig
from subiaco_change.objects.space_carving import CarvingEpoch, carve
from subiaco_change.objects.voxel_objects import Voxels

CELL = 0.5
LENGTH, DEPTH, TALL = 10.0, 8.0, 3.0
CONFIG = CarvingConfig()


def sheet(low, high):
    """Middles of the voxels of a box."""
    axes = [np.arange(a, b, CELL) + CELL / 2 for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def voxels(*sheets, occupied_in_other=True):
    xyz = np.concatenate([np.zeros((0, 3)), *sheets])
    count = len(xyz)
    flags = [np.full(count, value) for value in (True, occupied_in_other, False)]
    return Voxels(np.zeros(count, np.int64), xyz, np.tile([0.0, 0.0, 1.0], (count, 1)), xyz[:, 2], *flags)


def walls_of(sheets):
    """The voxels with the normals of walls that face the street."""
    return replace(sheets, normal=np.tile([0.0, -1.0, 0.0], (len(sheets), 1)))


def inside(*boxes):
    """Tell places that lie in a box (low, high), a hand's breadth of it taken off."""

    def told(xyz):
        return np.any([((xyz > low) & (xyz < high)).all(axis=1) for low, high in boxes], axis=0)

    return told


def nowhere(xyz):
    return np.zeros(len(xyz), dtype=bool)


def nothing_met(xy):
    return np.zeros(len(xy), dtype=bool)


def house(tall=TALL, east=True):
    """Front wall and side walls; the street lies at y < 0 and sees neither roof nor back."""
    walls = [sheet((0, 0, 0), (LENGTH, CELL, tall)), sheet((0, CELL, 0), (CELL, DEPTH, tall))]
    return [*walls, sheet((LENGTH - CELL, CELL, 0), (LENGTH, DEPTH, tall))] if east else walls


def wing(width=4.0, depth=5.0, side=True):
    """A wing on the east: its front wall, and its side wall where it was seen."""
    walls = [sheet((LENGTH, 1, 0), (LENGTH + width, 1 + CELL, TALL))]
    if side:
        walls.append(sheet((LENGTH + width - CELL, 1 + CELL, 0), (LENGTH + width, 1 + depth, TALL)))
    return walls


HIGH = 20.0
OUT = {
    "street": ((-9, -9, 0), (30, 0, HIGH)),
    "west": ((-9, -9, 0), (0, 30, HIGH)),
    "above": ((-9, -9, TALL), (30, 30, HIGH)),
    "east": ((LENGTH, -9, 0), (30, 30, HIGH)),
    "east of the wing": ((LENGTH + 4.0, -9, 0), (30, 30, HIGH)),
    "before the wing": ((LENGTH, -9, 0), (30, 1, HIGH)),
}


def seen(*names):
    return inside(*(OUT[name] for name in names))


PLAIN = seen("street", "west", "above", "east")


def epoch(sheets, empty, occupied_in_other=True):
    return CarvingEpoch(voxels(*sheets, occupied_in_other=occupied_in_other), empty, nothing_met)


def extended(side=True, gone=()):
    """The house with a new wing, which hides the wall of the house behind it."""
    old, new = voxels(*house(east=False)), voxels(*wing(side=side), occupied_in_other=False)
    known = [n for n in ("street", "west", "above", "east of the wing", "before the wing") if n not in gone]
    return CarvingEpoch(old.add(new), seen(*known), nothing_met)


def test_a_house_that_both_saw_alike_has_not_changed_by_more_than_the_resolution():
    found = carve(epoch(house(), PLAIN), epoch(house(), PLAIN), CONFIG)
    assert (found.volume.low, found.volume.high) == (0.0, 0.0)
    half = 0.25 * CONFIG.cell
    assert (found.height.low, found.height.high) == pytest.approx((-half, half))
    assert found.resolution == pytest.approx(half * LENGTH * DEPTH, rel=0.2)


@pytest.mark.parametrize("rise", [0.02, 0.06, 0.12])
def test_a_rise_below_the_resolution_lies_within_the_stated_bounds(rise):
    before, after = epoch(house(), PLAIN), epoch(house(), PLAIN)
    raised = replace(after.voxels, height=after.voxels.height + rise)
    found = carve(before, replace(after, voxels=raised), CONFIG)
    assert found.height.low <= rise <= found.height.high
    assert found.volume.widened(found.resolution).high >= 0.9 * rise * LENGTH * DEPTH


def lifted_roof(lift, width=LENGTH):
    """A house with a flat roof, of which the part up to a width is lifted; the sky above was seen."""
    roof = sheet((0, 0, TALL), (LENGTH, DEPTH, TALL + CELL)) - [0, 0, CELL / 2]
    roof[roof[:, 0] < width, 2] += lift

    def empty(xyz):
        top = TALL + np.where(xyz[:, 0] < width, lift, 0.0)
        over = ((xyz[:, :2] > 0) & (xyz[:, :2] < (LENGTH, DEPTH))).all(axis=1)
        return ~over | (xyz[:, 2] > top)

    return epoch([*house(), roof], empty)


@pytest.mark.parametrize("lift", [0.3, 0.45, 0.6, 0.7])
def test_a_roof_that_was_lifted_by_less_than_what_is_carved_changed_its_volume(lift):
    found = carve(lifted_roof(0.0), lifted_roof(lift), CONFIG)
    assert found.gained.low == pytest.approx(lift * LENGTH * DEPTH, rel=0.1)
    assert found.lost.high == 0.0
    stated = found.volume.widened(found.resolution)
    assert stated.low <= lift * LENGTH * DEPTH <= stated.high
    back = carve(lifted_roof(lift), lifted_roof(0.0), CONFIG)
    assert back.lost.low == pytest.approx(lift * LENGTH * DEPTH, rel=0.1)
    assert back.gained.high == 0.0


def test_a_step_over_less_than_half_of_a_roof_is_no_change_of_its_volume():
    found = carve(lifted_roof(0.0), lifted_roof(0.45, width=0.4 * LENGTH), CONFIG)
    assert (found.gained.high, found.lost.high) == (0.0, 0.0)


def test_of_a_lifted_roof_of_which_half_was_seen_the_rest_may_have_risen_as_much():
    seen_half = sheet((0, 0, TALL), (LENGTH, DEPTH / 2, TALL + CELL)) - [0, 0, CELL / 2]
    before, after = (
        replace(lifted_roof(lift), voxels=voxels(*house(), np.add(seen_half, [0, 0, lift])))
        for lift in (0.0, 0.45)
    )
    found = carve(before, after, CONFIG)
    assert found.gained.low == pytest.approx(0.5 * 0.45 * LENGTH * DEPTH, rel=0.2)
    assert found.gained.high >= 0.8 * 0.45 * LENGTH * DEPTH


def test_a_wing_five_metres_deep_of_which_two_walls_were_seen_has_its_volume():
    """Neither its roof nor the house wall behind it was seen: the walls enclose it."""
    found = carve(epoch(house(), PLAIN), extended(), CONFIG)
    assert 0.8 * 4 * 5 * TALL < found.volume.low <= 4 * 5 * TALL
    assert found.height.low <= 0.0 <= found.height.high


@pytest.mark.parametrize(("wide", "deep"), [(CELL, 0.55), (2 * CELL, 0.45)], ids=["a line", "a sheet"])
def test_from_a_line_or_a_sheet_of_cells_that_was_seen_free_nothing_else_counts_as_lost(wide, deep):
    """Along the eave of the house beams met cells that the other survey holds; its rooms are unknown.

    A sheet of a single cell is the resolution of a roof: half of the limit on a change of height.
    """
    eave = ((LENGTH - wide, 1.0, TALL - deep), (30, 6.0, HIGH))
    lower = [wall[~((wall[:, 0] > LENGTH - wide) & (wall[:, 2] > TALL - CELL))] for wall in house()]
    roof = voxels(sheet((0, 0, TALL - CELL), (LENGTH, DEPTH, TALL)), occupied_in_other=False)
    before = CarvingEpoch(voxels(*house()).add(roof), PLAIN, nothing_met)
    after = CarvingEpoch(voxels(*lower), inside(OUT["street"], OUT["west"], eave), nothing_met)
    assert carve(before, after, CONFIG).volume.low == 0.0
    assert carve(after, before, CONFIG).volume.high == 0.0
    with rules_switched_off(("lines_of_cells",)):
        assert carve(before, after, CONFIG).volume.low < -0.5 * LENGTH * DEPTH * TALL


def test_a_surface_whose_place_the_other_survey_did_not_observe_is_no_change_of_volume():
    """Beams passed between the voxels of a wall that only one survey met: its cells look free."""
    before, after = epoch(house(), PLAIN), extended()
    found = carve(before, after, CONFIG)
    assert found.volume.low > 0
    assert found.confirmed == (0, 0)
    known = replace(walls_of(after.voxels), free_space_confirmed=~after.voxels.occupied_in_other)
    gained, lost = carve(before, replace(after, voxels=known), CONFIG).confirmed
    assert gained > 50
    assert lost == 0
    unseen = replace(after.voxels, observed=after.voxels.occupied_in_other)
    found = carve(before, replace(after, voxels=unseen), CONFIG)
    assert found.volume.low == 0.0
    assert found.volume.high > 0.0


def test_behind_a_single_wall_the_depth_is_open():
    found = carve(epoch(house(), PLAIN), extended(side=False), CONFIG)
    assert found.volume.low < 0.25 * 4 * 5 * TALL
    assert found.volume.high >= 4 * 5 * TALL


def test_a_new_fence_beside_a_house_encloses_nothing():
    """The wall of the house stood before, so it is no wall of what is new; the fence is lower than a room."""
    before = epoch(house(), PLAIN)
    for tall in (1.8, TALL):
        fence = voxels(sheet((LENGTH, 1, 0), (LENGTH + 4, 1 + CELL, tall)), occupied_in_other=False)
        seen_now = seen("street", "west", "above", "before the wing", "east of the wing")
        found = carve(before, CarvingEpoch(voxels(*house()).add(fence), seen_now, nothing_met), CONFIG)
        assert found.volume.low < 0.1 * found.whole


CANOPY = ((0, -2.5, TALL - 0.6), (LENGTH, 0, TALL - 0.2))  # before the front wall, on nothing


def test_a_canopy_that_one_survey_missed_takes_no_volume_with_it():
    """The survey that has the canopy looked through below it; the other, of fewer beams, above it too."""
    under = inside(((-9, -9, 0), (30, 0, TALL - 0.6)), *(OUT[n] for n in ("west", "above", "east")))
    has = CarvingEpoch(
        voxels(*house()).add(voxels(sheet(*CANOPY), occupied_in_other=False)), under, nothing_met
    )
    found = carve(has, epoch(house(), PLAIN), CONFIG)
    assert found.volume.high == 0.0
    assert found.volume.low > -0.15 * found.whole


def test_the_volume_of_a_house_of_which_the_street_sees_half_a_roof_is_that_of_the_whole():
    """Under a pitched roof with its ridge along the street: 10 by 8 m, 3 m at the eaves, 5 m at the ridge."""
    deep = np.arange(CELL / 2, DEPTH, CELL)
    rise = TALL + 2.0 - 0.5 * np.abs(deep - DEPTH / 2)
    gables = [
        sheet((x, y - CELL / 2, 0), (x + CELL, y + CELL / 2, top))
        for x in (0, LENGTH - CELL)
        for y, top in zip(deep, rise, strict=True)
    ]
    roof = np.array(
        [
            (x, y, top)
            for x in np.arange(CELL / 2, LENGTH, CELL)
            for y, top in zip(deep, rise, strict=True)
            if y < DEPTH / 2
        ]
    )
    both = epoch([sheet((0, 0, 0), (LENGTH, CELL, TALL)), *gables, roof], seen("street"))
    found = carve(both, both, CONFIG)
    assert found.whole == pytest.approx(LENGTH * DEPTH * 4.0, rel=0.06)


@pytest.mark.parametrize(("seen", "share"), [(True, 0.0), (False, 1.0)])
def test_scaffolding_before_a_wall_that_both_surveys_saw_is_no_volume(seen, share):
    """1.5 m deep along the front, 3 m high; behind a wing of that size the later survey sees no wall."""
    front = walls_of(voxels(sheet((0, 0, 0), (LENGTH, CELL, TALL)), occupied_in_other=seen))
    rest = voxels(sheet((0, CELL, TALL - CELL), (LENGTH, DEPTH, TALL)))
    layer = voxels(sheet((0, -1.5, 0), (LENGTH, 0, TALL)), occupied_in_other=False)
    before = CarvingEpoch(front.add(rest), PLAIN, nothing_met)
    street = ((-9, -9, 0), (30, -1.5, HIGH))
    around = inside(street, OUT["west"], OUT["above"], OUT["east"])
    after = CarvingEpoch((front.add(rest) if seen else rest).add(layer), around, nothing_met)
    whole = share * 1.5 * LENGTH * TALL
    assert carve(before, after, CONFIG).volume.low == pytest.approx(whole, abs=0.2 * whole)
    assert carve(after, before, CONFIG).volume.high == pytest.approx(-whole, abs=0.2 * whole)
    with rules_switched_off(("layers_before_walls",)):
        assert carve(before, after, CONFIG).volume.low > 0.8 * 1.5 * LENGTH * TALL


def test_a_storey_behind_the_scaffolding_by_which_it_was_built_has_its_volume():
    front = walls_of(voxels(sheet((0, 0, 0), (LENGTH, CELL, TALL))))
    roof = voxels(sheet((0, CELL, TALL - CELL), (LENGTH, DEPTH, TALL)))
    top = 3 * TALL
    storeys = [sheet((0, 0, TALL), (LENGTH, CELL, top)), sheet((0, CELL, top - CELL), (LENGTH, DEPTH, top))]
    layer = sheet((0, -1.5, 0), (LENGTH, 0, TALL))
    new = voxels(*storeys, layer, occupied_in_other=False)
    sides = [inside(((-9, -9, 0), (30, y, HIGH)), OUT["west"], OUT["east"]) for y in (0, -1.5)]
    above = [inside(((-9, -9, z), (30, 30, HIGH))) for z in (TALL, top)]
    before, after = (
        CarvingEpoch(own, lambda xyz, a=a, b=b: a(xyz) | b(xyz), nothing_met)
        for own, a, b in zip((front.add(roof), front.add(new)), sides, above, strict=True)
    )
    storey = LENGTH * DEPTH * (top - TALL)
    assert 0.8 * storey < carve(before, after, CONFIG).volume.low <= storey


def test_a_wing_hides_room_though_most_of_it_lies_close_before_a_wall_that_was_seen_through_its_windows():
    """Its front lies 2.5 m before the wall, further than that of scaffolding does."""
    deep = 2.5
    front = walls_of(voxels(sheet((0, 0, 0), (LENGTH, CELL, TALL))))
    rest = voxels(sheet((0, CELL, TALL - CELL), (LENGTH, DEPTH, TALL)))
    sides = [sheet((x, CELL - deep, 0), (x + CELL, 0, TALL)) for x in (0, LENGTH - CELL)]
    new = voxels(sheet((0, -deep, 0), (LENGTH, CELL - deep, TALL)), *sides, occupied_in_other=False)
    before = CarvingEpoch(front.add(rest), PLAIN, nothing_met)
    around = inside(((-9, -9, 0), (30, -deep, HIGH)), OUT["west"], OUT["above"], OUT["east"])
    after = CarvingEpoch(front.add(rest).add(new), around, nothing_met)
    assert carve(before, after, CONFIG).volume.low == pytest.approx(deep * LENGTH * TALL, rel=0.2)
    assert carve(after, before, CONFIG).volume.high == pytest.approx(-deep * LENGTH * TALL, rel=0.2)


def test_a_mansard_above_the_front_of_a_flat_roof_that_nobody_saw_is_no_layer_before_the_front():
    """The earlier survey saw free space behind the parapet, and not the roof."""
    high, roof = 5 * CELL, TALL - 2 * CELL
    front = walls_of(voxels(sheet((0, 0, 0), (LENGTH, CELL, TALL))))
    slope = voxels(sheet((0, CELL, TALL), (LENGTH, 1.5, TALL + high)), occupied_in_other=False)
    sides = [inside(OUT["street"], OUT["west"], ((-9, -9, z), (30, 30, HIGH))) for z in (roof, TALL + high)]
    before = CarvingEpoch(front, sides[0], nothing_met)
    after = CarvingEpoch(front.add(slope), sides[1], nothing_met)
    whole = LENGTH * (TALL + high - roof)  # a metre deep
    assert carve(before, after, CONFIG).gained.low == pytest.approx(whole, rel=0.2)
    assert carve(after, before, CONFIG).lost.low == pytest.approx(whole, rel=0.2)


def test_swapping_the_epochs_swaps_the_bounds():
    there = carve(epoch(house(), PLAIN), extended(), CONFIG)
    back = carve(extended(), epoch(house(), PLAIN), CONFIG)
    assert (back.volume.low, back.volume.high) == (-there.volume.high, -there.volume.low)
    assert (back.height.low, back.height.high) == pytest.approx((-there.height.high, -there.height.low))


def test_a_wing_whose_place_nobody_saw_before_is_no_evidence():
    """What neither epoch knows free says nothing: the wing may have stood there all along."""
    hidden = epoch(house(), seen("street", "west", "above"))
    found = carve(hidden, extended(gone=("above",)), CONFIG)
    assert found.volume.low == 0.0


def test_a_storey_needs_free_space_above_the_old_roof():
    before, after = house(), house(tall=TALL + 2.5)
    high = inside(((-9, -9, TALL + 2.5), (30, 30, HIGH)))
    grown = voxels(*before).add(voxels(*(wall[wall[:, 2] > TALL] for wall in after), occupied_in_other=False))
    taller = CarvingEpoch(grown, high, nothing_met)
    known = carve(epoch(before, PLAIN), taller, CONFIG)
    assert known.height.middle == pytest.approx(2.5, abs=0.1)
    blind = carve(epoch(before, seen("street")), taller, CONFIG)
    assert blind.height.low <= 0.0 <= blind.height.high
    lost = carve(taller, epoch(before, seen("street")), CONFIG)
    assert lost.height.low <= 0.0 <= lost.height.high


def test_beams_along_a_wall_do_not_show_that_it_ends():
    """They cross the wall's own columns in front of it, above what their survey saw of the wall."""
    higher = voxels(*(wall[wall[:, 2] > TALL] for wall in house(tall=TALL + 2.5)), occupied_in_other=False)
    high = inside(((-9, -9, TALL + 2.5), (30, 30, HIGH)))
    for seen_there in (True, False):
        storey = replace(higher, observed=np.full(len(higher), seen_there))
        after = CarvingEpoch(voxels(*house()).add(storey), high, nothing_met)
        found = carve(epoch(house(), PLAIN), after, CONFIG)
        assert found.height.high == pytest.approx(2.5, abs=0.3)
        assert (found.height.low > 2.0) == seen_there
        assert seen_there or found.height.low <= 0.0


RIDGE = TALL + 2.0
ROOF = sheet((1, 1, RIDGE - CELL), (LENGTH - 1, DEPTH, RIDGE))
ABOVE_WALLS = [
    ((-9, -9, TALL), (30, 1, HIGH)),
    ((-9, -9, TALL), (1, 30, HIGH)),
    ((9, -9, TALL), (30, 30, HIGH)),
]


@pytest.mark.parametrize("open_from", [RIDGE, RIDGE - 0.4, TALL + 0.5], ids=["sky", "slope", "roof gone"])
def test_a_roof_that_one_survey_did_not_see_is_lower_only_where_its_place_was_seen_free(open_from):
    """The other survey saw the walls of the house, and over its rooms the sky from some height on."""
    gone = open_from < TALL + 1.0
    roof = replace(voxels(ROOF, occupied_in_other=False), observed=np.full(len(ROOF), gone))
    before = CarvingEpoch(voxels(*house()).add(roof), inside(*ABOVE_WALLS), nothing_met)
    sky = inside(*ABOVE_WALLS, ((-9, -9, open_from), (30, 30, HIGH)))
    found = carve(before, epoch(house(), sky), CONFIG)
    assert (found.height.high < -1.0) == gone
    assert gone or found.height.low <= 0.0 <= found.height.high


def test_a_new_house_has_the_volume_between_its_walls():
    found = carve(
        CarvingEpoch(voxels(), inside(((-9, -9, 0), (30, 30, HIGH))), nothing_met),
        epoch(house(), PLAIN, occupied_in_other=False),
        CONFIG,
    )
    assert found.volume.low == pytest.approx(LENGTH * DEPTH * TALL, rel=0.2)
    assert found.whole == pytest.approx(LENGTH * DEPTH * TALL, rel=0.2)


def test_large_objects_take_larger_cells():
    long = [sheet((0, 0, 0), (300, CELL, 20)), sheet((0, 0, 0), (CELL, 300, 20))]
    coarse = CarvingConfig(max_cells=100_000)
    found = carve(epoch(long, nowhere), epoch(long, nowhere), coarse)
    assert found.volume.low == found.volume.high == 0.0


@given(st.floats(2.0, 4.0))
def test_a_small_new_roof_has_a_volume_at_whatever_height_within_a_cell_it_lies(height):
    places = sheet((0, 0, 0), (1.5, 1.0, CELL)) * (1.0, 1.0, 0.0) + (0.0, 0.0, height)
    after = CarvingEpoch(voxels(places, occupied_in_other=False), None, nothing_met)
    before = CarvingEpoch(voxels(), lambda xyz: np.ones(len(xyz), dtype=bool), nothing_met)
    assert len(places) == CONFIG.support
    assert carve(before, after, CONFIG).volume.low == pytest.approx(1.5 * height, abs=1.5 * 0.3)


@pytest.mark.parametrize(
    ("tall", "kind", "told"),
    [(TALL, walls_of, True), (1.5, walls_of, False), (TALL, lambda sheets: sheets, False)],
    ids=["a wing", "a fence", "a ceiling"],
)
def test_new_walls_tell_the_sign_where_they_are_as_high_as_a_room(tall, kind, told):
    """All stand where the other survey saw free space on both sides."""
    new = kind(voxels(sheet((LENGTH, 1, 0), (LENGTH + 4, 1 + CELL, tall)), occupied_in_other=False))
    new = replace(new, free_space_confirmed=np.ones(len(new), dtype=bool))
    old = voxels(*house())
    open_ = inside(((LENGTH, -20, 0), (LENGTH + 20, 20, 20)))
    epochs = CarvingEpoch(old, open_, nothing_met), CarvingEpoch(old.add(new), nowhere, nothing_met)
    assert (carve(*epochs, CONFIG).confirmed[0] > 0) == told
    assert (carve(*epochs[::-1], CONFIG).confirmed[1] > 0) == told
    assert carve(*epochs, CONFIG).confirmed[1] == 0


BLOCK = [
    sheet((0, 0, 0), (LENGTH, CELL, TALL)),
    sheet((0, DEPTH - CELL, 0), (LENGTH, DEPTH, TALL)),
    sheet((0, 0, 0), (CELL, DEPTH, TALL)),
    sheet((LENGTH - CELL, 0, 0), (LENGTH, DEPTH, TALL)),
]


def floor_met(xy):
    """Tell columns between the walls of the block, where beams through the windows met the floor."""
    return ((xy > 1.0) & (xy < (LENGTH - 1.0, DEPTH - 1.0))).all(axis=1)


def test_a_house_did_not_grow_because_one_survey_met_its_floor_and_the_other_its_ceiling():
    room = inside(OUT["street"], OUT["west"], ((1, 1, 0), (LENGTH - 1, DEPTH - 1, TALL - CELL)))
    through_windows = CarvingEpoch(voxels(*BLOCK), room, floor_met)
    ceiling = sheet((1, 1, TALL - CELL), (LENGTH - 1, DEPTH - 1, TALL))
    lit = voxels(*BLOCK).add(voxels(ceiling, occupied_in_other=False))
    from_outside = CarvingEpoch(lit, PLAIN, nothing_met)
    assert carve(through_windows, from_outside, CONFIG).gained.high == 0.0
    assert carve(from_outside, through_windows, CONFIG).lost.high == 0.0
    with rules_switched_off(["inside_of_buildings"]):
        assert carve(through_windows, from_outside, CONFIG).gained.low > 100.0


def test_a_floor_seen_through_a_window_of_a_house_without_a_visible_roof_or_back_makes_no_yard():
    """The later survey sees the roof from the other lane."""
    walls = [BLOCK[0], *BLOCK[2:]]
    before = CarvingEpoch(voxels(*walls), seen("street", "west", "east"), floor_met)
    roof = voxels(sheet((1, 1, TALL - CELL), (LENGTH - 1, DEPTH - 1, TALL)), occupied_in_other=False)
    after = CarvingEpoch(voxels(*walls).add(roof), PLAIN, nothing_met)
    assert carve(before, after, CONFIG).gained.low == 0.0
    assert carve(after, before, CONFIG).lost.low == 0.0
    with rules_switched_off(["inside_of_buildings"]):
        assert carve(before, after, CONFIG).gained.low > 100.0


def test_a_shelter_between_three_walls_is_open_where_the_ground_was_met_up_to_the_street():
    """The earlier survey met the ground inside and before it, and knows nothing else of the space."""
    before = CarvingEpoch(
        voxels(*BLOCK[1:]),
        seen("west", "east"),
        lambda xy: ((xy > (1.0, -9.0)) & (xy < (LENGTH - 1.0, DEPTH - 1.0))).all(axis=1),
    )
    roof = sheet((1, 1, TALL - CELL), (LENGTH - 1, DEPTH - 1, TALL))
    new = voxels(BLOCK[0], roof, occupied_in_other=False)
    after = CarvingEpoch(voxels(*BLOCK[1:]).add(new), PLAIN, nothing_met)
    assert carve(before, after, CONFIG).gained.low > 100.0
    assert carve(after, before, CONFIG).lost.low > 100.0


def test_a_yard_that_is_open_to_the_street_is_outside():
    """A wall closes it in the later survey, and a roof covers it."""
    yard = inside(OUT["street"], ((1, -9, 0), (LENGTH - 1, DEPTH - 1, TALL)))
    before = CarvingEpoch(voxels(*BLOCK[1:]), yard, floor_met)
    roof = sheet((1, 1, TALL - CELL), (LENGTH - 1, DEPTH - 1, TALL))
    new = voxels(BLOCK[0], roof, occupied_in_other=False)
    after = CarvingEpoch(voxels(*BLOCK[1:]).add(new), PLAIN, nothing_met)
    assert carve(before, after, CONFIG).gained.low > 100.0


@pytest.mark.parametrize("yard", [False, True], ids=["nothing seen behind", "open behind"])
def test_a_house_that_was_built_upon_did_not_shrink_where_its_old_roof_is_a_room_behind_windows(yard):
    """No survey saw its rear wall. What is open behind the three walls is no room: the roof is gone."""
    walls = [BLOCK[0], *BLOCK[2:]]
    roof = voxels(sheet((0, 0, TALL - CELL), (LENGTH, DEPTH, TALL)), occupied_in_other=False)
    before = CarvingEpoch(voxels(*walls).add(roof), PLAIN, nothing_met)
    upper = voxels(*(wall + np.array([0.0, 0.0, TALL]) for wall in walls), occupied_in_other=False)
    room = ((1, 1, 0.5), (LENGTH - 1, 30.0 if yard else DEPTH - 1.0, 2 * TALL - CELL))
    known = inside(OUT["street"], OUT["west"], OUT["east"], room)
    after = CarvingEpoch(voxels(*walls).add(upper), known, nothing_met)
    found = carve(before, after, CONFIG)
    assert (found.lost.low > 100.0) == yard
    assert (found.lost.high == 0.0) == (not yard)
    assert (carve(after, before, CONFIG).gained.high == 0.0) == (not yard)


def test_a_storey_on_a_house_with_walls_on_all_sides_has_its_volume():
    above = inside(OUT["street"], OUT["west"], ((-9, -9, TALL), (30, 30, HIGH)))
    roof = sheet((0, 0, TALL - CELL), (LENGTH, DEPTH, TALL))
    before = CarvingEpoch(voxels(*BLOCK, roof), above, nothing_met)
    upper = [wall + np.array([0.0, 0.0, TALL]) for wall in (*BLOCK, roof)]
    after = CarvingEpoch(
        voxels(*BLOCK, roof).add(voxels(*upper, occupied_in_other=False)),
        inside(OUT["street"], OUT["west"], ((-9, -9, 2 * TALL), (30, 30, HIGH))),
        nothing_met,
    )
    found = carve(before, after, CONFIG)
    assert found.gained.low == pytest.approx(LENGTH * DEPTH * TALL, rel=0.2)
    assert found.height.low > 0.8 * TALL


def rise_of(before, after):
    """Change of height; that of the swapped epochs is the opposite."""
    raised, lowered = (carve(*pair, CONFIG).height for pair in ((before, after), (after, before)))
    assert (lowered.low, lowered.high) == pytest.approx((-raised.high, -raised.low))
    return raised


def raised_house(deep, *, wide=LENGTH, unseen=0.0):
    """Change of height of a house that rose by 3 m, of which the street sees the roof up to a depth [m].

    Through its windows it sees ceilings; above them nothing is known of either survey. ``wide``: extent of
    the roof along the street [m]. ``unseen``: height above the old roof below which the earlier survey saw no
    sky [m].
    """
    ceiling = sheet((CELL, deep, 2.5), (LENGTH - CELL, DEPTH, 3.0))
    sides = []
    for tall, hidden in ((TALL, unseen), (2 * TALL, 0.0)):
        roof = sheet((0, 0, tall - CELL), (wide, deep, tall))
        sky = inside(OUT["street"], ((-9, -9, tall + hidden), (30, deep + 0.5 * CELL, HIGH)))
        made = epoch([ceiling], sky)
        sides.append(replace(made, voxels=made.voxels.add(voxels(roof, occupied_in_other=False))))
    return rise_of(*sides)


def test_a_part_of_the_roof_tells_how_far_a_house_rose_though_ceilings_were_seen_behind():
    found = raised_house(deep=3 * CELL)
    assert (found.low, found.high) == pytest.approx((TALL, TALL), abs=0.3)
    with rules_switched_off(["known_tops"]):
        assert raised_house(deep=3 * CELL).low < 0.3


def test_a_roof_rose_by_what_is_certain_where_the_sky_right_above_the_old_one_was_not_seen():
    found = raised_house(deep=3 * CELL, unseen=1.5)
    assert found.low == pytest.approx(TALL - 1.5, abs=0.4)
    assert found.high == pytest.approx(TALL, abs=0.3)
    with rules_switched_off(["known_tops"]):
        assert raised_house(deep=3 * CELL, unseen=1.5).low < 0.3


def test_what_rose_for_certain_and_is_as_small_as_a_chimney_does_not_tell_how_far_a_house_rose():
    assert raised_house(deep=3 * CELL, wide=2.0, unseen=1.5).low < 0.3


def test_a_party_wall_of_unknown_height_does_not_hide_how_far_a_roof_rose():
    """The wall is higher than the roof, and narrower than roofs are. Ceilings were seen behind."""
    over = ((LENGTH - CELL, -9, TALL + 4.5), (30, 8.0, HIGH)), ((-9, 4.25, TALL + 3.5), (30, 8.0, HIGH))
    ceilings = sheet((CELL, 4.0, 2.0), (6.0, DEPTH, 2.5))
    party_wall = sheet((LENGTH - CELL, 0, 0), (LENGTH, DEPTH, TALL + 2.5))
    chimney = sheet((2.0, 1.0, 0), (2.0 + CELL, 1.0 + CELL, TALL + 5.0))
    sides = []
    for tall in (TALL, TALL + 1.0):
        roof = sheet((0, 0, tall - CELL), (LENGTH - CELL, 4.0, tall))
        sky = inside(OUT["street"], ((-9, -9, tall), (LENGTH - CELL, 4.25, HIGH)), *over)
        box = voxels(ceilings, party_wall, chimney).add(voxels(roof, occupied_in_other=False))
        sides.append(CarvingEpoch(box, sky, nothing_met))
    found = rise_of(*sides)
    assert (found.low, found.high) == pytest.approx((1.0, 1.0), abs=0.3)


def penthouse(side):
    """Change of height of a flat roof that got a storey 1 m behind its edge, seen from the street below.

    Nobody saw a roof. ``side``: whether the side wall of the storey was seen.
    """
    top, west, east, back = TALL + 3.0, 2.0, LENGTH - 1.0, 1.0
    front = sheet((west, back, TALL + 0.5), (east, back + CELL, top))
    end = sheet((east - CELL, back + CELL, TALL + 0.5), (east, DEPTH, top))
    storey = voxels(front, *([end] if side else []), occupied_in_other=False)
    edge, beside = ((-9, -9, TALL), (30, back, HIGH)), ((east, -9, TALL), (30, 30, HIGH))
    before = epoch(house(), inside(OUT["street"], edge, ((-9, -9, TALL + 0.5), (30, 30, HIGH))))
    after = epoch(house(), inside(OUT["street"], edge, beside, ((-9, -9, top), (30, 30, HIGH))))
    return rise_of(before, replace(after, voxels=after.voxels.add(walls_of(storey))))


def test_a_storey_behind_the_edge_of_a_flat_roof_raises_a_house_though_nobody_saw_a_roof():
    found = penthouse(side=True)
    assert found.low > 2.0
    assert found.low <= 3.0 <= found.high + 0.3
    with rules_switched_off(["behind_new_walls"]):
        assert penthouse(side=True).low < 0.3
    assert penthouse(side=False).low < 0.3, "a single wall may be a parapet"


def test_the_edge_of_a_roof_alone_does_not_tell_how_far_a_house_rose():
    assert raised_house(deep=CELL).low < 0.3


SLOPE = 2.5
CHIMNEYS = [((x, 1.0, TALL), (x + 1.0, 2.0, TALL + 2.0)) for x in (2.0, 7.0)]


def roofed(tall, *, chimneys=False, known=False):
    """A house whose roof is seen to a depth of 2.5 m, perhaps with chimneys of one height."""
    roof = sheet((0, 0, tall - CELL), (LENGTH, SLOPE, tall))
    tops = [sheet(*chimney) for chimney in CHIMNEYS if chimneys]
    box = voxels(house(tall)[0], roof, *tops, occupied_in_other=False)
    shared, over = box.height < TALL - CELL, box.height > tall
    normal = np.where(over[:, None], (0.0, -1.0, 0.0), box.normal)
    box = replace(box, normal=normal, occupied_in_other=shared, free_space_confirmed=over & known)
    sky = inside(OUT["street"], ((-9, -9, tall), (30, SLOPE, HIGH)))
    stacks = inside(*((np.subtract(low, 0.1), np.add(high, 0.1)) for low, high in CHIMNEYS))
    return CarvingEpoch(box, lambda xyz: sky(xyz) & ~(chimneys & stacks(xyz)), nothing_met)


def test_a_chimney_does_not_hide_that_the_roof_rose_beneath_it():
    before, after = (roofed(tall, chimneys=True) for tall in (TALL, TALL + 1.0))
    assert carve(before, after, CONFIG).height.middle == pytest.approx(1.0, abs=0.2)
    with_chimneys = CONFIG.model_copy(update={"roof_width": 0.5})
    assert carve(before, after, with_chimneys).height.middle == pytest.approx(0.0, abs=0.2)


def test_a_chimney_that_was_taken_down_changes_no_height_and_shows_no_wall_of_a_building():
    found = carve(roofed(TALL, chimneys=True, known=True), roofed(TALL), CONFIG)
    assert found.height.low <= 0.0 <= found.height.high
    assert found.confirmed == (0, 0)
    narrow = CONFIG.model_copy(update={"roof_width": 0.5})
    assert carve(roofed(TALL, chimneys=True, known=True), roofed(TALL), narrow).confirmed[1] > 0


def test_a_porch_whose_top_is_known_says_nothing_of_the_house_behind_it():
    porch = sheet((0, -2, 0), (LENGTH, -1.5, 2.5))
    walls = house()
    over = ((-9, -9, 2.5), (30, -1.5, HIGH))
    before = epoch([porch, *walls], inside(OUT["street"], over))
    after = epoch([porch, *walls], inside(OUT["street"], over))
    storey = voxels(*house(2 * TALL), occupied_in_other=False)
    after = replace(after, voxels=after.voxels.add(storey.select(storey.height > TALL)))
    assert carve(before, after, CONFIG).height.high > 2.0


def test_a_facade_that_is_of_another_object_in_one_epoch_is_not_lost_with_the_awning_before_it():
    """A tree before the house divides its facade in the later epoch, which met the ground beside the wall."""
    facade = sheet((0, 0, 0), (LENGTH, CELL, TALL))
    near, far = (facade[(facade[:, 0] > LENGTH / 2) == east] for east in (False, True))
    awning = sheet((LENGTH / 2 + 1, -1, 0), (LENGTH, 0, TALL))
    known = seen("street", "above")
    for shared, most in ((True, 15.0), (False, 25.0)):
        walls = voxels(near).add(voxels(far, occupied_in_other=shared))
        before = CarvingEpoch(walls.add(voxels(awning, occupied_in_other=False)), known, nothing_met)
        lost = carve(before, CarvingEpoch(voxels(near), known, floor_met), CONFIG).lost
        assert 10.0 < lost.high < most
        assert (lost.high < 15.0) == shared
