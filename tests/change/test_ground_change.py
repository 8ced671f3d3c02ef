"""Ground patches: what is large enough and high enough."""

import re
from dataclasses import replace

import numpy as np
import pytest
from assembled_run import compare_ground
from hypothesis import given, settings
from hypothesis import strategies as st

from subiaco_change.decisions.ground_cells import GroundCells, GroundChangeConfig, difference_cells
from subiaco_change.decisions.ground_change import beyond_threshold, find_patches, ground_raster
from subiaco_change.method_rules.switches import rules_switched_off
from subiaco_change.objects.voxel_objects import EpochView
from subiaco_geo.codes import Change, Semantic


def view(lift=None, seed=0, size=100.0, lod=0.03):
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0, size, (int(size * size * 12), 2))
    z = 0.03 * xy[:, 0] + rng.normal(0, 0.01, len(xy))
    if lift is not None:
        z += lift(xy[:, 0], xy[:, 1])
    n = len(xy)
    return EpochView(
        np.column_stack([xy, z]), np.tile([0.0, 0, 1], (n, 1)), np.full(n, Semantic.GROUND, dtype=np.uint8),
        np.full(n, -1, dtype=np.int32), np.zeros(n), np.full(n, lod), np.ones(n),
    )  # fmt: skip


def patches(lift, **config):
    found = compare_ground(view(seed=1), view(lift, seed=2), GroundChangeConfig(**config))
    return found.patches


def test_a_change_that_fills_a_tile_is_one_patch():
    found = patches(lambda x, y: -0.3 * ((x > 20) & (x < 40) & (y > 40) & (y < 60)))
    assert [p.change for p in found] == [Change.DECREASED]
    assert found[0].dz == pytest.approx(-0.3, abs=0.02)
    assert found[0].area == pytest.approx(400, rel=0.1)


def test_a_narrow_strip_is_found():
    found = patches(lambda x, y: 0.2 * ((x > 50) & (x < 51) & (y > 20) & (y < 60)))
    assert [p.change for p in found] == [Change.INCREASED]
    assert found[0].dz == pytest.approx(0.2, abs=0.03)


@pytest.mark.parametrize("dz", [0.21, -0.21, -0.4])
@pytest.mark.parametrize("angle", [0.3, 0.6, 1.2])
def test_a_strip_across_the_cells_is_one_patch(angle, dz):
    """0.85 m by 40 m at an angle to the cells: its edge runs through most of them."""
    along = np.array([np.cos(angle), np.sin(angle)])

    def lift(x, y):
        u, v = (x - 30) * along[0] + (y - 30) * along[1], (y - 30) * along[0] - (x - 30) * along[1]
        return dz * ((u > 0) & (u < 40) & (v > 0) & (v < 0.85))

    found = patches(lift)
    assert len(found) == 1
    assert found[0].dz == pytest.approx(dz, abs=0.06)
    assert found[0].area == pytest.approx(34, rel=0.3)  # a cell counts whole


def test_a_cell_on_an_edge_has_the_height_of_its_larger_part():
    def cell(*heights):
        xy = np.linspace(0.1, 0.4, len(heights))
        one = view(size=1.0)
        return EpochView(
            *(v[: len(heights)] for v in (np.column_stack([xy, xy, heights]), *list(vars(one).values())[1:7]))
        )

    def difference(before, after):
        return difference_cells(cell(*before), cell(*after), np.zeros(2), (1, 1), GroundChangeConfig()).dz[
            0, 0
        ]

    assert difference([5.0, 5.02, 4.98, 4.6], [4.6]) == pytest.approx(-0.4)
    assert np.isnan(difference([5.0, 4.6], [5.0, 4.6]))


@pytest.mark.parametrize(
    "lift",
    [
        lambda x, y: 0.1 * ((x > 20) & (x < 60)),
        lambda x, y: 0.2 * ((x > 20) & (x < 24) & (y > 20) & (y < 24)),
    ],
    ids=["camber", "small"],
)
def test_low_and_small_differences_are_no_changes(lift):
    assert patches(lift) == ()


