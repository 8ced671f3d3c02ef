"""Crowns of one epoch in whose place the other epoch, measured from above, met the ground alone.

Crowns of a wood touch, so that one instance holds several, and in a sparse cloud the nearest point of a
neighbouring crown occupies the place of a crown that was felled. Beams from above tell more than distances:
where a crown stands they end in it, all but a known share. Where as many as the crown is wide all met the
ground, the crown is gone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import bdtr

from subiaco_change.instance_splitting.one_epoch_parts import (
    has_top,
    join_parts,
    split_by_labels,
    with_free,
)
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import first_argument, switchable
from subiaco_change.objects.voxel_objects import (
    EpochView,
    ObjectInstance,
    Reach,
    Voxels,
    is_ghost_trail,
    join_voxels,
)
from subiaco_change.segmentation.clustering import cell_clusters, group_indices
from subiaco_change.segmentation.ground_model import Mask
from subiaco_geo.codes import Semantic
from subiaco_geo.frames import Floats, Ints

_TALL = NUMBERS.felled_crowns.tall
_CLEARED = NUMBERS.felled_crowns.cleared
_NEIGHBOURS = NUMBERS.felled_crowns.neighbours
_CHANCE = NUMBERS.felled_crowns.chance
_BESIDE = NUMBERS.felled_crowns.beside
_GROWN = NUMBERS.felled_crowns.grown
_JOINED = NUMBERS.felled_crowns.joined
_FEWEST = NUMBERS.felled_crowns.fewest_points
_TOP = NUMBERS.felled_crowns.top_reach


@switchable("felled_crowns", first_argument)
def split_felled_crowns(
    objects: Sequence[ObjectInstance], view: EpochView, other: EpochView, reach: Reach
) -> list[ObjectInstance]:
    """Split crowns off in whose place the other epoch met the ground alone; each becomes a part of its own.

    Parameters
    ----------
    objects : sequence of ObjectInstance
        Of one epoch.
    view, other : EpochView
        That epoch and the other one, which was measured from above, in one frame.
    reach : Reach
        When points of the other epoch occupy a place.
    """
    plants = [t for t in objects if t.semantic is Semantic.VEGETATION]
    if not plants or len(other.xyz) < _NEIGHBOURS:
        return list(objects)
    labels = _felled(join_voxels(plants), view, other, reach)
    if not labels.any():
        return list(objects)
    following = max(t.instance for t in objects) + 1
    kept: list[ObjectInstance] = []
    pieces: list[list[ObjectInstance]] = [[] for _ in range(int(labels.max()) + 1)]
    for obj in objects:
        own = np.zeros(len(obj.voxels), dtype=np.int64)
        if obj.semantic is Semantic.VEGETATION:
            own, labels = labels[: len(own)], labels[len(own) :]
        if not own.any():
            kept.append(obj)
            continue
        free = replace(obj, voxels=with_free(obj.voxels, own > 0))
        numbers, slot = np.unique(np.append(0, own), return_inverse=True)
        for number, piece in zip(numbers.tolist(), split_by_labels(free, slot[1:], following), strict=True):
            if len(piece.points):
                pieces[number].append(piece)
        following += len(numbers)
    rests, *felled = pieces
    return [*kept, *rests, *(part for some in felled for part in _large(some))]


def _large(pieces: Sequence[ObjectInstance]) -> list[ObjectInstance]:
    """Pieces of one place by instance; those too small to stand for a tree join the largest."""
    if not pieces:
        return []
    order = sorted(pieces, key=lambda p: -len(p.points))
    small = [p for p in order[1:] if len(p.points) < _FEWEST]
    large = [p for p in order[1:] if len(p.points) >= _FEWEST]
    return [join_parts([order[0], *small]), *large]


@dataclass(frozen=True)
class _Plan:
    """Points of an epoch seen from above: tree of their places, and heights above ground."""

    tree: cKDTree
    height: Floats

    @classmethod
    def of(cls, view: EpochView) -> _Plan:
        kept = ~is_ghost_trail(view)
        return cls(cKDTree(view.xyz[kept, :2]), view.height[kept])

    def low(self, xy: Floats, count: int, reach: float) -> Mask:
        """Tell at which places (M, 2) the nearest points, all within reach, lie on the ground."""
        distance, slot = self.tree.query(xy, k=[*range(1, count + 1)], distance_upper_bound=reach)
        near = np.isfinite(distance)
        return np.asarray((near & (self.height[np.where(near, slot, 0)] <= _CLEARED)).all(axis=1))

    def counts(self, xy: Floats, reach: float) -> tuple[int, int]:
        """Count the points within reach of places (M, 2): those on the ground, and all."""
        near = np.isfinite(cKDTree(xy).query(self.tree.data, distance_upper_bound=reach)[0])
        return int(np.count_nonzero(near & (self.height <= _CLEARED))), int(np.count_nonzero(near))


def _felled(voxels: Voxels, view: EpochView, other: EpochView, reach: Reach) -> Ints:
    """Return the number (M,) of the felled crown that every voxel of plants is a place of; 0 for none."""
    labels = np.zeros(len(voxels), dtype=np.int64)
    own, seen = _Plan.of(view), _Plan.of(other)
    xy, tall = voxels.xyz[:, :2], voxels.height > _TALL
    places = np.flatnonzero(tall)
    core = places[seen.low(xy[places], _NEIGHBOURS, reach.high)]
    if len(core) == 0:
        return labels
    beside = _BESIDE * reach.high
    standing = np.setdiff1d(places, core)
    passed = _share(*seen.counts(xy[standing], beside)) if len(standing) else 0.0
    open_ = np.zeros(len(voxels), dtype=bool)
    open_[places] = seen.low(xy[places], 1, reach.high)
    low = np.flatnonzero(~tall & ~voxels.occupied_in_other & voxels.observed)
    count = 0
    for group in group_indices(cell_clusters(xy[core], _JOINED * reach.high)):
        middle = core[group]
        gone = _is_gone(xy[middle], own, seen, passed, beside)
        if not gone or not has_top(voxels.xyz, middle, places, max(_TOP, reach.high)):
            continue
        count += 1
        near = cKDTree(xy[middle]).query(xy)[0]
        part = np.flatnonzero(open_ & (near <= _GROWN * reach.high) & (labels == 0))
        labels[part] = count
        labels[low[near[low] <= beside]] = count
    return labels


def _share(low: int, every: int) -> float:
    """Share of beams that met the ground, with half a beam of each kind beforehand."""
    return (low + 0.5) / (every + 1.0)


def _is_gone(xy: Floats, own: _Plan, seen: _Plan, passed: float, reach: float) -> bool:
    """Tell whether too many beams of the other epoch met the ground for crowns at places (M, 2) to stand."""
    through = max(passed, _share(*own.counts(xy, reach)))
    low, every = seen.counts(xy, reach)
    return bool(bdtr(every - low, every, 1.0 - through) <= _CHANCE)
