"""Observation times of voxels: time windows in which a voxel returned a beam or was crossed by one.

A window in which any beam returned from a voxel is a *hit window*; one in which nothing returned and
enough beams have gone through since the last look is a *through window*. Both are *looks*. Far from the
sensor few beams go through a voxel in one window, so beams add up over windows, until a return or a pause
of more than :data:`PENDING` windows discards them.
Consecutive hit windows, with no look through the voxel between them, make one *run*: a parked car has one,
a passing vehicle has one, a queue that crawls by a few, a hedge many.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from subiaco_geo.frames import Ints

COLUMNS = 7  # of the running state of a voxel, see below
WINDOWS = 1 << 15  # so many windows the running state can tell apart
PENDING = 10  # windows after which beams that were too few for a look are forgotten

_WINDOW, _STATE, _HITS, _THROUGH, _RUNS, _FIRST, _LAST = range(COLUMNS)
_BEAMS = 0xFF  # of the state: beams that went through since the last look, as far as they count
_HIT, _AFTER_HIT, _BEGAN_HIT = 0x100, 0x200, 0x400  # this window; the look before it; the first look

Rows = NDArray[np.uint16]
Counts = NDArray[np.uint16]


@numba.njit(cache=True, inline="always")
def _closed(state, least, gap):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Return the state of a voxel at the beginning of a window, from that at the end of the last one.

    The last one was ``gap`` windows before. Beams that were too few for a look count on for a while.
    """
    hit, looked = (state & _HIT) > 0, (state & _BEAMS) >= least
    after = _AFTER_HIT if hit else 0 if looked else state & _AFTER_HIT
    return (state & _BEGAN_HIT) | after | (0 if hit | looked | (gap > PENDING) else state & _BEAMS)


@numba.njit(cache=True)
def count_passing(states, window, least):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Count the beams that went through the voxels of a block.

    ``states`` (COLUMNS + 1, N) hold the running states, and in the last row the beams of the batch.
    Without a branch and in 16 bits, so that the processor takes many voxels at a time.
    """
    now, enough = np.uint16(window), np.uint16(least)
    for i in range(states.shape[1]):
        beams, last, old = states[COLUMNS, i], states[_WINDOW, i], states[_STATE, i]
        state = np.uint16(old if last == now else _closed(old, enough, np.uint16(now - last)))
        counted = np.uint16(state & _BEAMS)
        room = np.uint16(enough - counted if counted < enough else 0)
        more = np.uint16(min(beams, room))
        complete = (more > 0) & (more == room) & ((state & _HIT) == 0)
        states[_THROUGH, i] += np.uint16(complete)
        states[_STATE, i] = np.uint16(state + more) if beams else old
        states[_WINDOW, i] = now if beams else last
        states[COLUMNS, i] = 0


@numba.njit(cache=True, inline="always")
def count_return(states, place, window, least):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Count a return from one of the voxels (N,) of a block; ``states`` (COLUMNS, N) hold their states."""
    state = np.int64(states[_STATE, place])
    if states[_WINDOW, place] == window:
        if state & _HIT:
            return
        if (state & _BEAMS) >= least:
            states[_THROUGH, place] -= 1
    else:
        state = _closed(state, least, window - states[_WINDOW, place])
        states[_WINDOW, place] = window
    if states[_HITS, place] == 0:
        states[_FIRST, place] = window
        if states[_THROUGH, place] == 0:
            state |= _BEGAN_HIT
    states[_LAST, place] = window
    states[_HITS, place] += 1
    if not state & _AFTER_HIT:
        states[_RUNS, place] += 1
    states[_STATE, place] = state | _HIT