@pytest.mark.parametrize(
    ("side", "dz", "count"), [(4.0, -0.4, 1), (4.0, -0.2, 0), (3.0, 0.6, 1), (2.0, 1.5, 0)]
)
def test_a_small_patch_is_claimed_where_it_moved_as_much_ground_as_the_least_large_one(side, dz, count):
    """25 m2 by 0.15 m are 3.75 m3; of 4 m2 alone nothing is claimed, however deep."""
    found = patches(lambda x, y: dz * box(30, 30, side, side)(x, y))
    assert [np.sign(p.dz) for p in found] == [np.sign(dz)] * count
    assert all("limit 25 m², or 3.75 m³ of a smaller patch" in p.reason for p in found)
    with rules_switched_off(["deep_patches"]):
        assert patches(lambda x, y: dz * box(30, 30, side, side)(x, y)) == ()


def test_nothing_is_claimed_below_the_level_of_detection():
    rough = [view(seed=1, lod=0.3), view(lambda x, y: 0.2 * (x < 30), seed=2, lod=0.3)]
    assert compare_ground(*rough, GroundChangeConfig()).patches == ()


@pytest.mark.parametrize(("waves", "count"), [(0.0, 1), (0.14, 0)])
def test_a_patch_of_rough_ground_is_known_better_than_its_points(waves, count):
    """Points of a lawn are known to 0.21 m, those of the road around to 0.1 m.

    Where the ground around goes up and down over metres, as the maps bend, the mean of a patch is not known.
    """
    lawn = box(40, 40, 7, 7)
    surface = lambda x, y: waves * np.sin(x / 2) - 0.23 * lawn(x, y)  # noqa: E731
    epochs = view(seed=1), view(surface, seed=2)
    for epoch in epochs:
        epoch.lod[:] = np.where(lawn(epoch.xyz[:, 0], epoch.xyz[:, 1]), 0.21, 0.1)
    found = compare_ground(*epochs, GroundChangeConfig()).patches
    assert len(found) == count
    assert all(p.lod == pytest.approx(0.1) and p.area == pytest.approx(49, rel=0.1) for p in found)
    with rules_switched_off(["level_of_patches"]):
        assert compare_ground(*epochs, GroundChangeConfig()).patches == ()


@pytest.mark.parametrize(("moved", "count"), [(0.3, 1), (0.9, 0)])
def test_low_parts_of_what_moved_are_no_ground(moved, count):
    where = lambda x, y: (x > 30) & (x < 38) & (y > 30) & (y < 38)  # noqa: E731
    before = view(lambda x, y: 0.4 * where(x, y), seed=1)
    told = np.where(where(before.xyz[:, 0], before.xyz[:, 1]), moved, 0.1)
    found = compare_ground(replace(before, moved=told), view(seed=2), GroundChangeConfig()).patches
    assert len(found) == count


def blind_there(lift, where, seed=2):
    """An epoch without a level of detection where ``where`` holds."""
    found = view(lift, seed=seed)
    found.lod[where(found.xyz[:, 0], found.xyz[:, 1])] = np.inf
    return found


def box(x, y, length, width):
    return lambda px, py: (px > x) & (px < x + length) & (py > y) & (py < y + width)


def test_a_patch_too_sparse_for_a_level_of_detection_is_found_as_a_whole():
    where = box(30, 30, 6, 6)
    dug = blind_there(lambda x, y: -0.3 * where(x, y), where)
    found = compare_ground(view(seed=1), dug, GroundChangeConfig()).patches
    assert [p.change for p in found] == [Change.DECREASED]
    assert found[0].dz == pytest.approx(-0.3, abs=0.03)
    assert found[0].lod < 0.1
    assert compare_ground(view(seed=1), blind_there(None, where), GroundChangeConfig()).patches == ()


@pytest.mark.parametrize(("noise", "count"), [(0.01, 1), (0.25, 0)])
def test_a_sparse_patch_is_claimed_only_where_the_ground_around_keeps_still(noise, count):
    """Seen from afar the ground errs by blocks of 2 m together; 0.3 m dug is nothing among these."""
    off = np.random.default_rng(7).normal(0, noise, (50, 50))
    far, pit = box(20, 20, 30, 30), box(30, 30, 6, 6)

    def lift(x, y):
        blocks = off[(x / 2).astype(int) % 50, (y / 2).astype(int) % 50]
        return np.where(pit(x, y), -0.3, np.where(far(x, y), np.clip(blocks, -0.14, None), 0.0))

    found = compare_ground(view(seed=1), blind_there(lift, far), GroundChangeConfig()).patches
    assert len([p for p in found if p.change is Change.DECREASED]) == count


