"""Ghost trails of vehicles: swaths as wide as a vehicle, filled from side to side, on seen ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.special import expit

from subiaco_change.method_numbers import NUMBERS
from subiaco_change.segmentation.ground_model import Mask
from subiaco_change.segmentation.trail_raster import AROUND, Raster, TrailShapeConfig, limited
from subiaco_geo.frames import Floats

_DIRECTIONS = NUMBERS.trail_swaths.directions
SURE = NUMBERS.trail_swaths.certain
_VEHICLE = NUMBERS.trail_swaths.vehicle_area
_PART = NUMBERS.trail_swaths.part_area
_TALLER = NUMBERS.trail_swaths.taller


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
    axis = ndimage.binary_dilation(_axis(raster.body, config), AROUND, 2)
    labels, _ = ndimage.label(wide, AROUND)
    rim = int(np.ceil(config.beside / config.cell))
    for number, found in enumerate(ndimage.find_objects(labels), 1):
        low = [max(part.start - rim, 0) for part in found]
        high = [part.stop + rim for part in found]
        window = (slice(low[0], high[0]), slice(low[1], high[1]))
        swath = _measure(labels[window] == number, wide[window], raster, window, config)
        if swath is not None:
            chance = _by_parts(swath, axis[window], raster, config)
            np.copyto(cells[window], chance, where=swath.cells)
    return cells, wide


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
    fill = float(raster.inside[window][inner].mean()) if inner.any() else 0.0
    odds = config.prior + sum(
        (
            limited((area / width - config.length) / config.length_scale),
            limited(min(width - config.width, config.widest - width) / config.width_scale),
            limited((fill - config.fill) / config.fill_scale),
            limited((seen - config.ground) / config.ground_scale),
        )
    )
    return _Swath(cells, odds, lit, window)


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
