"""Superpoints: a minimal partition of the k-NN graph (method, part C2, Decision 5).

The energy is ``sum_i |f_i - g_s(i)|_1 + eta * sum_cut w_ij`` with
``w_ij = exp(-|f_i - f_j|^2 / sigma_f^2)``. It is lowered by merging regions
while eta grows to its final value. Merging the smaller region into the larger
adds at most ``n_small * |g_a - g_b|_1`` to the data term and saves ``eta`` times
the shared boundary, so that every accepted merge lowers the energy.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from subiaco_geo.clouds import stable_order
from subiaco_geo.config import StrictModel
from subiaco_geo.frames import Floats, Ints


class SuperpointConfig(StrictModel):
    """Potts energy and its minimisation."""

    strength: float = Field(
        0.8,
        gt=0,
        description="Weight eta of the boundary length in the energy of the partition (paper); raise it "
        "for larger superpoints",
    )
    sigma: float = Field(
        0.23,
        gt=0,
        description="Feature distance sigma_f that scales the boundary weights [1]; fixed so that tiles "
        "agree with the whole map",
    )
    rounds: int = Field(
        6, ge=1, le=30, description="Number of merging rounds, in which eta doubles up to its final value"
    )
    height_scale: float = Field(
        4.0, gt=0, description="Height above ground that weighs as much as a feature value of 1 [m]"
    )
    neighbours: int = Field(
        8, ge=2, description="Number of nearest neighbours that become edges of the partition graph"
    )


@dataclass(frozen=True)
class Partition:
    """Superpoint (N,) of every point, without gaps, the energy reached, and those of trivial partitions."""

    labels: Ints
    energy: float
    energy_single: float
    energy_one: float


@dataclass(frozen=True)
class _Regions:
    """Region (N,) of points, model (R, F) of regions, pairs (E, 2) that touch, their boundary (E,)."""

    labels: Ints
    models: Floats
    pairs: Ints
    boundary: Floats


def partition(features: Floats, neighbours: NDArray[np.int32], config: SuperpointConfig) -> Partition:
    """Minimise the energy over a k-NN graph.

    Parameters
    ----------
    features : (N, F) float64
        Scaled features.
    neighbours : (N, k) int
        Indices; the first column is the point itself.
    config : SuperpointConfig
    """
    edges = graph_edges(neighbours[:, : config.neighbours + 1])
    weights = edge_weights(features, edges, config.sigma)
    regions = _Regions(np.arange(len(features)), features, edges, weights)
    for step in range(config.rounds):
        eta = config.strength * 2.0 ** (step + 1 - config.rounds)
        regions = _merge_round(features, regions, eta)
    labels, one = regions.labels, np.zeros(len(features), dtype=np.int64)
    merged = _energy(features, labels, regions.models, edges, weights * config.strength)
    whole = float(np.abs(features - region_medians(features, one)).sum())
    single = float(config.strength * weights.sum())
    energies = [merged, whole, single]
    best = [labels, one, np.arange(len(features))][int(np.argmin(energies))]
    return Partition(best, min(energies), single, whole)


@numba.njit(cache=True)
def graph_edges(neighbours: NDArray[np.int32]) -> Ints:
    """Return the undirected edges (E, 2) of neighbour lists (N, k), each once, the lower end first."""
    count, k = neighbours.shape
    edges = np.empty((count * k, 2), dtype=np.int64)
    used = 0
    for i in range(count):
        for column in range(k):
            j = neighbours[i, column]
            named = j == i
            if j < i:  # the lower of its two ends may name it too
                for back in range(k):
                    named = named or neighbours[j, back] == i
            if not named:
                edges[used, 0], edges[used, 1] = min(i, j), max(i, j)
                used += 1
    return edges[:used].copy()


def edge_weights(features: Floats, edges: Ints, sigma: float) -> Floats:
    """Boundary weights (E,): exp(-d^2 / sigma_f^2) of the feature distances."""
    return np.asarray(np.exp(-_squared_gaps(features, edges) / sigma**2))


@numba.njit(cache=True)
def _squared_gaps(features: Floats, edges: Ints) -> Floats:
    """Squared distance (E,) of the features of both ends."""
    squared = np.zeros(len(edges))
    for e in range(len(edges)):
        for f in range(features.shape[1]):
            squared[e] += (features[edges[e, 0], f] - features[edges[e, 1], f]) ** 2
    return squared


def potts_energy(features: Floats, labels: Ints, edges: Ints, weights: Floats, strength: float) -> float:
    """Energy of a partition (N,) with the median feature of each region as its model."""
    compact = np.unique(labels, return_inverse=True)[1]
    return _energy(features, compact, region_medians(features, compact), edges, weights * strength)


def _energy(features: Floats, labels: Ints, models: Floats, edges: Ints, prices: Floats) -> float:
    """Sum the data term of regions 0..R-1 with models (R, F) and the prices (E,) of the edges cut."""
    cut = labels[edges[:, 0]] != labels[edges[:, 1]]
    return float(np.abs(features - models[labels]).sum() + prices[cut].sum())


def region_medians(features: Floats, labels: Ints) -> Floats:
    """Lower median features (R, F) of regions 0..R-1, exact for the L1 term."""
    return _medians(features, labels, np.bincount(labels))


@numba.njit(cache=True)
def _medians(features: Floats, labels: Ints, counts: Ints) -> Floats:
    """Gather the points region by region, and select within each."""
    starts = np.zeros(len(counts) + 1, dtype=np.int64)
    starts[1:] = np.cumsum(counts)
    filled = starts.copy()
    order = np.empty(len(labels), dtype=np.int64)
    for i in range(len(labels)):
        order[filled[labels[i]]] = i
        filled[labels[i]] += 1
    medians = np.empty((len(counts), features.shape[1]))
    values = np.empty(counts.max())
    for region in range(len(counts)):
        first, size = starts[region], counts[region]
        middle = (size - 1) // 2
        for f in range(features.shape[1]):
            if size > 32:
                for k in range(size):
                    values[k] = features[order[first + k], f]
                medians[region, f] = np.partition(values[:size], middle)[middle]
                continue
            for k in range(size):  # few: sorted as they come
                value, slot = features[order[first + k], f], k
                while slot > 0 and values[slot - 1] > value:
                    values[slot] = values[slot - 1]
                    slot -= 1
                values[slot] = value
            medians[region, f] = values[middle]
    return medians


def _merge_round(features: Floats, regions: _Regions, eta: float) -> _Regions:
    """Merge regions while the energy at this eta falls; boundaries are summed beforehand."""
    pairs, boundary, models = regions.pairs, regions.boundary, regions.models
    if len(pairs) == 0:
        return regions
    sizes = np.bincount(regions.labels)
    cost = _merge_costs(models, pairs, sizes, boundary)
    cheap = np.flatnonzero(cost < 2 * eta)
    cheap = cheap[stable_order(cost[cheap])]
    roots = merge_regions(pairs[cheap], boundary[cheap], models, sizes.astype(np.int64), eta)
    number = np.cumsum(roots == np.arange(len(roots))) - 1
    renamed = number[roots]
    labels = renamed[regions.labels]
    pairs, boundary = _sum_boundaries(renamed[pairs], boundary)
    return _Regions(labels, region_medians(features, labels), pairs, boundary)


@numba.njit(cache=True)
def _merge_costs(models: Floats, pairs: Ints, sizes: Ints, boundary: Floats) -> Floats:
    """L1 distance of the models of every pair (E, 2), times the size of the smaller, a boundary."""
    costs = np.empty(len(pairs))
    for e in range(len(pairs)):
        a, b = pairs[e, 0], pairs[e, 1]
        gap = 0.0
        for f in range(models.shape[1]):
            gap += abs(models[a, f] - models[b, f])
        costs[e] = gap * min(sizes[a], sizes[b]) / max(boundary[e], 1e-12)
    return costs


def _sum_boundaries(pairs: Ints, boundary: Floats) -> tuple[Ints, Floats]:
    """Add up the boundaries (E,) of pairs (E, 2) that are the same, and drop those within a region."""
    return _sum_sorted(pairs, boundary, int(pairs.max(initial=0)) + 1)


@numba.njit(cache=True)
def _sum_sorted(pairs: Ints, boundary: Floats, count: int) -> tuple[Ints, Floats]:
    """Sort pairs by their lower region, then sum those with the same higher one."""
    starts = np.zeros(count + 1, dtype=np.int64)
    for e in range(len(pairs)):
        if pairs[e, 0] != pairs[e, 1]:
            starts[min(pairs[e, 0], pairs[e, 1]) + 1] += 1
    starts = np.cumsum(starts)
    filled = starts.copy()
    order = np.empty(starts[-1], dtype=np.int64)
    for e in range(len(pairs)):
        if pairs[e, 0] != pairs[e, 1]:
            low = min(pairs[e, 0], pairs[e, 1])
            order[filled[low]] = e
            filled[low] += 1
    slot = np.full(count, -1, dtype=np.int64)
    summed = np.empty((len(order), 2), dtype=np.int64)
    total = np.zeros(len(order))
    used = 0
    for low in range(count):
        first = used
        for position in range(starts[low], starts[low + 1]):
            e = order[position]
            high = max(pairs[e, 0], pairs[e, 1])
            if slot[high] < first:
                slot[high] = used
                summed[used, 0], summed[used, 1] = low, high
                used += 1
            total[slot[high]] += boundary[e]
    return summed[:used].copy(), total[:used].copy()


@numba.njit(cache=True)
def merge_regions(pairs: Ints, boundary: Floats, models: Floats, sizes: Ints, eta: float) -> Ints:
    """Union-find over region pairs in the given order; returns the root (R,) of every region."""
    parent = np.arange(len(sizes))
    for e in range(len(pairs)):
        a, b = pairs[e, 0], pairs[e, 1]
        while parent[a] != a:
            parent[a] = parent[parent[a]]
            a = parent[a]
        while parent[b] != b:
            parent[b] = parent[parent[b]]
            b = parent[b]
        if a == b:
            continue
        if sizes[a] < sizes[b] or (sizes[a] == sizes[b] and b < a):
            a, b = b, a
        gap = 0.0
        for f in range(models.shape[1]):
            gap += abs(models[a, f] - models[b, f])
        if sizes[b] * gap <= eta * boundary[e]:
            parent[b] = a
            sizes[a] += sizes[b]
    for r in range(len(parent)):
        a = r
        while parent[a] != a:
            a = parent[a]
        parent[r] = a
    return parent