@pytest.mark.parametrize(("side", "count"), [(5.5, 1), (3.0, 0)])
def test_the_floor_that_the_edge_of_a_pit_hides_counts_towards_its_area(side, count):
    """Of 30 m2 dug, 5 m2 along one edge are hidden; a pit of 9 m2 stays too small."""
    pit, hidden = box(30, 30, side, side), box(30, 30, 1.0, side)
    dug = view(lambda x, y: -0.3 * pit(x, y), seed=2)
    assert len(compare_ground(view(seed=1), without(dug, hidden), GroundChangeConfig()).patches) == count


@pytest.mark.parametrize(("dz", "count"), [(-0.7, 1), (-0.4, 0)])
def test_cells_of_a_small_pit_that_nobody_measured_moved_as_the_measured_ones_did(dz, count):
    """7.5 m2, a third of them hidden by the edge; the limit is 3.75 m3, and 3.5 m3 were measured."""
    shape = (20, 20)
    none, flat, change = np.zeros(shape, dtype=bool), np.zeros(shape), np.zeros(shape)
    change[5:11, 5:10] = dz
    hidden = none.copy()
    hidden[9:11, 5:10] = True
    change[hidden] = np.nan
    cells = GroundCells(change, np.full(shape, 0.03), none, flat, none, none, none, hidden)
    found = find_patches(cells, np.zeros(2), GroundChangeConfig())[1]
    assert [p.area for p in found] == [7.5] * count
    assert all(f"{7.5 * abs(dz):.1f} m³" in p.reason for p in found)


def without(cloud, where):
    """An epoch without its points where ``where`` holds."""
    kept = ~where(cloud.xyz[:, 0], cloud.xyz[:, 1])
    fields = [n for n in EpochView.__dataclass_fields__ if getattr(cloud, n) is not None]
    return EpochView(**{n: getattr(cloud, n)[kept] for n in fields})


def test_a_strip_under_a_parked_car_is_one_patch_with_the_ground_that_the_other_epoch_saw_there():
    """1.5 m by 20 m raised by 0.3 m; a car of 4.5 m hides its middle in *after*: 11.6 m2 on either side."""
    strip, car = box(30, 30, 20, 1.5), box(38, 29, 4.5, 3.5)
    after = without(view(lambda x, y: 0.3 * strip(x, y), seed=2), car)
    found = compare_ground(view(seed=1), after, GroundChangeConfig())
    assert [p.change for p in found.patches] == [Change.INCREASED]
    row, column, _ = found.cell_of(np.array([[39.2, 30.8], [41.3, 30.8], [40.2, 35.0]]))
    assert found.patch[row, column].tolist() == [0, 0, -1]


def test_the_edge_of_a_patch_lies_where_half_of_its_height_is_reached():
    """5.2 m by 5.2 m, shifted by a quarter of a cell: 27 m2, of which whole cells over 0.15 m show 25 m2."""
    found = patches(lambda x, y: -0.2 * box(30.15, 30.15, 5.2, 5.2)(x, y))
    assert [p.change for p in found] == [Change.DECREASED]
    assert found[0].area == pytest.approx(27, rel=0.1)


@pytest.mark.filterwarnings("error")
def test_the_floor_of_a_pit_that_lies_where_it_lay_is_no_patch():
    shape = (40, 40)
    none, level, lod = np.zeros(shape, dtype=bool), np.zeros(shape), np.full(shape, 0.03)
    floor = none.copy()
    floor[10:30, 10:30] = True
    cells = GroundCells(level, lod, none, level, none, none, floor, none)
    assert find_patches(cells, np.zeros(2), GroundChangeConfig())[1] == ()


def test_a_few_deep_cells_in_the_dark_are_no_pit():
    """Twelve cells 2 m down around a place that nobody saw: their volume would do, their area does not."""
    dark, rim = box(30, 30, 6, 6), box(29.5, 30, 0.5, 6)
    before = without(view(seed=1), dark)
    after = without(view(lambda x, y: -2.0 * rim(x, y), seed=2), dark)
    assert compare_ground(before, after, GroundChangeConfig()).patches == ()


def test_epochs_without_common_ground_are_not_compared():
    first, second = view(seed=1, size=20.0), view(seed=2, size=20.0)
    second.xyz[:, 0] += 500.0
    assert compare_ground(first, second, GroundChangeConfig()) is None


