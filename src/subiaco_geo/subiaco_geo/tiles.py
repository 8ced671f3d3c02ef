"""Square tiles with a buffer: independent pieces of work whose cores cover the ground exactly once."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats

Bounds = tuple[float, float, float, float]


@dataclass(frozen=True)
class Tile:
    """One tile: results count inside ``core``, neighbours are seen inside ``buffered``.

    Parameters
    ----------
    id : str
        ``column_row`` on a grid anchored at zero, the same for every run.
    core, buffered : (min_x, min_y, max_x, max_y)
        Metres; the upper edges are outside.
    """

    id: str
    core: Bounds
    buffered: Bounds

    def in_core(self, xy: Floats) -> NDArray[np.bool_]:
        """Tell which points (N, 2 or more) lie in the core, upper edges excluded."""
        return _inside(xy, self.core)

    def in_buffered(self, xy: Floats) -> NDArray[np.bool_]:
        """Tell which points (N, 2 or more) lie in the core or its buffer."""
        return _inside(xy, self.buffered)


def _inside(xy: Floats, bounds: Bounds) -> NDArray[np.bool_]:
    x, y = xy[:, 0], xy[:, 1]
    return np.asarray((x >= bounds[0]) & (y >= bounds[1]) & (x < bounds[2]) & (y < bounds[3]))


def _span(low: float, high: float, size: float) -> range:
    """Return the cells of one axis that cover ``low`` to ``high``, rounding allowed for."""
    first, last = math.floor(low / size), math.floor(high / size)
    if first * size > low:
        first -= 1
    if (last + 1) * size <= high:
        last += 1
    return range(first, last + 1)


def tile_grid(bounds: Sequence[float], size: float = 80.0, overlap: float = 10.0) -> list[Tile]:
    """Cover a rectangle with tiles, row by row.

    Parameters
    ----------
    bounds : (min_x, min_y, max_x, max_y)
        Metres; points on the upper edges are covered too.
    size : float
        Edge of a core [m].
    overlap : float
        Buffer around it [m].

    Raises
    ------
    InputError
        Bounds that are not finite or turned round, or a size that is not positive.
    """
    if size <= 0 or overlap < 0:
        raise InputError(f"tiles: size {size} must be positive and overlap {overlap} not negative")
    low_x, low_y, high_x, high_y = (float(v) for v in bounds)
    if not np.isfinite([low_x, low_y, high_x, high_y]).all() or low_x > high_x or low_y > high_y:
        raise InputError(f"tiles: bounds {tuple(bounds)} are not (min_x, min_y, max_x, max_y)")
    return [
        _tile(column, row, size, overlap)
        for row in _span(low_y, high_y, size)
        for column in _span(low_x, high_x, size)
    ]


def tile_named(name: str, size: float = 80.0, overlap: float = 10.0) -> Tile:
    """Return the tile of an id, as :func:`tile_grid` would.

    Raises
    ------
    InputError
        Not an id of a tile.
    """
    column, _, row = name.partition("_")
    try:
        return _tile(int(column), int(row), size, overlap)
    except ValueError as error:
        raise InputError(f"tile {name!r}: an id is column_row, two whole numbers") from error


def neighbours(name: str, names: Collection[str], rings: int = 1) -> list[str]:
    """Return those of ``names`` that lie at most ``rings`` tiles from a tile, itself excluded, in order."""
    column, row = map(int, name.split("_"))
    reach = range(-rings, rings + 1)
    around = (f"{column + dc}_{row + dr}" for dr in reach for dc in reach if (dc, dr) != (0, 0))
    return sorted(set(around) & set(names))


def split_by_tile(xy: Floats, size: float = 80.0) -> dict[str, NDArray[np.int64]]:
    """Return the indices of the points (N, 2 or more) of every tile, in order; tiles by id."""
    index = np.floor(np.asarray(xy)[:, :2] / size).astype(np.int64)
    if len(index) == 0:
        return {}
    column, row = (along - along.min() for along in index.T)
    tile = row * (int(column.max()) + 1) + column
    tile = tile.astype(np.min_scalar_type(int(tile.max())))  # short keys sort faster
    order = np.argsort(tile, kind="stable")
    ordered = tile[order]
    fresh = np.concatenate([[0], np.flatnonzero(ordered[1:] != ordered[:-1]) + 1])
    groups = np.split(order, fresh[1:])
    return {f"{c}_{r}": g for (c, r), g in zip(index[order[fresh]].tolist(), groups, strict=True)}


def _tile(column: int, row: int, size: float, overlap: float) -> Tile:
    core = (column * size, row * size, (column + 1) * size, (row + 1) * size)
    buffered = (core[0] - overlap, core[1] - overlap, core[2] + overlap, core[3] + overlap)
    return Tile(f"{column}_{row}", core, buffered)
