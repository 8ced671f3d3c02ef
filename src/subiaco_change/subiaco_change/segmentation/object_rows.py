"""Rows of objects of one epoch, split: houses at steps in height, parked cars at gaps (method, part C4)."""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from pydantic import Field
from scipy.spatial import cKDTree

from subiaco_change.geometry import tree_for_few
from subiaco_change.method_rules.switches import always, one_part, switchable
from subiaco_change.quantiles import quantile_of
from subiaco_change.segmentation.bounding_rectangles import box_coordinates, box_sides, wall_coordinates
from subiaco_change.segmentation.clustering import cell_clusters, connect, group_indices
from subiaco_geo.config import StrictModel
from subiaco_geo.frames import Floats, Ints


class ProfileConfig(StrictModel):
    """Steps that part a row; the defaults are those of houses."""

    step: float = Field(
        0.85, gt=0, description="Smallest step of the top height between two objects of a row [m]"
    )
    width: float = Field(3.5, gt=0, description="Shortest length of one object in a row [m]")
    level: float = Field(
        2.0, gt=0, description="Length of the stretch on either side of a step that must be level [m]"
    )
    slack: float = Field(
        0.3,
        gt=0,
        description="Largest variation of the heights on a level stretch, as a fraction of the step",
    )
    sudden: float = Field(
        0.8,
        gt=0,
        le=1,
        description="Fraction of the step that must occur between two adjacent cells of the profile",
    )
    cell: float = Field(
        0.5, gt=0, description="Length of the cells of the profile in which the top height is taken [m]"
    )
    lowest: float = Field(
        2.8,
        gt=0,
        description="Smallest top height above ground on both sides of a step [m]; lower tops are garages "
        "and carports",
    )


def level_steps(top: Floats, config: ProfileConfig) -> Ints:
    """Slots at which tops (slots,) step suddenly between level stretches, the most sudden first."""
    side, reach = round(config.width / config.cell), round(config.level / config.cell)
    reach = min(reach, side - 1)
    places = np.arange(side, len(top) - side + 1)
    if len(places) == 0:
        return places
    windows = sliding_window_view(top, reach)
    level, vary = np.median(windows, axis=1), np.ptp(windows, axis=1)
    found = np.zeros(len(places), dtype=bool)
    # The slot that the step is in has some of either side, and is left out of one.
    for skip_before, skip_after in ((0, 0), (1, 0), (0, 1)):
        before, after = places - reach - skip_before, np.minimum(places + skip_after, len(level) - 1)
        step = np.abs(level[before] - level[after])
        flat = np.maximum(vary[before], vary[after]) < config.slack * step
        sudden = np.abs(top[before + reach - 1] - top[after]) > config.sudden * step
        tall = np.minimum(level[before], level[after]) > config.lowest
        found |= (step > config.step) & flat & sudden & tall
    places = places[found]
    return places[np.argsort(-np.abs(top[places] - top[places - 1]), kind="stable")]


def part_slots(slot: Ints, places: Ints, config: ProfileConfig) -> Ints:
    """Parts (N,) from 0 of points in slots (N,), cut at the places in their order, a thing's width apart."""
    cuts: list[int] = []
    for place in places.tolist():
        if all(abs(place - cut) >= round(config.width / config.cell) for cut in cuts):
            cuts.append(place)
    return np.searchsorted(np.sort(cuts), slot, side="right")


@switchable("row_houses_by_steps", one_part)
def split_row(xy: Floats, height: Floats, config: ProfileConfig) -> Ints:
    """Part one building (N,) across its long side, labels from 0.

    Seen from the street only facades may be left of a row, with a veranda in front that they
    share, so that the greatest height across the row tells its houses, not the whole surface.
    Hips and gables rise slowly along it; a party wall is a sudden step between level stretches.
    Neighbours that a carport or gate joins part where that is lowest.

    Parameters
    ----------
    xy : (N, 2) float64 [m]
    height : (N,) float64
        Above ground [m].
    config : ProfileConfig
    """
    along, across = wall_coordinates(xy).T
    if np.ptp(along) < 2 * config.width:
        return np.zeros(len(xy), dtype=np.int64)
    slot = np.floor((along - along.min()) / config.cell).astype(np.int64)
    row = np.floor((across - across.min()) / config.cell).astype(np.int64)
    surface = np.full((slot.max() + 1, row.max() + 1), -np.inf)
    np.maximum.at(surface, (slot, row), height)
    top = np.maximum(surface.max(axis=1), 0.0)  # nothing seen: no house
    steps = [p for p in level_steps(top, config).tolist() if _depth_steps(surface, p, config)]
    return part_slots(slot, np.array([*_dips(top, config), *steps], dtype=np.int64), config)


