"""Changes of the ground: cells of 0.5 m, contiguous patches, a 2 m raster (method, Decisions 3 and 12)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray
from pydantic import Field
from scipy import ndimage
from shapely.geometry.base import BaseGeometry

from subiaco_change.changes.objects import EpochView
from subiaco_change.records import GroundChange
from subiaco_change.semantics.ground import Mask, fill_gaps
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.config import StrictModel
from subiaco_geo.frames import Floats, Ints

_NO_CLAIM = 10.0  # level of detection shown where there is none [m]
_AROUND = 10.0  # what lies this near tells the noise of a thinly seen patch [m]
_NOISE_BLOCK = 2.0  # within which thinly seen heights err together [m]
_LOD_CELLS = 25  # known cells that speak for a patch without a level of detection


class GroundChangeConfig(StrictModel):
    """Ground differencing."""

    cell: float = Field(0.5, gt=0, description="cell in which ground is compared [m], Decision 12")
    report_cell: float = Field(2.0, gt=0, description="cell of the raster handed on [m], paper")
    threshold: float = Field(0.15, gt=0, description="elevation difference of a change [m], paper")
    area: float = Field(25.0, gt=0, description="contiguous area of a change [m2], paper")
    lod_factor: float = Field(1.2, gt=0, description="gate as a multiple of the level of detection, paper")
    max_spread: float = Field(
        0.12, gt=0, description="spread of heights in a cell beyond which it is no clean ground [m]"
    )
    bridge: int = Field(
        3, ge=1, description="window over which an empty cell takes its neighbours' height [cells]"
    )
    shown: float = Field(
        0.5,
        ge=0,
        description="volume seen to have moved, in volumes of the least change (area times threshold)",
    )
    closing: int = Field(
        5,
        ge=0,
        description="cells out of sight between changed ones up to twice this apart (a parked car, 5 m) are"
        " filled, and count towards the area this far around, doubling it at most [cells]",
    )


@dataclass(frozen=True)
class GroundPatch:
    """A contiguous area of changed ground: its cells, its mean difference and spread [m]."""

    change: Change
    area: float
    dz: float
    dz_spread: float
    lod: float
    cells: Ints
    outline: BaseGeometry


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


@dataclass(frozen=True)
class GroundCells:
    """Cells (rows, columns) of two epochs, row 0 in the south.

    ``dz`` after minus before, NaN where either epoch has no ground; ``lod`` [m], NaN where either has
    none; ``bridged``: took a neighbour's height in an epoch; ``known``: holds ground in either;
    ``height`` in *after* [m].
    """

    dz: Floats
    lod: Floats
    bridged: Mask
    known: Mask
    height: Floats


def difference_cells(
    before: EpochView, after: EpochView, corner: Floats, shape: tuple[int, int], config: GroundChangeConfig
) -> GroundCells:
    """Difference the ground of two epochs in the cells of a window that all their ground points lie in."""
    cells = [_cell_heights(v, v.semantic == Semantic.GROUND, corner, shape, config) for v in (before, after)]
    heights, bridged = _bridge(cells[0][0], cells[1][0], config)
    known = np.isfinite(cells[0][0]) | np.isfinite(cells[1][0])
    lod = np.maximum(cells[0][1], cells[1][1])
    return GroundCells(heights[1] - heights[0], lod, bridged, known, heights[1])


def shown_lod(lod: Floats) -> Floats:
    """Fill the level of detection of cells that have none from those around."""
    shown = fill_gaps(lod) if np.isfinite(lod).any() else np.full_like(lod, _NO_CLAIM)
    return np.where(np.isfinite(lod), lod, shown)


def _cell_heights(
    view: EpochView, mask: Mask, corner: Floats, shape: tuple[int, int], config: GroundChangeConfig
) -> tuple[Floats, Floats]:
    """Mean height and LoD of every cell; NaN where empty or where the heights spread."""
    xyz, lod = view.xyz[mask], view.lod[mask]
    index = np.floor((xyz[:, :2] - corner) / config.cell).astype(np.int64)
    flat = index[:, 1] * shape[1] + index[:, 0]
    size = shape[0] * shape[1]
    count = np.bincount(flat, minlength=size)
    safe = np.maximum(count, 1)
    mean = np.bincount(flat, xyz[:, 2], size) / safe
    spread = np.sqrt(np.bincount(flat, (xyz[:, 2] - mean[flat]) ** 2, size) / safe)
    finite = np.isfinite(lod)
    level = np.bincount(flat, np.where(finite, lod, 0.0), size)
    some = np.bincount(flat, finite, size)
    level = np.where(some > 0, level / np.maximum(some, 1), np.nan)
    good = (count > 0) & (spread < config.max_spread)
    return np.where(good, mean, np.nan).reshape(shape), np.where(good, level, np.nan).reshape(shape)


def _bridge(before: Floats, after: Floats, config: GroundChangeConfig) -> tuple[tuple[Floats, Floats], Mask]:
    """Bridge empty cells next to known ones, so that sparse ground stays contiguous; tell which they are.

    Heights are carried over relative to a smooth surface through both
    epochs: on a slope nothing is gained or lost.
    """
    known = [np.isfinite(v) for v in (before, after)]
    if not all(k.any() for k in known):
        return (before, after), np.zeros(before.shape, dtype=bool)
    smooth = ndimage.gaussian_filter(fill_gaps(np.fmin(before, after)), 2.0 / config.cell, mode="nearest")
    bridged = []
    for values, mask in zip((before, after), known, strict=True):
        weight = ndimage.uniform_filter(mask.astype(float), config.bridge, mode="constant")
        total = ndimage.uniform_filter(np.where(mask, values - smooth, 0.0), config.bridge, mode="constant")
        mean = smooth + total / np.maximum(weight, 1e-9)
        enough = weight * config.bridge**2 > 1.5
        bridged.append(np.where(mask, values, np.where(enough, mean, np.nan)))
    return (bridged[0], bridged[1]), ~(known[0] & known[1])


def find_patches(
    cells: GroundCells, corner: Floats, config: GroundChangeConfig
) -> tuple[Ints, tuple[GroundPatch, ...]]:
    """Connect cells of one sign beyond the gate, and keep what is large enough and stands out as a whole.

    A cell with too few points for a level of detection of its own (NaN) is
    gated by the threshold alone; its patch then answers for it with the level
    of detection of its mean. What nobody measured does not part a patch: a
    parked car hides the ground, and its neighbours' mean is no evidence.
    """
    dz, lod = cells.dz, cells.lod
    patch = np.full(dz.shape, -1, dtype=np.int64)
    patches: list[GroundPatch] = []
    gate = _gate(lod, config)
    unknown = ~np.isfinite(dz)
    least = config.shown * config.area * config.threshold / config.cell**2
    for sign, change in ((1.0, Change.INCREASED), (-1.0, Change.DECREASED)):
        rise = np.nan_to_num(sign * dz, nan=-1.0)
        over = rise > gate
        labels, count = ndimage.label(beyond_gate(cells, sign, config), structure=np.ones((3, 3)))
        labels = _to_half_height(labels, count, rise, gate, config)
        labels = _to_hidden(labels, unknown, cells.known, config)
        depth = np.where(over, np.minimum(rise, 2 * config.threshold), 0.0)  # a few deep cells are noise
        shown = np.bincount(labels.ravel(), depth.ravel(), count + 1)
        large = _possible_sizes(labels, count, unknown, config) * config.cell**2 > config.area
        for number in np.flatnonzero(large & (shown >= least)).tolist():
            found = _make_patch(change, labels == number, dz, lod, corner, config.cell)
            if abs(found.dz) > max(config.threshold, config.lod_factor * found.lod):
                patch[labels == number] = len(patches)
                patches.append(found)
    return patch, tuple(patches)


def _gate(lod: Floats, config: GroundChangeConfig) -> Floats:
    return np.asarray(np.fmax(config.threshold, config.lod_factor * lod))


def beyond_gate(cells: GroundCells, sign: float, config: GroundChangeConfig) -> Mask:
    """Tell which cells changed in one direction, those that nobody measured between them included."""
    over = np.nan_to_num(sign * cells.dz, nan=-1.0) > _gate(cells.lod, config)
    return _closed(over, cells.bridged & ~over, config)


def _to_hidden(labels: Ints, unknown: Mask, known: Mask, config: GroundChangeConfig) -> Ints:
    """Give cells that one epoch alone saw to the patch of the nearest cell that both saw.

    The near edge of a pit hides its floor, and what was there before is gone with the rest.
    """
    if config.closing == 0 or unknown.all():
        return labels
    distance, nearest = ndimage.distance_transform_edt(unknown, return_indices=True)
    taken = unknown & known & (labels == 0) & (distance <= config.closing)
    return np.where(taken, labels[nearest[0], nearest[1]], labels)


def _closed(over: Mask, blind: Mask, config: GroundChangeConfig) -> Mask:
    """Add the blind cells that lie between changed ones."""
    if config.closing == 0:
        return over
    size = 2 * config.closing + 1
    padded = np.pad(over, config.closing)
    closed = ndimage.binary_closing(padded, structure=np.ones((size, size)))
    inside = slice(config.closing, -config.closing)
    return np.asarray(over | (blind & closed[inside, inside]))


def _to_half_height(labels: Ints, count: int, rise: Floats, gate: Floats, config: GroundChangeConfig) -> Ints:
    """Move the edge of every patch out to where half of its height is reached.

    A cell that the edge runs through holds the mean of both sides: under the
    threshold, although half of it changed. ``rise`` (rows, columns) is signed
    so that the patch is positive, ``gate`` what its cells exceeded.
    """
    grown = labels.copy()
    for number, window in enumerate(ndimage.find_objects(labels, count), start=1):
        around = tuple(slice(max(s.start - 1, 0), s.stop + 1) for s in window)
        mine = labels[around] == number
        if np.count_nonzero(mine) * config.cell**2 < 0.25 * config.area:
            continue
        half = 0.5 * float(np.median(rise[around][mine & (rise[around] > gate[around])]))
        edge = ndimage.binary_dilation(mine, np.ones((3, 3))) & (grown[around] == 0)
        grown[around][edge & (rise[around] > half)] = number
    return grown


def _possible_sizes(labels: Ints, count: int, blind: Mask, config: GroundChangeConfig) -> Ints:
    """Cells of every patch and blind ones around it: the edge of a pit hides its floor."""
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    sizes[0] = 0
    size = 2 * config.closing + 1
    around = np.where(blind & (labels == 0), ndimage.grey_dilation(labels, size=(size, size)), 0)
    hidden = np.bincount(around.ravel(), minlength=count + 1)
    hidden[0] = 0
    return np.asarray(sizes + np.minimum(hidden, sizes))


def _make_patch(
    change: Change, where: Mask, dz: Floats, lod: Floats, corner: Floats, cell: float
) -> GroundPatch:
    cells = np.argwhere(where)
    west_south = corner + cells[:, ::-1] * cell
    boxes = shapely.box(west_south[:, 0], west_south[:, 1], west_south[:, 0] + cell, west_south[:, 1] + cell)
    outline = shapely.union_all(boxes)
    values = dz[where & np.isfinite(dz)]
    area = len(cells) * cell**2
    known = lod[where & np.isfinite(lod)]
    level = float(np.median(known)) if len(known) else _nearest_lod(cells, lod)
    if len(known) < 0.5 * len(values):  # mostly sparse: neighbours err together, over a block
        blocks = max(1.0, len(values) * cell**2 / _NOISE_BLOCK**2)
        spread = float(values.std()) / math.sqrt(blocks)
        level = math.hypot(level, 1.96 * spread, _noise_around(where, dz, cell))
    return GroundPatch(change, area, float(np.median(values)), float(values.std()), level, cells, outline)


def _noise_around(where: Mask, dz: Floats, cell: float) -> float:
    """Return the difference that 95 % of the blocks around a patch stay below [m].

    Seen thinly and from afar, neighbours err together (attitude, grazing rings): their mean gets no
    better with their number.
    """
    rows, columns = (
        slice(max(int(i.min()) - reach, 0), int(i.max()) + reach + 1)
        for i, reach in ((i, round(_AROUND / cell)) for i in np.nonzero(where))
    )
    around = np.where(where[rows, columns], np.nan, dz[rows, columns])
    factor = max(1, round(_NOISE_BLOCK / cell))
    blocks = _block_median(around, factor)
    values = blocks[np.isfinite(blocks)]
    return float(np.quantile(np.abs(values), 0.95)) if len(values) else 0.0


def _nearest_lod(cells: Ints, lod: Floats) -> float:
    """Median level of detection of the known cells nearest to the middle of a patch that has none [m]."""
    known = np.argwhere(np.isfinite(lod))
    if len(known) == 0:
        return _NO_CLAIM
    distance = np.linalg.norm(known - cells.mean(axis=0), axis=1)
    near = known[np.argsort(distance, kind="stable")[:_LOD_CELLS]]
    return float(np.median(lod[near[:, 0], near[:, 1]]))


def ground_raster(comparison: GroundComparison, origin: Floats, config: GroundChangeConfig) -> GroundChange:
    """Reduce the comparison to medians of the reporting cells, row 0 in the north, world corner.

    ``confidence`` is how surely the cell's difference lies on its side of the threshold, taking LoD95 as 1.96
    standard deviations.
    """
    factor = round(config.report_cell / config.cell)
    dz, lod = (_block_median(values, factor) for values in (comparison.dz, comparison.lod))
    sigma = np.maximum(lod / 1.96, 0.01)
    confidence = _normal_cdf(np.abs(np.abs(dz) - config.threshold) / sigma)
    west, south = comparison.corner + origin[:2]
    north = float(south + len(dz) * config.report_cell)
    grids = [np.asarray(v[::-1], dtype=np.float32) for v in (dz, confidence)]
    return GroundChange(grids[0], grids[1], float(west), north, config.report_cell)


def _block_median(values: Floats, factor: int) -> Floats:
    rows, columns = (-(-n // factor) for n in values.shape)
    padded = np.full((rows * factor, columns * factor), np.nan)
    padded[: values.shape[0], : values.shape[1]] = values
    blocks = padded.reshape(rows, factor, columns, factor).transpose(0, 2, 1, 3).reshape(rows, columns, -1)
    medians = np.full((rows, columns), np.nan)
    some = np.isfinite(blocks).any(axis=2)
    medians[some] = np.nanmedian(blocks[some], axis=1)
    return medians


def _normal_cdf(z: Floats) -> Floats:
    from scipy.special import ndtr

    return np.asarray(ndtr(z))


def patch_points(comparison: GroundComparison, view: EpochView) -> NDArray[np.int64]:
    """Patch (N,) of every ground point of an epoch, -1 for none."""
    row, column, inside = comparison.cell_of(view.xyz[:, :2])
    ground = inside & (view.semantic == Semantic.GROUND)
    return np.where(ground, comparison.patch[row, column], -1)
