"""A storey on one house of a row is a change of that house, not of the row."""

from functools import cache

import numpy as np
import pytest
from random_houses import Box, Sensor, Street, compare, survey

from subiaco_change.instance_splitting.merged_instances import changed_houses
from subiaco_change.objects.voxel_objects import Voxels
from subiaco_geo.codes import Change

CELL, WIDTH, DEPTH = 0.5, 5.0, 9.0
VERANDAH = 2.0  # in front of all houses of a row [m]


def roofs(tops):
    """Voxels of a row along x: roofs of these heights in every slot [m], as far as a street shows them."""
    x = (np.arange(len(tops)) + 0.5) * CELL
    y = (np.arange(round(DEPTH / CELL)) + 0.5) * CELL
    height = np.where(y[None, :] < VERANDAH, 1.9, np.asarray(tops)[:, None]).ravel()
    xyz = np.column_stack([np.repeat(x, len(y)), np.tile(y, len(x)), height])
    yes = np.ones(len(xyz), dtype=bool)
    return Voxels(
        np.zeros(len(xyz), dtype=int), xyz, np.tile([0.0, 0.0, 1.0], (len(xyz), 1)), height, *[yes] * 3
    )


def row(heights):
    return roofs(np.repeat(heights, round(WIDTH / CELL)))


def changed(before, after):
    """Which places of a row, numbered from 0, are of a changed house."""
    xyz = np.concatenate([before.xyz, after.xyz])
    house = changed_houses(before, after)[1]
    return sorted(set((xyz[house > 0, 0] // WIDTH).astype(int).tolist()))


@pytest.mark.parametrize("place", [0, 1, 2])
@pytest.mark.parametrize("sign", [1, -1], ids=["built", "taken off"])
def test_a_row_is_parted_at_the_walls_of_the_house_that_changed(place, sign):
    low, high = row((4.0, 4.0, 4.0)), row(np.where(np.arange(3) == place, 6.8, 4.0))
    assert changed(*(low, high)[::sign]) == [place]


def test_of_a_house_that_was_seen_to_its_front_alone_the_storey_shows_in_its_front():
    """A lower verandah stands in front of it."""
    before, after = row((4.0, 4.0, 4.0)), row((4.0, 6.8, 4.0))
    front = [v.select((v.xyz[:, 0] // WIDTH != 1) | (v.xyz[:, 1] < VERANDAH + CELL)) for v in (before, after)]
    assert changed(*front) == [1]


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ((4.0, 4.0, 4.0), (6.8, 6.8, 6.8)),
        ((4.0, 4.0, 4.0), (4.0, 4.9, 4.0)),
        ((4.0, 4.0, 4.0), (5.5, 7.0, 5.5)),
        ((4.0, 4.0, 4.0), (4.0, 4.0, 4.0)),
    ],
    ids=["all rose", "a roof made anew", "neighbours rose too", "nothing"],
)
def test_what_is_no_storey_of_one_house_parts_nothing(before, after):
    assert changed(row(before), row(after)) == []


def test_an_upper_floor_that_ends_in_a_slope_belongs_to_the_house_below():
    sloped = np.interp(np.arange(30) + 0.5, [0, 6, 13, 17, 24, 30], [4.0, 4.0, 6.8, 6.8, 4.0, 4.0])
    assert changed(row((4.0, 4.0, 4.0)), roofs(sloped)) == []


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
