"""Cost of matching two objects, and the number of voxels that they share (part D, Decisions 8 and 11)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.spatial import cKDTree

from subiaco_change.association.config import AssociationConfig
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.objects.measures import oriented_rectangle, rectangle_iou
from subiaco_change.objects.voxel_objects import ObjectInstance
from subiaco_geo.frames import Floats, Ints

#: Weights of centroid distance [1/m], 1 - IoU and histogram distance, paper.
_PAPER_COST = NUMBERS.costs.paper_weights
_PHI_REACH = NUMBERS.costs.intersection_reach
#: A scipy sparse array; scipy has no types.
Sparse = Any


def candidate_costs(
    before: Sequence[ObjectInstance],
    after: Sequence[ObjectInstance],
    groups_b: Sequence[tuple[int, ...]],
    groups_a: Sequence[tuple[int, ...]],
    config: AssociationConfig,
) -> tuple[Ints, Ints, Floats]:
    """Gated pairs of groups (E,), (E,) and their chi-square costs (E,)."""
    shapes_b = [_shape([before[i] for i in group]) for group in groups_b]
    shapes_a = [_shape([after[j] for j in group]) for group in groups_a]
    rows, columns, costs = [], [], []
    for i, j in _near_pairs(shapes_b, shapes_a, config):
        b, a = shapes_b[i], shapes_a[j]
        overlap = rectangle_iou(b.rectangle, a.rectangle)
        distance = float(np.linalg.norm(b.centroid - a.centroid))
        if distance > config.gate_distance and overlap < config.gate_overlap:
            continue
        rows.append(i)
        columns.append(j)
        costs.append(_cost(distance, overlap, b, a, config))
    return (
        np.array(rows, dtype=np.int64),
        np.array(columns, dtype=np.int64),
        np.array(costs, dtype=np.float64),
    )


def _histogram_distance(before: Floats, after: Floats, bins: int) -> float:
    """Chi-square distance, 0 to 1, of two height histograms over their common range."""
    if len(before) == 0 or len(after) == 0:
        return 1.0
    span = (min(before.min(), after.min()), max(before.max(), after.max()) + 1e-6)
    h, g = (np.histogram(v, bins, span)[0] / len(v) for v in (before, after))
    return float(0.5 * np.sum((h - g) ** 2 / np.maximum(h + g, 1e-12)))


def _cost(distance: float, overlap: float, b: _Shape, a: _Shape, config: AssociationConfig) -> float:
    """Price of calling two groups one object: a chi-square, or the paper's plain sum."""
    histogram = _histogram_distance(b.heights, a.heights, config.histogram_bins)
    if config.cost == "plain":
        weights = _PAPER_COST
        printed = weights[0] * distance + weights[1] * (1 - overlap) + weights[2] * histogram
        return printed + (config.kappa * _phi(b, a) if config.kappa > 0 else 0.0)
    spread = config.spread_distance + config.spread_relative * max(b.size, a.size)
    terms = (distance / spread, (1 - overlap) / config.spread_overlap, histogram / config.spread_histogram)
    return sum(t**2 for t in terms)


def _phi(b: _Shape, a: _Shape) -> float:
    """Return how far the median separation along the normal stays under the level of detection [m]."""
    distance, slot = cKDTree(a.xyz).query(b.xyz, distance_upper_bound=_PHI_REACH)
    shared = np.isfinite(distance)
    level = max(b.lod, a.lod)
    if not shared.any() or not np.isfinite(level):
        return 0.0
    step = a.xyz[slot[shared]] - b.xyz[shared]
    return max(0.0, level - float(np.median(np.abs(np.einsum("ij,ij->i", b.normal[shared], step)))))


@dataclass(frozen=True)
class _Shape:
    xyz: Floats
    normal: Floats
    lod: float
    centroid: Floats
    heights: Floats
    rectangle: object
    size: float
    reach: float


def _shape(objects: Sequence[ObjectInstance]) -> _Shape:
    xyz = np.concatenate([t.voxels.xyz for t in objects])
    heights = np.concatenate([t.voxels.height for t in objects])
    size = float(np.linalg.norm(np.ptp(xyz, axis=0)))
    normal = np.concatenate([t.voxels.normal for t in objects])
    lod = max(t.lod for t in objects)
    return _Shape(xyz, normal, lod, xyz.mean(axis=0), heights, oriented_rectangle(xyz[:, :2]), size, size / 2)


def _near_pairs(
    shapes_b: Sequence[_Shape], shapes_a: Sequence[_Shape], config: AssociationConfig
) -> list[tuple[int, int]]:
    """Pairs of groups whose circles come within the gate."""
    tree = cKDTree([s.centroid[:2] for s in shapes_a])
    widest = max(s.reach for s in shapes_a)
    pairs: list[tuple[int, int]] = []
    for i, shape in enumerate(shapes_b):
        reach = config.gate_distance + shape.reach + widest
        pairs.extend((i, j) for j in sorted(tree.query_ball_point(shape.centroid[:2], reach)))
    return pairs


def overlap_counts(
    before: Sequence[ObjectInstance], after: Sequence[ObjectInstance], tolerance: float
) -> tuple[Sparse, Sparse]:
    """Count voxels of every object whose nearest voxel of the other epoch is in each object there.

    Parameters
    ----------
    before, after : sequence of ObjectInstance
    tolerance : float
        Voxels farther apart do not overlap [m].

    Returns
    -------
    forward, backward : (B, A) and (A, B) sparse arrays
        Of voxels of *before* in *after*, and the other way round.
    """
    first, second = _stack(before), _stack(after)
    shape = (len(before), len(after))
    return (
        _nearest_counts(first, second, shape, tolerance),
        _nearest_counts(second, first, shape[::-1], tolerance),
    )


def _stack(objects: Sequence[ObjectInstance]) -> tuple[Floats, Ints]:
    if not objects:
        return np.zeros((0, 3)), np.zeros(0, dtype=np.int64)
    owner = np.repeat(np.arange(len(objects)), [len(t.voxels) for t in objects])
    return np.concatenate([t.voxels.xyz for t in objects]), owner


def _nearest_counts(
    source: tuple[Floats, Ints], target: tuple[Floats, Ints], shape: tuple[int, int], tolerance: float
) -> Sparse:
    if len(source[0]) == 0 or len(target[0]) == 0:
        return coo_array(shape).tocsr()
    distance, slot = cKDTree(target[0]).query(source[0], distance_upper_bound=tolerance)
    hit = np.isfinite(distance)
    pairs = (source[1][hit], target[1][slot[hit]])
    return coo_array((np.ones(int(hit.sum())), pairs), shape=shape).tocsr()
