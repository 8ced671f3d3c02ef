"""Decision on one object: its matched parts measured and labelled."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from scipy.spatial import cKDTree

from subiaco_change.association.costs import AssociationConfig
from subiaco_change.association.matching import match_kind
from subiaco_change.decisions.column_volumes import BUILT_UP, OpenGround, column_keys
from subiaco_change.decisions.config import DecisionConfig
from subiaco_change.decisions.driven_lane import decide_in_traffic, decide_shapeless, lane_share_of_claim
from subiaco_change.decisions.dynamic_objects import (
    Moved,
    Observed,
    OwnEpochEvidence,
    contrast_with_ground,
    doubt_of_porous,
    fits_a_vehicle,
    hides_no_ground,
    is_moving_object_trail,
    is_strip_on_road,
    may_be_a_person,
    shows_no_side,
)
from subiaco_change.decisions.measures import MeasureConfig, Measures, absence, measure, observed_fraction
from subiaco_change.decisions.plant_decisions import decide_plant
from subiaco_change.decisions.plant_measures import PlantConfig, measure_plant
from subiaco_change.decisions.plant_tops import expected_top
from subiaco_change.decisions.rules import Decision, decide, shown_volume
from subiaco_change.decisions.space_carving import Empty, Interval
from subiaco_change.decisions.trail_in_pieces import Surroundings, is_piece_of_trail
from subiaco_change.decisions.vegetation_null import PlantMeasures, no_null
from subiaco_change.decisions.voxel_objects import Certainty, Free, ObjectInstance, Voxels, join_voxels
from subiaco_change.geometry import in_box_around
from subiaco_change.instance_splitting.hedge_sections import NOTHING
from subiaco_change.instance_splitting.one_epoch_parts import decide_vehicle_part
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import no_decision, switchable
from subiaco_change.quantiles import quantile_of
from subiaco_change.segmentation.ground_model import Mask
from subiaco_geo.clouds import unique_cells
from subiaco_geo.codes import ONE_EPOCH, Change, Semantic
from subiaco_geo.frames import Floats, Ints

_FLAT_TOP = NUMBERS.object_decision.flat_top
_LAID_TOP = NUMBERS.object_decision.laid_top
_LEVEL = NUMBERS.object_decision.level_normal
_EVERY_VIEW = NUMBERS.object_decision.every_view
_BESIDE = NUMBERS.object_decision.beside_plant
_COLUMN = NUMBERS.object_decision.crown_column
_CROWN_TOP = NUMBERS.object_decision.crown_top
_CROWN_COLUMNS = NUMBERS.object_decision.crown_columns
_CUT_DEPTH = NUMBERS.object_decision.cut_depth
_CUT_SHARE = NUMBERS.object_decision.cut_share
_AROUND = NUMBERS.object_decision.around
_AROUND_COLUMN = NUMBERS.object_decision.around_column
_AROUND_COLUMNS = NUMBERS.object_decision.around_columns
_AROUND_POINTS = NUMBERS.object_decision.around_points
_AS_HIGH = NUMBERS.object_decision.as_high
_GOES_ON = NUMBERS.object_decision.goes_on
_GOES_ON_SHARE = NUMBERS.object_decision.goes_on_share
_FLOATING = NUMBERS.object_decision.floating
_LINE = NUMBERS.object_decision.line_height
_HELD = NUMBERS.object_decision.held
_SAME = NUMBERS.object_decision.same_point
_OF_PLANTS = (Change.UNCHANGED, Change.INCREASED, Change.DECREASED)  # labels on which other plants have a say


@dataclass(frozen=True)
class ObjectChange:
    """One object: its parts in both epochs, what was measured, and what was decided."""

    before: tuple[ObjectInstance, ...]
    after: tuple[ObjectInstance, ...]
    semantic: Semantic
    match_kind: str
    measures: Measures
    decision: Decision
    plant: PlantMeasures | None = None  # where the plants of the pair have a say in its label
    in_lane: float = 0.0  # fraction of a claim of one epoch that lies in the lane of a survey vehicle
    doubt: str = ""  # why a claim of one epoch may be a ghost trail

    @property
    def lod(self) -> float:
        """Median level of detection of its parts [m]."""
        return object_lod((*self.before, *self.after))

    def points(self, epoch: str) -> Ints:
        """Return the indices of its points in the cloud of an epoch, ``before`` or ``after``."""
        parts = [t.points for t in getattr(self, epoch)]
        return np.concatenate(parts) if parts else np.zeros(0, dtype=np.int64)


def object_lod(objects: Sequence[ObjectInstance]) -> float:
    """Median of the levels of detection of objects by their voxels [m]: a twig without one hides no house."""
    levels = np.array([t.lod for t in objects])
    order = np.argsort(levels)
    weight = np.cumsum([max(len(objects[i].voxels), 1) for i in order])
    return float(levels[order[int(np.searchsorted(weight, 0.5 * weight[-1]))]])


@dataclass(frozen=True)
class ObjectRules:
    """The slices of configuration that this stage reads."""

    measures: MeasureConfig
    association: AssociationConfig
    decisions: DecisionConfig
    by_class: bool = True  # objects of different classes are never one
    ground: OpenGround = BUILT_UP  # where nothing stands
    own: tuple[OwnEpochEvidence | None, OwnEpochEvidence | None] = (None, None)  # of *before* and of *after*
    standing: tuple[Floats, Floats] = (NOTHING, NOTHING)  # all points (N, 3) that stand, of any class
    free: tuple[Free | None, Free | None] = (None, None)  # what *before* and *after* know to be free
    above: tuple[Free | None, Free | None] = (None, None)  # the same above the tops of plants
    below_view: tuple[Empty | None, Empty | None] = (None, None)  # how high their views are known to reach
    certain: tuple[Certainty | None, Certainty | None] = (None, None)  # how certain these can be at most
    lanes: tuple[Observed, ...] = ()  # which places the survey vehicles of both epochs drove through
    moved: tuple[Moved | None, Moved | None] = (None, None)  # what *before* and *after* know to have moved
    around: tuple[Surroundings | None, Surroundings | None] = (None, None)  # what both hold farther around
    from_above: bool = False  # whether both epochs were measured from above
    plants: PlantConfig = field(default_factory=PlantConfig)


def decide_object(
    before: Sequence[ObjectInstance], after: Sequence[ObjectInstance], semantic: Semantic, rules: ObjectRules
) -> ObjectChange:
    """Measure and decide what the parts of one object in both epochs say together."""
    building = semantic is Semantic.BUILDING
    parts = (*before, *after)
    compared = _compared(before, after, semantic, rules)
    measures = measure(
        join_voxels(compared[0]), join_voxels(compared[1]), rules.measures, rules.ground, building
    )
    if not (before and after):
        measures = replace(measures, observed_fraction=_observed_fraction(parts, measures, rules))
    patch = rules.measures.patch_voxels
    measures = replace(measures, free=absence(before, after, rules.free, rules.certain, patch))
    lod = object_lod(parts)
    plant, matched = None, None
    if semantic is Semantic.VEGETATION and before and after:
        plant = measure_plant(
            *compared, measures, rules.plants, rules.standing, rules.free, rules.certain, rules.above
        )
        measures = _with_tops(measures, plant, lod)
        matched = partial(decide_plant, plant, lod, rules.decisions, no_null(rules.plants.null_model))
    decision = decide(semantic, bool(before), bool(after), measures, lod, rules.decisions, matched)
    if building and decision.change in (Change.INCREASED, Change.DECREASED):
        measures = replace(measures, delta_v=shown_volume(measures, rules.decisions.building).middle)
    if decision.change not in _OF_PLANTS or measures.iou <= rules.decisions.vegetation.min_iou:
        plant = None
    epoch = 0 if before else 1  # of an object of one epoch
    own = rules.own[epoch]
    doubt = ""
    if decision.change in ONE_EPOCH:
        contrast = contrast_with_ground(parts, semantic, own, rules.decisions)
        decision = (
            is_misclassified_ground(semantic, parts)
            or is_floating_line(parts, rules.standing[epoch], rules.decisions)
            or is_moving_object_trail(parts, semantic, own, rules.decisions, measures.free)
            or is_strip_on_road(parts, own, rules.decisions)
            or may_be_a_person(parts, semantic, own)
            or hides_no_ground(contrast)
            or shows_no_side(contrast)
            or decide_in_traffic(parts, rules.lanes, rules.moved[epoch], rules.decisions)
            or decide_shapeless(parts, semantic, rules.lanes, rules.decisions)
            or is_piece_of_trail(
                parts, semantic, own, rules.around[epoch], rules.around[1 - epoch], rules.decisions
            )
            or decide_vehicle_part(parts, semantic, measures, rules.standing[1 - epoch])
            or decision
        )
        if decision.change in ONE_EPOCH:
            doubt = doubt_of_porous(contrast, semantic)
    kind = match_kind(len(before), len(after))
    in_lane = lane_share_of_claim(decision, parts, rules.lanes, rules.decisions)
    sides = tuple(before), tuple(after)
    return ObjectChange(*sides, semantic, kind, measures, decision, plant, in_lane, doubt)


def _with_tops(measures: Measures, plant: PlantMeasures, lod: float) -> Measures:
    """Report the change of the height of a plant as that of the tops of its columns, where they are known."""
    if not math.isfinite(plant.rise):
        return measures
    half = math.hypot(1.96 * plant.rise_sigma, lod)
    return replace(measures, delta_h=plant.rise, height_bounds=Interval(plant.rise - half, plant.rise + half))


def _compared(
    before: Sequence[ObjectInstance], after: Sequence[ObjectInstance], semantic: Semantic, rules: ObjectRules
) -> tuple[Sequence[ObjectInstance], Sequence[ObjectInstance]]:
    """Parts of an object that are compared: of plants, those that the view of the other epoch reached.

    Of a plant of one epoch its own top tells whether a field of view ends in crowns. It may be the upper part
    of what the other epoch holds beside it; an isolated object was added, or removed, as a whole.
    """
    alone = not (before and after)
    if semantic is not Semantic.VEGETATION:
        return before, after
    if alone and not _adjoins((*before, *after), rules.standing[int(bool(before))]):
        return before, after
    return (
        _in_view(before, after or before, rules.below_view[1], rules.standing),
        _in_view(after, before or after, rules.below_view[0], rules.standing[::-1]),
    )


def _adjoins(objects: Sequence[ObjectInstance], standing: Floats) -> bool:
    """Tell whether standing points (N, 3) of the other epoch lie beside the points of objects."""
    xyz = np.concatenate([t.xyz for t in objects])
    near = standing[in_box_around(standing, xyz, _BESIDE)]
    return len(near) > 0 and float(cKDTree(xyz).query(near)[0].min()) <= _BESIDE


def _observed_fraction(parts: Sequence[ObjectInstance], measures: Measures, rules: ObjectRules) -> float:
    """Return the observed fraction of an object of one epoch, what the view may not have reached included.

    The lower part of a crown is enough to claim the crown, if that part is known to be free.
    """
    if not any(rules.below_view):
        return measures.observed_fraction
    return observed_fraction(join_voxels(parts), join_voxels(()), rules.measures)


def _all_parts(objects: Sequence[ObjectInstance], *_: object) -> list[ObjectInstance]:
    """Return the parts of a plant as they are."""
    return list(objects)


@switchable("view_height", _all_parts)
def _in_view(
    objects: Sequence[ObjectInstance],
    other: Sequence[ObjectInstance],
    below_view: Empty | None,
    standing: tuple[Floats, Floats],
) -> list[ObjectInstance]:
    """Parts of a plant, what is higher than the view of the other epoch reached not observed.

    Where the parts ``other`` of the plant show its top, the view reached that, unless what is ``standing``
    around in the own epoch goes on above the height at which it ends in the other one.
    """
    if not objects or below_view is None or all(below_view(t.xyz).all() for t in objects):
        return list(objects)
    if is_top_seen(other) and not goes_on_above(objects, other, standing):
        return list(objects)
    ceiling = max(float(t.xyz[:, 2].max()) for t in other)  # what is beside points is not above them
    found = []
    for instance in objects:
        voxels = instance.voxels
        known = _below_view(voxels, below_view) | (voxels.occupied_in_other & (voxels.xyz[:, 2] <= ceiling))
        limited = replace(
            voxels, observed=voxels.observed & known, free_space_confirmed=voxels.free_space_confirmed & known
        )
        slot = cKDTree(voxels.xyz).query(instance.xyz)[1]
        low = (voxels.height <= _EVERY_VIEW)[slot] | (instance.xyz[:, 2] <= ceiling)
        points = known[slot] & (low | below_view(instance.xyz))
        xyz = instance.xyz[points] if points.any() else instance.xyz
        found.append(replace(instance, voxels=limited, xyz=xyz))
    return found


def _below_view(voxels: Voxels, below_view: Empty) -> Mask:
    """Tell which voxels (M,) lie no higher than the view is known to reach, or than every view does."""
    return np.asarray((voxels.height <= _EVERY_VIEW) | below_view(voxels.xyz))


def is_top_seen(objects: Sequence[ObjectInstance]) -> bool:
    """Tell whether the points of a plant end at its top, and not where the field of view of a sensor ends.

    A crown is round: few of its columns reach its top. A field of view that ends in a crown cuts all columns
    at about the same height.
    """
    xyz = np.concatenate([t.xyz for t in objects])
    tops = _column_tops(xyz)
    top = quantile_of(tops, _CROWN_TOP)
    upper = tops[tops > 0.5 * (top + float(xyz[:, 2].min()))]
    return len(upper) >= _CROWN_COLUMNS and float(np.mean(upper >= top - _CUT_DEPTH)) < _CUT_SHARE


def goes_on_above(
    objects: Sequence[ObjectInstance], other: Sequence[ObjectInstance], standing: tuple[Floats, Floats]
) -> bool:
    """Tell whether what ends around a plant as high as the plant, in the other epoch, ends higher in its own.

    A plant that grew leaves the tops around as they are. A field of view that ends lower in one of two
    surveys lowers all tops that reach it, and the rings of its beams end at so many heights that cut crowns
    look round.

    Parameters
    ----------
    objects, other : sequence of ObjectInstance
        Parts of the plant in its own and in the other epoch.
    standing : (N, 3) and (M, 3) float64
        Points above the ground of both epochs, of any class [m].
    """
    plant = [np.concatenate([t.xyz for t in parts]) for parts in (objects, other)]
    whole = np.concatenate(plant)
    near = [xyz[in_box_around(xyz, whole, _AROUND)] for xyz in standing]
    if min(len(xyz) for xyz in near) == 0:
        return False
    columns, slot = unique_cells(_columns_of(np.concatenate(near)))
    slots = np.split(slot, [len(near[0])])
    fewest = np.min([np.bincount(s, minlength=len(columns)) for s in slots], axis=0)
    tops = [expected_top(xyz[:, 2], s, fewest) for xyz, s in zip(near, slots, strict=True)]
    beside = cKDTree(unique_cells(_columns_of(whole))[0]).query(columns)[0] > 1.5  # not even a corner touches
    level = (
        beside
        & (fewest >= _AROUND_POINTS)
        & (np.abs(tops[1] - quantile_of(_column_tops(plant[1]), _CROWN_TOP)) <= _AS_HIGH)
    )
    rises = (tops[0] - tops[1])[level]
    return len(rises) >= _AROUND_COLUMNS and float(np.mean(rises > _GOES_ON)) >= _GOES_ON_SHARE


def _columns_of(xyz: Floats) -> Ints:
    """Return the columns (N, 2) around a plant that points (N, 3) stand in."""
    return np.asarray(np.floor(xyz[:, :2] / _AROUND_COLUMN).astype(np.int64))


def _column_tops(xyz: Floats) -> Floats:
    """Heights (C,) of the tops of the columns of a plant of points (N, 3) [m]."""
    columns, slot = np.unique(column_keys(xyz, _COLUMN), return_inverse=True)
    tops = np.full(len(columns), -np.inf)
    np.maximum.at(tops, slot, xyz[:, 2])
    return tops


@switchable("misclassified_ground", no_decision)
def is_misclassified_ground(semantic: Semantic, objects: Sequence[ObjectInstance]) -> Decision | None:
    """Leave a low, level object to the comparison of the ground: it is ground with a wrong class."""
    voxels = join_voxels(objects)
    limit = _FLAT_TOP if semantic is Semantic.OTHER else _LAID_TOP
    if semantic is Semantic.BUILDING or float(np.quantile(voxels.height, 0.95)) > limit:
        return None
    level = float(np.abs(voxels.normal[:, 2]).mean())
    if level < _LEVEL:
        return None
    reason = (
        f"The top of the object lies {float(np.quantile(voxels.height, 0.95)):.2f} m above the ground (limit"
        f" {limit:.2f} m) and is level: the object is part of the ground, which is compared separately."
    )
    return Decision(Change.NOT_REPORTED, reason, 1.0)


@switchable("floating_scan_line", no_decision)
def is_floating_line(
    objects: Sequence[ObjectInstance], standing: Floats, rules: DecisionConfig
) -> Decision | None:
    """Claim nothing of a flat line of points above the ground that touches nothing: no object floats.

    One ring of one sweep met it. A standing object is met by other rings too: the roof of a vehicle
    that passed is not.

    Parameters
    ----------
    objects : sequence of ObjectInstance
        Of one epoch.
    standing : (N, 3) float64
        Points above the ground of that epoch, of any class, the objects included [m].
    rules : DecisionConfig
    """
    xyz = np.concatenate([t.xyz for t in objects])
    foot = float(min(t.voxels.height.min() for t in objects))
    low, high = np.quantile(xyz[:, 2], [0.05, 0.95]).tolist()
    if foot < _FLOATING or high - low > _LINE or not fits_a_vehicle(objects, rules):
        return None
    near = standing[in_box_around(standing, xyz, _HELD)]
    distance = cKDTree(xyz).query(near)[0]
    if np.any((distance > _SAME) & (distance <= _HELD)):
        return None
    reason = (
        f"The object is a line of points {high - low:.2f} m high (limit {_LINE:g} m), {foot:.1f} m above the"
        f" ground, and its own survey holds nothing else within {_HELD:g} m: a single scan line of something"
        " that may have passed, and nothing is claimed."
    )
    return Decision(Change.UNOBSERVED, reason, 0.0)
