"""Voxel sums that are moved to disk by tile, so that memory does not grow with the city."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any, Generic, TypeVar

import numba
import numpy as np
from numpy.typing import NDArray

from subiaco_geo.clouds import VOXEL_LIMIT, stable_order
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.observation_times import (
    COLUMNS,
    PENDING,
    WINDOWS,
    VoxelObservations,
    joined_looks,
    looks_of,
)
from subiaco_geo.visibility import VisibilityGrid
from subiaco_geo.voxel_traversal import VisibilityAccumulator
from subiaco_mapping.fusion.voxel_fusion import VoxelAccumulator, VoxelStatistics, statistics_of

_SHIFT = 21
_ROOM = 1 << 22  # first size of a visibility layer [voxels]; what is not used of it takes no memory
_NEAR_TILES = 12  # tiles kept at hand: one with its neighbours, and some

Rows = NDArray[Any]
Join = Callable[[Ints, list[Rows]], tuple[Ints, list[Rows]]]
Value = TypeVar("Value")


def tile_numbers(index: Ints, edge: int) -> Ints:
    """Return the tile (N,) of voxel indices (N, 2 or more); x major."""
    column, row = index[:, 0] // edge, index[:, 1] // edge
    return np.asarray(((column + VOXEL_LIMIT) << _SHIFT) | (row + VOXEL_LIMIT))


@numba.njit(cache=True)
def _tiles_of(keys: Ints, edge: int) -> Ints:
    """Return the tile (N,) of voxels by their keys (N,); a division for every column of sorted keys."""
    tiles = np.empty(len(keys), np.int64)
    last, tile = np.int64(-1), np.int64(0)
    for i in range(len(keys)):
        if keys[i] >> _SHIFT != last:  # another column of voxels
            last = keys[i] >> _SHIFT
            column, row = (last >> _SHIFT) - VOXEL_LIMIT, (last & ((1 << _SHIFT) - 1)) - VOXEL_LIMIT
            tile = ((column // edge + VOXEL_LIMIT) << _SHIFT) | (row // edge + VOXEL_LIMIT)
        tiles[i] = tile
    return tiles


def tiles_around(tile: int) -> list[int]:
    """Return a tile and its eight neighbours."""
    return [tile + (dx << _SHIFT) + dy for dx in (-1, 0, 1) for dy in (-1, 0, 1)]


def tile_corner(tile: int, edge: int) -> Ints:
    """Return the voxel index (2,) of a tile's lower corner."""
    return np.array([(tile >> _SHIFT) - VOXEL_LIMIT, (tile & ((1 << _SHIFT) - 1)) - VOXEL_LIMIT]) * edge


def _grouped(keys: Ints) -> tuple[Ints, Ints, Ints]:
    """Return the sorted keys, each once, where each begins, and the order; equal ones keep theirs."""
    order = stable_order(keys)
    ranked = keys[order]
    starts = np.flatnonzero(np.concatenate([[True], ranked[1:] != ranked[:-1]]))
    return ranked[starts], starts, order


def _stretches_by_tile(tiles: Ints) -> tuple[Ints, Ints, list[slice]]:
    """Return the tiles (T,), where the rows of each begin once in order, and stretches in that order.

    Rows of sorted keys lie in few stretches of one tile (N,): these are copied faster than single rows.
    """
    first = np.flatnonzero(np.concatenate([[True], tiles[1:] != tiles[:-1]]))
    found, starts, order = _grouped(tiles[first])
    lengths = np.diff(first, append=len(tiles))[order]
    begins = np.concatenate([[0], np.cumsum(lengths)[:-1]])[starts]
    stretches = zip(first[order].tolist(), lengths.tolist(), strict=True)
    return found, begins, [slice(begin, begin + length) for begin, length in stretches]


def summed(keys: Ints, columns: list[Rows]) -> tuple[Ints, list[Rows]]:
    """Add up rows of equal keys; keys come out sorted."""
    if len(keys) == 0:
        return keys, columns
    ranked, starts, order = _grouped(keys)
    if len(ranked) == len(keys):
        return ranked, [c[order] for c in columns]
    return ranked, [np.add.reduceat(c[order], starts, axis=0, dtype=c.dtype) for c in columns]


