"""Objects of two epochs in one frame, matched, measured and decided."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from subiaco_change.association.matching import Match, associate
from subiaco_change.decisions.column_volumes import OpenGround, ground_columns
from subiaco_change.decisions.confidence import ConfidenceConfig, bounded, features, paper_score, probability
from subiaco_change.decisions.dynamic_objects import Observed, own_survey, trusted
from subiaco_change.decisions.measures import footprint, same_place
from subiaco_change.decisions.object_decision import ObjectChange, ObjectRules, decide_object
from subiaco_change.decisions.voxel_objects import (
    EpochView,
    Thing,
    build_instances,
    build_voxels,
    join_voxels,
    stands,
)
from subiaco_change.instance_splitting.one_epoch_parts import part_things
from subiaco_change.instance_splitting.split_merge import (
    adopt_fragments,
    agree_on_classes,
    join_sides,
    join_wings,
    split_hedge_segments,
    split_low_overlap_matches,
    split_multi_body_matches,
    split_row_houses,
)
from subiaco_change.records import ChangeRecord
from subiaco_geo.codes import Semantic
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
        own=(own_survey(before, seen_by_before), own_survey(after, seen_by_after)),
        standing=(before.xyz[stands(before)], after.xyz[stands(after)]),
    )
    voxels_b = build_voxels(before, after, seen_by_after, edge, reach, step, rules.free[1])
    voxels_a = build_voxels(after, before, seen_by_before, edge, reach, step, rules.free[0])
    things_b, things_a = build_instances(before, voxels_b), build_instances(after, voxels_a)
    things_b, things_a = (part_things(things, rules.association.parts) for things in (things_b, things_a))
    if rules.by_class:
        things_b, things_a = agree_on_classes(things_b, things_a, rules.association, tolerance)
    changes: list[ObjectChange] = []
    if not rules.by_class:
        matches = associate(things_b, things_a, rules.association, tolerance)
        return [decide_object(b, a, _better((*b, *a)), rules) for b, a in _parts(matches, things_b, things_a)]
    for semantic in (Semantic.BUILDING, Semantic.VEGETATION, Semantic.MOBILE, Semantic.OTHER):
        of_b = [t for t in things_b if t.semantic is semantic]
        of_a = [t for t in things_a if t.semantic is semantic]
        matches = associate(of_b, of_a, rules.association, tolerance)
        changes.extend(decide_object(b, a, semantic, rules) for b, a in _parts(matches, of_b, of_a))
    changes = split_low_overlap_matches(changes, rules)
    changes = split_multi_body_matches(changes, rules)
    changes = split_row_houses(changes, rules)
    changes = split_hedge_segments(changes, rules)
    changes = join_sides(join_wings(changes, rules), rules)
    return adopt_fragments(changes, things_b, things_a, rules.association, tolerance)


def _parts(
    matches: Sequence[Match], before: Sequence[Thing], after: Sequence[Thing]
) -> list[tuple[list[Thing], list[Thing]]]:
    """Parts in both epochs of every match."""
    return [([before[i] for i in match.before], [after[j] for j in match.after]) for match in matches]


def _better(parts: Sequence[Thing]) -> Semantic:
    """Class of the better-scored part of a match."""
    return max(parts, key=lambda t: t.score).semantic


def height_of(things: Sequence[Thing], quantile: float = 0.95) -> float:
    """Height above ground that a share of the voxels of an object stays under [m]; NaN without voxels."""
    voxels = join_voxels(things)
    return float(np.quantile(voxels.height, quantile)) if len(voxels) else math.nan


def density_ratio(before: Sequence[Thing], after: Sequence[Thing]) -> float:
    """Return the log of the points per voxel in *after* over those in *before*; 0 where one is empty."""
    counts = [
        sum(len(t.points) for t in things) / max(sum(len(t.voxels) for t in things), 1)
        for things in (before, after)
    ]
    return math.log(counts[1] / counts[0]) if min(counts) > 0 else 0.0


def make_record(
    change: ObjectChange, object_id: int, origin: Floats, evidence: str, trust: ConfidenceConfig
) -> ChangeRecord:
    """Turn an object into a row of the table, in world coordinates."""
    import shapely.affinity

    things = (*change.before, *change.after)
    xyz = np.concatenate([t.voxels.xyz for t in things])
    outline = footprint([t.voxels.xyz[:, :2] for t in things])
    m = change.measures
    heights = [height_of(things) for things in (change.before, change.after)]
    score = float(np.mean([t.score for t in things]))
    density = change.plant.density if change.plant else density_ratio(change.before, change.after)
    found = features(change.decision, m, change.semantic, score, density, evidence)
    certain = bounded(probability(change.decision, found, trust), change.decision, m)
    certain, reason = trusted(change.decision, things, certain)
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
        delta_v_low_m3=m.volume_bounds.low if m.volume_bounds else math.nan,
        delta_v_high_m3=m.volume_bounds.high if m.volume_bounds else math.nan,
        height_before_m=heights[0],
        height_after_m=heights[1],
    )
