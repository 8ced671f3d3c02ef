"""One object of two epochs, its parts matched: measured, and decided."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from subiaco_change.changes.association import match_kind
from subiaco_change.changes.association_costs import AssociationConfig
from subiaco_change.changes.decisions import Decision, DecisionConfig, decide
from subiaco_change.changes.measures import (
    BUILT_UP,
    MeasureConfig,
    Measures,
    OpenGround,
    measure,
    oriented_rectangle,
)
from subiaco_change.changes.objects import Thing, join_voxels, looked_across
from subiaco_change.changes.outline import compare_outlines
from subiaco_change.changes.sections import NOTHING
from subiaco_change.semantics.ground import Mask
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.frames import Floats, Ints

_FLAT_TOP = 0.6  # highest top of what has no class and may be ground raised or laid on it [m]
_LAID_TOP = 0.25  # the same of a supposed vehicle or plant: no more than ground strays from its model
_LEVEL = 0.75  # mean upward part of its normals
_ACROSS = 0.125  # share of a part that the other epoch must have looked across
_VEHICLE = 1.5  # least width of a vehicle, or of the part of it that was seen [m]
_NEXT = 0.75  # so far from points of the other epoch, a voxel lies beside them [m]
_HELD = 0.5  # share of its voxels from which on a part lies beside them
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
    standing: tuple[Floats, Floats] = (NOTHING, NOTHING)  # all points (N, 3) that stand, of any class


def decide_object(
    before: Sequence[Thing], after: Sequence[Thing], semantic: Semantic, rules: ObjectRules
) -> ObjectChange:
    """Measure and decide what the parts of one object in both epochs say together."""
    measures = measure(join_voxels(before), join_voxels(after), rules.measures, rules.ground)
    if semantic is Semantic.VEGETATION and before and after:
        first, second = (np.concatenate([t.xyz for t in things]) for things in (before, after))
        measures = replace(measures, outline=compare_outlines(first, second, rules.measures.outline))
    lod = object_lod((*before, *after))
    decision = decide(semantic, bool(before), bool(after), measures, lod, rules.decisions)
    if decision.change in (Change.ADDED, Change.REMOVED):
        things = (*before, *after)
        through = _looked_through(things, rules.own[0] if before else rules.own[1])
        decision = (
            lies_flat(semantic, things)
            or drove_by(things, through, rules.decisions)
            or _grazed(semantic, things, measures)
            or longer_vehicle(semantic, things, rules.standing[int(bool(before))])
            or decision
        )
    kind = match_kind(len(before), len(after))
    return ObjectChange(tuple(before), tuple(after), semantic, kind, measures, decision)


def lies_flat(semantic: Semantic, things: Sequence[Thing]) -> Decision | None:
    """Leave a low, level thing to the ground's comparison: it is ground told wrong."""
    voxels = join_voxels(things)
    limit = _FLAT_TOP if semantic is Semantic.OTHER else _LAID_TOP
    if semantic is Semantic.BUILDING or float(np.quantile(voxels.height, 0.95)) > limit:
        return None
    level = float(np.abs(voxels.normal[:, 2]).mean())
    if level < _LEVEL:
        return None
    return Decision(Change.NOT_REPORTED, "lies flat on the ground, which is compared by itself", 1.0)


def _grazed(semantic: Semantic, things: Sequence[Thing], measures: Measures) -> Decision | None:
    """Leave a part of a vehicle open where the other epoch hardly looked across: beams graze what stands."""
    across = 0.5 * abs(measures.carried) / max(measures.gone_share, measures.new_share)
    if across >= _ACROSS or semantic is not Semantic.MOBILE or any(t.whole < 0 for t in things):
        return None
    reason = f"a part of a vehicle that the other epoch grazed: it looked across {across:.0%} of it"
    return Decision(Change.UNOBSERVED, reason, 1.0 - across)


def longer_vehicle(semantic: Semantic, things: Sequence[Thing], standing: Floats) -> Decision | None:
    """Tell the part that a vehicle is longer or higher by than another in its place from a vehicle.

    It is narrower than a vehicle, and beside it stand points (N, 3) of the other epoch.
    """
    if semantic is not Semantic.MOBILE or any(t.whole < 0 for t in things):
        return None
    xyz = join_voxels(things).xyz
    corners = np.array(oriented_rectangle(xyz[:, :2]).exterior.coords)
    if np.linalg.norm(np.diff(corners[:3], axis=0), axis=1).min() >= _VEHICLE:
        return None
    around = ((standing >= xyz.min(axis=0) - _NEXT) & (standing <= xyz.max(axis=0) + _NEXT)).all(axis=1)
    if not around.any():
        return None
    held = float(np.mean(cKDTree(standing[around]).query(xyz)[0] <= _NEXT))
    reason = f"a part of a vehicle, {held:.0%} of it beside what stands there in the other epoch"
    return Decision(Change.UNCHANGED, reason, held) if held >= _HELD else None


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
    voxels = join_voxels(things)
    return float(looked_across(voxels.xyz, voxels.normal, own, _BESIDE).mean())
