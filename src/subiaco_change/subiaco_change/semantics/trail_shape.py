"""Ghost trails of moving vehicles in a cloud that keeps neither counts nor times of beams, told by shape.

A vehicle that moved while it was mapped leaves a swath as wide as itself and many times as long. The swath
is filled from side to side, because the front and the rear of the vehicle were met at every place along it,
and the road beneath was seen as well as the road beside it, before the vehicle came and after it had left.
A standing vehicle is short, hollow, and hides part of the ground beneath it; a hedge, a wall or a barrier
hides all of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import Field
from scipy import ndimage
from scipy.special import expit

from subiaco_change.semantics.ground import Mask
from subiaco_geo.config import StrictModel
from subiaco_geo.frames import Floats, Ints

_AROUND = np.ones((3, 3), dtype=np.bool_)  # a cell and the eight around it
_DIRECTIONS = 24  # of straight lines in half a turn
_SURE = 0.9  # probability from which an edge belongs to a trail
_PART = 1.0  # footprint of a part beside the axis of a trail that may be an object of its own [m2]
_TALLER = 0.5  # what rises so far above a trail does not belong to it [m]
_LAYER = 0.5  # height of a layer in which a trail is followed upward [m]


class TrailShapeConfig(StrictModel):
    """Shape of the ghost trails of moving vehicles, for clouds without counts and times of beams."""

    cell: float = Field(
        0.3,
        gt=0,
        description="edge of the raster cells in which the shape of trails is measured [m]; coarser clouds"
        " need larger cells",
    )
    bottom: float = Field(
        0.3, gt=0, description="height above ground from which points belong to the body of a vehicle [m]"
    )
    body_top: float = Field(
        2.0, gt=0, description="height above ground up to which the width of a trail is measured [m]"
    )
    top: float = Field(3.8, gt=0, description="greatest height above ground of a vehicle [m]")
    ground_band: float = Field(
        0.15, gt=0, description="distance from the ground model within which a point is ground [m]"
    )
    roof: float = Field(
        0.4,
        ge=0,
        description="distance below the highest point of a vehicle that its roof may take; what lies lower"
        " and away from the sides is inside the vehicle [m]",
    )
    run: float = Field(
        5.0,
        gt=0,
        description="distance for which a trail must go on, forth and back along a straight line; the whole"
        " line is longer than a parked vehicle [m]",
    )
    run_share: float = Field(
        0.75,
        gt=0,
        le=1,
        description="share of such a line that must be occupied, gaps of one cell closed [1]",
    )
    least_area: float = Field(
        4.0, gt=0, description="footprint below which the shape of a trail says nothing [m2]"
    )
    length: float = Field(
        15.0,
        gt=0,
        description="length of a swath, its area over its width, at which a trail is as likely as a row of"
        " standing objects; raise it where long hedges stand between lanes [m]",
    )
    length_scale: float = Field(
        1.2, gt=0, description="difference of length that changes the log odds of a trail by 1 [m]"
    )
    width: float = Field(
        1.5, gt=0, description="width of a swath from which a vehicle is likelier than a hedge [m]"
    )
    widest: float = Field(
        3.6, gt=0, description="width of a swath above which it is no trail of one vehicle [m]"
    )
    width_scale: float = Field(
        0.15, gt=0, description="difference of width that changes the log odds of a trail by 1 [m]"
    )
    fill: float = Field(
        0.38,
        gt=0,
        lt=1,
        description="share of the cells inside a swath that hold points below its roof, at which a trail is"
        " as likely as a standing vehicle [1]",
    )
    fill_scale: float = Field(
        0.06, gt=0, description="difference of that share that changes the log odds of a trail by 1 [1]"
    )
    ground: float = Field(
        0.9,
        gt=0,
        lt=1,
        description="share of the cells beneath a swath where ground was seen, relative to the cells beside"
        " it, at which a trail is as likely as a standing object [1]",
    )
    ground_scale: float = Field(
        0.04, gt=0, description="difference of that share that changes the log odds of a trail by 1 [1]"
    )
    prior: float = Field(
        -1.0, description="log odds that a swath is a trail before its shape is considered [1]"
    )
    beside_axis: float = Field(
        -2.0,
        le=0,
        description="log odds that a part of a swath beside its axis belongs to the trail, before its"
        " shape is considered; lower it where standing vehicles that touch a trail are left out [1]",
    )
    edge: float = Field(
        0.9,
        ge=0,
        description="distance from a trail up to which the ragged edge of the trail reaches; small objects"
        " wholly within it count as trail, raise it where edges of trails are reported as objects [m]",
    )
    edge_share: float = Field(
        0.95, gt=0, le=1, description="share of the footprint of such an object that must lie within it [1]"
    )
    beside: float = Field(
        1.8, gt=0, description="distance from a swath within which the ground beside it is asked [m]"
    )


@dataclass(frozen=True)
class _Raster:
    """Cells of a cloud: ground seen, body of something, highest point [m], and points inside, below roofs."""

    index: Ints  # (N, 2) cell of every point
    ground: Mask
    body: Mask
    inside: Mask
    top: Floats


@dataclass(frozen=True)
class _Swath:
    """Cells of one swath (rows, columns of the window), its log odds of being a trail, and its window."""

    cells: Mask
    odds: float
    beside: float
    window: tuple[slice, slice]


def trail_probability(xyz: Floats, height: Floats, config: TrailShapeConfig) -> Floats:
    """Return the probability (N,) that points (N, 3) were left by a moving vehicle.

    Parameters
    ----------
    xyz : (N, 3) float64
        Upright local frame, with some 50 m of surroundings: the length of a trail tells most [m].
    height : (N,) float64
        Above ground [m].
    config : TrailShapeConfig
    """
    chance = np.zeros(len(xyz))
    body = (height > config.bottom) & (height < config.body_top)
    if not body.any():
        return chance
    raster = _rasterise(xyz, height, config)
    cells = np.zeros(raster.ground.shape)
    wide = ndimage.binary_opening(ndimage.binary_closing(raster.body, _AROUND), _AROUND)
    axis = ndimage.binary_dilation(_axis(raster.body, config), _AROUND, 2)
    labels, _ = ndimage.label(wide, _AROUND)
    rim = int(np.ceil(config.beside / config.cell))
    for number, found in enumerate(ndimage.find_objects(labels), 1):
        low = [max(part.start - rim, 0) for part in found]
        high = [part.stop + rim for part in found]
        window = (slice(low[0], high[0]), slice(low[1], high[1]))
        swath = _measure(labels[window] == number, wide[window], raster, window, config)
        if swath is not None:
            chance = _by_parts(swath, axis[window], raster, config)
            np.copyto(cells[window], chance, where=swath.cells)
    return _upward(height, _with_edges(cells, wide, raster.body, config), raster.index, config)


def _with_edges(cells: Floats, wide: Mask, body: Mask, config: TrailShapeConfig) -> Floats:
    """Give the ragged edges of trails (rows, columns) their probability.

    Cells of bodies beside a swath belong to it. So do the groups of them, farther out, that lie wholly where
    a vehicle of the trail may have reached.
    """
    near = ndimage.grey_dilation(cells, footprint=np.ones((5, 5)))
    found = np.where(wide, cells, near)
    width = 2 * round(config.edge / config.cell) + 1
    reached = ndimage.grey_dilation(cells, footprint=np.ones((width, width)))
    left, count = ndimage.label(body & (found < _SURE), _AROUND)
    if count:
        numbers = np.arange(1, count + 1)
        share = np.asarray(ndimage.mean(reached >= _SURE, left, numbers))
        inside = np.append(False, share >= config.edge_share)[left] & ~wide
        found[inside] = reached[inside]
    return np.asarray(found)


def _axis(body: Mask, config: TrailShapeConfig) -> Mask:
    """Tell from which cells (rows, columns) bodies go on nearly without a gap, forth and back along a line.

    A parked vehicle that touches a trail is shorter than the line, and is left out.
    """
    half = max(round(config.run / config.cell), 1)
    steps = np.arange(-half, half + 1)
    padded = np.pad(body, half)
    rows, columns = body.shape
    found = np.zeros(body.shape, dtype=np.bool_)
    for angle in np.arange(_DIRECTIONS) * np.pi / _DIRECTIONS:
        line = np.rint(steps[:, None] * np.array([np.cos(angle), np.sin(angle)])).astype(np.int64)
        before, after = (tuple(line[half + step]) for step in (-1, 1))
        closed = padded | (np.roll(padded, before, (0, 1)) & np.roll(padded, after, (0, 1)))
        held = [np.zeros(body.shape, dtype=np.int16) for _ in range(2)]
        for place, (row, column) in enumerate(line + half):
            held[int(place > half)] += closed[row : row + rows, column : column + columns]
        found |= np.minimum(held[0] - 1, held[1]) >= config.run_share * half
    return found


def _rasterise(xyz: Floats, height: Floats, config: TrailShapeConfig) -> _Raster:
    place = np.floor(xyz[:, :2] / config.cell).astype(np.int64)  # of one lattice for all tiles of a cloud
    index = place - place.min(axis=0) + 2
    shape = tuple(int(size) for size in index.max(axis=0) + 3)

    def held(points: Mask) -> Mask:
        cells = np.zeros(shape, dtype=np.bool_)
        cells[tuple(index[points].T)] = True
        return cells

    vehicle = (height > config.bottom) & (height < config.top)
    top = np.full(shape, -np.inf)
    np.maximum.at(top, tuple(index[vehicle].T), height[vehicle])
    roof = ndimage.grey_dilation(top, footprint=_AROUND)[tuple(index.T)] - config.roof
    body = vehicle & (height < config.body_top)
    return _Raster(
        index, held(np.abs(height) < config.ground_band), held(body), held(body & (height < roof)), top
    )


def _measure(
    cells: Mask, wide: Mask, raster: _Raster, window: tuple[slice, slice], config: TrailShapeConfig
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
    fill = float(raster.inside[window][inner].mean()) if inner.any() else 0.0
    odds = config.prior + sum(
        (
            _term((area / width - config.length) / config.length_scale),
            _term(min(width - config.width, config.widest - width) / config.width_scale),
            _term((fill - config.fill) / config.fill_scale),
            _term((seen - config.ground) / config.ground_scale),
        )
    )
    return _Swath(cells, odds, lit, window)


def _term(log_odds: float, most: float = 2.0, least: float = -6.0) -> float:
    """Limit what one measure of the shape may say."""
    return float(np.clip(log_odds, least, most))


def _by_parts(swath: _Swath, axis: Mask, raster: _Raster, config: TrailShapeConfig) -> Floats:
    """Probability (rows, columns) of the parts of a swath: beside its axis a standing vehicle may touch it.

    Parts beside the axis are trail where they are filled and stand on seen ground, as the swath itself.
    """
    chance = np.where(swath.cells, expit(swath.odds), 0.0)
    tops = raster.top[swath.window]
    known = tops[swath.cells & axis & np.isfinite(tops)]
    usual = float(np.quantile(known, 0.8)) if len(known) else np.inf
    high = swath.cells & (tops > usual + _TALLER)
    beside, _ = ndimage.label(swath.cells & ~axis, _AROUND)
    ground, inside = raster.ground[swath.window], raster.inside[swath.window]
    depth = ndimage.distance_transform_edt(np.pad(swath.cells, 1))[1:-1, 1:-1]
    for number, found in enumerate(ndimage.find_objects(beside), 1):
        part = beside[found] == number
        if part.sum() * config.cell**2 < _PART:
            continue
        inner = part & (depth[found] >= 2.0)
        fill = float(inside[found][inner].mean()) if inner.any() else 0.0
        odds = config.beside_axis + _term((fill - config.fill) / config.fill_scale)
        odds += _term(
            (float(ground[found][part].mean()) / swath.beside - config.ground) / config.ground_scale
        )
        if odds < 0:
            whole = ndimage.binary_dilation(beside == number, _AROUND, 2) & swath.cells
            chance[whole] = np.minimum(chance[whole], expit(odds))
    raised, _ = ndimage.label(high, _AROUND)
    for number, found in enumerate(ndimage.find_objects(raised), 1):
        if config.cell * np.hypot(*(part.stop - part.start for part in found)) < 2.0 * config.run:
            chance[ndimage.binary_dilation(raised == number, _AROUND)] = 0.0
    return chance


def _upward(height: Floats, cells: Floats, index: Ints, config: TrailShapeConfig) -> Floats:
    """Give points (N,) the probability of their cells, upward as far as they hang together."""
    chance = np.where((height > config.bottom) & (height < config.body_top), cells[tuple(index.T)], 0.0)
    reached = chance > 0
    layers = int(np.ceil((config.top - config.body_top) / _LAYER))
    for layer in range(layers):
        low = config.body_top + layer * _LAYER
        below = np.zeros(cells.shape)
        held = reached & (height >= low - _LAYER) & (height < low)
        np.maximum.at(below, tuple(index[held].T), chance[held])
        below = ndimage.grey_dilation(below, footprint=_AROUND)
        here = (height >= low) & (height < min(low + _LAYER, config.top))
        chance[here] = below[tuple(index[here].T)]
        reached |= here & (chance > 0)
    low_edge = (height > 0.5 * config.bottom) & (height <= config.bottom)
    chance[low_edge] = cells[tuple(index[low_edge].T)]
    return chance