def test_the_raster_is_in_world_coordinates_with_north_up():
    comparison = compare_ground(
        view(seed=1, size=40.0), view(lambda x, y: 0.3 * (y > 30), seed=2, size=40.0), GroundChangeConfig()
    )
    raster = ground_raster(comparison, np.array([1000.0, 5000.0, 0.0]), GroundChangeConfig())
    assert (raster.west, raster.north, raster.cell) == (1000.0, 5040.0, 2.0)
    assert raster.dz[1].mean() - raster.dz[-2].mean() == pytest.approx(0.3, abs=0.03)


def test_cells_whose_neighbours_moved_the_other_way_are_no_part_of_a_patch():
    shape = (20, 40)
    dz = np.full(shape, 0.3)
    dz[:, 19:21] = np.nan
    blind = np.isnan(dz)
    hidden = GroundCells(
        dz, np.full(shape, 0.03), blind, np.zeros(shape), *(np.zeros(shape, dtype=bool) for _ in range(4))
    )
    assert beyond_threshold(hidden, 1.0, GroundChangeConfig()).all()
    sunk = replace(hidden, dz=np.where(blind, -0.05, dz))
    assert not beyond_threshold(sunk, 1.0, GroundChangeConfig())[:, 19:21].any()


def trench(ground, keep):
    """A trench of 1.5 m by 30 m and 0.5 m deep seen from the south: the top of its far wall, and no floor.

    ``keep`` (N,) points of the ground around that the epoch has.
    """
    x, y, z = ground.xyz.T
    inside = (x > 20) & (x < 50) & (y > 40) & (y < 41.5)
    wall = inside & (y > 41.2)
    lower = ground.xyz - np.outer(wall, [0.0, 0.0, 0.3]) * np.linspace(0.7, 1.3, len(z))[:, None]
    kept = wall | (~inside & keep(x, y))
    return EpochView(*(v[kept] for v in (lower, *list(vars(ground).values())[1:7])))


def test_a_trench_whose_floor_its_edge_hides_is_found_by_its_far_wall():
    after = trench(view(seed=2), lambda x, y: x > -1)
    found = compare_ground(view(seed=1), after, GroundChangeConfig())
    assert [p.change for p in found.patches] == [Change.DECREASED]
    assert found.patches[0].area == pytest.approx(45, rel=0.2)
    filled = compare_ground(after, view(seed=1), GroundChangeConfig())
    assert [p.change for p in filled.patches] == [Change.INCREASED]


@pytest.mark.parametrize(("depth", "whole"), [(1.0, True), (0.4, False)], ids=["through it", "above it"])
@pytest.mark.parametrize("filled", [False, True], ids=["dug", "filled"])
def test_the_floor_of_a_pit_that_its_edge_hides_is_known_where_beams_went_through_the_old_ground(
    depth, whole, filled
):
    """Of the floor of a pit of 100 m2, 1 m deep, 40 m2 were met; before it beams went ``depth`` below."""
    pit, met = box(30, 30, 10, 10), box(30, 36, 10, 4)
    dug = view(lambda x, y: -1.0 * pit(x, y), seed=2)
    x, y, _ = dug.xyz.T
    kept = ~pit(x, y) | met(x, y)
    dug = EpochView(*(v[kept] for v in list(vars(dug).values())[:7]))

    def empty(places):
        above_floor = places[:, 2] > 0.03 * places[:, 0] - depth
        return pit(places[:, 0], places[:, 1]) & above_floor

    epochs, saw = (view(seed=1), dug), (None, empty)
    if filled:
        epochs, saw = epochs[::-1], saw[::-1]
    (found,) = compare_ground(*epochs, GroundChangeConfig(), saw).patches
    assert found.change is (Change.INCREASED if filled else Change.DECREASED)
    assert abs(found.dz) == pytest.approx(1.0, abs=0.05)
    assert found.area == pytest.approx(100 if whole else 45, rel=0.12)
    looking = "earlier" if filled else "later"
    hidden = re.search(rf"Over (\d+) m² the {looking} survey did not meet its lower ground", found.reason)
    assert float(hidden[1]) == pytest.approx(58 if whole else 5, abs=6)
    with rules_switched_off(["seen_below_ground"]):
        assert compare_ground(*epochs, GroundChangeConfig(), saw).patches[0].area < 55


def test_free_space_below_the_old_ground_alone_is_no_patch():
    """Nothing says how deep a pit is of which neither floor nor wall was met."""
    pit, before, after = box(30, 30, 10, 10), view(seed=1), view(seed=2)
    kept = ~pit(*after.xyz[:, :2].T)
    after = EpochView(*(v[kept] for v in list(vars(after).values())[:7]))
    inside = box(31, 31, 8, 8)
    saw = (None, lambda places: inside(places[:, 0], places[:, 1]))
    assert compare_ground(before, after, GroundChangeConfig(), saw).patches == ()


