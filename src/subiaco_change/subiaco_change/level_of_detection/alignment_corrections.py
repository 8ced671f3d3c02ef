"""Corrections beyond the rigid transform of two epochs: vertical bias and residual warp, and their report.

The long-wavelength height difference between two epochs is estimated and removed (method, Decision 3).

The warp over blocks is what a rigid motion leaves of drift and shear (method, Decision 2). Off by default.
It may follow what many surfaces of neighbouring blocks agree on, never what one surface says alone: a real
change is left as it is.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pydantic import Field
from scipy import ndimage, sparse
from scipy.sparse.linalg import spsolve

from subiaco_change.level_of_detection.common_frame import BlockGrid, CommonFrame, SmoothField
from subiaco_change.level_of_detection.registration_uncertainty import SigmaField, UncertaintyConfig
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.records import Registration
from subiaco_change.segmentation.ground_model import Mask, fill_gaps
from subiaco_geo.config import StrictModel
from subiaco_geo.frames import Floats, Ints

_LOG = logging.getLogger(__name__)
_CELL = NUMBERS.vertical_bias.cell
_ROUNDS = NUMBERS.warp.rounds


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


class WarpConfig(StrictModel):
    """Residual warp."""

    enabled: bool = Field(False, description="Remove smooth residuals that remain after the rigid transform")
    block: float = Field(20.0, gt=0, description="Distance between the nodes of the warp grid [m]")
    stiffness: float = Field(
        0.02,
        gt=0,
        description="Expected difference of displacement between neighbouring nodes [m]; raise it for a "
        "more flexible warp",
    )
    noise: float = Field(
        0.03, gt=0, description="Standard deviation of a single residual of the warp estimate [m]"
    )
    reach: float = Field(
        0.08,
        gt=0,
        description="Distance of a residual from the smooth field beyond which the residual is change "
        "[m]; smaller than the change limits",
    )
    limit: float = Field(0.25, gt=0, description="Largest displacement of the warp per component [m]")


@dataclass(frozen=True)
class Residuals:
    """Places (N, 3) of surfaces, their unit normals (N, 3), after minus before along them (N,) [m]."""

    xyz: Floats
    normals: Floats
    distance: Floats


def estimate_warp(residuals: Residuals, grid: BlockGrid, config: WarpConfig) -> SmoothField:
    """Fit displacements at the nodes of a grid to residuals along normals.

    Minimises ``sum rho(n . u(p) - d) / noise^2 + sum |u_i - u_j|^2 / stiffness^2``
    over nodes and their neighbours, with ``u`` bilinear between nodes. ``rho``
    is Tukey's biweight whose width shrinks to ``reach`` from round to round,
    while the field is stiff at first: what departs from its surroundings by
    more than ``reach`` ends up without weight.

    Returns
    -------
    SmoothField
        How *before* must move [m], at most ``limit`` a component.
    """
    design = _design(residuals, grid)
    smooth = _smoothness(grid)
    count = design.shape[1]
    u = np.zeros(count)
    for step in range(_ROUNDS):
        progress = min(step / (_ROUNDS - 3), 1.0)
        width = config.reach * 4.0 ** (1.0 - progress)
        stiffness = config.stiffness * 0.25 ** (1.0 - progress)
        left = residuals.distance - design @ u
        weight = np.clip(1.0 - (left / width) ** 2, 0.0, None) ** 2 / config.noise**2
        normal = design.T @ sparse.diags_array(weight) @ design + smooth / stiffness**2
        normal = normal + sparse.eye_array(count) / (10.0 * config.limit) ** 2
        u = spsolve(normal.tocsc(), design.T @ (weight * residuals.distance))
    values = np.clip(u, -config.limit, config.limit).reshape(*grid.shape, 3)
    return SmoothField(grid, values)


def _design(residuals: Residuals, grid: BlockGrid) -> sparse.csr_array:
    """Rows of ``n . u(p)`` (N, 3 nodes): four nodes around every place, three components each."""
    rows, columns = grid.shape
    where = np.clip(grid.nodes(residuals.xyz), 0.0, np.array([[rows - 1], [columns - 1]], dtype=float))
    base = np.minimum(np.floor(where).astype(np.int64), np.array([[max(rows - 2, 0)], [max(columns - 2, 0)]]))
    part = where - base
    n = len(residuals.distance)
    entries, places = [], []
    for dr in (0, 1):
        for dc in (0, 1):
            share = (part[0] if dr else 1.0 - part[0]) * (part[1] if dc else 1.0 - part[1])
            node = np.minimum(base[0] + dr, rows - 1) * columns + np.minimum(base[1] + dc, columns - 1)
            entries.append(share[:, None] * residuals.normals)
            places.append(node[:, None] * 3 + np.arange(3))
    row = np.repeat(np.arange(n), 12)
    shape = (n, rows * columns * 3)
    return sparse.csr_array((np.hstack(entries).ravel(), (row, np.hstack(places).ravel())), shape=shape)


def _smoothness(grid: BlockGrid) -> sparse.csr_array:
    """Sum of squared differences between neighbouring nodes as a matrix (3 nodes, 3 nodes)."""
    number = np.arange(grid.shape[0] * grid.shape[1]).reshape(grid.shape)
    first = np.concatenate([number[:, :-1].ravel(), number[:-1].ravel()])
    second = np.concatenate([number[:, 1:].ravel(), number[1:].ravel()])
    edge = np.arange(len(first))
    ones = np.ones(len(first))
    shape = (len(first), number.size)
    step = sparse.csr_array((ones, (edge, first)), shape=shape) - sparse.csr_array(
        (ones, (edge, second)), shape=shape
    )
    return sparse.csr_array(sparse.kron(step.T @ step, sparse.eye_array(3)))


class PlacingConfig(StrictModel):
    """What is removed and stated beyond the rigid transform."""

    vertical: VerticalBiasConfig = VerticalBiasConfig()
    warp: WarpConfig = WarpConfig()
    uncertainty: UncertaintyConfig = UncertaintyConfig()


def stated_registration(
    registration: Registration, sigma: NDArray[np.float64], bias: SmoothField | None
) -> Registration:
    """State sigma_reg as the median over the points, and how it and the heights vary."""
    low, median, high = np.quantile(sigma, (0.05, 0.5, 0.95)).tolist()
    details = {**registration.details, "sigma_reg_p05_m": low, "sigma_reg_p95_m": high}
    if bias is not None:
        height = bias.values[:, :, 2]
        details |= {
            "vertical_bias_m": float(np.median(height)),
            "vertical_bias_min_m": float(height.min()),
            "vertical_bias_max_m": float(height.max()),
        }
    return replace(registration, sigma_reg_m=median, details=details)


def block_table(sigma: SigmaField, frame: CommonFrame) -> pd.DataFrame:
    """Report the registration block by block.

    Returns
    -------
    pandas.DataFrame
        ``east north`` of the centre in the world; ``sigma_standing_m`` and
        ``sigma_lying_m``, what the epochs lie apart on walls and on level
        surfaces beyond the noise of their points; ``n_standing n_lying``,
        residuals behind them (thin blocks borrow from their neighbours);
        ``shift_east_m shift_north_m shift_up_m``, what was added to *before*
        beyond the rigid transform.
    """
    origin = frame.origin
    centres = sigma.grid.centres()
    place = np.column_stack([centres, np.zeros(len(centres))])
    shift = np.zeros_like(place)
    for correction in frame.corrections:
        shift += correction.at(place)
    table = pd.DataFrame(
        {
            "east": centres[:, 0] + origin[0],
            "north": centres[:, 1] + origin[1],
            "sigma_standing_m": sigma.bias[:, 0],
            "sigma_lying_m": sigma.bias[:, 1],
            "n_standing": sigma.count[:, 0],
            "n_lying": sigma.count[:, 1],
            "shift_east_m": shift[:, 0],
            "shift_north_m": shift[:, 1],
            "shift_up_m": shift[:, 2],
        }
    )
    return table[sigma.count.sum(axis=1) > 0].reset_index(drop=True)
