"""Vehicle class: cars among other objects, trucks among buildings, and shelters that are neither."""

from __future__ import annotations

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from subiaco_change.geometry import in_box_around
from subiaco_change.method_rules.switches import applies, never, switchable
from subiaco_change.quantiles import quantile_of
from subiaco_change.segmentation.bounding_rectangles import box_coordinates, box_sides, in_box_of
from subiaco_change.segmentation.clustering import cell_clusters, group_indices, voxel_clusters
from subiaco_change.segmentation.config import VehicleConfig
from subiaco_change.segmentation.ground_model import Mask
from subiaco_change.segmentation.object_rows import split_rows
from subiaco_geo.clouds import stable_order, within_box
from subiaco_geo.codes import Semantic
from subiaco_geo.frames import Floats, Ints

_FEWEST = 15  # points of a vehicle


def _no_boxes(xyz: Floats, *_: object) -> tuple[Mask, Mask]:
    """Return no trucks and no shelters."""
    return np.zeros(len(xyz), dtype=bool), np.zeros(len(xyz), dtype=bool)


@switchable("large_vehicles", _no_boxes)
def free_boxes(
    xyz: Floats, height: Floats, core: Mask, part: Mask, hard: Mask, free: Mask, config: VehicleConfig
) -> tuple[Mask, Mask]:
    """Tell which points are trucks and buses, and which shelters: boxes on the ground, alone, like facades.

    They exceed the box of the paper's vehicles; two sides must be seen, else a lone wall would pass.

    Parameters
    ----------
    xyz, height : (N, 3), (N,) float64 [m]
    core : (N,) bool
        Planes that are facades or roofs.
    part : (N,) bool
        Smaller planes, of which a shelter may consist.
    hard : (N,) bool
        Points that may belong to a truck or shelter: neither ground nor foliage.
    free : (N,) bool
        Points that are no ground, which distinguish wheels from walls.
    config : VehicleConfig
    """
    below = _Columns(xyz, height, np.flatnonzero(free & (height < config.truck_top)), config.truck_gap)
    low = (height > config.split_band) & (height < config.truck_top + config.truck_gap)
    planar = core | part
    members = np.flatnonzero((planar | hard) & low)
    large, shelter = np.zeros((2, len(xyz)), dtype=bool)
    for group in group_indices(cell_clusters(xyz[members, :2], config.truck_gap)):
        mine = members[group]
        if planar[mine].mean() < config.truck_planes or not _is_free_box(xyz[mine], height[mine], config):
            continue
        if has_eaves(xyz[mine], height[mine], config):
            shelter[mine] = True
        elif core[mine].mean() > config.truck_planes and _foot(below.heights(xyz[mine])) < config.wheels:
            large[mine] = True
    low = height < config.truck_top
    return (
        _reach_out(xyz, large, low, config.truck_edge),
        _reach_out(xyz, shelter, low, config.truck_edge),
    )


class _Columns:
    """Heights of points by the cell [m] that they are in, seen from above."""

    def __init__(self, xyz: Floats, height: Floats, members: NDArray[np.int64], cell: float) -> None:
        self._cell = cell
        keys = self._keys(xyz[members])
        order = stable_order(keys)
        self._sorted, self._height = keys[order], height[members[order]]

    def _keys(self, xyz: Floats) -> NDArray[np.int64]:
        column, row = np.floor(xyz[:, :2] / self._cell).astype(np.int64).T
        return np.asarray((column << 32) + row)

    def heights(self, xyz: Floats) -> Floats:
        """All heights in the cells of points (N, 3)."""
        wanted = np.unique(self._keys(xyz))
        first, last = (np.searchsorted(self._sorted, wanted, side) for side in ("left", "right"))
        return np.concatenate([self._height[a:b] for a, b in zip(first, last, strict=True)])


def _foot(height: Floats) -> float:
    """Points a metre of height (N,) just above the ground, for those half a metre to 1.4 m above it."""
    foot, side = ((low < height) & (height <= high) for low, high in ((0.1, 0.35), (0.6, 1.4)))
    return float(foot.sum() / 0.25 / max(side.sum() / 0.8, 1.0))


