"""Swaths of ghost trails in a raster: of vehicles, of cyclists and people on foot, and their fragments.

The swath of a vehicle is as wide as the vehicle and filled from side to side, on ground that was seen, and
there is little just above the ground: a vehicle runs on wheels, where a hedge reaches the ground. The swath
of a person is thin and lies on open ground: a fence, a wall or a hedge of that length hides the ground behind
it, and a fence is a plane. A person sways, and hid any place beside the way for a moment only.

Where few beams met a moving vehicle, its trail falls apart into fragments. A fragment belongs to a known
trail if it lies in line with the trail, near it or near a fragment that does, and on ground that was seen. A
vehicle that stands at the end of a trail is larger than a fragment.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree
from scipy.special import expit

from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import first_argument, rule_mask, switchable, zeros_of_them
from subiaco_change.segmentation.clustering import group_indices
from subiaco_change.segmentation.ground_model import Mask
from subiaco_change.segmentation.trail_raster import AROUND, Raster, TrailShapeConfig, limited
from subiaco_geo.frames import Floats, Ints

_DIRECTIONS = NUMBERS.trail_swaths.directions
_VEHICLE = NUMBERS.trail_swaths.vehicle_area
_PART = NUMBERS.trail_swaths.part_area
_TALLER = NUMBERS.trail_swaths.taller
_SHORTEST = NUMBERS.trail_swaths.shortest_parked
_LONGEST = NUMBERS.trail_swaths.longest_parked
_NARROWEST = NUMBERS.trail_swaths.narrowest_parked
_REACH = NUMBERS.thin_trails.thickness_radius
_LEAST = NUMBERS.thin_trails.fewest_points
_SAMPLE = NUMBERS.thin_trails.thickness_places
_WINDOW = NUMBERS.thin_trails.open_window
_OPEN = NUMBERS.thin_trails.open_quantile
_DIRECTION = NUMBERS.trail_ends.direction_reach
_STRAIGHT = NUMBERS.trail_ends.straightness
_BLOCK = NUMBERS.trail_ends.block
_ROUNDS = NUMBERS.trail_ends.most_pieces

SURE = NUMBERS.trail_swaths.certain


@dataclass(frozen=True)
class _Swath:
    """Cells of one swath (rows, columns of the window), its log odds of being a trail, and its window."""

    cells: Mask
    odds: float
    beside: float
    window: tuple[slice, slice]


def find_swaths(raster: Raster, config: TrailShapeConfig) -> tuple[Floats, Mask]:
    """Return the probability of the cells (rows, columns) of swaths, and all wide bodies."""
    cells = np.zeros(raster.ground.shape)
    wide = ndimage.binary_opening(ndimage.binary_closing(raster.body, AROUND), AROUND)
    axis, parked = _axis(raster, config)
    axis = ndimage.binary_dilation(axis, AROUND, 2)
    parked = ndimage.binary_dilation(parked, AROUND)
    labels, _ = ndimage.label(ndimage.binary_opening(wide & ~parked, AROUND), AROUND)
    rim = int(np.ceil(config.beside / config.cell))
    for number, found in enumerate(ndimage.find_objects(labels), 1):
        low = [max(part.start - rim, 0) for part in found]
        high = [part.stop + rim for part in found]
        window = (slice(low[0], high[0]), slice(low[1], high[1]))
        swath = _measure(labels[window] == number, wide[window], raster, window, config)
        if swath is not None:
            np.copyto(cells[window], _by_parts(swath, axis[window], raster, config), where=swath.cells)
    return cells, wide


@switchable("trail_edges", first_argument)
def with_edges(cells: Floats, wide: Mask, body: Mask, config: TrailShapeConfig) -> Floats:
    """Give the ragged edges of trails (rows, columns) their probability.

    Cells of bodies beside a swath belong to it. So do the groups of them, farther out, that lie wholly where
    a vehicle of the trail may have reached.
    """
    near = ndimage.grey_dilation(cells, footprint=np.ones((5, 5)))
    found = np.where(wide, cells, near)
    width = 2 * round(config.edge / config.cell) + 1
    reached = ndimage.grey_dilation(cells, footprint=np.ones((width, width)))
    left, count = ndimage.label(body & (found < SURE), AROUND)
    if count:
        numbers = np.arange(1, count + 1)
        share = np.asarray(ndimage.mean(reached >= SURE, left, numbers))
        inside = np.append(False, share >= config.edge_share)[left] & ~wide
        found[inside] = reached[inside]
    return np.asarray(found)


def _axis(raster: Raster, config: TrailShapeConfig) -> tuple[Mask, Mask]:
    """Tell from which cells (rows, columns) bodies go on along a line, and which are parked vehicles.

    From an axis they go on nearly without a gap, forth and back. A parked vehicle that touches a trail is
    shorter than the line, and is left out. So are those of a row beside the trail: the rows of cells along
    the street end at both ends of each of them, or lead over ground that they hide. Of a trail, the ground
    was seen before the vehicle came and after it had left.
    """
    body, half = raster.body, max(round(config.run / config.cell), 1)
    steps = np.arange(-half, half + 1)
    padded = np.pad(body, half)
    seen_ground = ndimage.binary_closing(raster.ground)
    lit = np.pad(body & seen_ground, half)
    found = np.zeros(body.shape, dtype=np.bool_)
    ends = np.zeros(body.shape, dtype=np.bool_)
    most, seen = np.zeros((2, *body.shape), dtype=np.float32)
    for angle in np.arange(_DIRECTIONS) * np.pi / _DIRECTIONS:
        line = np.rint(steps[:, None] * np.array([np.cos(angle), np.sin(angle)])).astype(np.int64)
        held, run = _along(padded, line, half)
        found |= np.minimum(held[0] - 1, held[1]) >= config.run_share * half
        along = ndimage.uniform_filter(np.where(body, held.sum(axis=0), 0).astype(np.float32), 4 * half + 1)
        length = run.sum(axis=0) * config.cell
        ends_here = (run[0] <= half) & (run[1] < half) & (length >= _SHORTEST) & (length <= _LONGEST)
        seen_here = _count(lit, line, half) / np.maximum(_count(padded, line, half), 1)
        longer = along > most
        ends, seen = np.where(longer, ends_here, ends), np.where(longer, seen_here, seen)
        most = np.maximum(most, along)
    hides = body & (seen < config.ground * _open_share(seen_ground, config))
    parked = rule_mask(
        "parked_beside_trails",
        _vehicles(ends & body, config) | _vehicles(body & ndimage.binary_dilation(hides), config),
    )
    return found & ~parked, parked


def _vehicles(cells: Mask, config: TrailShapeConfig) -> Mask:
    """Keep what is as wide and as large as a parked vehicle of some cells (rows, columns)."""
    wide = max(round(_NARROWEST / config.cell), 1)
    labels, count = ndimage.label(ndimage.binary_opening(cells, np.ones((wide, wide))), AROUND)
    large = np.bincount(labels.ravel(), minlength=count + 1) * config.cell**2 >= _VEHICLE
    large[0] = False
    return np.asarray(large[labels])


def _count(padded: Mask, line: Ints, half: int) -> NDArray[np.int16]:
    """Count the cells that hold something at steps (K, 2) of a line from every cell (rows, columns)."""
    rows, columns = (size - 2 * half for size in padded.shape)
    total = np.zeros((rows, columns), dtype=np.int16)
    for row, column in line + half:
        total += padded[row : row + rows, column : column + columns]
    return total


def _along(padded: Mask, line: Ints, half: int) -> tuple[NDArray[np.int16], NDArray[np.int16]]:
    """Count cells of bodies along a line from every cell: all of them, and those up to the first gap.

    Gaps of one cell are closed. Both counts (2, rows, columns) are back, the cell itself included, and forth.
    """
    rows, columns = (size - 2 * half for size in padded.shape)
    before, after = (tuple(line[half + step]) for step in (-1, 1))
    closed = padded | (np.roll(padded, before, (0, 1)) & np.roll(padded, after, (0, 1)))
    ways = line[half::-1], line[half + 1 :]
    held = np.stack([_count(closed, way, half) for way in ways])
    run = np.zeros_like(held)
    for side, way in enumerate(ways):
        missed = np.zeros((rows, columns), dtype=np.int8)
        for row, column in way + half:
            there = slice(row, row + rows), slice(column, column + columns)
            missed = np.where(padded[there] & (missed < 2), 0, missed + 1)
            run[side] += missed < 2
    return held, run


def _measure(
    cells: Mask, wide: Mask, raster: Raster, window: tuple[slice, slice], config: TrailShapeConfig
) -> _Swath | None:
    """Measure a swath; None where it is too small to tell anything."""
    area = float(cells.sum()) * config.cell**2
    if area < config.least_area:
        return None
    depth = ndimage.distance_transform_edt(np.pad(cells, 1))[1:-1, 1:-1]
    width = 2.0 * config.cell * float(np.median(depth[depth >= np.quantile(depth[cells], 0.7)]))
    inner = depth >= 2.0
    beside = ~wide & (ndimage.distance_transform_edt(~cells) * config.cell < config.beside)
    ground = raster.ground[window]
    lit = max(float(ground[beside].mean()) if beside.any() else 1.0, 0.1)
    seen = float(ground[cells].mean()) / lit
    low = float(raster.foot[window][beside].mean()) if beside.any() else 0.0
    foot = (float(raster.foot[window][cells].mean()) - low) / max(1.0 - low, 0.1)
    length = min(area / width, _extent(cells) * config.cell)
    fill = float(raster.inside[window][inner].mean()) if inner.any() else 0.0
    odds = config.prior + sum(
        (
            limited((length - config.length) / config.length_scale),
            limited(min(width - config.width, config.widest - width) / config.width_scale),
            limited((fill - config.fill) / config.fill_scale),
            limited((seen - config.ground) / config.ground_scale),
            limited((config.foot - foot) / config.foot_scale),
        )
    )
    return _Swath(cells, odds, lit, window)


def _extent(cells: Mask) -> float:
    """Extent of a swath (rows, columns) along its main direction [cells]: shrubs that sprawl are no trail."""
    places = np.argwhere(cells).astype(np.float64)
    places -= places.mean(axis=0)
    along = places @ np.linalg.eigh(places.T @ places)[1][:, -1]
    return float(np.ptp(along)) + 1.0


def _by_parts(swath: _Swath, axis: Mask, raster: Raster, config: TrailShapeConfig) -> Floats:
    """Probability (rows, columns) of the parts of a swath: beside its axis a standing vehicle may touch it.

    Parts beside the axis are trail where they are filled and stand on seen ground, as the swath itself.
    """
    chance = np.where(swath.cells, expit(swath.odds), 0.0)
    tops = raster.top[swath.window]
    known = tops[swath.cells & axis & np.isfinite(tops)]
    usual = float(np.quantile(known, 0.8)) if len(known) else np.inf
    high = swath.cells & (tops > usual + _TALLER)
    beside, _ = ndimage.label(swath.cells & ~axis, AROUND)
    ground, inside = raster.ground[swath.window], raster.inside[swath.window]
    depth = ndimage.distance_transform_edt(np.pad(swath.cells, 1))[1:-1, 1:-1]
    for number, found in enumerate(ndimage.find_objects(beside), 1):
        part = beside[found] == number
        if part.sum() * config.cell**2 < _PART:
            continue
        inner = part & (depth[found] >= 2.0)
        fill = float(inside[found][inner].mean()) if inner.any() else 0.0
        odds = config.beside_axis if part.sum() * config.cell**2 >= _VEHICLE else 0.0
        odds += limited((fill - config.fill) / config.fill_scale)
        odds += limited(
            (float(ground[found][part].mean()) / swath.beside - config.ground) / config.ground_scale
        )
        if odds < 0:
            whole = ndimage.binary_dilation(beside == number, AROUND, 2) & swath.cells
            chance[whole] = np.minimum(chance[whole], expit(odds))
    raised, _ = ndimage.label(high, AROUND)
    for number, found in enumerate(ndimage.find_objects(raised), 1):
        if config.cell * np.hypot(*(part.stop - part.start for part in found)) < 2.0 * config.run:
            chance[ndimage.binary_dilation(raised == number, AROUND)] = 0.0
    return chance


@switchable("thin_trails", zeros_of_them)
def thin_trails(xyz: Floats, index: Ints, raster: Raster, config: TrailShapeConfig) -> Floats:
    """Return the probability (N,) that points (N, 3) of bodies were left by a cyclist or a person on foot.

    Parameters
    ----------
    xyz : (N, 3) float64
        Points of bodies that no vehicle left [m].
    index : (N, 2) int64
        Their cells.
    raster : Raster
    config : TrailShapeConfig
    """
    chance = np.zeros(len(xyz))
    body = np.zeros(raster.ground.shape, dtype=np.bool_)
    body[tuple(index.T)] = True
    labels, _ = ndimage.label(ndimage.binary_closing(body, AROUND), AROUND)
    open_ground = _open_share(raster.ground, config)
    for number, members in enumerate(group_indices(labels[tuple(index.T)].astype(np.int64))):
        length = float(np.hypot(*np.ptp(xyz[members, :2], axis=0))) if len(members) >= _LEAST else 0.0
        if number == 0 or length < config.thin_length - 6.0 * config.thin_length_scale:
            continue
        rim = int(np.ceil(config.beside / config.cell)) + 1
        low, high = index[members].min(axis=0) - rim, index[members].max(axis=0) + rim + 1
        window = (slice(max(low[0], 0), high[0]), slice(max(low[1], 0), high[1]))
        odds = _lit_odds(labels[window] == number, labels[window] > 0, raster, window, open_ground, config)
        if odds <= 0:
            continue
        spread = _thickness(xyz[members, :2])
        if np.median(spread) < config.thickest:
            thick = limited((float(np.median(spread)) - config.thickness) / config.thickness_scale)
            long = limited((length - config.thin_length) / config.thin_length_scale)
            chance[members] = np.where(spread < config.thickest, expit(2.0 * min(odds, thick, long)), 0.0)
    return chance


def _open_share(ground: Mask, config: TrailShapeConfig) -> float:
    """Share of the cells of open ground that hold ground points: how densely ground was seen at all."""
    size = round(_WINDOW / config.cell)
    share = ndimage.uniform_filter(ground.astype(np.float64), size)[ground]
    return float(np.quantile(share, _OPEN)) if len(share) else 1.0


def _lit_odds(
    cells: Mask,
    bodies: Mask,
    raster: Raster,
    window: tuple[slice, slice],
    open_ground: float,
    config: TrailShapeConfig,
) -> float:
    """Log odds of a trail by the ground beside it, its height, and what is over it."""
    away = ndimage.distance_transform_edt(~cells)
    ring = (away > 1.5) & (away * config.cell < config.beside) & ~bodies
    if not ring.any():
        return -6.0
    ground, tops = raster.ground[window], raster.top[window]
    beside = float(ground[ring].mean())
    lit = limited((beside / open_ground - config.lit) / config.ground_scale)
    reached = tops[cells & np.isfinite(tops)]
    tall = limited((float(np.median(reached)) - config.thin_top) / config.thin_top_scale)
    over = limited((config.overhead - float((tops[cells] > config.body_top).mean())) / config.ground_scale)
    return min(lit, tall, over)


def _thickness(xy: Floats) -> Floats:
    """Return the standard deviation (N,) across a swath at its points (N, 2) [m], told at sampled places."""
    some = xy[:: max(len(xy) // _SAMPLE, 1)]
    tree = cKDTree(xy)
    spread = np.zeros(len(some))
    for number, near in enumerate(tree.query_ball_point(some, _REACH)):
        if len(near) > 2:
            spread[number] = np.sqrt(max(float(np.linalg.eigvalsh(np.cov(xy[near].T))[0]), 0.0))
    return np.asarray(spread[cKDTree(some).query(xy)[1]])


@switchable("trail_pieces", first_argument)
def with_pieces(cells: Floats, raster: Raster, sure: float, config: TrailShapeConfig) -> Floats:
    """Return the probability of cells (rows, columns), with pieces that continue sure trails.

    Parameters
    ----------
    cells : (rows, columns) float64
        Probability that the bodies of cells moved.
    raster : Raster
    sure : float
        Probability from which a cell belongs to a trail; pieces get it.
    config : TrailShapeConfig
    """
    labels, count = _pieces(raster.body & (cells < sure), config)
    known = np.argwhere(cells >= sure).astype(np.float64) * config.cell
    if count == 0 or len(known) == 0:
        return cells
    index = np.argwhere(labels > 0)
    number = labels[tuple(index.T)]
    places = index.astype(np.float64) * config.cell
    open_pieces = _candidates(labels, count, raster, config)
    pieces = {k: places[m] for k, m in enumerate(group_indices(number)) if open_pieces[k]}
    found = cells.copy()
    for _ in range(_ROUNDS):
        tree = cKDTree(known)
        joined = [k for k in sorted(pieces) if _continues(pieces[k], known, tree, config)]
        if not joined:
            break
        found[np.isin(labels, joined)] = sure
        known = np.concatenate([known, *(pieces.pop(k) for k in joined)])
    return found


def _pieces(bodies: Mask, config: TrailShapeConfig) -> tuple[Ints, int]:
    """Give numbers to the pieces (rows, columns) of bodies, without what may be a standing vehicle."""
    groups, count = ndimage.label(bodies, AROUND)
    area = np.bincount(groups.ravel(), minlength=count + 1) * config.cell**2
    extent = [0.0] + [
        config.cell * max(part.stop - part.start for part in found) for found in ndimage.find_objects(groups)
    ]
    vehicle = (area >= config.piece) & (np.array(extent) < config.piece_length)
    edge = max(round(_BLOCK / config.cell), 1)
    row, column = (np.arange(size) // edge for size in bodies.shape)
    block = row[:, None] * (column.max() + 1) + column[None, :]
    key = np.where(bodies & ~vehicle[groups], groups * (block.max() + 1) + block + 1, 0)
    values, labels = np.unique(key, return_inverse=True)
    labels = labels.reshape(key.shape) + int(values[0] > 0)
    return labels.astype(np.int64), int(labels.max())


def _candidates(labels: Ints, count: int, raster: Raster, config: TrailShapeConfig) -> Mask:
    """Tell which pieces (count + 1,) lie on seen ground and are as low as a car."""
    numbers = np.arange(count + 1)
    seen = ndimage.maximum_filter(raster.ground, 3).astype(np.float64)
    on_ground = np.asarray(ndimage.mean(seen, labels, numbers)) >= config.ground
    low = np.asarray(ndimage.maximum(raster.top, labels, numbers)) < config.body_top
    candidates = np.asarray(on_ground & low)
    candidates[0] = False
    return candidates


def _continues(piece: Floats, known: Floats, tree: cKDTree, config: TrailShapeConfig) -> bool:
    """Tell whether a piece (N, 2) lies near known cells of trails (M, 2), in line with them [m]."""
    distance, nearest = tree.query(piece, distance_upper_bound=config.piece_gap)
    if not np.isfinite(distance).any():
        return False
    start = known[nearest[int(np.argmin(distance))]]
    around = known[tree.query_ball_point(start, _DIRECTION)]
    values, axes = np.linalg.eigh(np.cov(around.T)) if len(around) > 2 else (np.ones(2), np.eye(2))
    if values[1] < _STRAIGHT**2 * max(values[0], 1e-9):
        return False
    aside = np.abs((piece - around.mean(axis=0)) @ axes[:, 0])
    return bool(aside.max() <= config.piece_aside)
