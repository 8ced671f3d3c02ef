"""Hash table that finds the number of a voxel, or of a block of voxels, by its packed key.

The table is an array (S, 2) int64 with the key and the number of every slot; S is a power of two. A free slot
holds :data:`EMPTY`, which is no packed key. Callers keep slots free: a search for a missing key ends at one.
"""

from __future__ import annotations

import numba
import numpy as np

from subiaco_geo.frames import Ints

EMPTY = -1


def empty_table(size: int) -> Ints:
    """Return a table (size, 2) without keys; ``size`` is a power of two."""
    return np.full((size, 2), EMPTY, dtype=np.int64)


@numba.njit(cache=True)
def find_slot(index: Ints, key: int) -> int:
    """Return the slot of a key in a table (S, 2), or the free slot in which the key belongs."""
    mask = np.uint64(len(index) - 1)
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    slot = (mixed ^ (mixed >> np.uint64(32))) & mask
    while index[slot, 0] != key and index[slot, 0] != EMPTY:
        slot = (slot + np.uint64(1)) & mask
    return slot  # type: ignore[return-value]


@numba.njit(cache=True)
def enter_keys(keys: Ints, index: Ints) -> None:
    """Fill an empty table (S, 2) with keys (N,), each once, and their numbers 0 to N - 1."""
    for number in range(len(keys)):
        slot = find_slot(index, keys[number])
        index[slot, 0], index[slot, 1] = keys[number], number
