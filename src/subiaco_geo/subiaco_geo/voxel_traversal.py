"""Ray casting through a sparse voxel grid: voxels that returned a beam, and voxels it crossed."""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from subiaco_geo.clouds import VOXEL_LIMIT, stable_order
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.observation_times import (
    COLUMNS,
    Rows,
    VoxelObservations,
    count_passing,
    count_return,
    looks_of,
    pending_rows,
)
from subiaco_geo.visibility import VisibilityGrid
from subiaco_geo.voxel_table import EMPTY, empty_table, enter_keys, find_slot

_CACHE_LINE = 64  # [bytes]
_BATCH = (1 << 16) - 1  # most beams that are traced together: a cell counts them in 16 bits

_BITS = 2  # an axis: 4 x 4 x 4 voxels in a block
_CELLS = 1 << (3 * _BITS)
_LAST = (1 << _BITS) - 1
_INSIDE = (_LAST << 42) | (_LAST << 21) | _LAST  # bits of a key that tell the place in a block

Counts = NDArray[np.uint32]
Flags = NDArray[np.bool_]


@numba.njit(cache=True)
def _place(key: int) -> int:
    """Return the place of a voxel in its block."""
    return ((((key >> 42) & _LAST) << _BITS | ((key >> 21) & _LAST)) << _BITS) | (key & _LAST)


@numba.njit(cache=True)
def _block_number(index: Ints, used: Ints, block: int) -> int:
    """Return the number of a block, which is given the next free one where it is new."""
    slot = find_slot(index, block)
    if index[slot, 0] == EMPTY:
        index[slot, 0], index[slot, 1] = block, used[0]
        used[0] += 1
    return index[slot, 1]


def _in_order(index: Ints, count: int) -> Ints:
    """Return the keys (N,) of a table in the order of their numbers."""
    keys = np.empty(count, dtype=np.int64)
    held = index[index[:, 0] != EMPTY]
    keys[held[:, 1]] = held[:, 0]
    return keys


@numba.njit(cache=True)
def _touch(
    points: Floats, first: int, blocks: int, index: Ints, used: Ints, states: Rows, window: int, least: int
) -> int:
    """Count a hit window at the voxels of points (voxel units) until done or all blocks are used."""
    last, fresh = np.int64(EMPTY), 0
    for i in range(first, len(points)):
        key = np.int64(0)
        for axis in range(3):
            key = (key << 21) | (np.int64(np.floor(points[i, axis])) + VOXEL_LIMIT)
        if key == last:
            continue
        if used[0] == blocks:
            first = i
            break
        last = key
        block, place = _block_number(index, used, key & ~_INSIDE), _place(key)
        fresh += states[block, 0, place] == 0
        count_return(states[block], place, window, least)
    else:
        first = len(points)
    used[1] += fresh
    return first


