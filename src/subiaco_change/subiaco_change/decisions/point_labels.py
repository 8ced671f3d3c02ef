"""Change label of every point: that of its object, or of its ground cell."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import shapely.affinity
from numpy.typing import NDArray
from scipy.special import ndtr

from subiaco_change.decisions.ground_change import GroundComparison, GroundPatch, patch_points
from subiaco_change.geometry import tree_for_few
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import none_of_them, rule_mask, switchable
from subiaco_change.objects.voxel_objects import EpochView, is_ghost_trail
from subiaco_change.records import ChangeRecord
from subiaco_change.segmentation.ground_model import Mask
from subiaco_change.visibility_evidence import EvidenceConfig, ground_observed
from subiaco_geo.codes import CHANGED, Change, Semantic
from subiaco_geo.frames import Floats, Ints

_INTERIOR = NUMBERS.point_labels.interior_reach
_AROUND = NUMBERS.point_labels.surrounding_points


@dataclass(frozen=True)
class PointLabels:
    """Fields of one epoch's points, as :class:`subiaco_change.records.ChangeResult` wants them."""

    change: NDArray[np.uint8]
    semantic: NDArray[np.uint8]
    instance: NDArray[np.int32]
    confidence: NDArray[np.float32]
    lod95: NDArray[np.float32]

    def fields(self) -> dict[str, NDArray[np.generic]]:
        """Return the fields by name."""
        return {name: getattr(self, name) for name in self.__dataclass_fields__}


def unlabelled(view: EpochView) -> PointLabels:
    """Return labels of points before any decision; ghost trails keep these labels."""
    count = len(view.xyz)
    return PointLabels(
        np.where(is_ghost_trail(view), Change.NOT_REPORTED, Change.UNCHANGED).astype(np.uint8),
        view.semantic.copy(),
        np.full(count, -1, dtype=np.int32),
        np.full(count, 0.5, dtype=np.float32),
        view.lod.astype(np.float32),
    )


def label_rest(
    view: EpochView,
    labels: PointLabels,
    ground: GroundComparison | None,
    patch_ids: Sequence[int],
    seen_by_other: Callable[[Floats], Mask],
    evidence: EvidenceConfig,
    other_ground: Floats,
    occupied_by_other: Callable[[Floats], Mask],
    touch: float,
) -> Ints:
    """Label, in place, what belongs to no object, and return the points (K,) that were joined to objects.

    Points of a ground patch get its label and id; other ground stays Unchanged where the other epoch
    observed the place, by its beams or by ground points (M, 3) around, and is Unobserved elsewhere. Points
    that are too few for an object stay Unchanged where the other epoch holds points too: few points do
    not show whether they are new or gone. Where it holds none, they belong to a changed object within
    ``touch`` [m], if there is one.
    """
    loose = np.flatnonzero(labels.instance < 0)
    is_ground = view.semantic[loose] == Semantic.GROUND
    seen = _compared(ground, view, loose)
    trail = labels.change[loose] == Change.NOT_REPORTED
    seen[trail] = seen_by_other(view.xyz[loose[trail]])
    fragment = ~is_ground & ~trail
    seen[fragment] = ~rule_mask("points_of_no_object", ~occupied_by_other(view.xyz[loose[fragment]]))
    hidden = np.flatnonzero(is_ground & ~seen)
    seen[hidden] = ground_observed(seen_by_other, view.xyz[loose[hidden]], evidence)
    hidden = hidden[~seen[hidden]]
    seen[hidden] = surrounded(view.xyz[loose[hidden], :2], other_ground[:, :2], evidence.ground_between)
    labels.change[loose[~seen]] = Change.UNOBSERVED
    joined = _join_fragments(view.xyz, labels, loose[fragment & ~seen], touch)
    inside = _join_interiors(view, labels, loose)
    if ground is not None:
        _label_ground(ground, view, patch_ids, labels)
    return np.union1d(joined, inside)


def _join_interiors(view: EpochView, labels: PointLabels, loose: Ints) -> Ints:
    """Give what was seen through windows the label of the building around it; return these points (K,).

    It is no part of the object that is compared: furniture is another in each survey.
    """
    members = loose[(labels.instance[loose] < 0) & (view.semantic[loose] == Semantic.BUILDING)]
    hosts = np.flatnonzero((labels.instance >= 0) & (labels.semantic == Semantic.BUILDING))
    return _join_nearest(view.xyz, labels, members, hosts, _INTERIOR)


def _join_fragments(xyz: Floats, labels: PointLabels, fragments: Ints, touch: float) -> Ints:
    """Give points of no object the label of the changed object they touch; return those that touch one."""
    changed = np.isin(labels.change, CHANGED)
    hosts = np.flatnonzero((labels.instance >= 0) & changed)
    return _join_nearest(xyz, labels, fragments, hosts, touch)


