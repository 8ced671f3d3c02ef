"""A storey on one house of a row is a change of that house, not of the row."""

from functools import cache

import numpy as np
import pytest
from random_houses import Box, Sensor, Street, compare, survey

from subiaco_change.decisions.column_volumes import ColumnChange
from subiaco_change.instance_splitting.merged_instances import changed_houses
from subiaco_geo.codes import Change

CELL, WIDTH, DEPTH = 0.5, 5.0, 9.0
SEEN_DEPTH = 5.0  # of the roofs, as far as the street shows them


def columns(before, after, foot=4.0):
    """Columns of a row of houses with flat roofs at these heights [m], and the places of its voxels."""
    tops = [np.repeat(heights, round(WIDTH / CELL)) for heights in (before, after)]
    change = tops[1] - tops[0]
    across = np.arange(round(DEPTH / CELL)) * CELL < SEEN_DEPTH
    grid = np.where(across[None, :], change[:, None], 0.0)
    found = ColumnChange(
        np.zeros(2),
        np.eye(2),
        CELL,
        grid,
        np.where(grid != 0, foot, np.inf),
        np.stack([np.tile(top[:, None], (1, len(across))) for top in tops]),
    )
    places = np.stack(np.meshgrid(*(np.arange(n) for n in grid.shape), indexing="ij"), axis=-1).reshape(-1, 2)
    return found, (places + 0.5) * CELL


@pytest.mark.parametrize("sign", [1, -1], ids=["built", "taken off"])
def test_a_row_is_parted_at_the_walls_of_the_house_that_changed(sign):
    found, xy = (
        columns((4.0, 4.0, 4.0), (4.0, 6.8, 4.0)) if sign > 0 else columns((4.0, 6.8, 4.0), (4.0, 4.0, 4.0))
    )
    parts = changed_houses(found, xy)
    assert (parts == (xy[:, 0] // WIDTH)).all()


def test_a_house_at_the_end_of_a_row_is_parted_from_it():
    found, xy = columns((4.0, 4.0, 4.0), (4.0, 4.0, 6.8))
    assert (changed_houses(found, xy) == (xy[:, 0] >= 2 * WIDTH)).all()


@pytest.mark.parametrize(
    ("before", "after", "foot"),
    [
        ((4.0, 4.0, 4.0), (6.8, 6.8, 6.8), 4.0),
        ((4.0, 4.0, 4.0), (4.0, 4.9, 4.0), 4.0),
        ((4.0, 4.0, 4.0), (5.5, 7.0, 5.5), 4.0),
        ((4.0, 4.0, 4.0), (4.0, 6.8, 4.0), 0.5),
        ((4.0, 4.0, 4.0), (4.0, 4.0, 4.0), 4.0),
    ],
    ids=["all rose", "a roof made anew", "neighbours rose too", "from the ground", "nothing"],
)
def test_what_is_no_storey_of_one_house_parts_nothing(before, after, foot):
    found, xy = columns(before, after, foot)
    assert changed_houses(found, xy).max() == 0


def test_an_upper_floor_that_ends_in_a_slope_belongs_to_the_house_below():
    found, xy = columns((4.0, 4.0, 4.0), (4.0, 6.8, 4.0))
    after = np.interp(np.arange(30) + 0.5, [0, 6, 13, 17, 24, 30], [4.0, 4.0, 6.8, 6.8, 4.0, 4.0])
    tops = np.stack([np.full(30, 4.0), after])
    sloped = np.repeat(tops[:, :, None], found.change.shape[1], axis=2)
    change = np.where(found.change.any(axis=0)[None, :], (after - 4.0)[:, None], 0.0)
    slope = ColumnChange(found.corner, found.turn, CELL, change, np.where(change > 0, 4.0, np.inf), sloped)
    assert changed_houses(slope, xy).max() == 0


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