class TileRuns:
    """Rows by voxel key on disk. Every run is one spill, sorted by tile.

    Parameters
    ----------
    folder : Path
    edge : int
        Edge of a tile [voxels].
    join : callable
        Makes one row of all rows of a key, which come in the order in which they were written.
    """

    def __init__(self, folder: Path, edge: int, join: Join = summed) -> None:
        self.edge = edge
        self._join = join
        self._folder = folder
        self._runs: list[tuple[list[Rows], dict[int, slice]]] = []
        folder.mkdir(parents=True)

    def append(self, keys: Ints, columns: list[Rows]) -> None:
        """Write a run: keys (N,), each once, and columns (N, ...)."""
        found, starts, stretches = _stretches_by_tile(_tiles_of(keys, self.edge))
        ends = np.append(starts[1:], len(keys))
        mapped = []
        for number, rows in enumerate([keys, *columns]):
            path = self._folder / f"{len(self._runs):05d}_{number}.npy"
            np.save(path, np.concatenate([rows[stretch] for stretch in stretches]))
            mapped.append(np.load(path, mmap_mode="r"))
        spans = zip(found.tolist(), starts.tolist(), ends.tolist(), strict=True)
        self._runs.append((mapped, {name: slice(start, end) for name, start, end in spans}))

    def tiles(self) -> list[int]:
        """Return the tiles that hold something, in order."""
        return sorted({tile for _, spans in self._runs for tile in spans})

    def read(self, tiles: list[int]) -> tuple[Ints, list[Rows]]:
        """Return keys and columns of tiles, runs joined, sorted by key; there must be some."""
        parts = [[c[spans[t]] for c in rows] for t in tiles for rows, spans in self._runs if t in spans]
        keys, *columns = (np.concatenate(column) for column in zip(*parts, strict=True))
        if len(parts) == 1 and (keys[1:] > keys[:-1]).all():  # of one run, nothing to join
            return keys, columns
        return self._join(keys, columns)


class Recent(Generic[Value]):
    """What was made for the tiles asked for last."""

    def __init__(self, make: Callable[[int], Value]) -> None:
        self._make = make
        self._kept: OrderedDict[int, Value] = OrderedDict()

    def __call__(self, tile: int) -> Value:
        """Return it, read again where it is not kept."""
        if tile not in self._kept:
            self._kept[tile] = self._make(tile)
            if len(self._kept) > _NEAR_TILES:
                self._kept.popitem(last=False)
        self._kept.move_to_end(tile)
        return self._kept[tile]


