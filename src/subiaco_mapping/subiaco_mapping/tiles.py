"""Voxel sums that go to disk by tile: memory holds what the vehicle sees at present, not the city."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.clouds import unpack_voxel_keys, voxel_indices, voxel_keys
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.raywalk import VisibilityAccumulator
from subiaco_geo.visibility import VisibilityGrid
from subiaco_mapping.fusion import VoxelAccumulator, VoxelStatistics, statistics_of

_SHIFT = 21
_REACH = 1 << 20
_NEAR_TILES = 12  # tiles kept at hand: one with its neighbours, and some

Rows = NDArray[Any]
Value = TypeVar("Value")


def tile_numbers(index: Ints, edge: int) -> Ints:
    """Return the tile (N,) of voxel indices (N, 2 or more); x major."""
    column, row = index[:, 0] // edge, index[:, 1] // edge
    return np.asarray(((column + _REACH) << _SHIFT) | (row + _REACH))


def tiles_around(tile: int) -> list[int]:
    """Return a tile and its eight neighbours."""
    return [tile + (dx << _SHIFT) + dy for dx in (-1, 0, 1) for dy in (-1, 0, 1)]


def tile_corner(tile: int, edge: int) -> Ints:
    """Return the voxel index (2,) of a tile's lower corner."""
    return np.array([(tile >> _SHIFT) - _REACH, (tile & ((1 << _SHIFT) - 1)) - _REACH]) * edge


def summed(keys: Ints, columns: list[Rows]) -> tuple[Ints, list[Rows]]:
    """Add up rows of equal keys; keys come out sorted."""
    if len(keys) == 0:
        return keys, columns
    order = np.argsort(keys, kind="stable")
    ranked = keys[order]
    starts = np.flatnonzero(np.concatenate([[True], ranked[1:] != ranked[:-1]]))
    return ranked[starts], [np.add.reduceat(c[order], starts, axis=0, dtype=c.dtype) for c in columns]


class TileRuns:
    """Rows by voxel key on disk. Every run is one spill, sorted by tile.

    Parameters
    ----------
    folder : Path
    edge : int
        Edge of a tile [voxels].
    """

    def __init__(self, folder: Path, edge: int) -> None:
        self.edge = edge
        self._folder = folder
        self._runs: list[tuple[list[Rows], dict[int, slice]]] = []
        folder.mkdir(parents=True)

    def append(self, keys: Ints, columns: list[Rows]) -> None:
        """Write a run: keys (N,), each once, and columns (N, ...)."""
        tile = tile_numbers(unpack_voxel_keys(keys), self.edge)
        order = np.argsort(tile, kind="stable")
        found, starts = np.unique(tile[order], return_index=True)
        ends = np.append(starts[1:], len(tile))
        mapped = []
        for number, rows in enumerate([keys, *columns]):
            path = self._folder / f"{len(self._runs):05d}_{number}.npy"
            np.save(path, rows[order])
            mapped.append(np.load(path, mmap_mode="r"))
        spans = zip(found.tolist(), starts.tolist(), ends.tolist(), strict=True)
        self._runs.append((mapped, {name: slice(start, end) for name, start, end in spans}))

    def tiles(self) -> list[int]:
        """Return the tiles that hold something, in order."""
        return sorted({tile for _, spans in self._runs for tile in spans})

    def read(self, tiles: list[int]) -> tuple[Ints, list[Rows]]:
        """Return keys and columns of tiles, runs added up, sorted by key; there must be some."""
        parts = [[c[spans[t]] for c in rows] for t in tiles for rows, spans in self._runs if t in spans]
        keys, *columns = (np.concatenate(column) for column in zip(*parts, strict=True))
        return summed(keys, columns)