def _reach_out(xyz: Floats, found: Mask, open_: Mask, reach: float) -> Mask:
    """Add the open points within reach [m] of the found ones."""
    loose = np.flatnonzero(open_ & ~found)
    grown = found.copy()
    if found.any() and len(loose):
        near = cKDTree(xyz[found]).query(xyz[loose], distance_upper_bound=reach)[0]
        grown[loose[np.isfinite(near)]] = True
    return grown


def _is_free_box(xyz: Floats, height: Floats, config: VehicleConfig) -> bool:
    if len(xyz) < 40 or quantile_of(height, 0.99) > config.truck_top or quantile_of(height, 0.02) > 0.8:
        return False
    length, width = box_sides(xyz[:, :2])
    return bool(2.8 < length < config.truck_length and config.truck_min_width < width < config.truck_width)


@switchable("eaves_of_shelters", never)
def has_eaves(xyz: Floats, height: Floats, config: VehicleConfig) -> bool:
    """Tell a shelter: its top stands out over its body; vehicles grow narrower upwards."""
    top = quantile_of(height, 0.98) - config.top_band
    head, body = height > top, (height < top - 0.15) & (height > config.split_band)
    if head.sum() < 4 or body.sum() < 4:
        return False
    sides = box_coordinates(xyz[:, :2])
    return bool((np.ptp(sides[head], axis=0) > np.ptp(sides[body], axis=0) + config.overhang).any())


def ground_boxes(
    xyz: Floats,
    height: Floats,
    foliage: Mask,
    upright: Mask,
    members: NDArray[np.int64],
    config: VehicleConfig,
) -> list[tuple[NDArray[np.int64], Semantic]]:
    """Vehicles, shelters and fences that meet in a low cluster, each with its class.

    It is one such box, or what is left apart once leaves and the lowest band are out.
    """
    hard = 1.0 - float(foliage[members].mean())
    whole = _kind(xyz[members], height[members], upright[members], hard, config)
    if whole is Semantic.MOBILE:
        return [(members, whole)]
    core = members[~foliage[members] & (height[members] > config.split_band)]
    labels = cell_clusters(xyz[core, :2], config.split_gap)
    labels = split_rows(xyz[core, :2], height[core], labels, config.rows)
    groups = [core[g] for g in group_indices(labels)]
    kinds = [_kind(xyz[g], height[g], upright[g], 1.0, config) for g in groups]
    parts = [(g, kind) for g, kind in zip(groups, kinds, strict=True) if kind is not None]
    return parts if parts or whole is None else [(members, whole)]


def _kind(xyz: Floats, height: Floats, upright: Mask, hard: float, config: VehicleConfig) -> Semantic | None:
    """Class of a compact thing that stands on the ground; None for what is no box of a vehicle's size."""
    if len(xyz) < _FEWEST:
        return None
    if not _fits(xyz, height, hard, config):
        return Semantic.MOBILE if _is_side_of_car(xyz, height, hard, config) else None
    top = quantile_of(height, 0.98)
    upper = upright[height > 0.5 * top].mean()
    thin = upper > config.screen_upright and _fill(xyz) < config.screen_fill
    tall = top > config.van_top  # garden fences are lower
    on_wheels = tall and _foot(height) < config.wheels and box_sides(xyz[:, :2])[0] < config.mobile_length
    screen = applies("screens", thin and not on_wheels)
    if screen or has_eaves(xyz, height, config):
        return Semantic.OTHER
    return Semantic.MOBILE


@switchable("one_sided_cars", never)
def _is_side_of_car(xyz: Floats, height: Floats, hard: float, config: VehicleConfig) -> bool:
    """Tell the side of a car that was seen from one side alone: its windows lean inwards.

    Walls and fences of that length are upright to their tops, and foliage is not smooth.
    """
    sides = box_coordinates(xyz[:, :2])
    length, width = np.ptp(sides, axis=0).tolist()
    top, low = quantile_of(height, 0.98), quantile_of(height, 0.02)
    if not (
        config.car_length < length < config.mobile_length
        and config.side_lean < width <= config.mobile_min_width
    ):
        return False
    if hard < config.side_hard or low > 0.6 or not 1.2 < top < 2.2:
        return False
    head, body = height > config.side_window * top, height < 0.5 * top
    if head.sum() < 4 or body.sum() < 4:
        return False
    return bool(abs(np.median(sides[head, 1]) - np.median(sides[body, 1])) > config.side_lean)


