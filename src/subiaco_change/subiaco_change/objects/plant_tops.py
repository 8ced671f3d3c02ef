"""Change of the tops of a plant: columns at equal point density, where both epochs saw the space above.

Voxels of two epochs count as the same place within a distance that grows with the spacing of the points, so
that they do not resolve half a metre of growth. The tops of columns do: each is read from as many points in
both epochs, and what two samplings of an unchanged plant differ by is what the columns scatter.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import Field
from scipy.spatial import cKDTree
from scipy.special import gammaln, ndtri, stdtrit

from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import switchable
from subiaco_change.objects.known_space import Free, KnownSpaces
from subiaco_change.quantiles import median_and_spread
from subiaco_geo.clouds import extent_of, unique_cells
from subiaco_geo.config import StrictModel
from subiaco_geo.frames import Floats, Ints

_LIMIT = NUMBERS.plant_tops.student_limit


class TopConfig(StrictModel):
    """Columns in which the tops of plants are compared."""

    cell: float = Field(0.75, gt=0, description="Smallest edge of the columns in which tops are compared [m]")
    filling: float = Field(
        0.0,
        ge=0,
        description="Mean number of points of the sparser epoch in a column, for which columns of a sparse "
        "plant are wider than the smallest edge; 0 keeps that edge. In sparse clouds: `spacing.filling`",
    )
    points: int = Field(3, ge=1, description="Number of points that a column needs in each epoch")
    columns: int = Field(3, ge=3, description="Number of columns that a comparison of tops needs")
    upper: float = Field(
        0.5,
        gt=0,
        le=1,
        description="Fraction of the columns, the highest ones, whose tops are those of the plant; of few "
        "columns in a sparse cloud as many as a comparison needs",
    )
    known: float = Field(
        0.2,
        ge=0,
        le=1,
        description="Fraction of these columns above which the epoch with the lower top must have observed "
        "free space; tops are those of such columns. Raise it to claim less",
    )
    above: float = Field(
        0.5,
        gt=0,
        description="Height above the lower top at which its epoch must have observed free space [m]",
    )
    free: float = Field(
        0.7, gt=0.5, lt=1, description="Probability of being free from which that space counts as observed"
    )
    patch: float = Field(
        2.0,
        gt=0,
        description="Number of neighbouring columns of the smallest edge whose tops the same beams met, and "
        "whose errors are one",
    )
    part: float = Field(
        2.0,
        gt=0,
        description="Number of standard deviations of the other half of the columns by which the quarter "
        "that moved most must exceed their median for a part of the plant to have moved",
    )


@dataclass(frozen=True)
class TopChange:
    """Median rise of the tops of a plant, with its standard error [m]; NaN where it was not observed.

    ``rise_of_part`` and ``fall_of_part`` [m]: how far the quarter of all its columns rose, or fell, that did
    most, where that is beyond two standard deviations of the other half; 0 elsewhere. ``unseen``: the epochs
    share columns, but the space above their lower tops was not observed.
    """

    median: float = math.nan
    sigma: float = math.nan
    rise_of_part: float = 0.0
    fall_of_part: float = 0.0
    unseen: bool = False


@dataclass(frozen=True)
class _Columns:
    """Columns of both epochs: edge, cells (C, 2), tops (2, C) at equal density, highest points (2, C) [m]."""

    cell: float
    cells: Ints
    tops: Floats
    highest: Floats

    def select(self, kept: np.ndarray) -> _Columns:
        return _Columns(self.cell, self.cells[kept], self.tops[:, kept], self.highest[:, kept])


def change_of_tops(before: Floats, after: Floats, spaces: KnownSpaces, config: TopConfig) -> TopChange:
    """Measure how far the tops of the highest columns of a plant moved.

    Parameters
    ----------
    before, after : (N, 3), (M, 3) float64
        Points of the plant [m].
    spaces : (KnownSpace, KnownSpace)
        What *before* and *after* know of the space around it: points that stand there, places free above it.
    config : TopConfig

    Returns
    -------
    TopChange
        The error is that of a median over patches of columns.
    """
    columns = _shared_columns(before, after, config)
    if len(columns.cells) < config.columns:
        return TopChange()
    rises = columns.tops[1] - columns.tops[0]
    parts = _of_part(rises, config.part), _of_part(-rises, config.part)
    middle = columns.tops.mean(axis=0)
    least = np.quantile(middle, 1.0 - config.upper)
    if config.filling > 0:
        least = min(least, np.partition(middle, -config.columns)[-config.columns])
    columns = columns.select(middle >= least)
    known = _known(columns, spaces, config)
    if np.count_nonzero(known) < max(config.columns, config.known * len(known)):
        return TopChange(rise_of_part=parts[0], fall_of_part=parts[1], unseen=True)
    rises = (columns.tops[1] - columns.tops[0])[known]
    median, spread = median_and_spread(rises)
    shared = max(config.patch * (config.cell / columns.cell) ** 2, 1.0)  # wide columns share no beams
    patches = max(len(rises) / shared, 1.0)
    few = _uncertain_spread(len(rises))
    return TopChange(median, few * 1.2533 * spread / math.sqrt(patches), parts[0], parts[1])


def _of_part(rises: Floats, certain: float) -> float:
    """Return the upper quartile of rises (C,) if the scatter of the lower half does not explain it."""
    low, middle, high = np.quantile(rises, [0.25, 0.5, 0.75]).tolist()
    sd = 1.4826 * (middle - low)  # of a normal distribution with this lower quartile
    return float(high) if high > middle + certain * sd else 0.0


def _uncertain_spread(columns: int) -> float:
    """Return the factor on the error of a median whose spread is that of few columns."""
    return float(stdtrit(columns - 1, _LIMIT) / ndtri(_LIMIT))


def _edge(before: Floats, after: Floats, config: TopConfig) -> float:
    """Return the edge [m] of columns that hold enough points (N, 3), (M, 3) of the sparser epoch."""
    held = unique_cells(np.floor(np.concatenate([before, after])[:, :2] / config.cell).astype(np.int64))[0]
    fewest = max(min(len(before), len(after)), 1)
    return config.cell * max(math.sqrt(config.filling * len(held) / fewest), 1.0)


def _shared_columns(before: Floats, after: Floats, config: TopConfig) -> _Columns:
    """Return the columns with enough points in both epochs."""
    cell = _edge(before, after, config)
    places = np.floor(np.concatenate([before, after])[:, :2] / cell).astype(np.int64)
    cells, slot = unique_cells(places)
    split = np.split(slot, [len(before)])
    heights, slots = _in_common_view((before[:, 2], after[:, 2]), split, len(cells), config)
    counts = np.array([np.bincount(s, minlength=len(cells)) for s in slots])
    fewest = counts.min(axis=0)
    tops = np.array([expected_top(z, s, fewest) for z, s in zip(heights, slots, strict=True)])
    highest = np.full((2, len(cells)), -np.inf)
    for epoch, (z, s) in enumerate(zip(heights, slots, strict=True)):
        np.maximum.at(highest[epoch], s, z)
    return _Columns(cell, cells, tops, highest).select(fewest >= config.points)


@switchable("common_view_of_crowns", lambda heights, slots, *_: (heights, slots))
def _in_common_view(
    heights: tuple[Floats, Floats], slots: Sequence[Ints], count: int, config: TopConfig
) -> tuple[tuple[Floats, Floats], Sequence[Ints]]:
    """Leave out points of both epochs below the part of a column that both epochs saw.

    Of a crown behind a house, one survey saw the top alone: all of its points lie high, and the highest of
    as many points of the whole crown lies lower.
    """
    lowest = np.full((2, count), np.inf)
    for low, z, slot in zip(lowest, heights, slots, strict=True):
        np.minimum.at(low, slot, z)
    kept = [z >= lowest.max(axis=0)[slot] for z, slot in zip(heights, slots, strict=True)]
    left = np.array([np.bincount(s[k], minlength=count) for s, k in zip(slots, kept, strict=True)])
    apart = left.min(axis=0) < config.points  # one epoch lies above the other: the plant grew, or was topped
    kept = [k | apart[slot] for k, slot in zip(kept, slots, strict=True)]
    first, second = ((z[k], s[k]) for z, s, k in zip(heights, slots, kept, strict=True))
    return (first[0], second[0]), (first[1], second[1])


def expected_top(heights: Floats, column: Ints, drawn: Ints) -> Floats:
    """Return the expected height of the highest of a number of points drawn from every column (C,).

    Of n points of a column, m are drawn: the k-th lowest is the highest of them in C(k-1, m-1) of C(n, m)
    draws. Two epochs of which as many points are drawn differ by their tops, not by their densities.

    Parameters
    ----------
    heights : (N,) float64
    column : (N,) int
        Column of every point.
    drawn : (C,) int
        Number of points drawn from every column; 0 where a column has none.
    """
    order = np.lexsort((heights, column))
    height, column = heights[order], column[order]
    count = np.bincount(column, minlength=len(drawn))
    rank = np.arange(len(height)) - (np.cumsum(count) - count)[column] + 1
    n, m = count[column], drawn[column]
    chosen = (rank >= m) & (m > 0)
    rank, n, m = rank[chosen], n[chosen], m[chosen]
    ways = gammaln(rank) - gammaln(m) - gammaln(rank - m + 1)
    total = gammaln(n + 1) - gammaln(m + 1) - gammaln(n - m + 1)
    share = np.exp(ways - total)
    return np.asarray(np.bincount(column[chosen], height[chosen] * share, minlength=len(drawn)), np.float64)


@switchable("space_above_tops", lambda columns, *_: np.ones(len(columns.cells), dtype=bool))
def _known(columns: _Columns, spaces: KnownSpaces, config: TopConfig) -> np.ndarray:
    """Tell of which columns (C,) the epoch with the lower top knows that nothing stood above it.

    Above that top it observed free space, and no point of another class reaches into the difference.
    """
    lower_before = columns.tops[0] <= columns.tops[1]
    known = np.ones(len(columns.cells), dtype=bool)
    middles = np.asarray((columns.cells + 0.5) * columns.cell, dtype=np.float64)
    for epoch, mine in enumerate((lower_before, ~lower_before)):
        if not mine.any():
            continue
        space, top = spaces[epoch], columns.highest[epoch]
        between = stands_between(columns.cell, columns.cells, columns.tops, top, space.standing)
        known[mine] &= ~between[mine]
        if space.above is not None:
            known &= ~mine | open_above(middles, top, columns.tops[1 - epoch], space.above, config)
    return known


def open_above(middles: Floats, own: Floats, other: Floats, free: Free, config: TopConfig) -> np.ndarray:
    """Tell over which columns (C,) an epoch observed free space from its ``own`` top up to the ``other``.

    One free place does not show that a plant ends below it: beams of two rings pass over and under a bough.
    Places are asked every ``config.above`` metres, the first of them even where the other top is lower.
    """
    steps = np.maximum(np.ceil((other - own) / config.above - 1e-9), 1.0)
    open_ = np.ones(len(own), dtype=bool)
    for step in range(1, int(steps.max(initial=0.0)) + 1):
        ask = np.flatnonzero(open_ & (steps >= step))
        if len(ask) == 0:
            break
        places = np.column_stack([middles[ask], own[ask] + step * config.above])
        open_[ask] = free(places) >= config.free
    return open_


def stands_between(cell: float, cells: Ints, tops: Floats, own: Floats, standing: Floats) -> np.ndarray:
    """Tell in which columns (C,) points of another object reach between the tops of both epochs.

    Parameters
    ----------
    cell : float
        Edge of the columns [m].
    cells : (C, 2) int
    tops : (2, C) float64
        Of *before* and *after* [m].
    own : (C,) float64
        Of the epoch that is asked; its points below are those of the object itself [m].
    standing : (N, 3) float64
        Points of that epoch [m].
    """
    held = np.zeros(len(cells), dtype=bool)
    first, last = extent_of(cells)
    (west, south), (east, north) = first * cell, (last + 1) * cell
    x, y = standing[:, 0], standing[:, 1]
    xyz = standing[(x >= west) & (x < east) & (y >= south) & (y < north)]
    if len(xyz) == 0:
        return held
    distance, slot = cKDTree(cells).query(np.floor(xyz[:, :2] / cell), distance_upper_bound=0.5)
    xyz, slot = xyz[np.isfinite(distance)], slot[np.isfinite(distance)]
    low, high = tops.min(axis=0)[slot], tops.max(axis=0)[slot]
    between = (xyz[:, 2] > np.maximum(0.5 * (low + high), own[slot] + 1e-6)) & (xyz[:, 2] < high + 0.1)
    held[slot[between]] = True
    return held