@switchable("steps_in_depth", always)
def _depth_steps(surface: Floats, place: int, config: ProfileConfig) -> bool:
    """Tell whether the rows that both sides of a place show, verandas left out, step there too.

    They do not where the roof of one house is seen on one side of the place only.
    """
    sides = np.stack([surface[place - 3 : place - 1].max(axis=0), surface[place + 1 : place + 3].max(axis=0)])
    shown = np.isfinite(sides).all(axis=0) & (sides.max(axis=0) > config.lowest)
    gap = np.abs(sides[0, shown] - sides[1, shown])
    return bool(len(gap) == 0 or np.median(gap) > config.step)


def _no_slots(*_: object) -> Ints:
    """Return no slots."""
    return np.zeros(0, dtype=np.int64)


@switchable("row_houses_by_dips", _no_slots)
def _dips(top: Floats, config: ProfileConfig) -> Ints:
    """Slots at which the tops (slots,) are lowest between two houses."""
    run = np.cumsum(np.append(True, np.diff(top > config.lowest)))
    sizes = np.bincount(run)
    walls = []
    for k in np.unique(run[top <= config.lowest]).tolist():
        beside = (sizes[k - 1], sizes[k + 1] if k + 1 < len(sizes) else 0)
        if min(beside) * config.cell >= config.width:
            slots = np.flatnonzero(run == k)
            walls.append(slots[np.argmin(top[slots])])
    return np.array(walls, dtype=np.int64)


class PassageConfig(StrictModel):
    """What a passage between two houses is."""

    cell: float = Field(
        0.4, gt=0, description="Edge of the cells, seen from above, in which a passage leaves a gap [m]"
    )
    widest: float = Field(
        2.3, gt=0, description="Largest distance of two houses between which a passage is searched [m]"
    )
    ground: float = Field(
        0.3, gt=0, description="Largest distance of a ground point from the middle of a passage [m]"
    )
    length: float = Field(1.2, gt=0, description="Shortest length of a passage whose ground was seen [m]")
    house: float = Field(3.5, gt=0, description="Shortest observed length of a house beside a passage [m]")
    top: float = Field(
        2.8, gt=0, description="Smallest top height above ground of a house beside a passage [m]"
    )


def _clusters_as_they_are(_: Floats, __: Floats, labels: Ints, *___: object) -> Ints:
    """Return the clusters as they are."""
    return labels


@switchable("passages", _clusters_as_they_are)
def split_at_passages(
    xy: Floats, height: Floats, labels: Ints, ground: Floats, config: PassageConfig
) -> Ints:
    """Part clusters of buildings (N,) at passages: gaps in which the ground was seen between two houses.

    Parameters
    ----------
    xy : (N, 2) float64 [m]
    height : (N,) float64
        Above ground [m].
    labels : (N,) int
        Clusters from 0.
    ground : (M, 2) float64
        Ground points [m].
    config : PassageConfig
    """
    parted = np.zeros(len(labels), dtype=np.int64)
    tree = tree_for_few(ground) if len(ground) else None
    following = 0
    for members in group_indices(labels):
        own = np.zeros(len(members), dtype=np.int64)
        if tree is not None and np.ptp(box_coordinates(xy[members]), axis=0).max() >= 2 * config.house:
            own = _houses(xy[members], height[members], tree, config)
        parted[members] = own + following
        following += int(own.max()) + 1
    return parted