def release_false_vehicles(
    xyz: Floats,
    height: Floats,
    foliage: Mask,
    semantic: NDArray[np.uint8],
    moving: Mask,
    level: Mask,
    config: VehicleConfig,
) -> NDArray[np.uint8]:
    """Take the class of vehicles away from raised beds, and pieces of hedges and walls.

    A vehicle has clearance around it. A candidate without clearance takes the class of its surroundings.
    A low object that is mostly ``level`` is no car.
    """
    settled = semantic.copy()
    members = np.flatnonzero((semantic == Semantic.MOBILE) & ~moving)
    if len(members) == 0:
        return settled
    labels = voxel_clusters(xyz[members], config.clear_gap)
    crowd, beside = _surroundings(xyz, height, semantic, members, labels, config)
    for number, group in enumerate(group_indices(labels)):
        mine = members[group]
        if _is_slab(height[mine], level[mine], config):
            settled[mine] = Semantic.OTHER
        elif applies("clearance_of_vehicles", crowd[number] > _crowd_limit(xyz[mine], config)):
            leafy = foliage[mine].mean() > config.leafy
            settled[mine] = Semantic.VEGETATION if leafy else beside[number]
    return settled


def _classes_as_they_are(
    _: Floats, __: Floats, semantic: NDArray[np.uint8], *___: object
) -> NDArray[np.uint8]:
    """Return the classes as they are."""
    return semantic


@switchable("cabins", _classes_as_they_are)
def with_cabins(
    xyz: Floats, height: Floats, semantic: NDArray[np.uint8], config: VehicleConfig
) -> NDArray[np.uint8]:
    """Give plants of the size of a car, and with a cabin, the class of vehicles.

    Beams pass through windows and meet seats: sampled sparsely, a car is as rough as a shrub. But a car
    fills the rectangle around it, and its roof is much smaller than its body. A hedge is as wide at its top,
    and a shrub that narrows upwards is round. A fence, a narrow hedge or the ghost trail of a pedestrian that
    touches a car is thinner than the car, and is left out. A car that touches nothing is taken as it is: a
    survey that passed on one side may not show how thick it is.
    """
    low = np.flatnonzero((height > config.split_band) & (height < config.car_top))
    completed, plant = semantic.copy(), semantic == Semantic.VEGETATION

    def is_car(mine: Ints) -> bool:
        return bool(plant[mine].mean() > config.leafy and has_cabin(xyz[mine], height[mine], config))

    alone = group_indices(cell_clusters(xyz[low, :2], config.split_gap))
    for mine in filter(is_car, (low[group] for group in alone)):
        completed[mine] = Semantic.MOBILE
    low = low[completed[low] == semantic[low]]
    parts = _thick_parts(xyz[low, :2], height[low] < config.car_body, config)
    low, parts = low[parts >= 0], parts[parts >= 0]
    for group in group_indices(split_rows(xyz[low, :2], height[low], parts, config.rows)):
        of_row = _cars_of_row(xyz, height, low[group], config) if plant[low[group]].any() else []
        for mine in filter(is_car, of_row):
            completed[mine] = Semantic.MOBILE
    return completed


def _cars_of_row(xyz: Floats, height: Floats, members: Ints, config: VehicleConfig) -> list[Ints]:
    """Divide a group that is as wide as one car and longer into cars, where it is lowest: between bonnets."""
    along, across = box_coordinates(xyz[members, :2]).T
    if np.ptp(along) <= config.mobile_length or np.ptp(across) >= config.car_width:
        return [members]
    slot = np.floor((along - along.min()) / config.split_gap).astype(np.int64)
    top, shortest = np.zeros(slot.max() + 1), round(config.car_length / config.split_gap)
    np.maximum.at(top, slot, height[members])  # no points between two cars: 0
    between = ndimage.uniform_filter1d(top, round(config.bonnet / config.split_gap))[shortest:-shortest]
    if len(between) == 0:
        return [members]
    first = slot < shortest + int(between.argmin())
    sides = members[first], members[~first]
    return [car for side in sides for car in _cars_of_row(xyz, height, side, config)]