class Recent(Generic[Value]):
    """What was made for the tiles asked for last."""

    def __init__(self, make: Callable[[int], Value]) -> None:
        self._make = make
        self._kept: OrderedDict[int, Value] = OrderedDict()

    def __call__(self, tile: int) -> Value:
        """Return it, made anew where it is not kept."""
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
    """A visibility layer that goes to disk when it outgrows ``most`` voxels; see VisibilityAccumulator."""

    def __init__(self, folder: Path, origin: Floats, voxel: float, edge: int, most: int) -> None:
        self._origin, self._voxel, self._most = origin, voxel, most
        self._folder = folder
        self._runs = TileRuns(folder / "runs", edge)
        self._active = VisibilityAccumulator(origin, voxel)
        self._near = Recent(self._tile)

    def add(self, starts: Floats, ends: Floats, returned: NDArray[np.bool_]) -> None:
        """Walk beams (N, 3) -> (N, 3) [m, world]."""
        self._active.add(starts, ends, returned)
        if len(self._active) >= self._most:
            self.flush()

    def flush(self) -> None:
        """Write what is in memory."""
        grid = self._active.grid()
        if len(grid.keys):
            self._runs.append(grid.keys, [grid.hits, grid.passes])
            self._active = VisibilityAccumulator(self._origin, self._voxel)

    def _tile(self, tile: int) -> VisibilityGrid:
        keys, (hits, passes) = self._runs.read([tile])
        return VisibilityGrid(self._origin, self._voxel, keys, hits, passes)

    def passes(self, world: Floats) -> NDArray[np.uint32]:
        """Return the beams (N,) that went through the voxels of points (N, 3); flushed before."""
        tiles = tile_numbers(voxel_indices(world - self._origin, self._voxel), self._runs.edge)
        found = np.zeros(len(world), dtype=np.uint32)
        for tile in sorted(set(tiles.tolist()) & set(self._runs.tiles())):
            inside = tiles == tile
            found[inside] = self._near(tile).lookup(world[inside])[1]
        return found

    def grid(self) -> VisibilityGrid:
        """Return the whole layer, mapped from disk; flushed before."""
        whole = DiskColumns(self._folder / "grid")
        whole.append(keys=np.zeros(0, np.int64), hits=np.zeros(0, np.uint32), passes=np.zeros(0, np.uint32))
        columns: dict[int, list[int]] = {}
        for tile in self._runs.tiles():
            columns.setdefault(tile >> _SHIFT, []).append(tile)
        for column in columns.values():  # keys sort by x first
            keys, (hits, passes) = self._runs.read(column)
            whole.append(keys=keys, hits=hits, passes=passes)
        return VisibilityGrid(self._origin, self._voxel, **whole.arrays())


class TurnTiles:
    """In how many turns every voxel returned something; goes to disk like the rest.

    Parameters
    ----------
    folder : Path
    voxel : float
        Edge [m].
    edge : int
        Edge of a tile [voxels].
    most : int
        Rows in memory.
    """

    def __init__(self, folder: Path, voxel: float, edge: int, most: int) -> None:
        self._voxel, self._most = voxel, most
        self._runs = TileRuns(folder, edge)
        self._fresh: list[Ints] = []
        self._size = 0
        self._near = Recent(lambda tile: self._runs.read([tile]))

    def add(self, keys: Ints) -> None:
        """Take the voxels of one turn, each once."""
        self._fresh.append(keys)
        self._size += len(keys)
        if self._size >= self._most:
            self.flush()

    def flush(self) -> None:
        """Write what is in memory."""
        if self._size:
            keys, counts = np.unique(np.concatenate(self._fresh), return_counts=True)
            self._runs.append(keys, [counts.astype(np.uint32)])
        self._fresh, self._size = [], 0

    def turns(self, xyz: Floats) -> NDArray[np.uint32]:
        """Return the turns (N,) that returned something from the voxels of points (N, 3)."""
        index = voxel_indices(xyz, self._voxel)
        tiles, query = tile_numbers(index, self._runs.edge), voxel_keys(index)
        found = np.zeros(len(xyz), dtype=np.uint32)
        for tile in sorted(set(tiles.tolist()) & set(self._runs.tiles())):
            keys, (counts,) = self._near(tile)
            inside = tiles == tile
            slot = np.minimum(np.searchsorted(keys, query[inside]), len(keys) - 1)
            found[inside] = np.where(keys[slot] == query[inside], counts[slot], 0)
        return found


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
