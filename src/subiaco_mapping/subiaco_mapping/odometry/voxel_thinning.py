"""Thinning of a scan: the first point of every voxel."""

from __future__ import annotations

import numba
import numpy as np

from subiaco_geo.frames import Floats

_BITS = 21  # of a voxel index along each axis: +-2**20 voxels around the sensor
_SPREAD = 0x9E3779B97F4A7C15  # odd, near 2**64 over the golden ratio: neighbours fall far apart (Knuth 1998)


def first_in_voxels(xyz: Floats, edge: float) -> Floats:
    """Return the first point of every voxel of an edge [m] of points (N, 3), in an order that tells nothing.

    These are the points that kiss-icp's thinning keeps, without copying every point to it and back. In the
    order of the scan, thinning again would prefer the rings and columns that come first.
    """
    points = np.ascontiguousarray(xyz, dtype=np.float64)
    return _first(points, edge)


@numba.njit(cache=True, error_model="numpy")
def _first(points: Floats, edge: float) -> Floats:
    """Fill an open-addressed table of voxels; return the points (K, 3) that came first, in its order."""
    size = 16
    while size < 2 * len(points):
        size *= 2
    table = np.full(size, -1, dtype=np.int64)
    first = np.empty(size, dtype=np.int32)
    mask, last, kept = np.uint64(size - 1), np.int64(-1), 0
    reach, own = np.int64(1 << (_BITS - 1)), np.int64((1 << _BITS) - 1)
    for i in range(len(points)):
        key = np.int64(0)
        for axis in range(3):
            key = (key << _BITS) | ((np.int64(np.floor(points[i, axis] / edge)) + reach) & own)
        if key == last:  # neighbours in a scan often share a voxel
            continue
        last = key
        slot = ((np.uint64(key) * np.uint64(_SPREAD)) >> np.uint64(32)) & mask
        while table[slot] >= 0 and table[slot] != key:
            slot = (slot + np.uint64(1)) & mask
        if table[slot] < 0:
            table[slot] = key
            first[slot] = i
            kept += 1
    found, n = np.empty((kept, 3)), 0
    for place in range(size):
        if table[place] >= 0:
            for axis in range(3):
                found[n, axis] = points[first[place], axis]
            n += 1
    return found
