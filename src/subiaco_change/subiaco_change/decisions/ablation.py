"""Ablation: parts of the method switched off one at a time, as in the paper."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from subiaco_change.decisions.voxel_objects import EpochView, Reach, occupied
from subiaco_change.segmentation.clustering import voxel_clusters
from subiaco_change.segmentation.ground_model import Mask
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.frames import Floats


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


def view_without(view: EpochView, without: Collection[Part], edge: float) -> EpochView:
    """Take from an epoch what is left out; ``edge`` is that of the occupancy of B8 [m]."""
    if Part.LOD in without:
        view = replace(view, lod=np.zeros_like(view.lod))
    if Part.SEMANTICS in without:
        view = _classless(view, edge)
    if Part.OBJECTS in without:
        view = replace(view, instance=np.full_like(view.instance, -1))
    return view


def _classless(view: EpochView, edge: float) -> EpochView:
    off = np.flatnonzero(view.semantic != Semantic.GROUND)
    instance = np.full(len(view.xyz), -1, dtype=np.int32)
    instance[off] = voxel_clusters(view.xyz[off], edge)
    semantic = view.semantic.copy()
    semantic[off] = Semantic.BUILDING
    return replace(view, semantic=semantic, instance=instance)


def pointwise(
    view: EpochView, other: EpochView, seen_by_other: Callable[[Floats], Mask], epoch: str, reach: Reach
) -> NDArray[np.uint8]:
    """Label points (N,) one by one: Added or Removed where the other epoch saw the place free."""
    change = np.full(len(view.xyz), Change.UNCHANGED, dtype=np.uint8)
    off = np.flatnonzero(view.semantic != Semantic.GROUND)
    still = occupied(view.xyz[off], other.xyz[other.semantic != Semantic.GROUND], reach)
    seen = seen_by_other(view.xyz[off])
    change[off[~still & seen]] = Change.REMOVED if epoch == "before" else Change.ADDED
    change[off[~still & ~seen]] = Change.UNOBSERVED
    return change