def _join_nearest(xyz: Floats, labels: PointLabels, points: Ints, hosts: Ints, reach: float) -> Ints:
    """Give points (K,) the label of the nearest host (H,) within reach [m]; return those that have one."""
    nearest = touching(xyz[points], xyz[hosts], reach)
    joined, host = points[nearest >= 0], hosts[nearest[nearest >= 0]]
    for field in (labels.change, labels.semantic, labels.instance, labels.confidence):
        field[joined] = field[host]
    return np.asarray(joined)


def touching(fragments: Floats, hosts: Floats, touch: float) -> Ints:
    """Return the nearest host (K,) of each fragment (K, 3) within ``touch`` [m], -1 without any."""
    if len(fragments) == 0 or len(hosts) == 0:
        return np.full(len(fragments), -1, dtype=np.int64)
    distance, slot = tree_for_few(hosts).query(fragments, distance_upper_bound=touch)
    return np.where(np.isfinite(distance), slot, -1)


@switchable("ground_between_rings", none_of_them)
def surrounded(xy: Floats, points: Floats, reach: float) -> Mask:
    """Tell which places (M, 2) have points (N, 2) within reach [m] on at least three of their four sides.

    Between beams that met the ground metres apart, the ground is known; beyond the last one it is not.
    """
    if len(points) == 0 or len(xy) == 0:
        return np.zeros(len(xy), dtype=bool)
    distance, slot = tree_for_few(points).query(xy, k=_AROUND, distance_upper_bound=reach)
    found = np.isfinite(distance)
    step = points[np.where(found, slot, 0)] - xy[:, None]
    quadrant = 2 * (step[..., 0] > 0) + (step[..., 1] > 0)
    sides = sum(np.any((quadrant == q) & found, axis=1).astype(int) for q in range(4))
    return np.asarray(sides >= 3)


def _compared(ground: GroundComparison | None, view: EpochView, members: Ints) -> Mask:
    """Tell which points are ground whose cell holds ground in both epochs."""
    if ground is None:
        return np.zeros(len(members), dtype=bool)
    row, column, inside = ground.cell_of(view.xyz[members, :2])
    both = inside & np.isfinite(ground.dz[row, column])
    return np.asarray(both & (view.semantic[members] == Semantic.GROUND))


def _label_ground(
    ground: GroundComparison, view: EpochView, patch_ids: Sequence[int], labels: PointLabels
) -> None:
    patch = patch_points(ground, view)
    row, column, inside = ground.cell_of(view.xyz[:, :2])
    known = inside & (view.semantic == Semantic.GROUND) & np.isfinite(ground.dz[row, column])
    sigma = np.maximum(ground.lod[row[known], column[known]] / 1.96, 0.01)
    distance = np.abs(np.abs(ground.dz[row[known], column[known]]) - 0.15)
    labels.confidence[known] = ndtr(distance / sigma)
    for number, item in enumerate(ground.patches):
        members = patch == number
        labels.change[members], labels.instance[members] = item.change, patch_ids[number]
        labels.confidence[members] = item.confidence


def patch_record(patch: GroundPatch, origin: Floats, z: float, evidence: str) -> ChangeRecord:
    """Return the row of a patch of ground, in world coordinates; number and points are added later."""
    centre = patch.outline.centroid
    return ChangeRecord(
        object_id=-1,
        semantic=Semantic.GROUND,
        change=patch.change,
        id_before=(),
        id_after=(),
        match_kind="one_to_one",
        delta_h_m=patch.dz,
        delta_v_m3=patch.dz * patch.area,
        delta_v_surface_m3=math.nan,
        delta_c_m=math.nan,
        iou_3d=math.nan,
        d_perp_m=patch.dz,
        lod95_m=patch.lod,
        observed_fraction=1.0,
        evidence=evidence,
        score_paper=_ground_score(patch.dz, patch.lod),
        confidence=patch.confidence,
        n_before=0,
        n_after=0,
        x=float(centre.x + origin[0]),
        y=float(centre.y + origin[1]),
        z=z + float(origin[2]),
        footprint=shapely.affinity.translate(patch.outline, float(origin[0]), float(origin[1])),
        delta_h_low_m=patch.dz - patch.lod,
        delta_h_high_m=patch.dz + patch.lod,
        delta_v_low_m3=(patch.dz - patch.lod) * patch.area,
        delta_v_high_m3=(patch.dz + patch.lod) * patch.area,
        reason=patch.reason,
    )


def _ground_score(dz: float, lod: float) -> float:
    """Return the paper's score for ground: height and separation terms."""
    total = 0.50 * abs(dz) / math.hypot(lod, 0.10) + 0.25 * abs(dz) / max(lod, 1e-6)
    return 1.0 / (1.0 + math.exp(-min(total, 50.0)))
