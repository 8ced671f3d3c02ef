"""Ray casting through a sparse voxel grid: voxels that returned a beam, and voxels it crossed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from subiaco_geo.clouds import stable_order
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

_EMPTY = -1
_LIMIT = 1 << 20  # voxel indices that fit a key, see subiaco_geo.clouds.voxel_keys
_MAX_LOAD = 0.6
_CACHE_LINE = 64  # [bytes]
_CELL = np.dtype([("key", np.int64), ("hits", np.uint32), ("passes", np.uint32)])
_TIMED_CELL = np.dtype([*_CELL.descr, ("looks", np.uint16, (8,))])

Counts = NDArray[np.uint32]
Flags = NDArray[np.bool_]


@numba.njit(cache=True, inline="always")
def _slot(keys: Ints, key: int) -> int:
    """Return the slot of a key in an open-addressing table, or the empty slot for it."""
    mask = np.uint64(len(keys) - 1)
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    slot = (mixed ^ (mixed >> np.uint64(32))) & mask
    while keys[slot] != key and keys[slot] != _EMPTY:
        slot = (slot + np.uint64(1)) & mask
    return slot  # type: ignore[return-value]


@numba.njit(cache=True)
def _reinsert(
    old_keys: Ints, old_hits: Counts, old_passes: Counts, keys: Ints, hits: Counts, passes: Counts
) -> None:
    """Copy every entry of one table into a larger, empty one."""
    for i in range(len(old_keys)):
        if old_keys[i] != _EMPTY:
            slot = _slot(keys, old_keys[i])
            keys[slot] = old_keys[i]
            hits[slot] = old_hits[i]
            passes[slot] = old_passes[i]


@numba.njit(cache=True)
def _move_looks(old_keys: Ints, old_looks: Rows, keys: Ints, looks: Rows) -> None:
    """Copy the looks of every entry of one table to where a larger one, filled already, has it."""
    for i in range(len(old_keys)):
        if old_keys[i] != _EMPTY:
            looks[_slot(keys, old_keys[i])] = old_looks[i]


@numba.njit(cache=True)
def _touch(
    points: Floats, first: int, room: int, keys: Ints, looks: Rows, window: int, least: int
) -> tuple[int, int]:
    """Count a hit window at the voxels of points (voxel units) until done or the table is full."""
    added = 0
    for i in range(first, len(points)):
        if added == room:
            return i, added
        key = np.int64(0)
        for axis in range(3):
            key = (key << 21) | (np.int64(np.floor(points[i, axis])) + _LIMIT)
        slot = _slot(keys, key)
        if keys[slot] == _EMPTY:
            keys[slot] = key
            added += 1
        count_return(looks, slot, window, least)
    return len(points), added


@numba.njit(cache=True)
def _walk(  # noqa: C901, PLR0912, PLR0915
    starts: Floats, ends: Floats, returned: Flags, first: int, room: int,
    keys: Ints, hits: Counts, passes: Counts, looks: Rows, window: int, least: int,
) -> tuple[int, int]:  # fmt: skip
    """Walk beams (voxel units) from index ``first`` until done or the table is full.

    VoxelObservations are counted where ``window`` is not 0 (:mod:`subiaco_geo.observation_times`).

    Amanatides and Woo (1987), with the number of steps fixed beforehand on
    every axis, so that rounding can never walk past the end voxel. Returns
    the next beam and the number of new entries. The keys on a beam come first, then their slots, then
    the counts: in one loop, every wrong guess of the processor about a step would wait for the memory.
    """
    added = 0
    path = np.empty(room + 1, np.int64)
    cell, left, step = np.empty(3, np.int64), np.empty(3, np.int64), np.empty(3, np.int64)
    t_next, t_delta = np.empty(3), np.empty(3)
    for ray in range(first, len(starts)):
        steps = 0
        for axis in range(3):
            cell[axis] = np.int64(np.floor(starts[ray, axis]))
            left[axis] = abs(np.int64(np.floor(ends[ray, axis])) - cell[axis])
            direction = ends[ray, axis] - starts[ray, axis]
            step[axis] = 1 if direction > 0 else -1
            t_next[axis] = np.inf
            t_delta[axis] = 0.0
            if left[axis] > 0:
                edge = cell[axis] + (1 if direction > 0 else 0)
                t_next[axis] = (edge - starts[ray, axis]) / direction
                t_delta[axis] = abs(1.0 / direction)
            steps += left[axis]
        if added + steps + 1 > room:
            return ray, added
        key = ((cell[0] + _LIMIT) << 42) | ((cell[1] + _LIMIT) << 21) | (cell[2] + _LIMIT)
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
        for i in range(steps + 1):
            slot = _slot(keys, path[i])
            if keys[slot] == _EMPTY:
                keys[slot] = path[i]
                added += 1
            path[i] = slot
        crossed = steps if returned[ray] else steps + 1
        for i in range(crossed):
            slot = np.uint64(path[i])
            passes[slot] += 1
            if window:
                count_passing(looks, slot, window, least)
        if crossed == steps:
            slot = np.uint64(path[steps])
            hits[slot] += 1
            if window:
                count_return(looks, slot, window, least)
    return len(starts), added


def _aligned(size: int, kind: np.dtype[Any]) -> NDArray[Any]:
    """Return zeroed rows that begin on a border of the cache."""
    raw = np.zeros(size * kind.itemsize + _CACHE_LINE, dtype=np.uint8)
    first = -raw.ctypes.data % _CACHE_LINE
    return np.asarray(raw[first : first + size * kind.itemsize].view(kind))


def _beams(starts: Floats, ends: Floats, origin: Floats, voxel: float) -> tuple[Floats, Floats]:
    """Check beams and put them in voxel units."""
    if starts.shape != ends.shape or starts.ndim != 2 or starts.shape[1] != 3:
        raise InputError(f"beam starts {starts.shape} and ends {ends.shape} must both be (N, 3)")
    return _in_voxels("starts", starts, origin, voxel), _in_voxels("ends", ends, origin, voxel)


def _in_voxels(name: str, points: Floats, origin: Floats, voxel: float) -> Floats:
    """Put points (N, 3) [m, world] in voxel units; ``name`` them where they cannot be counted."""
    units = np.ascontiguousarray((points - origin) / voxel)
    if not np.abs(units).max(initial=0.0) < _LIMIT - 1:  # NaN neither
        if not np.isfinite(units).all():
            raise InputError(f"beam {name} hold NaN or infinite coordinates; drop them first")
        raise InputError(
            f"beam {name} lie more than {_LIMIT} voxels from the grid origin; use a nearer origin"
        )
    return units


class VisibilityAccumulator:
    """Counts hits and passes of many batches of beams in one growing hash table.

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
        self._used = 0
        self._allocate(1 << int(np.ceil(np.log2(max(capacity, 1024)))))

    def __len__(self) -> int:
        """Return the number of voxels seen so far."""
        return self._used

    def _allocate(self, size: int) -> None:
        """Make an empty table; all of a voxel lies side by side, so that a step reads one place."""
        table = _aligned(size, _CELL if self._least == 0 else _TIMED_CELL)
        self._keys: Ints = table["key"]
        self._hits: Counts = table["hits"]
        self._passes: Counts = table["passes"]
        self._keys.fill(_EMPTY)
        looks = table["looks"] if self._least else np.zeros((1, 2 * COLUMNS), dtype=np.uint16)[:, ::2]
        self._looks: Rows = looks[:, :COLUMNS]

    def _grow(self, size: int) -> None:
        old, looks = (self._keys, self._hits, self._passes), self._looks
        self._allocate(size)
        _reinsert(*old, self._keys, self._hits, self._passes)
        if self._least:
            _move_looks(old[0], looks, self._keys, self._looks)

    def touch(self, points: Floats, window: int) -> None:
        """Count a window in which something returned from the voxels of points (N, 3) [m, world].

        Beams that are not traced are counted here too. ``window`` is its number, 1 or more; windows come
        in order.
        """
        units = _in_voxels("starts", points, self.origin, self.voxel)
        done = 0
        while done < len(units):
            room = int(_MAX_LOAD * len(self._keys)) - self._used
            if room < 1:
                self._grow(2 * len(self._keys))
                continue
            done, added = _touch(units, done, room, self._keys, self._looks, window, self._least)
            self._used += added

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
        if window and not self._least:
            raise InputError("this accumulator keeps no time; give it least_beams")
        first_cell, last_cell = _beams(starts, ends, self.origin, self.voxel)
        flags = np.ones(len(starts), dtype=np.bool_) if returned is None else returned
        longest = int(np.abs(last_cell - first_cell).sum(axis=1).max(initial=0.0)) + 7
        ray = 0
        while ray < len(starts):
            room = int(_MAX_LOAD * len(self._keys)) - self._used
            if room < longest:
                self._grow(2 * len(self._keys))
                continue
            ray, added = _walk(
                first_cell, last_cell, flags, ray, room, self._keys, self._hits, self._passes,
                self._looks, window, self._least,
            )  # fmt: skip
            self._used += added

    def pending(self, window: int, shift: int) -> VisibilityAccumulator:
        """Return an accumulator that goes on from here and holds only beams of incomplete observations.

        ``window`` is the number of the next window; from there on windows are numbered ``shift`` less.
        """
        used = np.flatnonzero(self._keys != _EMPTY)
        kept, rows = pending_rows(self._looks[used], self._least, window, shift)
        keys, none = self._keys[used[kept]], np.zeros(len(kept), dtype=np.uint32)
        fresh = VisibilityAccumulator(
            self.origin, self.voxel, max(1 << 18, int(len(kept) / _MAX_LOAD) + 1), self._least
        )
        _reinsert(keys, none, none, fresh._keys, fresh._hits, fresh._passes)
        _move_looks(keys, rows, fresh._keys, fresh._looks)
        fresh._used = len(kept)
        return fresh

    def grid(self) -> VisibilityGrid:
        """Return what was counted so far."""
        order = self._order()
        return VisibilityGrid(
            self.origin, self.voxel, self._keys[order], self._hits[order], self._passes[order]
        )

    def looks(self) -> VoxelObservations:
        """Return the looks at every voxel, in the order of :meth:`grid`."""
        return looks_of(self._looks[self._order()], self._least)

    def _order(self) -> Ints:
        """Return the slots of the voxels seen so far, by key."""
        used = np.flatnonzero(self._keys != _EMPTY)
        return np.asarray(used[stable_order(self._keys[used])])


def accumulate_visibility(
    starts: Floats, ends: Floats, origin: Floats, voxel: float, returned: Flags | None = None
) -> VisibilityGrid:
    """Walk beams (N, 3) -> (N, 3) [m, world] once; see :class:`VisibilityAccumulator`."""
    accumulator = VisibilityAccumulator(origin, voxel)
    accumulator.add(starts, ends, returned)
    return accumulator.grid()


def merge_grids(grids: Sequence[VisibilityGrid]) -> VisibilityGrid:
    """Add the counts of grids that share origin and voxel."""
    if not grids:
        raise InputError("no visibility grids to merge")
    first = grids[0]
    for grid in grids[1:]:
        if grid.voxel != first.voxel or not np.array_equal(grid.origin, first.origin):
            raise InputError("visibility grids differ in origin or voxel; build them with the same ones")
    keys, slots = np.unique(np.concatenate([g.keys for g in grids]), return_inverse=True)
    hits, passes = np.zeros((2, len(keys)), dtype=np.uint32)
    np.add.at(hits, slots, np.concatenate([g.hits for g in grids]))
    np.add.at(passes, slots, np.concatenate([g.passes for g in grids]))
    return VisibilityGrid(first.origin, first.voxel, keys, hits, passes)
