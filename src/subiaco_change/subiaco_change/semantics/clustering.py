"""Euclidean clusters as connected voxels or cells: linear, deterministic, fast."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from subiaco_geo.clouds import voxel_indices, voxel_keys
from subiaco_geo.frames import Floats, Ints


def voxel_clusters(xyz: Floats, size: float) -> Ints:
    """Label points (N,) by 26-connected occupied voxels of an edge [m].

    Points closer than ``size`` always share a cluster; points farther apart
    than ``2 * sqrt(3) * size`` never touch directly. Labels count from 0.
    """
    if len(xyz) == 0:
        return np.zeros(0, dtype=np.int64)
    keys, inverse = np.unique(voxel_keys(voxel_indices(xyz, size)), return_inverse=True)
    return connect(len(keys), voxel_neighbours(keys))[inverse]


def voxel_neighbours(keys: Ints) -> Ints:
    """Return pairs (E, 2) of positions in the sorted voxel keys (M,) that touch (26 neighbours)."""
    pairs = []
    here = np.arange(len(keys))
    for dx, dy, dz in _half_neighbourhood():
        wanted = keys + ((dx << 42) + (dy << 21) + dz)
        slot = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        hit = keys[slot] == wanted
        pairs.append(np.stack([here[hit], slot[hit]], axis=1))
    return np.concatenate(pairs)


def _half_neighbourhood() -> list[tuple[int, int, int]]:
    cube = [(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)]
    return [offset for offset in cube if offset > (0, 0, 0)]


def connect(count: int, pairs: Ints) -> Ints:
    """Label ``count`` nodes (count,) by the connected components of pairs (E, 2)."""
    ones = np.ones(len(pairs), dtype=np.int8)
    graph = coo_array((ones, (pairs[:, 0], pairs[:, 1])), shape=(count, count)).tocsr()
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)


def cell_clusters(xy: Floats, cell: float) -> Ints:
    """Label points (N,) by 8-connected occupied cells of an edge [m] seen from above."""
    flat = np.concatenate([xy, np.zeros((len(xy), 1))], axis=1)
    return voxel_clusters(flat, cell)


def group_indices(labels: Ints) -> list[NDArray[np.int64]]:
    """Return the point indices of every label 0..max; labels below 0 are left out."""
    order = np.argsort(labels, kind="stable")
    bounds = np.searchsorted(labels[order], np.arange(labels.max(initial=-1) + 2))
    return [order[a:b] for a, b in pairwise(bounds.tolist())]


def group_reduce(labels: Ints, values: NDArray[np.generic], size: int, how: str = "median") -> Floats:
    """Reduce values (N,) by label 0..size-1: median, mean, minimum or maximum; NaN where empty."""
    if len(labels) == 0:
        return np.full(size, np.nan)
    index = np.arange(size)
    function = getattr(ndimage, how)
    counts = np.bincount(labels, minlength=size)
    reduced = np.asarray(function(values, labels, index), dtype=np.float64)
    return np.where(counts > 0, reduced, np.nan)
