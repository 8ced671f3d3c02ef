"""Objects of two epochs in one frame, matched, measured and decided."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from subiaco_change.association.matching import Match, associate
from subiaco_change.decisions.confidence import confidence, features, paper_score
from subiaco_change.decisions.confidence_config import ConfidenceConfig
from subiaco_change.decisions.config import DecisionConfig
from subiaco_change.decisions.driven_lane import limit_in_lane
from subiaco_change.decisions.dynamic_objects import Observed, limit_confidence, own_epoch_evidence
from subiaco_change.decisions.hanging_parts import join_hanging_parts
from subiaco_change.decisions.object_decision import ObjectChange, ObjectRules, decide_object
from subiaco_change.decisions.split_merge import (
    join_building_extensions,
    join_hidden_walls,
    part_hardly_overlapping,
    split_hedge_segments,
    split_multi_body_matches,
    split_row_houses,
    unify_classes,
)
from subiaco_change.decisions.standing_trunks import join_standing_trunks
from subiaco_change.instance_splitting.felled_crowns import split_felled_crowns
from subiaco_change.instance_splitting.one_epoch_parts import split_one_epoch_parts
from subiaco_change.instance_splitting.places_seen_free import places_seen_free
from subiaco_change.instance_splitting.trees_over_shrubs import split_trees_over_shrubs
from subiaco_change.objects.column_volumes import OpenGround, ground_columns
from subiaco_change.objects.known_space import KnownSpace
from subiaco_change.objects.measures import footprint, same_place
from subiaco_change.objects.voxel_objects import (
    EpochView,
    ObjectInstance,
    Reach,
    Voxels,
    build_instances,
    build_voxels,
    height_of,
    is_standing,
    join_voxels,
)
from subiaco_change.records import ChangeRecord
from subiaco_geo.codes import ONE_EPOCH, Semantic
from subiaco_geo.frames import Floats


def compare_objects(
    before: EpochView, after: EpochView, seen_by_before: Observed, seen_by_after: Observed, rules: ObjectRules
) -> list[ObjectChange]:
    """Match, measure and decide every object of two epochs in one local frame."""
    edge, tolerance = rules.measures.voxel, rules.measures.tolerance
    reach = same_place(rules.measures)
    step = rules.measures.crossing
    bare = [ground_columns(v.xyz[v.semantic == Semantic.GROUND], edge) for v in (before, after)]
    rules = replace(
        rules,
        ground=OpenGround(bare[0], bare[1], rules.ground.empty, edge),
        own=(own_epoch_evidence(before, seen_by_before), own_epoch_evidence(after, seen_by_after)),
        spaces=(_with_standing(rules.spaces[0], before), _with_standing(rules.spaces[1], after)),
    )
    voxels_b = build_voxels(before, after, seen_by_after, edge, reach, step, rules.spaces[1].free)
    voxels_a = build_voxels(after, before, seen_by_before, edge, reach, step, rules.spaces[0].free)
    objects_before = _with_parts((before, after), voxels_b, 1, reach, rules)
    objects_after = _with_parts((after, before), voxels_a, 0, reach, rules)
    if rules.by_class:
        objects_before, objects_after = unify_classes(
            objects_before, objects_after, rules.association, tolerance
        )
    changes: list[ObjectChange] = []
    if not rules.by_class:
        matches = associate(objects_before, objects_after, rules.association, tolerance)
        return [
            decide_object(b, a, _better((*b, *a)), rules)
            for b, a in _parts(matches, objects_before, objects_after)
        ]
    for semantic in (Semantic.BUILDING, Semantic.VEGETATION, Semantic.MOBILE, Semantic.OTHER):
        of_b = [t for t in objects_before if t.semantic is semantic and not t.is_part]
        of_a = [t for t in objects_after if t.semantic is semantic and not t.is_part]
        matches = associate(of_b, of_a, rules.association, tolerance)
        changes.extend(decide_object(b, a, semantic, rules) for b, a in _parts(matches, of_b, of_a))
    changes.extend(decide_object((t,), (), t.semantic, rules) for t in objects_before if t.is_part)
    changes.extend(decide_object((), (t,), t.semantic, rules) for t in objects_after if t.is_part)
    changes = split_multi_body_matches(part_hardly_overlapping(changes, rules), rules)
    changes = split_row_houses(join_building_extensions(changes, rules), rules)
    changes = join_standing_trunks(split_hedge_segments(changes, rules), rules)
    return join_hanging_parts(join_hidden_walls(changes, rules))


def _with_standing(space: KnownSpace, view: EpochView) -> KnownSpace:
    """Add to what an epoch knows of the space around its points above the ground."""
    return replace(space, standing=view.xyz[is_standing(view)])


def _with_parts(
    views: tuple[EpochView, EpochView], voxels: Voxels, other: int, reach: Reach, rules: ObjectRules
) -> list[ObjectInstance]:
    """Objects of the first epoch, and their parts that the other epoch lacks as objects of their own.

    ``other``: number of the other epoch, 0 for *before*.
    """
    objects = build_instances(views[0], voxels)
    if rules.from_above:
        objects = split_felled_crowns(objects, *views, reach)
    joined = join_voxels(objects)
    seen_free = places_seen_free(joined, views[1], reach, rules.spaces[other].free)
    ends = np.cumsum([len(t.voxels) for t in objects])[:-1]
    free = np.split(seen_free, ends) if objects else []
    parted = split_one_epoch_parts(objects, rules.association.parts, free)
    return split_trees_over_shrubs(parted, rules.spaces[other].below_view, rules.association.parts)


def _parts(
    matches: Sequence[Match], before: Sequence[ObjectInstance], after: Sequence[ObjectInstance]
) -> list[tuple[list[ObjectInstance], list[ObjectInstance]]]:
    """Parts in both epochs of every match."""
    return [([before[i] for i in match.before], [after[j] for j in match.after]) for match in matches]


def _better(parts: Sequence[ObjectInstance]) -> Semantic:
    """Class of the better-scored part of a match."""
    return max(parts, key=lambda t: t.score).semantic


def log_ratio(before: float, after: float, unknown: float = 0.0) -> float:
    """Return the log of *after* over *before*; ``unknown`` where one of them is 0."""
    return math.log(after / before) if min(before, after) > 0 else unknown


def density_ratio(
    before: Sequence[ObjectInstance], after: Sequence[ObjectInstance], around: float = 0.0
) -> float:
    """Return the log of the points per voxel in *after* over those in *before*, or ``around``."""
    counts = [
        sum(len(t.points) for t in objects) / max(sum(len(t.voxels) for t in objects), 1)
        for objects in (before, after)
    ]
    return log_ratio(counts[0], counts[1], around)


def make_record(
    change: ObjectChange,
    object_id: int,
    origin: Floats,
    evidence: str,
    trust: ConfidenceConfig,
    rules: DecisionConfig,
    around: float = 0.0,
) -> ChangeRecord:
    """Turn an object into a row of the table, in world coordinates.

    ``around``: log ratio of the points of both epochs around, for an object that only one of them has.
    """
    import shapely.affinity

    objects = (*change.before, *change.after)
    xyz = np.concatenate([t.voxels.xyz for t in objects])
    outline = footprint([t.voxels.xyz[:, :2] for t in objects])
    m = change.measures
    heights = [height_of(objects) for objects in (change.before, change.after)]
    score = float(np.mean([t.score for t in objects]))
    density = change.plant.density if change.plant else density_ratio(change.before, change.after, around)
    found = features(change.decision, m, change.semantic, score, density, evidence)
    certain = confidence(change.decision, found, m, trust)
    certain, reason = limit_confidence(change.decision, objects, certain, rules, m.free)
    certain, reason = limit_in_lane(change.decision.change, change.in_lane, certain, reason, rules)
    if change.doubt and change.decision.change in ONE_EPOCH:
        certain, reason = min(certain, rules.lane_confidence), f"{reason} {change.doubt}"
    return ChangeRecord(
        object_id=object_id,
        semantic=change.semantic,
        change=change.decision.change,
        id_before=tuple(t.instance for t in change.before),
        id_after=tuple(t.instance for t in change.after),
        match_kind=change.match_kind,
        delta_h_m=m.delta_h,
        delta_v_m3=m.delta_v,
        delta_v_surface_m3=m.delta_v_surface,
        delta_c_m=m.delta_c,
        iou_3d=m.iou if change.before and change.after else math.nan,
        d_perp_m=m.d_perp,
        lod95_m=change.lod,
        observed_fraction=m.observed_fraction,
        evidence=evidence,
        score_paper=paper_score(change.semantic, m, change.lod),
        confidence=certain,
        n_before=int(sum(len(t.points) for t in change.before)),
        n_after=int(sum(len(t.points) for t in change.after)),
        x=float(xyz[:, 0].mean() + origin[0]),
        y=float(xyz[:, 1].mean() + origin[1]),
        z=float(xyz[:, 2].mean() + origin[2]),
        footprint=shapely.affinity.translate(outline, float(origin[0]), float(origin[1])),
        reason=reason,
        features=tuple(found.tolist()),
        delta_h_low_m=m.height_bounds.low if m.height_bounds else math.nan,
        delta_h_high_m=m.height_bounds.high if m.height_bounds else math.nan,
        delta_v_low_m3=m.stated_volume.low if m.stated_volume else math.nan,
        delta_v_high_m3=m.stated_volume.high if m.stated_volume else math.nan,
        height_before_m=heights[0],
        height_after_m=heights[1],
    )
