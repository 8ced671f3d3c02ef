"""Objects of two epochs in one frame -> matched, measured, decided."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from subiaco_change.changes.apart import pieces_apart
from subiaco_change.changes.association import AssociationConfig, Match, associate, overlap_counts
from subiaco_change.changes.confidence import ConfidenceConfig, confidence, features, paper_score
from subiaco_change.changes.decisions import Decision, DecisionConfig, decide
from subiaco_change.changes.measures import (
    BUILT_UP,
    MeasureConfig,
    Measures,
    OpenGround,
    footprint,
    ground_columns,
    measure,
)
from subiaco_change.changes.objects import (
    EpochView,
    Reach,
    Thing,
    Voxels,
    build_things,
    build_voxels,
    looked_across,
)
from subiaco_change.changes.outline import compare_outlines
from subiaco_change.changes.parts import divided, part_things
from subiaco_change.changes.sections import Section, moved_sections, section_labels
from subiaco_change.changes.wings import built, find_wings
from subiaco_change.records import ChangeRecord
from subiaco_change.semantics.ground import Mask
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.frames import Floats, Ints

_FLAT_TOP = 0.6  # highest top of what may be ground raised or laid on it [m]
_LEVEL = 0.75  # mean upward part of its normals
_WHOLE = 0.75  # share of its columns from which on a hedge moved as a whole
_CLAIMS = (Change.ADDED, Change.REMOVED, Change.INCREASED, Change.DECREASED)
_BESIDE = 0.5  # so far beside a surface lies the next voxel of the visibility layer [m]
Observed = Callable[[Floats], Mask]


@dataclass(frozen=True)
class ObjectChange:
    """One object: its parts in both epochs, what was measured, and what was decided."""

    before: tuple[Thing, ...]
    after: tuple[Thing, ...]
    semantic: Semantic
    match_kind: str
    measures: Measures
    decision: Decision

    @property
    def lod(self) -> float:
        """Median level of detection of its parts [m]."""
        return object_lod((*self.before, *self.after))

    def points(self, epoch: str) -> Ints:
        """Return the indices of its points in the cloud of an epoch, ``before`` or ``after``."""
        parts = [t.points for t in getattr(self, epoch)]
        return np.concatenate(parts) if parts else np.zeros(0, dtype=np.int64)


def object_lod(things: Sequence[Thing]) -> float:
    """Median of the levels of detection of things by their voxels [m]: a twig without one hides no house."""
    levels = np.array([t.lod for t in things])
    order = np.argsort(levels)
    weight = np.cumsum([max(len(things[i].voxels), 1) for i in order])
    return float(levels[order[int(np.searchsorted(weight, 0.5 * weight[-1]))]])


@dataclass(frozen=True)
class ObjectRules:
    """The slices of configuration that this stage reads."""

    measures: MeasureConfig
    association: AssociationConfig
    decisions: DecisionConfig
    by_class: bool = True  # objects of different classes are never one
    ground: OpenGround = BUILT_UP  # where nothing stands
    own: tuple[Observed | None, Observed | None] = (None, None)  # what the surveys of *before*, *after* saw


def compare_objects(
    before: EpochView, after: EpochView, seen_by_before: Observed, seen_by_after: Observed, rules: ObjectRules
) -> list[ObjectChange]:
    """Match, measure and decide every object of two epochs in one local frame."""
    edge, tolerance = rules.measures.voxel, rules.measures.tolerance
    reach = Reach(rules.measures.same_low, rules.measures.same_high, rules.measures.same_factor)
    step = rules.measures.crossing
    bare = [ground_columns(v.xyz[v.semantic == Semantic.GROUND], edge) for v in (before, after)]
    rules = replace(rules, ground=OpenGround(bare[0], bare[1]), own=(seen_by_before, seen_by_after))
    things_b = build_things(before, build_voxels(before, after, seen_by_after, edge, reach, step))
    things_a = build_things(after, build_voxels(after, before, seen_by_before, edge, reach, step))
    things_b, things_a = (part_things(things, rules.association.parts) for things in (things_b, things_a))
    if rules.by_class:
        things_b, things_a = agree_on_classes(things_b, things_a, rules.association, tolerance)
    changes: list[ObjectChange] = []
    if not rules.by_class:
        matches = associate(things_b, things_a, rules.association, tolerance)
        return [_decide(m, things_b, things_a, _better(m, things_b, things_a), rules) for m in matches]
    for semantic in (Semantic.BUILDING, Semantic.VEGETATION, Semantic.MOBILE, Semantic.OTHER):
        of_b = [t for t in things_b if t.semantic is semantic]
        of_a = [t for t in things_a if t.semantic is semantic]
        matches = associate(of_b, of_a, rules.association, tolerance)
        changes.extend(_decide(match, of_b, of_a, semantic, rules) for match in matches)
    changes = part_company(changes, rules)
    changes = tell_apart(changes, rules)
    changes = part_sections(changes, rules)
    changes = join_wings(changes, rules)
    return adopt_fragments(changes, things_b, things_a, rules.association, tolerance)


def join_wings(changes: list[ObjectChange], rules: ObjectRules) -> list[ObjectChange]:
    """Make wings built onto a building, or taken from it, one object with it, and decide it anew.

    A wing seen from few sides may have passed for a vehicle or a plant: what is built tells.
    """
    numbers = [
        i
        for i, change in enumerate(changes)
        if (change.semantic is Semantic.BUILDING and change.decision.change is not Change.UNOBSERVED)
        or (
            change.semantic in (Semantic.MOBILE, Semantic.VEGETATION, Semantic.OTHER)
            and change.decision.change in (Change.ADDED, Change.REMOVED)
            and built(_join((*change.before, *change.after)))
        )
    ]
    if rules.association.parts.points == 0:
        return changes
    pairs = [(_join(changes[i].before), _join(changes[i].after)) for i in numbers]
    wings = {numbers[w]: numbers[h] for w, h in find_wings(pairs, rules.association.parts).items()}
    joined = list(changes)
    for host in sorted(set(wings.values())):
        parts = [changes[host], *(changes[w] for w, h in wings.items() if h == host)]
        before, after = ([t for part in parts for t in getattr(part, e)] for e in ("before", "after"))
        joined[host] = _decide(Match(_all(before), _all(after)), before, after, Semantic.BUILDING, rules)
    return [change for i, change in enumerate(joined) if i not in wings]


def part_company(changes: Sequence[ObjectChange], rules: ObjectRules) -> list[ObjectChange]:
    """Take what was matched and hardly overlaps for two things: one is slight, the other came or went.

    A fence that a house was built around lies inside the house, and is no house.
    """
    told: list[ObjectChange] = []
    for change in changes:
        alone = [change]
        sizes = [sum(len(t.voxels) for t in things) for things in (change.before, change.after)]
        slight = 0 < min(sizes) < rules.association.parts.remainder * max(sizes)
        if slight and change.measures.iou <= _least_overlap(change.semantic, rules):
            b, a = change.before, change.after
            alone = [
                _decide(Match(_all(b), ()), b, (), change.semantic, rules),
                _decide(Match((), _all(a)), (), a, change.semantic, rules),
            ]
        fared = {part.decision.change for part in alone}
        told.extend(alone if fared & {Change.ADDED, Change.REMOVED} else [change])
    return told


def _least_overlap(semantic: Semantic, rules: ObjectRules) -> float:
    """Overlap up to which two matched objects of a class are not compared; -1 where they always are."""
    if semantic is Semantic.BUILDING:
        return rules.decisions.building.min_iou
    return rules.decisions.vegetation.min_iou if semantic is Semantic.VEGETATION else -1.0


def tell_apart(changes: Sequence[ObjectChange], rules: ObjectRules) -> list[ObjectChange]:
    """Decide the bodies of a split or merge one by one where they did not fare alike."""
    following = 1 + max((t.instance for c in changes for t in (*c.before, *c.after)), default=0)
    told: list[ObjectChange] = []
    for change in changes:
        pieces = pieces_apart(change.before, change.after, rules.association, following)
        if len(pieces) == 1:
            told.append(change)
            continue
        parts = [_decide(Match(_all(b), _all(a)), b, a, change.semantic, rules) for b, a in pieces]
        labels = {part.decision.change for part in parts}
        told.extend(parts if len(labels) > 1 and not labels.isdisjoint(_CLAIMS) else [change])
        following += sum(len(p.before) + len(p.after) for p in parts)
    return told


def part_sections(changes: Sequence[ObjectChange], rules: ObjectRules) -> list[ObjectChange]:
    """Give the sections of hedges whose tops moved rows of their own, or the whole where nearly all did."""
    if rules.association.parts.points == 0:
        return list(changes)
    following = 1 + max((t.instance for c in changes for t in (*c.before, *c.after)), default=0)
    parted: list[ObjectChange] = []
    for change in changes:
        pieces = _sections(change, following, rules)
        parted.extend(pieces)
        following += sum(len(p.before) + len(p.after) for p in pieces)
    return parted


def _sections(change: ObjectChange, following: int, rules: ObjectRules) -> list[ObjectChange]:
    if change.semantic is not Semantic.VEGETATION or not (change.before and change.after):
        return [change]
    limit = max(rules.decisions.vegetation.height, rules.decisions.lod_factor * change.lod)
    sections, columns = moved_sections(change.before, change.after, limit)
    if not sections:
        return [change]
    decisions = [_moved_top(section) for section in sections]
    if sum(len(s.xy) for s in sections) >= _WHOLE * len(columns):
        largest = decisions[int(np.argmax([len(s.xy) for s in sections]))]
        return [replace(change, decision=largest) if change.decision.change is Change.UNCHANGED else change]
    sides: list[list[list[Thing]]] = []
    for things in (change.before, change.after):
        side: list[list[Thing]] = [[] for _ in range(len(sections) + 1)]
        for thing in things:
            numbers, labels = np.unique(section_labels(thing, sections, columns), return_inverse=True)
            for number, piece in zip(numbers.tolist(), divided(thing, labels, following), strict=True):
                side[number].append(piece)
            following += len(numbers)
        sides.append(side)
    pieces = [
        _decide(Match(_all(b), _all(a)), b, a, change.semantic, rules)
        for b, a in zip(*sides, strict=True)
        if b or a
    ]
    if len(pieces) <= len(sections) or not all(p.before and p.after for p in pieces):
        return [change]
    return [pieces[0], *(replace(p, decision=d) for p, d in zip(pieces[1:], decisions, strict=True))]


def _moved_top(section: Section) -> Decision:
    change = Change.INCREASED if section.rise > 0 else Change.DECREASED
    reason = f"top {section.rise:+.2f} m (gate {section.gate:.2f}) over {0.25 * len(section.xy):.0f} m2"
    return Decision(change, reason, abs(section.rise) / section.gate)


def _all(things: Sequence[Thing]) -> tuple[int, ...]:
    return tuple(range(len(things)))


def _better(match: Match, things_b: Sequence[Thing], things_a: Sequence[Thing]) -> Semantic:
    """Class of the better-scored part of a match."""
    parts = [*(things_b[i] for i in match.before), *(things_a[j] for j in match.after)]
    return max(parts, key=lambda t: t.score).semantic


def adopt_fragments(
    changes: list[ObjectChange],
    things_b: Sequence[Thing],
    things_a: Sequence[Thing],
    config: AssociationConfig,
    tolerance: float,
) -> list[ObjectChange]:
    """Let left-over fragments join the changed object that the other epoch holds in their place.

    A part of a wall may look like a hedge in one epoch: its class keeps it
    from its partner, its place does not, and every point of a changed object
    carries its label. Statistics stay those of the object without them.
    """
    if not things_b or not things_a:
        return changes
    overlaps = overlap_counts(things_b, things_a, tolerance)
    slots = [{t.instance: i for i, t in enumerate(things)} for things in (things_b, things_a)]
    hosts = {
        (epoch, part.instance): number
        for number, change in enumerate(changes)
        if change.decision.change in (Change.INCREASED, Change.DECREASED)
        for epoch, parts in enumerate((change.before, change.after))
        for part in parts
    }
    joined: dict[int, list[int]] = {}
    for number, change in enumerate(changes):
        if change.match_kind != "none" or change.decision.change is not Change.UNCHANGED:
            continue
        epoch = 0 if change.before else 1
        part = (*change.before, *change.after)[0]
        row = overlaps[epoch][[slots[epoch][part.instance]], :].tocoo()
        if row.nnz == 0 or row.data.max() <= config.contained * len(part.voxels):
            continue
        other = (things_a, things_b)[epoch][int(row.col[row.data.argmax()])]
        host = hosts.get((1 - epoch, other.instance))
        if host is not None:
            joined.setdefault(host, []).append(number)
    gone = {number for numbers in joined.values() for number in numbers}
    return [
        _with_parts(change, [changes[k] for k in joined.get(number, [])])
        for number, change in enumerate(changes)
        if number not in gone
    ]


def _with_parts(change: ObjectChange, fragments: Sequence[ObjectChange]) -> ObjectChange:
    before = (*change.before, *(t for f in fragments for t in f.before))
    after = (*change.after, *(t for f in fragments for t in f.after))
    kind = Match(tuple(range(len(before))), tuple(range(len(after)))).kind
    return replace(change, before=before, after=after, match_kind=kind)


def agree_on_classes(
    before: list[Thing], after: list[Thing], config: AssociationConfig, tolerance: float
) -> tuple[list[Thing], list[Thing]]:
    """Give one thing one class (C6): where two objects mostly coincide, the better score wins."""
    if not before or not after:
        return before, after
    forward, backward = overlap_counts(before, after, tolerance)
    before, after = list(before), list(after)
    common = forward.multiply(backward.T).tocoo()
    for i, j in zip(common.row.tolist(), common.col.tolist(), strict=True):
        b, a = before[i], after[j]
        if b.semantic is a.semantic:
            continue
        shares = (forward[i, j] / len(b.voxels), backward[j, i] / len(a.voxels))
        if min(shares) < config.same_place:
            continue
        winner = b.semantic if b.score >= a.score else a.semantic
        before[i], after[j] = replace(b, semantic=winner), replace(a, semantic=winner)
    return before, after


def _decide(
    match: Match, things_b: Sequence[Thing], things_a: Sequence[Thing], semantic: Semantic, rules: ObjectRules
) -> ObjectChange:
    before = tuple(things_b[i] for i in match.before)
    after = tuple(things_a[j] for j in match.after)
    measures = measure(_join(before), _join(after), rules.measures, rules.ground)
    if semantic is Semantic.VEGETATION and before and after:
        first, second = (np.concatenate([t.xyz for t in things]) for things in (before, after))
        measures = replace(measures, outline=compare_outlines(first, second, rules.measures.outline))
    lod = object_lod((*before, *after))
    decision = decide(semantic, bool(before), bool(after), measures, lod, rules.decisions)
    if decision.change in (Change.ADDED, Change.REMOVED):
        things = (*before, *after)
        through = _looked_through(things, rules.own[0] if before else rules.own[1])
        decision = lies_flat(semantic, things) or drove_by(things, through, rules.decisions) or decision
    return ObjectChange(before, after, semantic, match.kind, measures, decision)


def lies_flat(semantic: Semantic, things: Sequence[Thing]) -> Decision | None:
    """Leave a low, level thing of no class to the ground's comparison: it is ground told wrong."""
    voxels = _join(things)
    if semantic is not Semantic.OTHER or float(np.quantile(voxels.height, 0.95)) > _FLAT_TOP:
        return None
    level = float(np.abs(voxels.normal[:, 2]).mean())
    if level < _LEVEL:
        return None
    return Decision(Change.NOT_REPORTED, "lies flat on the ground, which is compared by itself", 1.0)