@numba.njit(cache=True)
def _walk(  # noqa: C901, PLR0912, PLR0915
    starts: Floats, ends: Floats, returned: Flags, first: int, blocks: int, index: Ints, used: Ints,
    counts: Counts, states: Rows, marked: Flags, window: int, least: int, longest: int,
) -> int:  # fmt: skip
    """Walk beams (voxel units) from index ``first`` until done or all blocks may be used; return the next.

    VoxelObservations are counted where ``window`` is not 0 (:mod:`subiaco_geo.observation_times`).

    Amanatides and Woo (1987), with the number of steps fixed beforehand on
    every axis, so that rounding can never walk past the end voxel. The keys on a beam come first, then
    their cells: in one loop, every wrong guess of the processor about a step would wait for the memory.
    Beams are counted in the last row of ``states`` first, as many of them cross the same voxels.
    """
    path, batch = np.empty(longest, np.int64), states.shape[1] - 1
    met, number = np.empty(blocks + 1, np.int64), 0
    last, hit = np.empty((min(len(starts) - first, _BATCH), 2), np.int64), 0
    cell, left, step = np.empty(3, np.int64), np.empty(3, np.int64), np.empty(3, np.int64)
    t_next, t_delta = np.empty(3), np.empty(3)
    ray, filled = first, used[0]
    while ray < min(len(starts), first + _BATCH):
        steps, crossed_blocks = 0, 1
        for axis in range(3):
            cell[axis] = np.int64(np.floor(starts[ray, axis]))
            end = np.int64(np.floor(ends[ray, axis]))
            left[axis] = abs(end - cell[axis])
            crossed_blocks += abs((end >> _BITS) - (cell[axis] >> _BITS))
            direction = ends[ray, axis] - starts[ray, axis]
            step[axis] = 1 if direction > 0 else -1
            t_next[axis] = np.inf
            t_delta[axis] = 0.0
            if left[axis] > 0:
                edge = cell[axis] + (1 if direction > 0 else 0)
                t_next[axis] = (edge - starts[ray, axis]) / direction
                t_delta[axis] = abs(1.0 / direction)
            steps += left[axis]
        if filled + crossed_blocks > blocks:
            break
        key = ((cell[0] + VOXEL_LIMIT) << 42) | ((cell[1] + VOXEL_LIMIT) << 21) | (cell[2] + VOXEL_LIMIT)
        dx, dy, dz = step[0] << 42, step[1] << 21, step[2]
        nx, ny, nz = left
        tx, ty, tz = t_next[0], t_next[1], t_next[2]
        for i in range(steps + 1):
            path[i] = key
            if tx <= ty and tx <= tz:
                key += dx
                nx -= 1
                tx = tx + t_delta[0] if nx > 0 else np.inf
            elif ty <= tz:
                key += dy
                ny -= 1
                ty = ty + t_delta[1] if ny > 0 else np.inf
            else:
                key += dz
                nz -= 1
                tz = tz + t_delta[2] if nz > 0 else np.inf
        block, own, place = np.int64(EMPTY), np.uint64(0), np.uint64(0)
        for i in range(steps + 1):
            key = path[i]
            if key & ~_INSIDE != block:
                block = key & ~_INSIDE
                slot = find_slot(index, block)
                if index[slot, 0] == EMPTY:
                    index[slot, 0], index[slot, 1] = block, filled
                    filled += 1
                own = np.uint64(index[slot, 1])
                met[number] = index[slot, 1]
                number += not marked[own]
                marked[own] = True
            place = np.uint64(_place(key))
            states[own, batch, place] += np.uint16(1)
        if returned[ray]:
            states[own, batch, place] -= np.uint16(1)
            last[hit, 0], last[hit, 1] = own, place
            hit += 1
        ray += 1
    used[0] = filled
    used[1] += _count_passes(met[:number], counts, states, marked, window, least)
    used[1] += _count_returns(last[:hit], counts, states, window, least)
    return ray


@numba.njit(cache=True)
def _count_passes(met: Ints, counts: Counts, states: Rows, marked: Flags, window: int, least: int) -> int:
    """Count the beams of a batch that went through the cells of blocks; return how many cells are new."""
    fresh, batch = 0, states.shape[1] - 1
    for block in met:
        for i in range(_CELLS):
            beams = states[block, batch, i]
            new = (beams > 0) & ((counts[block, 0, i] | counts[block, 1, i]) == 0)
            fresh += new & (states[block, 0, i] == 0) if window else new
            counts[block, 1, i] += beams
        if window:
            count_passing(states[block], window, least)
        else:
            states[block, batch] = 0
        marked[block] = False
    return fresh


@numba.njit(cache=True)
def _count_returns(last: Ints, counts: Counts, states: Rows, window: int, least: int) -> int:
    """Count the beams that returned from cells (N, 2); return how many cells are new."""
    fresh = 0
    for k in range(len(last)):
        block, place = last[k]
        new = (counts[block, 0, place] | counts[block, 1, place]) == 0
        counts[block, 0, place] += np.uint32(1)
        if window:
            new &= states[block, 0, place] == 0
            count_return(states[block], place, window, least)
        fresh += new
    return fresh


@numba.njit(cache=True)
def _collect(index: Ints, used: Ints, counts: Counts, states: Rows, timed: bool) -> Ints:
    """Return keys and cells (2, N) of the voxels at which something was counted."""
    found, n = np.empty((2, used[1]), np.int64), 0
    for slot in range(len(index)):
        if index[slot, 0] == EMPTY:
            continue
        block = index[slot, 1]
        for place in range(_CELLS):
            counted = (counts[block, 0, place] | counts[block, 1, place]) > 0
            if counted or (timed and states[block, 0, place] > 0):
                found[0, n] = (
                    index[slot, 0]
                    | (place >> 2 * _BITS) << 42
                    | ((place >> _BITS) & _LAST) << 21
                    | place & _LAST
                )
                found[1, n] = block * _CELLS + place
                n += 1
    return found


