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
    closing: int = Field(
        3,
        ge=0,
        description="cells out of sight between changed ones up to twice this apart are filled, and count"
        " towards the area this far around, doubling it at most [cells]",
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


def compare_ground(
    before: EpochView, after: EpochView, config: GroundChangeConfig
) -> GroundComparison | None:
    """Compare the ground of two epochs in one frame; None where they share none."""
    ground = [view.semantic == Semantic.GROUND for view in (before, after)]
    if not all(mask.any() for mask in ground):
        return None
    low = np.min([v.xyz[m, :2].min(axis=0) for v, m in zip((before, after), ground, strict=True)], axis=0)
    high = np.max([v.xyz[m, :2].max(axis=0) for v, m in zip((before, after), ground, strict=True)], axis=0)
    corner = np.floor(low / config.report_cell) * config.report_cell
    columns, rows = (np.floor((high - corner) / config.cell).astype(int) + 1).tolist()
    dz, lod, _ = difference_cells(before, after, corner, (rows, columns), config)
    if not np.isfinite(dz).any():
        return None
    patch, patches = _find_patches(dz, lod, corner, config)
    return GroundComparison(corner, config.cell, dz, shown_lod(lod), patch, patches)


def difference_cells(
    before: EpochView, after: EpochView, corner: Floats, shape: tuple[int, int], config: GroundChangeConfig
) -> tuple[Floats, Floats, Floats]:
    """Height difference, level of detection and height in *after* (rows, columns) [m] of the cells of a window.

    NaN where either epoch has no ground, or no level of its own. All ground points lie in the window.
    """
    cells = [
        _cell_heights(view, view.semantic == Semantic.GROUND, corner, shape, config)
        for view in (before, after)
    ]
    heights = _bridge(cells[0][0], cells[1][0], config)
    return heights[1] - heights[0], np.maximum(cells[0][1], cells[1][1]), heights[1]


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


def _bridge(before: Floats, after: Floats, config: GroundChangeConfig) -> tuple[Floats, Floats]:
    """Bridge empty cells next to known ones, so that sparse ground stays contiguous.

    Heights are carried over relative to a smooth surface through both
    epochs: on a slope nothing is gained or lost.
    """
    known = [np.isfinite(v) for v in (before, after)]
    if not all(k.any() for k in known):
        return before, after
    smooth = ndimage.gaussian_filter(fill_gaps(np.fmin(before, after)), 2.0 / config.cell, mode="nearest")
    bridged = []
    for values, mask in zip((before, after), known, strict=True):
        weight = ndimage.uniform_filter(mask.astype(float), config.bridge, mode="constant")
        total = ndimage.uniform_filter(np.where(mask, values - smooth, 0.0), config.bridge, mode="constant")
        mean = smooth + total / np.maximum(weight, 1e-9)
        enough = weight * config.bridge**2 > 1.5
        bridged.append(np.where(mask, values, np.where(enough, mean, np.nan)))
    return bridged[0], bridged[1]


def _find_patches(
    dz: Floats, lod: Floats, corner: Floats, config: GroundChangeConfig
) -> tuple[Ints, tuple[GroundPatch, ...]]:
    """Connect cells of one sign beyond the gate, and keep what is large enough and stands out as a whole.

    A cell with too few points for a level of detection of its own (NaN) is
    gated by the threshold alone; its patch then answers for it with the level
    of detection of its mean.
    """
    patch = np.full(dz.shape, -1, dtype=np.int64)
    patches: list[GroundPatch] = []
    typical = float(np.nanmedian(lod)) if np.isfinite(lod).any() else _NO_CLAIM
    for sign, change in ((1.0, Change.INCREASED), (-1.0, Change.DECREASED)):
        over = beyond_gate(dz, lod, sign, config)
        blind = ~np.isfinite(dz)
        labels, count = ndimage.label(over, structure=np.ones((3, 3)))
        sizes = _possible_sizes(labels, count, blind, config)
        for number in np.flatnonzero(sizes * config.cell**2 > config.area).tolist():
            found = make_patch(change, labels == number, dz, lod, corner, config.cell, typical)
            if stands_out(found, config):
                patch[labels == number] = len(patches)
                patches.append(found)
    return patch, tuple(patches)


def beyond_gate(dz: Floats, lod: Floats, sign: float, config: GroundChangeConfig) -> Mask:
    """Tell which cells changed in one direction, blind ones between them included."""
    over = np.nan_to_num(sign * dz, nan=-1.0) > np.fmax(config.threshold, config.lod_factor * lod)
    return _closed(over, ~np.isfinite(dz), config)


def stands_out(patch: GroundPatch, config: GroundChangeConfig) -> bool:
    """Tell whether a patch as a whole is beyond the gate."""
    return abs(patch.dz) > max(config.threshold, config.lod_factor * patch.lod)


def _closed(over: Mask, blind: Mask, config: GroundChangeConfig) -> Mask:
    """Add the blind cells that lie between changed ones."""
    if config.closing == 0:
        return over
    size = 2 * config.closing + 1
    return np.asarray(over | (blind & ndimage.binary_closing(over, structure=np.ones((size, size)))))


def _possible_sizes(labels: Ints, count: int, blind: Mask, config: GroundChangeConfig) -> Ints:
    """Cells of every patch and blind ones around it: the edge of a pit hides its floor."""
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    sizes[0] = 0
    size = 2 * config.closing + 1
    around = np.where(blind & (labels == 0), ndimage.grey_dilation(labels, size=(size, size)), 0)
    hidden = np.bincount(around.ravel(), minlength=count + 1)
    hidden[0] = 0
    return np.asarray(sizes + np.minimum(hidden, sizes))


def ground_hidden(where: Mask, blind: Mask, config: GroundChangeConfig) -> int:
    """Count the blind cells around those of a patch."""
    size = 2 * config.closing + 1
    return int((ndimage.binary_dilation(where, structure=np.ones((size, size))) & blind).sum())


def make_patch(
    change: Change, where: Mask, dz: Floats, lod: Floats, corner: Floats, cell: float, typical: float
) -> GroundPatch:
    cells = np.argwhere(where)
    west_south = corner + cells[:, ::-1] * cell
    boxes = shapely.box(west_south[:, 0], west_south[:, 1], west_south[:, 0] + cell, west_south[:, 1] + cell)
    outline = shapely.union_all(boxes)
    values = dz[where & np.isfinite(dz)]
    area = len(cells) * cell**2
    known = lod[where & np.isfinite(lod)]
    level = float(np.median(known)) if len(known) else typical
    if len(known) < 0.5 * len(values):  # mostly sparse: the spread of the differences speaks for their mean
        level = math.hypot(level, 1.96 * float(values.std()) / math.sqrt(len(values)))
    return GroundPatch(change, area, float(np.median(values)), float(values.std()), level, cells, outline)


def ground_raster(comparison: GroundComparison, origin: Floats, config: GroundChangeConfig) -> GroundChange:
    """Reduce the comparison to medians of the reporting cells, row 0 in the north, world corner.

    ``confidence`` is how surely the cell's difference lies on its side of the threshold, taking LoD95 as 1.96
    standard deviations.
    """
    factor = round(config.report_cell / config.cell)
    rows, columns = (-(-n // factor) for n in comparison.dz.shape)
    dz, lod = (_block_median(values, rows, columns, factor) for values in (comparison.dz, comparison.lod))
    sigma = np.maximum(lod / 1.96, 0.01)
    confidence = _normal_cdf(np.abs(np.abs(dz) - config.threshold) / sigma)
    west, south = comparison.corner + origin[:2]
    north = float(south + rows * config.report_cell)
    grids = [np.asarray(v[::-1], dtype=np.float32) for v in (dz, confidence)]
    return GroundChange(grids[0], grids[1], float(west), north, config.report_cell)


def _block_median(values: Floats, rows: int, columns: int, factor: int) -> Floats:
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