def _thick_parts(xy: Floats, body: Mask, config: VehicleConfig) -> Ints:
    """Return the number (N,) of the part of each point (N, 2); below 0 what is thinner than a car.

    Points of the ``body`` (N,) show how thick a part is, and of what is higher only the roof between them:
    branches may hang over a car.
    """
    if len(xy) == 0:
        return np.zeros(0, dtype=np.int64)
    reach = round(0.5 * config.car_width / config.split_gap)
    cell = np.floor(xy / config.split_gap).astype(np.int64)
    cell -= cell.min(axis=0) - 1 - reach
    held, above = np.zeros((2, *(cell.max(axis=0) + reach + 2)), dtype=bool)
    held[tuple(cell[body].T)] = True
    above[tuple(cell[~body].T)] = True
    held |= above & ndimage.binary_closing(held, np.ones((3, 3)), iterations=reach)
    half = 0.5 * config.thinnest_car / config.split_gap
    holes, count = ndimage.label(~held)
    small = np.bincount(holes.ravel(), minlength=count + 1) * config.split_gap**2 <= config.car_hole
    filled = held | small[holes]
    cores, _ = ndimage.label(ndimage.distance_transform_edt(filled) > half, np.ones((3, 3)))
    away, nearest = ndimage.distance_transform_edt(cores == 0, return_indices=True)
    parts = np.where((away <= half) & held, cores[tuple(nearest)], 0)
    return np.asarray(parts[tuple(cell.T)] - 1, dtype=np.int64)


def has_cabin(xyz: Floats, height: Floats, config: VehicleConfig) -> bool:
    """Tell a body of the size of a car that fills the rectangle around it, and that has a smaller roof.

    Parameters
    ----------
    xyz, height : (N, 3), (N,) float64
        Points of the body, and their height above ground [m].
    config : VehicleConfig
    """
    if len(xyz) < _FEWEST:
        return False
    sides = box_coordinates(xyz[:, :2])
    low, high = np.quantile(sides, [config.car_stray, 1.0 - config.car_stray], axis=0)
    inner = within_box(sides, low, high)
    sides, xyz, height = sides[inner], xyz[inner], height[inner]
    top = quantile_of(height, 0.98)
    length, width = (high - low).tolist()
    if not _is_car_sized(length, width, top, config):
        return False
    body, roof = (_held(s, config.split_gap) for s in (sides, sides[height > top - config.top_band]))
    outline = shapely.MultiPoint(xyz[:, :2]).convex_hull.area
    filled = body * config.split_gap**2 > config.cabin_fill * length * width
    return bool(
        filled and outline > config.cabin_outline * length * width and roof < config.cabin_share * body
    )


@switchable("edges_of_vehicles", _classes_as_they_are)
def with_edges(
    xyz: Floats, height: Floats, semantic: NDArray[np.uint8], moving: Mask, config: VehicleConfig
) -> NDArray[np.uint8]:
    """Give the rough points in the boxes of vehicles their class: edges look like leaves.

    Where a plant touches a vehicle, only its smooth points were found.
    """
    members = np.flatnonzero((semantic == Semantic.MOBILE) & ~moving)
    if len(members) == 0:
        return semantic
    loose = np.flatnonzero(np.isin(semantic, (Semantic.VEGETATION, Semantic.OTHER)) & ~moving)
    completed = semantic.copy()
    for group in group_indices(voxel_clusters(xyz[members], config.clear_gap)):
        mine = members[group]
        near = loose[in_box_around(xyz[loose, :2], xyz[mine, :2], config.edge)]
        near = near[height[near] < quantile_of(height[mine], 0.98) + config.edge]
        near = near[in_box_of(xyz[mine, :2], xyz[near, :2], config.edge)]
        whole = np.concatenate([mine, near])
        length, width = box_sides(xyz[whole, :2])
        if config.car_length < length < config.mobile_length and width < config.truck_width:
            completed[whole] = Semantic.MOBILE
    return completed


