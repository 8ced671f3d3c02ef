"""Long-wavelength height difference between two epochs, estimated and removed (method, Decision 3)."""

from __future__ import annotations

import logging
import math

import numpy as np
from pydantic import Field
from scipy import ndimage

from subiaco_change.level_of_detection.displacement_field import BlockGrid, SmoothField
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.segmentation.ground_model import Mask, fill_gaps
from subiaco_geo.config import StrictModel
from subiaco_geo.frames import Floats, Ints

_LOG = logging.getLogger(__name__)
_CELL = NUMBERS.vertical_bias.cell


class VerticalBiasConfig(StrictModel):
    """Vertical bias between epochs (Decision 3)."""

    tile: float = Field(
        20.0, gt=0, description="Edge of the tiles whose median height difference counts once [m] (paper)"
    )
    reach: int = Field(
        2,
        ge=1,
        description="Number of tiles on each side over which the median of tiles is taken; raise it for a "
        "smoother field",
    )
    min_tiles: int = Field(
        6, ge=1, description="Number of tiles with ground below which no vertical bias is removed"
    )
    limit: float = Field(
        0.10, ge=0, description="Largest departure of the vertical bias from its median over the map [m]"
    )
    max_offset: float = Field(
        1.0,
        ge=0,
        description="Largest median height difference over the map that is removed as vertical bias [m]",
    )


def bias_field(
    medians: Floats, known: Mask, grid: BlockGrid, config: VerticalBiasConfig
) -> SmoothField | None:
    """Smooth the medians (rows, columns) of the tiles of a grid; None where too few are known.

    The median over the map may be large (datums, antenna heights). Departures
    from it are medians over windows of tiles, so that a change of the ground that fills a
    tile, or a few, moves nothing, and none exceeds ``limit``.
    """
    if known.sum() < config.min_tiles:
        return None
    overall = float(np.median(medians[known]))
    if abs(overall) > config.max_offset:
        _LOG.warning(
            "vertical bias: the ground lies %.2f m apart over the map, more than vertical.max_offset; kept",
            overall,
        )
        return None
    window = 2 * config.reach + 1
    apart = np.where(known, medians - overall, np.nan)
    wide = ndimage.generic_filter(apart, _median, size=window, mode="constant", cval=np.nan)
    smooth = fill_gaps(np.clip(wide, -config.limit, config.limit))
    values = np.zeros((*grid.shape, 3))
    values[:, :, 2] = overall + smooth
    return SmoothField(grid, values)


def tile_medians(before: Floats, after: Floats, grid: BlockGrid) -> tuple[Floats, Mask]:
    """Median height difference (rows, columns) of the tiles, and which tiles have enough shared ground."""
    per_tile = max(round(grid.cell / _CELL), 1)
    rows, columns = grid.shape
    fine = BlockGrid(grid.corner, grid.cell / per_tile, (rows * per_tile, columns * per_tile))
    heights = [_cell_means(points, fine) for points in (before, after)]
    both = np.flatnonzero(np.isfinite(heights[0]) & np.isfinite(heights[1]))
    dz = heights[1][both] - heights[0][both]
    row, column = np.divmod(both, fine.shape[1])
    tile = (row // per_tile) * columns + column // per_tile
    medians = _grouped_median(tile, dz, rows * columns)
    count = np.bincount(tile, minlength=len(medians))
    known = count >= max(0.02 * per_tile**2, 4)
    return medians.reshape(grid.shape), known.reshape(grid.shape)


def _cell_means(points: Floats, grid: BlockGrid) -> Floats:
    cell = grid.block_of(points)
    size = grid.shape[0] * grid.shape[1]
    count = np.bincount(cell, minlength=size)
    total = np.bincount(cell, points[:, 2], size)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _grouped_median(group: Ints, values: Floats, size: int) -> Floats:
    """Lower median of the values of every group (size,), NaN where empty."""
    order = np.lexsort((values, group))
    names, first, count = np.unique(group[order], return_index=True, return_counts=True)
    result = np.full(size, np.nan)
    result[names] = values[order][first + (count - 1) // 2]
    return result


def _median(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else math.nan