def test_between_scan_lines_far_apart_no_pit_hides_its_floor():
    after = trench(view(seed=2), lambda x, y: np.mod(y, 4.0) < 0.5)
    found = compare_ground(view(seed=1), after, GroundChangeConfig())
    assert sum(p.area for p in found.patches) < 20


@pytest.mark.parametrize(("apart", "count"), [(1.0, 1), (4.0, 0)])
def test_a_patch_between_scan_lines_far_apart_is_not_claimed(apart, count):
    """One row of cells in eight that errs does not lift the ground between the rows."""
    lines = lambda x, y: np.mod(y, apart) < 0.5  # noqa: E731
    before = view(seed=1)
    after = view(lambda x, y: 0.3 * box(30, 30, 10, 10)(x, y), seed=2)
    seen = lines(after.xyz[:, 0], after.xyz[:, 1])
    after = replace(
        after,
        **{name: getattr(after, name)[seen] for name in vars(after) if getattr(after, name) is not None},
    )
    found = compare_ground(before, after, GroundChangeConfig()).patches
    assert len(found) == count
    with rules_switched_off(["measured_patches"]):
        assert len(compare_ground(before, after, GroundChangeConfig()).patches) == 1


@given(st.integers(0, 1000), st.floats(0.0, 0.12), st.floats(0.0, 0.4))
@settings(max_examples=15, deadline=None)
def test_two_surveys_of_the_same_ground_with_steps_show_no_change(seed, noise, step):
    """A step of the ground and gaps of any kind: what lies lower beside an edge is no pit."""
    rng = np.random.default_rng(seed)
    grounds = []
    for epoch in range(2):
        ground = view(lambda x, y: step * (y > 20.3), seed=2 * seed + epoch, size=40.0)
        gaps = [box(*rng.uniform(2, 30, 2), *rng.uniform(1, 9, 2)) for _ in range(6)]
        seen = ~np.any([gap(ground.xyz[:, 0], ground.xyz[:, 1]) for gap in gaps], axis=0)
        xyz = ground.xyz + np.column_stack([np.zeros((len(seen), 2)), rng.normal(0, noise / 2, len(seen))])
        grounds.append(EpochView(*(v[seen] for v in (xyz, *list(vars(ground).values())[1:7]))))
    assert compare_ground(*grounds, GroundChangeConfig()).patches == ()


def test_a_patch_whose_difference_varies_by_a_third_of_it_is_not_certain():
    """Ground dug by 0.3 m, evenly, and by 0.3 m with 0.1 m from place to place."""
    rough = np.random.default_rng(3).normal(0, 0.1, (100, 100))
    pit = box(30, 30, 10, 10)

    def uneven(x, y):
        return np.where(pit(x, y), -0.3 + rough[x.astype(int), y.astype(int)], 0.0)

    even, varied = (patches(lift)[0] for lift in (lambda x, y: -0.3 * pit(x, y), uneven))
    assert even.confidence > 0.98
    assert varied.confidence < 0.96


def test_a_patch_that_varies_by_more_than_it_moved_is_none():
    """Yards at several levels, of which the epochs saw other parts."""
    pit, step = box(30, 30, 8, 8), np.random.default_rng(5).choice([-0.2, -0.25, -1.6], (100, 100))
    found = patches(lambda x, y: np.where(pit(x, y), step[x.astype(int), y.astype(int)], 0.0))
    assert found == ()
    assert len(patches(lambda x, y: np.where(pit(x, y), -0.25, 0.0))) == 1


def test_a_patch_that_varies_nearly_as_much_as_it_moved_is_none_and_a_high_cone_of_earth_is_one():
    """Most cells of a yard rose by 0.25 m and a fifth by 0.85 m; a heap of 4 m ends in a point."""
    step = np.random.default_rng(7).choice([0.2, 0.25, 0.25, 0.25, 0.85], (100, 100))
    yard = box(30, 30, 8, 8)
    assert patches(lambda x, y: np.where(yard(x, y), step[x.astype(int), y.astype(int)], 0.0)) == ()
    heap = patches(lambda x, y: np.maximum(4.0 - 0.7 * np.hypot(x - 34.0, y - 34.0), 0.0))
    assert [found.change for found in heap] == [Change.INCREASED]
    assert heap[0].dz / heap[0].dz_spread > 1.24


