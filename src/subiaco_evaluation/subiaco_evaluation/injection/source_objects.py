"""Objects of a map from which injected changes are made."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from subiaco_change.level_of_detection.common_frame import levelled
from subiaco_change.objects.voxel_objects import UNCERTAIN
from subiaco_change.segmentation.classes import label_points
from subiaco_change.segmentation.ground_model import Mask
from subiaco_change.segmentation.instances import segment
from subiaco_change.visibility_evidence import EvidenceConfig, make_observer
from subiaco_evaluation.injection.config import InjectionConfig
from subiaco_evaluation.injection.edits import Edited
from subiaco_geo.clouds import PointCloud, voxel_downsample
from subiaco_geo.codes import Semantic
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.survey_map import SurveyMap

#: Instance of points of a ghost trail.
TRAIL = -2
_TOUCHING = 0.5  # fragments this near an object are parts of it [m]


@dataclass(frozen=True)
class SourceScene:
    """A map at the working leaf, with the class (N,) uint8 and the object (N,) int32 of every point.

    The object :data:`TRAIL` is a ghost trail, -1 is no object.
    """

    cloud: PointCloud
    semantic: NDArray[np.uint8]
    instance: NDArray[np.int32]


def label_scene(survey: SurveyMap, config: InjectionConfig) -> SourceScene:
    """Find the classes and the objects of a map at the working leaf."""
    cloud = voxel_downsample(survey.cloud, config.leaf)
    upright = levelled(cloud)
    observer = make_observer(survey, EvidenceConfig())
    passes, moved = (found(cloud.world()) for found in (observer.passes, observer.moved))
    semantic = label_points(upright, config.semantics, passes, moved=moved)
    classes, instance = segment(upright, semantic, config.instances.model_copy(update={"leaf": config.leaf}))
    for number, members in _members(instance, instance >= 0).items():
        if _is_trail(members, passes, moved, config):
            instance[instance == number] = TRAIL
    return SourceScene(cloud, classes, instance)


def _is_trail(members: Ints, passes: Floats | None, moved: Floats | None, config: InjectionConfig) -> bool:
    """Tell whether an object may have moved, by times where the map has them, else by counts of beams."""
    if moved is not None:
        return bool(moved[members].mean() >= UNCERTAIN)
    return passes is not None and bool(np.quantile(passes[members], 0.25) >= config.decisions.trail_passes)


def by_turns(classes: Sequence[int], random: np.random.Generator) -> Ints:
    """Order things at random, a class after the other in turn, so that the rare ones come too."""
    order = random.permutation(len(classes))
    drawn = np.asarray(classes, dtype=np.int64)[order]
    turn = np.zeros(len(order), dtype=np.int64)
    for code in np.unique(drawn):
        turn[drawn == code] = np.arange(np.count_nonzero(drawn == code))
    return np.asarray(order[np.argsort(turn, kind="stable")])


def things_of(edited: Edited) -> list[Ints]:
    """Members of every object near the drive that is large enough to be edited.

    Fragments that touch an object belong to it: nothing of it stays behind. A ghost trail
    is no object.
    """
    size = np.bincount(edited.instance[edited.instance >= 0])
    large = (edited.instance >= 0) & (size[np.maximum(edited.instance, 0)] >= edited.config.min_points)
    loose = ~large & (edited.instance != TRAIL) & (edited.semantic != Semantic.GROUND)
    groups = _members(edited.instance, large)
    if groups and loose.any():
        distance, nearest = cKDTree(edited.xyz[large]).query(
            edited.xyz[loose], distance_upper_bound=_TOUCHING
        )
        touching = np.isfinite(distance)
        owner = np.full(len(edited.xyz), -1)
        owner[np.flatnonzero(loose)[touching]] = edited.instance[large][nearest[touching]]
        extra = _members(owner, owner >= 0)
        groups = {k: np.concatenate([v, extra.get(k, v[:0])]) for k, v in groups.items()}
    poses = edited.sight.poses[:, :2]
    return [
        members
        for members in groups.values()
        if np.linalg.norm(poses - edited.xyz[members, :2].mean(axis=0), axis=1).min()
        < edited.config.max_range
    ]


def _members(instance: NDArray[Any], of: Mask) -> dict[int, Ints]:
    """Return the members of every instance among some points, in the order of the instances."""
    chosen = np.flatnonzero(of)
    order = chosen[np.argsort(instance[chosen], kind="stable")]
    cuts = np.flatnonzero(np.diff(instance[order])) + 1
    return {int(instance[group[0]]): group for group in np.split(order, cuts) if len(group)}