@numba.njit(cache=True)
def _rows_of(states: Rows, cells: Ints) -> Rows:
    """Return the running states (N, COLUMNS) of cells (N,)."""
    rows = np.empty((len(cells), COLUMNS), np.uint16)
    for i in range(len(cells)):
        block, place = divmod(cells[i], _CELLS)
        for column in range(COLUMNS):
            rows[i, column] = states[block, column, place]
    return rows


@numba.njit(cache=True)
def _put(keys: Ints, rows: Rows, index: Ints, used: Ints, states: Rows) -> None:
    """Write the looks of voxels, none of them there yet; there must be room."""
    for i in range(len(keys)):
        block, place = _block_number(index, used, keys[i] & ~_INSIDE), _place(keys[i])
        states[block, :COLUMNS, place] = rows[i]
    used[1] += len(keys)


def _aligned(shape: tuple[int, ...], kind: type[np.generic]) -> NDArray[Any]:
    """Return a zeroed array that begins on a border of the cache."""
    raw = np.zeros(math.prod(shape) * np.dtype(kind).itemsize + _CACHE_LINE, dtype=np.uint8)
    first = -raw.ctypes.data % _CACHE_LINE
    return np.asarray(raw[first : first + len(raw) - _CACHE_LINE].view(kind).reshape(shape))


@numba.njit(cache=True)
def _units(points: Floats, origin: Floats, voxel: float, limit: int) -> tuple[Floats, bool]:
    """Return points (N, 3) in voxel units, and whether all are within a limit; NaN is not."""
    units, near = np.empty(points.shape), True
    for i in range(len(points)):
        for axis in range(3):
            units[i, axis] = (points[i, axis] - origin[axis]) / voxel
            near &= abs(units[i, axis]) < limit
    return units, near


def _beams(starts: Floats, ends: Floats, origin: Floats, voxel: float) -> tuple[Floats, Floats]:
    """Check beams and put them in voxel units."""
    if starts.shape != ends.shape or starts.ndim != 2 or starts.shape[1] != 3:
        raise InputError(f"beam starts {starts.shape} and ends {ends.shape} must both be (N, 3)")
    return _in_voxels("starts", starts, origin, voxel), _in_voxels("ends", ends, origin, voxel)


def _in_voxels(name: str, points: Floats, origin: Floats, voxel: float) -> Floats:
    """Put points (N, 3) [m, world] in voxel units; ``name`` them where they cannot be counted."""
    units, near = _units(points, origin, voxel, VOXEL_LIMIT - 1)
    if not near:
        if not np.isfinite(units).all():
            raise InputError(f"beam {name} hold NaN or infinite coordinates; drop them first")
        raise InputError(
            f"beam {name} lie more than {VOXEL_LIMIT} voxels from the grid origin; use a nearer origin"
        )
    return units


