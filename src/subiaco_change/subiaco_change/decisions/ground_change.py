"""Changes of the ground: cells of 0.5 m, connected patches, a raster of 2 m (method, Decisions 3 and 12)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.special import ndtr, ndtri
from shapely.geometry.base import BaseGeometry

from subiaco_change.decisions.ground_cells import NO_CLAIM, GroundCells, GroundChangeConfig, block_median
from subiaco_change.geometry import outline_of_cells
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import first_argument, never, switchable
from subiaco_change.objects.voxel_objects import EpochView
from subiaco_change.records import GroundChange
from subiaco_change.segmentation.ground_model import Mask
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.frames import Floats, Ints

_AROUND = NUMBERS.ground_change.noise_reach
_NOISE_BLOCK = NUMBERS.ground_change.noise_block
_INNER = NUMBERS.ground_change.inner_share
_EDGE = NUMBERS.ground_change.edge_share
_LOD_CELLS = NUMBERS.ground_change.lod_cells


@dataclass(frozen=True)
class GroundPatch:
    """A contiguous area of changed ground: its cells, its mean difference and spread [m].

    ``confidence``: probability that a place in it moved by more than the threshold; ``reason``: the sentence
    of its row.
    """

    change: Change
    area: float
    dz: float
    dz_spread: float
    lod: float
    cells: Ints
    outline: BaseGeometry
    confidence: float
    reason: str = ""


@dataclass(frozen=True)
class GroundComparison:
    """Differences, after minus before, on cells of the common frame.

    ``dz`` (rows, columns), row 0 in the south, NaN where either epoch has no
    ground; ``patch`` (rows, columns) index into ``patches`` or -1.
    """

    corner: Floats
    cell: float
    dz: Floats
    lod: Floats
    patch: Ints
    patches: tuple[GroundPatch, ...]

    def cell_of(self, xy: Floats) -> tuple[Ints, Ints, Mask]:
        """Row, column and whether inside, for points (N, 2)."""
        index = np.floor((xy - self.corner) / self.cell).astype(np.int64)
        inside = ((index >= 0) & (index < np.array(self.dz.shape[::-1]))).all(axis=1)
        clipped = np.clip(index, 0, np.array(self.dz.shape[::-1]) - 1)
        return clipped[:, 1], clipped[:, 0], np.asarray(inside)


def find_patches(
    cells: GroundCells, corner: Floats, config: GroundChangeConfig
) -> tuple[Ints, tuple[GroundPatch, ...]]:
    """Connect cells of one sign beyond the threshold, and keep what is large and stands out as a whole.

    Cells are gated by the threshold alone; their patch answers for them with
    the level of detection of its mean. What nobody measured does not part a
    patch: a parked car hides the ground, and its neighbours' mean is no
    evidence.
    """
    dz = cells.dz
    patch = np.full(dz.shape, -1, dtype=np.int64)
    patches: list[GroundPatch] = []
    for sign, change in ((1.0, Change.INCREASED), (-1.0, Change.DECREASED)):
        rise = np.nan_to_num(sign * dz, nan=-1.0)
        labels, count = ndimage.label(beyond_threshold(cells, sign, config), structure=np.ones((3, 3)))
        labels = _to_half_height(labels, count, rise, config)
        large = _possible_sizes(labels, count, cells, config) * config.cell**2 > config.area
        large |= _moved_as_much(labels, count, rise, config)
        for number in np.flatnonzero(large).tolist():
            where = labels == number
            if not np.isfinite(dz[where]).any():  # a pit of which neither floor nor wall was met
                continue
            if _is_interpolated(where, cells, config) or _is_other_surface(where, cells, config):
                continue
            found = _make_patch(change, where, cells, corner, config)
            uneven = config.evenness * found.dz_spread
            if abs(found.dz) > max(config.threshold, config.lod_factor * found.lod, uneven):
                patch[where] = len(patches)
                patches.append(found)
    return patch, tuple(patches)


def _none_more(_: Ints, count: int, *__: object) -> Mask:
    """Return no patch."""
    return np.zeros(count + 1, dtype=bool)


@switchable("deep_patches", _none_more)
def _moved_as_much(labels: Ints, count: int, rise: Floats, config: GroundChangeConfig) -> Mask:
    """Tell which patches (count + 1,), however small, moved as much ground as the least of the large ones.

    A trench of a metre is as much of a change as a road that was raised by a hand's breadth. Cells of a patch
    that nobody measured, as of a floor behind the edge of a pit, moved as the measured ones did.
    """
    size, measured = _own_sizes(labels, count), np.bincount(labels[rise > 0.0], minlength=count + 1)
    moved = np.bincount(labels.ravel(), np.maximum(rise, 0.0).ravel(), minlength=count + 1)
    cell = config.cell**2
    whole = size * moved / np.maximum(measured, 1)
    return np.asarray((size * cell > config.small_area) & (whole * cell >= config.volume))


@switchable("measured_patches", never)
def _is_interpolated(where: Mask, cells: GroundCells, config: GroundChangeConfig) -> bool:
    """Tell whether most of a patch is what neighbours of few measured cells were taken for.

    Far from the path of a sensor its scan lines lie metres apart. A few cells that err together then
    claim the ground between them.
    """
    known = (np.isfinite(cells.dz) & ~cells.bridged) | cells.raised | cells.lowered
    return bool(known[where].mean() < config.measured_share)


@switchable("other_surface", never)
def _is_other_surface(where: Mask, cells: GroundCells, config: GroundChangeConfig) -> bool:
    """Tell whether both epochs hold the surfaces of a patch, so that no ground moved.

    The cells on the rim do not count where others are left: beside them lies what surrounds the patch.
    """
    measured = where & np.isfinite(cells.dz)
    inner = measured & ndimage.binary_erosion(where, np.ones((3, 3)))
    counted = inner if np.count_nonzero(inner) >= _INNER * np.count_nonzero(measured) else measured
    shares = float(cells.other[counted].mean()), float(cells.inside[counted].mean())
    return shares[0] >= config.same_share and shares[1] >= config.same_inside


def beyond_threshold(cells: GroundCells, sign: float, config: GroundChangeConfig) -> Mask:
    """Tell which cells changed in one direction, and which between them belong to the same change.

    Between changed cells lie some that nobody measured, where no neighbour moved the other way, and some
    that the edge of the change runs through: they hold the mean of both sides. Walls and hidden
    floors of pits belong to the change.
    """
    rise = np.nan_to_num(sign * cells.dz, nan=-1.0)
    against = np.nan_to_num(sign * cells.dz, nan=1.0) <= 0.0
    between = (cells.bridged & ~against) | (rise > _EDGE * config.threshold)
    return _closed(rise > config.threshold, between, config) | (cells.raised if sign > 0 else cells.lowered)


@switchable("closed_gaps", first_argument)
def _closed(over: Mask, between: Mask, config: GroundChangeConfig) -> Mask:
    """Add the cells ``between`` that lie between changed ones."""
    if config.closing == 0:
        return over
    if not (over.any() and between.any()):
        return over
    size = 2 * config.closing + 1
    padded = np.pad(over, config.closing).view(np.uint8)  # filters of a square take its sides in turn
    grown = ndimage.maximum_filter(padded, size, mode="constant", cval=0)
    closed = ndimage.minimum_filter(grown, size, mode="constant", cval=0).view(np.bool_)
    inside = slice(config.closing, -config.closing)
    return np.asarray(over | (between & closed[inside, inside]))


@switchable("half_height_edge", first_argument)
def _to_half_height(labels: Ints, count: int, rise: Floats, config: GroundChangeConfig) -> Ints:
    """Move the edge of every patch out to where half of its height is reached.

    A cell that the edge runs through holds the mean of both sides: under the
    threshold, although half of it changed. ``rise`` (rows, columns) is signed
    so that the patch is positive.
    """
    grown = labels.copy()
    for number, window in enumerate(ndimage.find_objects(labels, count), start=1):
        around = tuple(slice(max(s.start - 1, 0), s.stop + 1) for s in window)
        mine = labels[around] == number
        over = mine & (rise[around] > config.threshold)
        if np.count_nonzero(mine) * config.cell**2 < config.small_area or not over.any():
            continue
        half = _EDGE * float(np.median(rise[around][over]))
        edge = ndimage.binary_dilation(mine, np.ones((3, 3))) & (grown[around] == 0)
        grown[around][edge & (rise[around] > half)] = number
    return grown


def _own_sizes(labels: Ints, count: int, *_: object) -> Ints:
    """Cells of every patch."""
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    sizes[0] = 0
    return sizes


@switchable("possible_area", _own_sizes)
def _possible_sizes(labels: Ints, count: int, cells: GroundCells, config: GroundChangeConfig) -> Ints:
    """Cells of every patch and blind ones around it: the edge of a pit hides its floor.

    No more are hidden than both epochs measured: where one epoch is sparse, most cells are blind or took the
    height of their neighbours.
    """
    blind = ~np.isfinite(cells.dz)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    size = 2 * config.closing + 1
    around = np.where(blind & (labels == 0), ndimage.grey_dilation(labels, size=(size, size)), 0)
    hidden = np.bincount(around.ravel(), minlength=count + 1)
    measured = np.bincount(labels[~blind & ~cells.bridged], minlength=count + 1)
    sizes[0] = hidden[0] = 0
    return np.asarray(sizes + np.minimum(hidden, measured))


def _make_patch(
    change: Change, where: Mask, ground: GroundCells, corner: Floats, config: GroundChangeConfig
) -> GroundPatch:
    cell, dz, lod = config.cell, ground.dz, ground.lod
    cells = np.argwhere(where)
    outline = outline_of_cells(cells[:, ::-1], corner, cell)
    values = dz[where & np.isfinite(dz)]
    area = len(cells) * cell**2
    known = lod[where & np.isfinite(lod)]
    level = float(np.median(known)) if len(known) else _nearest_lod(cells, lod)
    in_pit = where & (ground.raised | ground.lowered)
    level_ground = np.count_nonzero(where & ~in_pit)
    height, spread = float(np.median(values)), float(values.std())
    blocks = max(1.0, len(values) * cell**2 / _NOISE_BLOCK**2)  # neighbours err together, over a block
    of_mean = 1.96 * spread / math.sqrt(blocks)
    if len(known) < 0.5 * level_ground:  # thinly seen
        level = math.hypot(level, of_mean, _noise_around(where, dz, cell))
    else:
        level = _of_whole_patch(level, of_mean, where, dz, lod, cell)
    confidence = patch_confidence(height, level, spread, config.threshold)
    volume = abs(float(values.mean())) * area
    reason = (
        f"The ground level changed by {height:+z.2f} m (limit {config.threshold:.2f} m, LoD95 {level:.2f} m,"
        f" standard deviation {spread:.2f} m) over {area:.0f} m² and {volume:.1f} m³ (limit"
        f" {config.area:.0f} m², or {config.volume:.2f} m³ of a smaller patch): the ground was"
        f" {'raised' if height > 0 else 'lowered'}."
    )
    hidden = np.count_nonzero(in_pit & ~np.isfinite(dz)) * cell**2
    if hidden >= 1.0:
        lower = "earlier" if height > 0 else "later"
        reason += (
            f" Over {hidden:.0f} m² the {lower} survey did not meet its lower ground; its height there is"
            " that of the rest."
        )
    return GroundPatch(change, area, height, spread, level, cells, outline, confidence, reason)


def patch_confidence(dz: float, lod: float, spread: float, threshold: float) -> float:
    """Probability that a place of a patch moved by more than the threshold, LoD95 being 1.96 sd.

    Where the difference varies much from place to place, the patch is less surely one surface that moved.
    """
    return float(_normal_cdf((abs(dz) - threshold) / max(math.hypot(lod / 1.96, spread), 0.01)))


@switchable("noise_around_patches", lambda *_: 0.0)
def _noise_around(where: Mask, dz: Floats, cell: float) -> float:
    """Return the difference that 95 % of the blocks around a patch stay below [m].

    Seen thinly and from afar, neighbours err together (attitude, grazing rings): their mean gets no
    better with their number.
    """
    values = _blocks_around(where, dz, cell)
    return float(np.quantile(np.abs(values), 0.95)) if len(values) else 0.0


@switchable("level_of_patches", first_argument)
def _of_whole_patch(level: float, of_mean: float, where: Mask, dz: Floats, lod: Floats, cell: float) -> float:
    """Return the level of detection of the mean of a patch, given that of its points [m].

    The roughness of single points averages out over a patch (``of_mean``). What blocks of neighbours have in
    common does not: that of the blocks around, of which most did not change, is measured. Nor do the
    registration and the noise of both maps, which alone make up the level of the smoothest ground around.
    """
    values = _blocks_around(where, dz, cell)
    if len(values) < _LOD_CELLS:
        return level
    common = float(np.median(np.abs(values)) / ndtri(0.75))  # standard deviation about zero
    least = float(np.nanmin(lod[_around(where, cell)]))
    return min(level, max(math.hypot(of_mean, 1.96 * common), least))


def _blocks_around(where: Mask, dz: Floats, cell: float) -> Floats:
    """Return the median differences (B,) of the blocks around a patch [m]."""
    window = _around(where, cell)
    blocks = block_median(np.where(where[window], np.nan, dz[window]), max(1, round(_NOISE_BLOCK / cell)))
    return np.asarray(blocks[np.isfinite(blocks)])


def _around(where: Mask, cell: float) -> tuple[slice, slice]:
    """Rows and columns of a patch and of what lies within reach of it."""
    reach = round(_AROUND / cell)
    rows, columns = (slice(max(int(i.min()) - reach, 0), int(i.max()) + reach + 1) for i in np.nonzero(where))
    return rows, columns


def _nearest_lod(cells: Ints, lod: Floats) -> float:
    """Median level of detection of the known cells nearest to the middle of a patch that has none [m]."""
    known = np.argwhere(np.isfinite(lod))
    if len(known) == 0:
        return NO_CLAIM
    distance = np.linalg.norm(known - cells.mean(axis=0), axis=1)
    near = known[np.argsort(distance, kind="stable")[:_LOD_CELLS]]
    return float(np.median(lod[near[:, 0], near[:, 1]]))


def ground_raster(comparison: GroundComparison, origin: Floats, config: GroundChangeConfig) -> GroundChange:
    """Reduce the comparison to medians of the reporting cells, row 0 in the north, world corner.

    ``confidence`` is how surely the cell's difference lies on its side of the threshold, taking LoD95 as 1.96
    standard deviations.
    """
    factor = round(config.report_cell / config.cell)
    dz, lod = (block_median(values, factor) for values in (comparison.dz, comparison.lod))
    sigma = np.maximum(lod / 1.96, 0.01)
    confidence = _normal_cdf(np.abs(np.abs(dz) - config.threshold) / sigma)
    west, south = comparison.corner + origin[:2]
    north = float(south + len(dz) * config.report_cell)
    grids = [np.asarray(v[::-1], dtype=np.float32) for v in (dz, confidence)]
    return GroundChange(grids[0], grids[1], float(west), north, config.report_cell)


def _normal_cdf(z: Floats | float) -> Floats:
    return np.asarray(ndtr(z))


def patch_points(comparison: GroundComparison, view: EpochView) -> NDArray[np.int64]:
    """Patch (N,) of every ground point of an epoch, -1 for none."""
    row, column, inside = comparison.cell_of(view.xyz[:, :2])
    ground = inside & (view.semantic == Semantic.GROUND)
    return np.where(ground, comparison.patch[row, column], -1)