class DiskColumns:
    """Arrays that grow on disk; read back they are mapped, not loaded.

    The files may be removed while the arrays are in use.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._shapes: dict[str, tuple[np.dtype[Any], tuple[int, ...]]] = {}
        folder.mkdir(parents=True)

    def append(self, **columns: Rows) -> None:
        """Add rows to every column."""
        for name, rows in columns.items():
            self._shapes[name] = (rows.dtype, rows.shape[1:])
            with (self._folder / name).open("ab") as stream:
                stream.write(np.ascontiguousarray(rows).data)

    def arrays(self) -> dict[str, Rows]:
        """Return every column."""
        return {name: self._array(name, *shape) for name, shape in self._shapes.items()}

    def _array(self, name: str, dtype: np.dtype[Any], tail: tuple[int, ...]) -> Rows:
        path = self._folder / name
        if path.stat().st_size == 0:
            return np.zeros((0, *tail), dtype=dtype)
        return np.asarray(np.memmap(path, dtype=dtype, mode="c")).reshape(-1, *tail)


class VisibilityTiles:
    """A visibility layer that goes to disk when it outgrows ``most`` voxels; see VisibilityAccumulator.

    Parameters
    ----------
    folder : Path
    origin : (3,) float64
        World coordinates of the corner of voxel (0, 0, 0) [m].
    voxel : float
        Edge [m].
    edge : int
        Edge of a tile [voxels].
    most : int
        Voxels in memory.
    least_beams : int
        Beams in a time window that make a look through a voxel.
    """

    def __init__(
        self, folder: Path, origin: Floats, voxel: float, edge: int, most: int, least_beams: int
    ) -> None:
        self._origin, self._voxel, self._most, self._least = origin, voxel, most, least_beams
        self._folder = folder
        self._runs = TileRuns(folder / "runs", edge, _joined_beams)
        self._active = self._empty()
        self._base, self._window = 0, 0

    def _empty(self) -> VisibilityAccumulator:
        room = min(2 * self._most, _ROOM)
        return VisibilityAccumulator(self._origin, self._voxel, room, self._least)

    def add(
        self, starts: Floats, ends: Floats, returned: NDArray[np.bool_], hits: Floats, window: int
    ) -> None:
        """Walk beams (N, 3) -> (N, 3) of one scan, in which points ``hits`` (M, 3) returned [m, world].

        ``window`` is the number of the time window, 1 or more. What is in memory goes to disk between
        two windows.
        """
        if window != self._window:
            reached = 0 < window - self._base < WINDOWS
            full = len(self._active) >= self._most or self._active.cells >= 2 * self._most
            if full or not reached:
                self._go_on(window)
            self._window = window
        self._active.touch(hits, window - self._base)
        self._active.add(starts, ends, returned, window - self._base)

    def _go_on(self, window: int) -> None:
        """Write what is in memory, except beams of observations that the next windows may complete."""
        base = max(window - 1 - PENDING, 0)
        near = self._base <= base and window - self._window <= PENDING
        fresh = self._active.pending(window - self._base, base - self._base) if near else self._empty()
        self.flush()
        self._active, self._base = fresh, base if near else window - 1

    def flush(self) -> None:
        """Write what is in memory."""
        if len(self._active):
            grid, looks = self._active.grid_and_looks()
            looks = looks.later(self._base)
            self._runs.append(grid.keys, [grid.hits, grid.passes, *looks.columns()])
            self._active = self._empty()

    def free(self) -> None:
        """Give the table's memory back."""
        self._active = self._empty()

    def grid(self) -> tuple[VisibilityGrid, VoxelObservations]:
        """Return the whole layer, mapped from disk, and the looks at its voxels; flushed before."""
        whole = DiskColumns(self._folder / "grid")
        nothing = np.zeros((0, COLUMNS), dtype=np.uint16)
        empty = [np.zeros(0, np.uint32), np.zeros(0, np.uint32), *looks_of(nothing, 1).columns()]
        looks_named = tuple(f"look_{field.name}" for field in fields(VoxelObservations))
        names = ("hits", "passes", *looks_named)
        whole.append(keys=np.zeros(0, np.int64), **dict(zip(names, empty, strict=True)))
        columns: dict[int, list[int]] = {}
        for tile in self._runs.tiles():
            columns.setdefault(tile >> _SHIFT, []).append(tile)
        for column in columns.values():  # keys sort by x first
            keys, found = self._runs.read(column)
            whole.append(keys=keys, **dict(zip(names, found, strict=True)))
        arrays = whole.arrays()
        looks = VoxelObservations(*(arrays.pop(name) for name in looks_named))
        keys, hits, passes = (arrays[name] for name in ("keys", "hits", "passes"))
        return VisibilityGrid(self._origin, self._voxel, keys, hits, passes), looks


def _joined_beams(keys: Ints, columns: list[Rows]) -> tuple[Ints, list[Rows]]:
    """Join rows of equal keys, in the order of time: beams are added up, looks follow one another."""
    ranked, starts, order = _grouped(keys)
    if len(ranked) == len(keys):  # nothing to join
        return ranked, [c[order] for c in columns]
    counts = [np.add.reduceat(c[order], starts, axis=0, dtype=c.dtype) for c in columns[:2]]
    looks = joined_looks(starts, VoxelObservations(*(c[order] for c in columns[2:])))
    return ranked, [*counts, *looks.columns()]


class VoxelTiles:
    """Voxel sums that go to disk when they outgrow ``most`` voxels; see VoxelAccumulator."""

    def __init__(self, folder: Path, leaf: float, edge: int, most: int) -> None:
        self._leaf, self._most = leaf, most
        self._runs = TileRuns(folder, edge)
        self._active = VoxelAccumulator(leaf)

    def add(self, xyz: Floats, intensity: NDArray[np.float32], sensor: Floats) -> None:
        """Add points (N, 3) [m] seen from a sensor position (3,)."""
        self._active.add(xyz, intensity, sensor)
        if len(self._active) >= self._most:
            self.flush()

    def flush(self) -> None:
        """Write what is in memory."""
        if len(self._active):
            keys, counts, sums = self._active.sums()
            self._runs.append(keys, [counts, sums])
            self._active.clear()

    @property
    def tiles(self) -> list[int]:
        """Tiles that hold something, in order; flushed before."""
        return self._runs.tiles()

    def statistics(self, tile: int) -> VoxelStatistics:
        """Return what one tile holds; flushed before."""
        keys, (counts, sums) = self._runs.read([tile])
        return statistics_of(keys, counts, sums, self._leaf)

    def free(self) -> None:
        """Give the table's memory back."""
        self._active = VoxelAccumulator(self._leaf)