@dataclass(frozen=True)
class VoxelObservations:
    """Observations of every voxel of a grid.

    Parameters
    ----------
    hits, through : (M,) uint16
        Windows in which something returned, and in which nothing did although beams went through.
    runs : (M,) uint16
        Of hit windows without a look through the voxel between them.
    first, last : (M,) uint32
        Number of the first and the last hit window, 1 or more; 0 where nothing returned.
    edges : (M,) uint8
        1: the first look was a hit; 2: the last one was.
    """

    hits: Counts
    through: Counts
    runs: Counts
    first: NDArray[np.uint32]
    last: NDArray[np.uint32]
    edges: NDArray[np.uint8]

    def columns(self) -> list[NDArray[Any]]:
        """Return the fields in order."""
        return [getattr(self, field.name) for field in fields(self)]

    def select(self, index: Any) -> VoxelObservations:
        """Return the looks at some of the voxels: a mask, indices or a slice."""
        return VoxelObservations(*(column[index] for column in self.columns()))

    def later(self, windows: int) -> VoxelObservations:
        """Return them with every window numbered so many later."""
        shift = np.uint32(windows)
        first, last = (np.where(c > 0, c + shift, 0).astype(np.uint32) for c in (self.first, self.last))
        return VoxelObservations(self.hits, self.through, self.runs, first, last, self.edges)


def looks_of(rows: Rows, least: int) -> VoxelObservations:
    """Read the running states (M, COLUMNS) of voxels."""
    state = rows[:, _STATE]
    hit, through = (state & _HIT) > 0, (state & _BEAMS) >= least
    ends = hit | (~through & ((state & _AFTER_HIT) > 0))
    edges = (((state & _BEGAN_HIT) > 0) + 2 * ends.astype(np.uint8)).astype(np.uint8)
    first, last = (rows[:, column].astype(np.uint32) for column in (_FIRST, _LAST))
    return VoxelObservations(
        rows[:, _HITS].copy(), rows[:, _THROUGH].copy(), rows[:, _RUNS].copy(), first, last, edges
    )


def pending_rows(rows: Rows, least: int, window: int, shift: int) -> tuple[Ints, Rows]:
    """Return which running states (M, COLUMNS) hold beams of a look that is not complete, and new states.

    The new states hold nothing but those beams. ``window`` is the next window; windows are numbered ``shift``
    less from there on.
    """
    state = rows[:, _STATE]
    beams = state & _BEAMS
    held = (state & _HIT == 0) & (beams > 0) & (beams < least)
    kept = np.flatnonzero(held & (window - rows[:, _WINDOW].astype(np.int64) <= PENDING))
    fresh = np.zeros((len(kept), rows.shape[1]), dtype=rows.dtype)
    fresh[:, _STATE] = beams[kept]
    fresh[:, _WINDOW] = rows[kept, _WINDOW].astype(np.int64) - shift
    return kept, fresh


def joined_looks(starts: Ints, looks: VoxelObservations) -> VoxelObservations:
    """Join the looks of the same voxels at different times.

    Parameters
    ----------
    starts : (M,) int64
        Where the rows of each voxel begin; they go on to the next start.
    looks : VoxelObservations
        Rows of one voxel lie side by side, in the order of time.
    """
    ends = np.append(starts[1:], len(looks.hits)).astype(np.int64)
    return VoxelObservations(*_join(starts, ends, *looks.columns()))


@numba.njit(cache=True)
def _join(starts, ends, hits, through, runs, first, last, edges):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    count = len(starts)
    out = np.zeros((3, count), dtype=np.uint16)
    times = np.zeros((2, count), dtype=np.uint32)
    sides = np.zeros(count, dtype=np.uint8)
    for k in range(count):
        total, looked = np.zeros(3, dtype=np.int64), False
        for i in range(starts[k], ends[k]):
            if hits[i] == 0 and through[i] == 0:
                continue
            total += np.array([hits[i], through[i], runs[i]], dtype=np.int64)
            if not looked:
                sides[k] = edges[i]
            else:
                if sides[k] & 2 and edges[i] & 1:
                    total[2] -= 1
                sides[k] = (sides[k] & 1) | (edges[i] & 2)
            looked = True
            if hits[i]:
                times[0, k] = first[i] if times[0, k] == 0 else min(times[0, k], first[i])
                times[1, k] = max(times[1, k], last[i])
        for column in range(3):
            out[column, k] = min(total[column], 65535)
    return out[0], out[1], out[2], times[0], times[1], sides