def with_points(view, xyz, semantic):
    """The epoch with further points of a class."""
    n = len(xyz)
    more = EpochView(
        xyz, np.tile([0.0, 0, 1], (n, 1)), np.full(n, semantic, dtype=np.uint8),
        np.full(n, 0, dtype=np.int32), np.zeros(n), np.full(n, 0.03), np.ones(n),
    )  # fmt: skip
    fields = [f for f in EpochView.__dataclass_fields__ if getattr(view, f) is not None]
    return EpochView(**{f: np.concatenate([getattr(view, f), getattr(more, f)]) for f in fields})


@pytest.mark.parametrize("semantic", [Semantic.VEGETATION, Semantic.OTHER])
def test_a_surface_that_the_other_epoch_holds_under_another_class_did_not_move(semantic):
    """Grass 0.4 m high: *before* sees through to the soil and calls the tops plants, *after* ground."""
    meadow = box(30, 30, 20, 12)
    rng = np.random.default_rng(9)
    xy = rng.uniform([30, 30], [50, 42], (4000, 2))
    tops = np.column_stack([xy, 0.03 * xy[:, 0] + 0.4 + rng.normal(0, 0.03, len(xy))])
    before = view(seed=1)
    after = view(lambda x, y: 0.4 * meadow(x, y), seed=2)
    assert len(compare_ground(before, after, GroundChangeConfig()).patches) == 1
    assert compare_ground(with_points(before, tops, semantic), after, GroundChangeConfig()).patches == ()
    assert compare_ground(after, with_points(before, tops, semantic), GroundChangeConfig()).patches == ()


def test_walls_beside_a_narrow_trench_are_no_second_surface_of_the_ground():
    """A trench of 30 m x 1 m between two walls that *after* holds from the floor of the trench up to 3 m."""
    trench = box(30, 30, 30, 1)
    x, y, z = (v.ravel() for v in np.meshgrid(np.arange(30, 60, 0.2), (29.9, 31.1), np.arange(-0.3, 3, 0.2)))
    walls = np.column_stack([x, y, 0.03 * x + z])
    before, after = view(seed=1), with_points(
        view(lambda x, y: -0.35 * trench(x, y), seed=2), walls, Semantic.BUILDING
    )  # fmt: skip
    (patch,) = compare_ground(before, after, GroundChangeConfig()).patches
    assert patch.change is Change.DECREASED
    assert patch.area == pytest.approx(30, abs=4)


def test_ground_that_coincides_with_points_below_a_wall_of_the_other_epoch_did_not_move():
    """A verge of 12 m x 3 m that *before* calls a wall, with the wall behind it, and *after* ground."""
    verge = box(30, 30, 12, 3)
    rng = np.random.default_rng(3)
    xy = rng.uniform([30, 30], [42, 33], (900, 2))
    top = np.column_stack([xy, 0.03 * xy[:, 0] + 0.4 + rng.normal(0, 0.02, len(xy))])
    above = np.concatenate([top + np.array([0.0, 0.0, dz]) for dz in (0.3, 0.6, 0.9)])
    lone = above + np.array([0.3, 0.3, 0.2])
    before = view(seed=1)
    after = view(lambda x, y: 0.4 * verge(x, y), seed=2)
    config = GroundChangeConfig()
    assert len(compare_ground(with_points(before, lone, Semantic.BUILDING), after, config).patches) == 1
    both = with_points(before, np.concatenate([top, above]), Semantic.BUILDING)
    assert compare_ground(both, after, config).patches == ()
    with rules_switched_off(["coinciding_ground"]):
        assert len(compare_ground(both, after, config).patches) == 1


def test_the_rim_of_a_milled_strip_is_no_second_surface_of_the_ground():
    """A strip 2 m wide and 0.4 m deep whose rim, at the old level, is labelled as something else."""
    strip = box(30, 30, 20, 2)
    rim = np.array([(x, y, 0.03 * x) for x in np.arange(30, 50, 0.25) for y in (29.9, 32.1)])
    before, after = view(seed=1), with_points(
        view(lambda x, y: -0.4 * strip(x, y), seed=2), rim, Semantic.OTHER
    )  # fmt: skip
    (patch,) = compare_ground(before, after, GroundChangeConfig()).patches
    assert patch.change is Change.DECREASED
