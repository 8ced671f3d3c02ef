"""Cells of both epochs, and the rules that turn differences into the five labels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from subiaco_change.records import Registration
from subiaco_change.segmentation.ground_model import GroundModel, Mask, fit_ground
from subiaco_evaluation.baselines.config import CellConfig, Voids
from subiaco_evaluation.config import BaselineConfig
from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import Change
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, Ints

Codes = NDArray[np.uint8]
_BUDGET = 1 << 26  # cells
_AROUND = np.ones((3, 3), dtype=bool)


class CleanUp(Protocol):
    """What every method does after thresholding."""

    @property
    def opening(self) -> int:
        """Radius of the morphological opening [cells]."""

    @property
    def min_area(self) -> float:
        """Smallest contiguous change [m2]."""


@dataclass(frozen=True)
class Grid:
    """Cells aligned to whole multiples of the edge in world coordinates, row 0 in the south.

    ``corner`` (2,) is local to the clouds [m].
    """

    corner: Floats
    cell: float
    shape: tuple[int, int]

    def flat(self, xyz: Floats) -> Ints:
        """Return the cell (N,) of points (N, 3) that lie inside, up to rounding."""
        index = np.floor((xyz[:, :2] - self.corner) / self.cell).astype(np.int64)
        index = np.clip(index, 0, np.array(self.shape[::-1]) - 1)
        return np.asarray(index[:, 1] * self.shape[1] + index[:, 0])


def common_grid(before: PointCloud, after: PointCloud, cell: float) -> Grid:
    """Return the cells that hold both clouds, which share one origin.

    Raises
    ------
    InputError
        The area is too large for cells of this size.
    """
    offset = after.origin[:2]
    low = np.minimum(before.xyz[:, :2].min(axis=0), after.xyz[:, :2].min(axis=0)) + offset
    high = np.maximum(before.xyz[:, :2].max(axis=0), after.xyz[:, :2].max(axis=0)) + offset
    first = np.floor(low / cell)
    columns, rows = (np.floor(high / cell) - first + 1).astype(np.int64).tolist()
    if rows * columns > _BUDGET:
        raise InputError(
            f"cells.cell={cell}: {rows} x {columns} cells are too many; raise it, or crop the epochs"
        )
    # A hair of slack: the last digits of a large coordinate must not put a point outside.
    return Grid(first * cell - offset - 1e-6, cell, (rows, columns))


@dataclass(frozen=True)
class EpochCells:
    """One epoch in cells.

    ``cell`` (N,) and ``thing`` (N,) are by point: its cell, and whether it
    stands above the ground. The rest are rasters: number of points, number of
    things, height of the highest point (NaN where empty) and of the ground [m].
    """

    cloud: PointCloud
    cell: Ints
    thing: Mask
    count: Ints
    things: Ints
    top: Floats
    ground: Floats


@dataclass(frozen=True)
class Pair:
    """Two epochs in one frame, ready for any simple method."""

    before: EpochCells
    after: EpochCells
    grid: Grid
    registration: Registration

    @property
    def rise(self) -> Floats:
        """Height by which the highest point rose (rows, columns), NaN where either epoch is empty [m]."""
        return self.after.top - self.before.top


def make_pair(
    before: PointCloud, after: PointCloud, registration: Registration, config: BaselineConfig
) -> Pair:
    """Put two clouds of one frame and origin into cells."""
    grid = common_grid(before, after, config.cells.cell)
    sides = [_make_side(cloud, grid, config) for cloud in (before, after)]
    return Pair(sides[0], sides[1], grid, registration)


def _make_side(cloud: PointCloud, grid: Grid, config: BaselineConfig) -> EpochCells:
    model = fit_ground(cloud.xyz, config.ground)
    cell = grid.flat(cloud.xyz)
    size = grid.shape[0] * grid.shape[1]
    thing = cloud.xyz[:, 2] - model.height(cloud.xyz[:, :2]) > config.cells.thing_height
    top = np.full(size, -np.inf)
    np.maximum.at(top, cell, cloud.xyz[:, 2])
    top[np.isinf(top)] = np.nan
    count, things = np.bincount(cell, minlength=size), np.bincount(cell[thing], minlength=size)
    count, things = (values.reshape(grid.shape) for values in (count, things))
    ground = _ground_raster(model, grid)
    return EpochCells(cloud, cell, np.asarray(thing), count, things, top.reshape(grid.shape), ground)


def _ground_raster(model: GroundModel, grid: Grid) -> Floats:
    row, column = np.mgrid[: grid.shape[0], : grid.shape[1]]
    centres = np.column_stack([column.ravel(), row.ravel()]) * grid.cell + grid.corner + 0.5 * grid.cell
    return model.height(centres).reshape(grid.shape)


@dataclass(frozen=True)
class CellVerdict:
    """What a method says of every cell (rows, columns).

    ``code`` holds codes of :class:`Change`; ``confidence`` is 0.5 at the
    threshold and grows away from it, no probability; ``distance`` is the
    difference that was measured and ``lod95`` its level of detection [m], NaN
    where there is none.
    """

    code: Codes
    confidence: Floats
    distance: Floats
    lod95: Floats


def clean(changed: Mask, config: CleanUp, cell: float) -> Mask:
    """Open a mask of changed cells, and drop what is smaller than the smallest area."""
    if config.opening:
        window = np.ones((2 * config.opening + 1,) * 2, dtype=bool)
        changed = ndimage.binary_opening(changed, structure=window)
    labels, count = ndimage.label(changed, structure=_AROUND)
    large = np.bincount(labels.ravel(), minlength=count + 1) * cell**2 >= config.min_area
    large[0] = False
    return np.asarray(large[labels])


def name_changes(pair: Pair, up: Mask, down: Mask, voids: Voids) -> Codes:
    """Name changed cells.

    Added where *before* holds only ground and *after* something on it,
    Removed the other way round, else Increased or Decreased. A changed cell
    that is empty in the other epoch is 255, bare ground there, or Unchanged,
    as ``voids`` says.
    """
    code = np.full(pair.grid.shape, Change.UNCHANGED, dtype=np.uint8)
    sides = ((up, pair.after, pair.before), (down, pair.before, pair.after))
    names = ((Change.ADDED, Change.INCREASED), (Change.REMOVED, Change.DECREASED))
    for (changed, own, other), (whole, partly) in zip(sides, names, strict=True):
        appears = (own.things > 0) & (other.things == 0)
        code[changed & appears] = whole
        code[changed & ~appears] = partly
        void = changed & (other.count == 0)
        if voids == "ground":
            void &= ~appears
        code[void] = Change.UNOBSERVED if voids == "unobserved" else Change.UNCHANGED
    return code


def decide_from_points(
    pair: Pair, changed: tuple[Mask, Mask], config: CellConfig, method: CleanUp, voids: Voids
) -> tuple[Codes, Floats]:
    """Turn changed points of both epochs into codes and confidences of cells.

    A cell changes where enough points of an epoch have no counterpart in the
    other: upwards if they are those of *after*, downwards if of *before*;
    where both, the highest point decides.
    """
    shares = [_share(side, mask) for side, mask in zip((pair.before, pair.after), changed, strict=True)]
    over = [share >= config.share for share in shares]
    rises = np.where(np.isfinite(pair.rise), pair.rise, shares[1] - shares[0]) >= 0
    up = clean(over[1] & (rises | ~over[0]), method, config.cell)
    down = clean(over[0] & ~(rises & over[1]), method, config.cell)
    code = name_changes(pair, up, down, voids)
    return code, _margin(np.fmax(*shares), config.share, code)


def _share(side: EpochCells, changed: Mask) -> Floats:
    hits = np.bincount(side.cell[changed], minlength=side.count.size).reshape(side.count.shape)
    return np.asarray(hits / np.maximum(side.count, 1))


def _margin(share: Floats, threshold: float, code: Codes) -> Floats:
    beyond = (share - threshold) / max(1.0 - threshold, 1e-9)
    below = (threshold - share) / threshold
    changed = code < Change.UNCHANGED
    return np.asarray(0.5 + 0.5 * np.clip(np.where(changed, beyond, below), 0.0, 1.0))


def mean_by_cell(pair: Pair, values: tuple[Floats, Floats]) -> Floats:
    """Average values of the points of both epochs by cell (rows, columns), NaN where none is finite."""
    cell = np.concatenate([pair.before.cell, pair.after.cell])
    together = np.concatenate(values)
    known = np.isfinite(together)
    size = pair.before.count.size
    count = np.bincount(cell[known], minlength=size)
    total = np.bincount(cell[known], together[known], size)
    mean = np.divide(total, count, out=np.full(size, np.nan), where=count > 0)
    return np.asarray(mean.reshape(pair.grid.shape))
