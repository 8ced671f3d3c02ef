"""Euclidean clusters as connected components of voxels or cells, in linear time."""

from __future__ import annotations

from itertools import pairwise

import numba
import numpy as np
from numpy.typing import NDArray

from subiaco_geo.clouds import stable_order, voxel_indices, voxel_keys
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.voxel_components import connected_voxels, root_of


def voxel_clusters(xyz: Floats, size: float) -> Ints:
    """Label points (N,) by 26-connected occupied voxels of an edge [m].

    Points closer than ``size`` always share a cluster; points farther apart
    than ``2 * sqrt(3) * size`` never touch directly. Labels count from 0.
    """
    if len(xyz) == 0:
        return np.zeros(0, dtype=np.int64)
    keys = voxel_keys(voxel_indices(xyz, size))
    order = np.argsort(keys)
    first = np.append(True, np.diff(keys[order]) > 0)
    roots = connected_voxels(keys[order[first]])
    number = np.cumsum(roots == np.arange(len(roots))) - 1
    labels = np.empty(len(keys), dtype=np.int64)
    labels[order] = number[roots[np.cumsum(first) - 1]]
    return labels


def connect(count: int, pairs: Ints) -> Ints:
    """Label ``count`` nodes (count,) by the connected components of pairs (E, 2)."""
    if count == 0:
        return np.zeros(0, dtype=np.int64)
    roots = _components(count, np.asarray(pairs, dtype=np.int64))
    return np.asarray((np.cumsum(roots == np.arange(count)) - 1)[roots])


@numba.njit(cache=True)
def _components(count: int, pairs: Ints) -> Ints:
    """Lowest node (count,) that each node is connected to by pairs (E, 2)."""
    parent = np.arange(count)
    for e in range(len(pairs)):
        a, b = root_of(parent, pairs[e, 0]), root_of(parent, pairs[e, 1])
        parent[max(a, b)] = min(a, b)
    for node in range(count):
        parent[node] = parent[parent[node]]
    return parent


def cell_clusters(xy: Floats, cell: float) -> Ints:
    """Label points (N,) by 8-connected occupied cells of an edge [m] seen from above."""
    flat = np.concatenate([xy, np.zeros((len(xy), 1))], axis=1)
    return voxel_clusters(flat, cell)


def group_indices(labels: Ints) -> list[NDArray[np.int64]]:
    """Return the point indices of every label 0..max; labels below 0 are left out."""
    order = stable_order(labels)
    bounds = np.searchsorted(labels[order], np.arange(labels.max(initial=-1) + 2))
    return [order[a:b] for a, b in pairwise(bounds.tolist())]


def group_reduce(labels: Ints, values: NDArray[np.generic], size: int, how: str = "median") -> Floats:
    """Reduce values (N,) by label 0..size-1: median, mean, minimum or maximum; NaN where empty."""
    if len(labels) == 0:
        return np.full(size, np.nan)
    counts = np.bincount(labels, minlength=size)
    if how == "median":
        return _medians(labels, values.astype(np.float64), counts)
    if how == "mean":
        with np.errstate(invalid="ignore"):
            return np.asarray(np.bincount(labels, values, minlength=size) / counts)
    return _extremes(labels, values.astype(np.float64), size, how == "maximum")


@numba.njit(cache=True)
def _extremes(labels: Ints, values: Floats, size: int, largest: bool) -> Floats:
    """Smallest or largest (R,) of the values (N,) of every label; NaN where empty."""
    extremes = np.full(size, np.nan)
    for i in range(len(labels)):
        value, old = values[i], extremes[labels[i]]
        if np.isnan(old) or (value > old if largest else value < old):
            extremes[labels[i]] = value
    return extremes


@numba.njit(cache=True)
def _medians(labels: Ints, values: Floats, counts: Ints) -> Floats:
    """Median (R,) of the values (N,) of every label, the mean of both middle ones; NaN where empty."""
    starts = np.zeros(len(counts) + 1, dtype=np.int64)
    starts[1:] = np.cumsum(counts)
    filled = starts.copy()
    gathered = np.empty(len(values))
    for i in range(len(labels)):
        gathered[filled[labels[i]]] = values[i]
        filled[labels[i]] += 1
    medians = np.full(len(counts), np.nan)
    for region in range(len(counts)):
        size = counts[region]
        if size > 0:
            own = np.sort(gathered[starts[region] : starts[region + 1]])
            medians[region] = (own[(size - 1) // 2] + own[size // 2]) / 2
    return medians


def voxel_means(xyz: Floats, edge: float) -> tuple[Floats, Ints]:
    """Mean (M, 3) of the points of every occupied voxel, and the voxel (N,) of every point."""
    _, cell = np.unique(voxel_keys(voxel_indices(xyz, edge)), return_inverse=True)
    count = np.bincount(cell)
    return np.stack([np.bincount(cell, xyz[:, i]) / count for i in range(3)], axis=1), cell