def _houses(xy: Floats, height: Floats, ground: cKDTree, config: PassageConfig) -> Ints:
    """Houses (N,) from 0 that passages part; what is too small for a house joins the nearest."""
    label = cell_clusters(xy, config.cell)
    groups = group_indices(label)
    houses = [
        g
        for g in groups
        if len(g) >= 3
        and quantile_of(height[g], 0.95) >= config.top
        and np.ptp(box_coordinates(xy[g]), axis=0).max() >= config.house
    ]
    if len(houses) < 2:
        return np.zeros(len(xy), dtype=np.int64)
    owner = np.repeat(np.arange(len(houses)), [len(g) for g in houses])
    nearest = owner[cKDTree(xy[np.concatenate(houses)]).query(xy)[1]]
    trees = [cKDTree(xy[g]) for g in group_indices(nearest)]
    together = [
        (i, j)
        for i in range(len(trees))
        for j in range(i)
        if _adjoins_without_passage(trees[i], trees[j], ground, config)
    ]
    return connect(len(trees), np.array(together, dtype=np.int64).reshape(-1, 2))[nearest]


def _adjoins_without_passage(one: cKDTree, other: cKDTree, ground: cKDTree, config: PassageConfig) -> bool:
    """Tell whether a house lies beside another without a passage whose ground was seen.

    The sides of a passage face each other: what is nearest to a point lies near what is nearest to that.
    Round a corner of one house that nobody saw, they do not.
    """
    distance, slot = other.query(one.data, distance_upper_bound=config.widest)
    near = np.isfinite(distance)
    if not near.any():
        return False
    here, there = one.data[near], other.data[slot[near]]
    back = one.data[one.query(there)[1]]
    facing = (distance[near] > config.cell) & (np.linalg.norm(back - here, axis=1) <= config.cell)
    middle = 0.5 * (here + there)[facing]
    seen = np.isfinite(ground.query(middle, distance_upper_bound=config.ground)[0])
    return len(np.unique(np.floor(middle[seen] / config.cell), axis=0)) * config.cell < config.length


class RowConfig(StrictModel):
    """What a row of cars is, and what the cars in it are."""

    length: float = Field(
        5.2, gt=0, description="Length above which a cluster of vehicles may be a row of cars [m]"
    )
    width: float = Field(
        2.3, gt=0, description="Width above which a cluster of vehicles may be a row of cars [m]"
    )
    top: float = Field(
        2.4,
        gt=0,
        description="Height above ground above which a cluster is a truck and is not divided into cars [m]",
    )
    gap: float = Field(
        0.2,
        gt=0,
        description="Smallest gap at which a row of cars is divided [m]; 0.3 m less the noise of the map",
    )
    car_length: float = Field(
        2.8, gt=0, description="Shortest observed length of a car that results from dividing a row [m]"
    )
    car_width: float = Field(
        1.0, gt=0, description="Smallest observed width of a car that results from dividing a row [m]"
    )


@switchable("parked_rows", _clusters_as_they_are)
def split_rows(xy: Floats, height: Floats, labels: Ints, config: RowConfig) -> Ints:
    """Part clusters (N,) too large for a car at gaps that run right through them.

    Parameters
    ----------
    xy : (N, 2) float64 [m]
    height : (N,) float64
        Above ground [m].
    labels : (N,) int
        Clusters from 0.
    config : RowConfig
    """
    parted = np.empty_like(labels)
    following = 0
    for members in group_indices(labels):
        for part in _parts(xy, height, members, config):
            parted[part] = following
            following += 1
    return parted


def _parts(xy: Floats, height: Floats, members: Ints, config: RowConfig) -> list[Ints]:
    """Cut at the widest gap that leaves a car on both sides, and go on with these."""
    if len(members) < 2 or quantile_of(height[members], 0.98) > config.top:
        return [members]
    sides = box_coordinates(xy[members])
    if (np.ptp(sides, axis=0) <= (config.length, config.width)).all():
        return [members]
    for axis in (0, 1):
        order = np.argsort(sides[:, axis], kind="stable")
        gaps = np.diff(sides[order, axis])
        for cut in np.argsort(-gaps, kind="stable")[: (gaps > config.gap).sum()].tolist():
            first, second = members[order[: cut + 1]], members[order[cut + 1 :]]
            if _is_car(xy[first], config) and _is_car(xy[second], config):
                return [*_parts(xy, height, first, config), *_parts(xy, height, second, config)]
    return [members]


def _is_car(xy: Floats, config: RowConfig) -> bool:
    long, short = box_sides(xy)
    return bool(long > config.car_length and short > config.car_width)