def drove_by(things: Sequence[Thing], through: float, rules: DecisionConfig) -> Decision | None:
    """Tell a trail from a thing: low, and its own survey looked through all of it.

    ``through`` is the share of the surface on both sides of which that survey looked: where this is
    nearly all of it, fewer beams suffice, for what stands lets none go on behind it.
    """
    top = max(float(t.voxels.height.max()) for t in things)
    passed = min(float(np.quantile(t.passed, 0.25)) if len(t.passed) else 0.0 for t in things)
    enough = rules.trail_passes_through if through >= rules.trail_through else rules.trail_passes
    if top > rules.trail_top or passed < enough:
        return None
    reason = f"drove by while it was mapped: {passed:.1f} beams passed for each that returned"
    return Decision(Change.NOT_REPORTED, reason, passed / enough)


def _looked_through(things: Sequence[Thing], own: Observed | None) -> float:
    """Share of the surface of things on both sides of which their own survey looked."""
    if own is None:
        return 1.0
    voxels = _join(things)
    return float(looked_across(voxels.xyz, voxels.normal, own, _BESIDE).mean())


def _join(things: Sequence[Thing]) -> Voxels:
    """Concatenate the voxels of the parts of an object."""
    if not things:
        flags = np.zeros(0, dtype=bool)
        return Voxels(
            np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), flags, flags, flags
        )
    names = Voxels.__dataclass_fields__
    return Voxels(*(np.concatenate([getattr(t.voxels, name) for t in things]) for name in names))


def make_record(
    change: ObjectChange, object_id: int, origin: Floats, evidence: str, trust: ConfidenceConfig
) -> ChangeRecord:
    """Turn an object into a row of the table, in world coordinates."""
    import shapely.affinity

    things = (*change.before, *change.after)
    xyz = np.concatenate([t.voxels.xyz for t in things])
    outline = footprint([t.voxels.xyz[:, :2] for t in things])
    m = change.measures
    score = float(np.mean([t.score for t in things]))
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
        confidence=confidence(change.decision, m, change.semantic, score, trust),
        n_before=int(sum(len(t.points) for t in change.before)),
        n_after=int(sum(len(t.points) for t in change.after)),
        x=float(xyz[:, 0].mean() + origin[0]),
        y=float(xyz[:, 1].mean() + origin[1]),
        z=float(xyz[:, 2].mean() + origin[2]),
        footprint=shapely.affinity.translate(outline, float(origin[0]), float(origin[1])),
        reason=change.decision.reason,
        features=tuple(features(change.decision, m, change.semantic, score).tolist()),
    )