class VisibilityAccumulator:
    """Counts hits and passes of many batches of beams in blocks of voxels that a growing hash table finds.

    The voxels of a block lie side by side: what a beam and its neighbours count stays in the caches, and the
    beams of a batch are entered block by block, many voxels in one instruction.

    Parameters
    ----------
    origin : (3,) float64
        World coordinates of the corner of voxel (0, 0, 0) [m].
    voxel : float
        Edge [m].
    capacity : int
        First size of the table [voxels]; it grows by itself.
    least_beams : int
        Traced beams of one window that make the window a look through a voxel; 0 keeps no time.
    """

    def __init__(self, origin: Floats, voxel: float, capacity: int = 1 << 18, least_beams: int = 0) -> None:
        if voxel <= 0:
            raise InputError(f"voxel must be positive, got {voxel}")
        self.origin = np.asarray(origin, dtype=np.float64)
        self.voxel = float(voxel)
        self._least = least_beams
        self._used = np.zeros(2, dtype=np.int64)  # blocks and voxels
        self._allocate(1 << int(np.ceil(np.log2(max(capacity // _CELLS, 16)))))

    def __len__(self) -> int:
        """Return the number of voxels seen so far."""
        return int(self._used[1])

    @property
    def cells(self) -> int:
        """Voxels of the blocks in use: what takes memory."""
        return int(self._used[0]) * _CELLS

    def _allocate(self, blocks: int) -> None:
        """Make room for blocks, a power of two; their table stays half empty."""
        self._counts: Counts = _aligned((blocks, 2, _CELLS), np.uint32)
        self._states: Rows = _aligned((blocks, COLUMNS + 1 if self._least else 1, _CELLS), np.uint16)
        self._marked: Flags = np.zeros(blocks, dtype=np.bool_)
        self._index = empty_table(2 * blocks)

    @property
    def _blocks(self) -> int:
        return len(self._marked)

    def _grow(self, blocks: int) -> None:
        counts, states, index = self._counts, self._states, self._index
        used = int(self._used[0])
        self._allocate(1 << int(np.ceil(np.log2(blocks))))
        self._counts[:used], self._states[:used] = counts[:used], states[:used]
        enter_keys(_in_order(index, used), self._index)

    def touch(self, points: Floats, window: int) -> None:
        """Count a window in which something returned from the voxels of points (N, 3) [m, world].

        Beams that are not traced are counted here too. ``window`` is its number, 1 or more; windows come
        in order.
        """
        self._require_time(timed=True)
        units = _in_voxels("starts", points, self.origin, self.voxel)
        done = 0
        while True:
            done = _touch(
                units, done, self._blocks, self._index, self._used, self._states, window, self._least
            )
            if done == len(units):
                return
            self._grow(2 * self._blocks)

    def add(self, starts: Floats, ends: Floats, returned: Flags | None = None, window: int = 0) -> None:
        """Walk beams.

        Every voxel before the last counts a pass, the last one a hit.

        Parameters
        ----------
        starts, ends : (N, 3) float64
            World coordinates [m] of the sensor and of the return.
        returned : (N,) bool, optional
            False where the beam came back with nothing up to ``ends``: the
            last voxel counts as passed too. Default: every beam returned.
        window : int
            Number of the time window, 1 or more, for an accumulator that keeps time.
        """
        self._require_time(window > 0)
        first_cell, last_cell = _beams(starts, ends, self.origin, self.voxel)
        flags = np.ones(len(starts), dtype=np.bool_) if returned is None else returned
        longest = int(np.abs(last_cell - first_cell).sum(axis=1).max(initial=0.0)) + 7
        ray = 0
        while ray < len(starts):
            ray = _walk(
                first_cell, last_cell, flags, ray, self._blocks, self._index, self._used,
                self._counts, self._states, self._marked, window, self._least, longest,
            )  # fmt: skip
            if self._used[0] + longest > self._blocks:
                self._grow(self._blocks + max(self._blocks, longest))

    def _require_time(self, timed: bool) -> None:
        if timed and not self._least:
            raise InputError("this accumulator keeps no time; give it least_beams")
        if self._least and not timed:
            raise InputError("this accumulator keeps time; give the window of the beams, 1 or more")

    def pending(self, window: int, shift: int) -> VisibilityAccumulator:
        """Return an accumulator that goes on from here and holds only beams of incomplete observations.

        ``window`` is the number of the next window; from there on windows are numbered ``shift`` less.
        """
        keys, cells = self._collected()
        kept, rows = pending_rows(_rows_of(self._states, cells), self._least, window, shift)
        blocks = len(np.unique(keys[kept] & ~_INSIDE))
        fresh = VisibilityAccumulator(
            self.origin, self.voxel, max(self._blocks, blocks) * _CELLS, self._least
        )
        _put(keys[kept], rows, fresh._index, fresh._used, fresh._states)
        return fresh

    def grid(self) -> VisibilityGrid:
        """Return what was counted so far."""
        return self._grid(*self._ordered())

    def looks(self) -> VoxelObservations:
        """Return the looks at every voxel, in the order of :meth:`grid`."""
        return looks_of(_rows_of(self._states, self._ordered()[1]), self._least)

    def grid_and_looks(self) -> tuple[VisibilityGrid, VoxelObservations]:
        """Return :meth:`grid` and :meth:`looks`, the order of the voxels found once."""
        keys, cells = self._ordered()
        return self._grid(keys, cells), looks_of(_rows_of(self._states, cells), self._least)

    def _grid(self, keys: Ints, cells: Ints) -> VisibilityGrid:
        block, place = cells // _CELLS, cells % _CELLS
        hits, passes = (self._counts[block, row, place] for row in range(2))
        return VisibilityGrid(self.origin, self.voxel, keys, hits, passes)

    def _collected(self) -> Ints:
        return _collect(self._index, self._used, self._counts, self._states, self._least > 0)

    def _ordered(self) -> Ints:
        """Return keys and cells (2, N) of the voxels seen so far, by key."""
        found = self._collected()
        return np.asarray(found[:, stable_order(found[0])])
