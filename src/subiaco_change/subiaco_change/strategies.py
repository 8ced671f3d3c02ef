"""Strategies: how the parts of the method are done that an ablation study can disable.

A stage chooses its strategies at the top and does not know afterwards which ones were chosen.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from subiaco_change.decisions.config import DecisionConfig
from subiaco_change.level_of_detection.displacement_lod import combine
from subiaco_change.objects.voxel_objects import EpochView, Reach, occupied
from subiaco_change.segmentation.classes import SemanticResult
from subiaco_change.segmentation.clustering import voxel_clusters
from subiaco_change.segmentation.ground_model import Mask
from subiaco_change.segmentation.instances import InstanceConfig, segment
from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.frames import Floats

Codes = NDArray[np.uint8]
Instances = NDArray[np.int32]


class Part(StrEnum):
    """What can be left out.

    ``lod``: no level of detection, no gate. ``class_association``: objects of
    any class may be one. ``semantics``: everything off the ground is one
    class, its objects connected components (B8), with the rules of buildings.
    ``objects``: every point by itself, Added or Removed or not.
    """

    LOD = "lod"
    CLASS_ASSOCIATION = "class_association"
    SEMANTICS = "semantics"
    OBJECTS = "objects"


@dataclass(frozen=True)
class PointComparison:
    """What the label of a point may be read from: one epoch, the other, and where the other could see."""

    view: EpochView
    other: EpochView
    seen_by_other: Callable[[Floats], Mask]
    epoch: str
    reach: Reach


@dataclass(frozen=True)
class Classified:
    """Points with classes: an epoch, the epoch turned upright, its classes, settings, edge of a voxel [m]."""

    cloud: PointCloud
    upright: PointCloud
    result: SemanticResult
    config: InstanceConfig
    voxel: float


@dataclass(frozen=True)
class Strategies:
    """How the parts of the method are done. Build it with :func:`choose_strategies`.

    Parameters
    ----------
    lods : callable
        Level of detection (N,) [m] from the variance of points [m2] and the sigma of the registration [m].
    decisions : callable
        Settings of the decisions as they are used.
    by_class : bool
        Whether only objects of one class are matched.
    instances : callable
        Class and instance (N,) of classified points.
    kept : callable
        Instances (N,) that are kept as objects.
    labels : callable
        Labels (N,) of points, from the labels of their objects.
    """

    lods: Callable[[Floats, Floats, str], NDArray[np.float32]]
    decisions: Callable[[DecisionConfig], DecisionConfig]
    by_class: bool
    instances: Callable[[Classified], tuple[Codes, Instances]]
    kept: Callable[[Instances], Instances]
    labels: Callable[[PointComparison, Codes], Codes]


def choose_strategies(without: Collection[Part]) -> Strategies:
    """Choose how every part of the method is done, some of them left out."""
    gated, objects = Part.LOD not in without, Part.OBJECTS not in without
    return Strategies(
        lods=combined_lods if gated else no_lods,
        decisions=unchanged_settings if gated else without_lod_floor,
        by_class=Part.CLASS_ASSOCIATION not in without,
        instances=connected_components if Part.SEMANTICS in without else class_instances,
        kept=all_instances if objects else no_instances,
        labels=object_labels if objects else point_labels,
    )


def combined_lods(variance: Floats, sigma: Floats, how: str) -> NDArray[np.float32]:
    """Return the level of detection of points (N,) [m], inf where it is not known."""
    lod = combine(variance, sigma, how)
    return np.where(np.isfinite(lod), lod, np.inf).astype(np.float32)


def no_lods(variance: Floats, _sigma: Floats, _how: str) -> NDArray[np.float32]:
    """Return 0 for every point (N,): every displacement is detected."""
    return np.zeros(len(variance), dtype=np.float32)


def unchanged_settings(decisions: DecisionConfig) -> DecisionConfig:
    """Return the settings as they are."""
    return decisions


def without_lod_floor(decisions: DecisionConfig) -> DecisionConfig:
    """Return the settings without a smallest level of detection."""
    return decisions.model_copy(update={"lod_floor": 0.0})


def class_instances(found: Classified) -> tuple[Codes, Instances]:
    """Return the classes of points as they are, and instances by the rules of every class."""
    return segment(found.upright, found.result, found.config)


def connected_components(found: Classified) -> tuple[Codes, Instances]:
    """Make all points off the ground one class, and their connected components its objects (method, B8)."""
    semantic = found.result.semantic
    off = np.flatnonzero(semantic != Semantic.GROUND)
    instance = np.full(len(found.cloud), -1, dtype=np.int32)
    instance[off] = voxel_clusters(found.cloud.xyz[off], found.voxel)
    one = np.where(semantic == Semantic.GROUND, semantic, np.uint8(Semantic.BUILDING))
    return one.astype(np.uint8), instance


def all_instances(instance: Instances) -> Instances:
    """Keep all instances (N,)."""
    return instance


def no_instances(instance: Instances) -> Instances:
    """Keep no instance: -1 for every point (N,)."""
    return np.full_like(instance, -1)


def object_labels(_compared: PointComparison, change: Codes) -> Codes:
    """Label every point (N,) as its object."""
    return change


def point_labels(compared: PointComparison, change: Codes) -> Codes:
    """Label points (N,) off the ground one by one: Added or Removed where the other epoch saw them free."""
    view, other = compared.view, compared.other
    alone = np.full(len(view.xyz), Change.UNCHANGED, dtype=np.uint8)
    off = np.flatnonzero(view.semantic != Semantic.GROUND)
    still = occupied(view.xyz[off], other.xyz[other.semantic != Semantic.GROUND], compared.reach)
    seen = compared.seen_by_other(view.xyz[off])
    alone[off[~still & seen]] = Change.REMOVED if compared.epoch == "before" else Change.ADDED
    alone[off[~still & ~seen]] = Change.UNOBSERVED
    return np.where(view.semantic == Semantic.GROUND, change, alone)