@switchable("slabs", never)
def _is_slab(height: Floats, level: Mask, config: VehicleConfig) -> bool:
    """Tell a raised bed or terrace: low, and mostly level where it stands out."""
    top = quantile_of(height, 0.98)
    return bool(top < config.slab_top and level[height > 0.5 * top].mean() > config.slab_level)


def _crowd_limit(xyz: Floats, config: VehicleConfig) -> float:
    narrow = box_sides(xyz[:, :2])[1] < config.clear_width
    return config.clear_share if narrow else config.clear_share_wide


def _surroundings(
    xyz: Floats,
    height: Floats,
    semantic: NDArray[np.uint8],
    members: NDArray[np.int64],
    labels: Ints,
    config: VehicleConfig,
) -> tuple[Floats, Ints]:
    """Share of the cells seen around each cluster that are not free, and the class of most there."""
    count = int(labels.max()) + 1
    tops = np.array([quantile_of(height[members[g]], 0.98) for g in group_indices(labels)])
    others = np.flatnonzero((semantic != Semantic.MOBILE) & (height < tops.max() + config.split_band))
    tree = cKDTree(xyz[members, :2])
    distance, slot = tree.query(xyz[others, :2], distance_upper_bound=config.clear_reach)
    near = np.isfinite(distance)
    others, own = others[near], labels[slot[near]]
    stands = (height[others] > config.clear_height) & (height[others] < tops[own] + config.split_band)
    column, row = np.floor(xyz[others, :2] / config.clear_cell).astype(np.int64).T
    column -= column.min(initial=0)
    row -= row.min(initial=0)
    key = (own * (int(column.max(initial=0)) + 1) + column) * (int(row.max(initial=0)) + 1) + row
    _, first, cell = np.unique(key, return_index=True, return_inverse=True)
    blocked = np.bincount(cell, stands, len(first)) > 0
    share = np.bincount(own[first], blocked, count) / np.maximum(np.bincount(own[first], minlength=count), 1)
    votes = np.bincount(
        own[stands] * len(Semantic) + semantic[others[stands]], minlength=count * len(Semantic)
    )
    return share, votes.reshape(count, -1).argmax(axis=1)


def _fill(xyz: Floats, cell: float = 0.25) -> float:
    """Share of its rectangle that a thing fills, seen from above."""
    sides = box_coordinates(xyz[:, :2])
    held = _held(sides - sides.min(axis=0), cell)
    return float(held * cell**2 / max(float(np.prod(np.ptp(sides, axis=0))), cell**2))


def _held(places: Floats, cell: float) -> int:
    """Count the cells that hold places (N, 2)."""
    column, row = np.floor(places / cell).astype(np.int64).T
    return len(np.unique((column << 32) + row))


def _fits(xyz: Floats, height: Floats, hard: float, config: VehicleConfig) -> bool:
    """Tell what fits the box of a vehicle or a row of them; cars may look softer."""
    length, width = box_sides(xyz[:, :2])
    top = quantile_of(height, 0.98)
    low = quantile_of(height, 0.02)
    row_of_cars = 1.4 < width < 3.2 and top < 2.4
    car = _is_car_sized(length, width, top, config)
    return bool(
        hard > (0.5 * config.mobile_hard if car else config.mobile_hard)
        and width > config.mobile_min_width
        and length > 1.4
        and (length < config.mobile_length or row_of_cars)
        and 0.8 < top < config.mobile_height
        and low < 0.8
        and length * width * top < config.mobile_volume
    )


def _is_car_sized(length: float, width: float, top: float, config: VehicleConfig) -> bool:
    """Tell what is as long, as wide and as high as a car [m]."""
    return bool(
        config.car_length < length < config.mobile_length
        and 1.4 < width < config.car_width
        and 1.2 < top < config.car_top
    )
