"""Trees of one epoch that stand over a shrub, a hedge or a stump that both epochs have.

A crown and the shrub beneath it grow together, so that one instance holds both, and the trunk between them
is hidden. Where the other epoch has nothing of the instance that is higher than a shrub, nobody pruned the
tree: it was felled, or planted since. The shrub stays an object of its own.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from subiaco_change.association.config import PartConfig
from subiaco_change.instance_splitting.one_epoch_parts import large_parts, split_by_labels
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import first_argument, switchable
from subiaco_change.objects.known_space import Empty
from subiaco_change.objects.measures import footprint_sides
from subiaco_change.objects.voxel_objects import ObjectInstance
from subiaco_change.quantiles import quantile_of
from subiaco_change.segmentation.clustering import group_indices, voxel_clusters
from subiaco_geo.codes import Semantic
from subiaco_geo.frames import Floats, Ints

_LOW = NUMBERS.trees_over_shrubs.shrub_height
_TALL = NUMBERS.trees_over_shrubs.tree_height
_HIGHER = NUMBERS.trees_over_shrubs.times_higher
_TOP = NUMBERS.trees_over_shrubs.top_quantile
_GONE = NUMBERS.trees_over_shrubs.free_share
_SEEN = NUMBERS.trees_over_shrubs.observed_share
_VIEW = NUMBERS.trees_over_shrubs.view_share
_WIDTH = NUMBERS.trees_over_shrubs.crown_width


@switchable("trees_over_shrubs", first_argument)
def split_trees_over_shrubs(
    objects: Sequence[ObjectInstance], below_view: Empty | None, config: PartConfig
) -> list[ObjectInstance]:
    """Split trees off from the shrubs that both epochs have; each tree becomes a part of its own.

    Parameters
    ----------
    objects : sequence of ObjectInstance
        Of one epoch.
    below_view : callable, optional
        Which places (N, 3) are no higher than the view of the other epoch is known to have reached; None
        where nothing tells what that epoch saw.
    config : PartConfig
    """
    if config.points == 0:
        return list(objects)
    following = max((t.instance for t in objects), default=-1) + 1
    shrubs: list[ObjectInstance] = []
    trees: list[ObjectInstance] = []
    for obj in objects:
        labels = _trees_of(obj, below_view, config)
        if not labels.any():
            shrubs.append(obj)
            continue
        rest, *own = split_by_labels(obj, labels, following)
        following += len(own)
        shrubs.append(rest)
        trees.extend(own)
    return [*shrubs, *trees]


def _trees_of(obj: ObjectInstance, below_view: Empty | None, config: PartConfig) -> Ints:
    """Return the tree (M,) of every voxel of an instance, 0 for what both epochs have."""
    voxels = obj.voxels
    labels = np.zeros(len(voxels), dtype=np.int64)
    common, alone = voxels.occupied_in_other, voxels.observed_unoccupied
    if obj.semantic is not Semantic.VEGETATION or obj.is_part or not common.any() or not alone.any():
        return labels
    shrub = quantile_of(voxels.height[common], _TOP)
    tall = max(_HIGHER * shrub, _TALL)
    if not config.top <= shrub <= _LOW or quantile_of(voxels.height[alone], _TOP) < tall:
        return labels
    above = voxels.height > shrub + config.gap
    seen = np.count_nonzero(above & voxels.observed)
    if seen < _SEEN * np.count_nonzero(above) or np.count_nonzero(above & alone) < _GONE * seen:
        return labels
    members = np.flatnonzero(alone)
    for group in group_indices(voxel_clusters(voxels.xyz[members], config.gap)):
        tree = members[group]
        if voxels.height[tree].max() >= tall and _is_crown_in_view(voxels.xyz[tree], below_view):
            labels[tree] = labels.max() + 1
    if not labels.any():
        return labels
    known = (labels > 0) | common
    labels[~known] = labels[known][cKDTree(voxels.xyz[known]).query(voxels.xyz[~known])[1]]
    return large_parts(labels, obj, config.points, config.points)


def _is_crown_in_view(xyz: Floats, below_view: Empty | None) -> bool:
    """Tell whether places (M, 3) are as wide as a crown, and the other epoch could see some of them."""
    if footprint_sides(xyz)[0] < _WIDTH:
        return False
    return below_view is None or bool(below_view(xyz).mean() >= _VIEW)
