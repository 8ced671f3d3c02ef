"""Connected components of voxels that touch at a face, an edge or a corner (26 neighbours)."""

from __future__ import annotations

import numba
import numpy as np

from subiaco_geo.frames import Ints


@numba.njit(cache=True)
def root_of(parent: Ints, node: int) -> int:
    """Return the root of a node in a forest (N,) of parents, and shorten the path to it."""
    while parent[node] != node:
        parent[node] = parent[parent[node]]
        node = parent[node]
    return node


@numba.njit(cache=True)
def connected_voxels(keys: Ints) -> Ints:
    """Label voxels by connected component.

    Parameters
    ----------
    keys : (N,) int64
        Packed voxel indices (:func:`subiaco_geo.clouds.voxel_keys`), sorted, each once.

    Returns
    -------
    (N,) int64
        Lowest row of the component of every voxel.
    """
    count = len(keys)
    parent = np.arange(count)
    for dx in range(2):
        for dy in range(-1, 2):
            step, j = (dx << 42) + (dy << 21), 0
            for i in range(count):
                low = keys[i] + step - 1
                while j < count and keys[j] < low:
                    j += 1
                other = j
                while other < count and keys[other] <= low + 2:
                    a, b = root_of(parent, i), root_of(parent, other)
                    if a < b:
                        parent[b] = a
                    else:
                        parent[a] = b
                    other += 1
    for i in range(count):
        parent[i] = root_of(parent, i)
    return parent
