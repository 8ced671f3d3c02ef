"""Decision on one object: its matched parts measured and labelled."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from scipy.spatial import cKDTree

from subiaco_change.association.config import AssociationConfig
from subiaco_change.association.matching import match_kind
from subiaco_change.decisions.config import DecisionConfig
from subiaco_change.decisions.driven_lane import decide_in_traffic, lane_share_of_claim
from subiaco_change.decisions.dynamic_objects import (
    Moved,
    Observed,
    OwnEpochEvidence,
    decide_moving_object_trail,
    fits_a_vehicle,
)
from subiaco_change.decisions.plant_decisions import decide_plant
from subiaco_change.decisions.plant_measures import PlantConfig, measure_plant
from subiaco_change.decisions.rules import Decision, decide, shown_volume
from subiaco_change.decisions.trail_in_pieces import Surroundings, decide_piece_of_trail
from subiaco_change.decisions.trail_shapes import (
    contrast_with_ground,
    decide_by_ground_beneath,
    decide_by_side,
    decide_person_on_the_way,
    decide_strip_on_road,
    doubt_of_porous,
    is_standing_car,
)
from subiaco_change.decisions.vegetation_null import PlantMeasures, no_null
from subiaco_change.decisions.view_of_crowns import within_view
from subiaco_change.geometry import in_box_around
from subiaco_change.instance_splitting.building_extensions import is_open_roof
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import never, no_decision, switchable
from subiaco_change.objects.column_volumes import BUILT_UP, OpenGround
from subiaco_change.objects.known_space import ALL_FREE, KnownSpaces
from subiaco_change.objects.measures import (
    MeasureConfig,
    Measures,
    absence,
    footprint_sides,
    measure,
    observed_fraction,
)
from subiaco_change.objects.space_carving import Interval, are_level
from subiaco_change.objects.voxel_objects import ObjectInstance, join_voxels
from subiaco_change.segmentation.config import VehicleConfig
from subiaco_geo.codes import ONE_EPOCH, Change, Semantic
from subiaco_geo.frames import Floats, Ints

_FLAT_TOP = NUMBERS.object_decision.flat_top
_LAID_TOP = NUMBERS.object_decision.laid_top
_LEVEL = NUMBERS.object_decision.level_normal
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
    spaces: KnownSpaces = ALL_FREE  # what *before* and *after* know of the space around
    lanes: tuple[Observed, ...] = ()  # which places the survey vehicles of both epochs drove through
    own: tuple[OwnEpochEvidence | None, OwnEpochEvidence | None] = (None, None)  # of *before* and of *after*
    moved: tuple[Moved | None, Moved | None] = (None, None)  # what *before* and *after* know to have moved
    around: tuple[Surroundings | None, Surroundings | None] = (None, None)  # what both hold farther around
    from_above: bool = False  # whether both epochs were measured from above
    plants: PlantConfig = field(default_factory=PlantConfig)
    vehicles: VehicleConfig = field(default_factory=VehicleConfig)


def decide_object(
    before: Sequence[ObjectInstance], after: Sequence[ObjectInstance], semantic: Semantic, rules: ObjectRules
) -> ObjectChange:
    """Measure and decide what the parts of one object in both epochs say together."""
    building = semantic is Semantic.BUILDING
    parts = (*before, *after)
    compared = within_view(before, after, semantic, rules.spaces)
    measures = measure(
        join_voxels(compared[0]), join_voxels(compared[1]), rules.measures, rules.ground, building
    )
    if not (before and after):
        measures = replace(measures, observed_fraction=_observed_fraction(parts, measures, rules))
    free = absence(before, after, rules.spaces, rules.measures.patch_voxels)
    measures = replace(measures, free=free)
    lod = object_lod(parts)
    plant, matched = None, None
    if semantic is Semantic.VEGETATION and before and after:
        plant = measure_plant(*compared, measures, rules.plants, rules.spaces)
        measures = _with_tops(measures, plant, lod)
        matched = partial(decide_plant, plant, lod, rules.decisions, no_null(rules.plants.null_model))
    roof = building and is_roof_on_posts(before, after, rules)
    fixed = semantic is Semantic.OTHER and all(is_fixed(side, rules.decisions) for side in (before, after))
    sides = bool(before), bool(after)
    decision = decide(semantic, *sides, measures, lod, rules.decisions, matched, roof, fixed)
    if building and decision.change in (Change.INCREASED, Change.DECREASED):
        measures = replace(measures, delta_v=shown_volume(measures, rules.decisions.building).middle)
    if decision.change not in _OF_PLANTS or measures.iou <= rules.decisions.vegetation.min_iou:
        plant = None
    epoch = 0 if before else 1  # of an object of one epoch
    own = rules.own[epoch]
    doubt = ""
    if decision.change in ONE_EPOCH:
        # The evidence for rules of shape: a standing car is no ghost trail by its shape.
        shape = None if is_standing_car(parts, semantic, rules.vehicles) else own
        contrast = contrast_with_ground(parts, semantic, shape, rules.decisions)
        decision = (
            decide_misclassified_ground(semantic, parts)
            or decide_floating_line(parts, rules.spaces[epoch].standing, rules.decisions)
            or decide_moving_object_trail(parts, semantic, own, rules.decisions, measures.free)
            or decide_strip_on_road(parts, shape, rules.decisions)
            or decide_person_on_the_way(parts, semantic, shape)
            or decide_by_ground_beneath(contrast)
            or decide_by_side(contrast)
            or decide_in_traffic(parts, rules.lanes, rules.moved[epoch], rules.decisions)
            or decide_piece_of_trail(
                parts, semantic, shape, rules.around[epoch], rules.around[1 - epoch], rules.decisions
            )
            or decision
        )
        if decision.change in ONE_EPOCH:
            doubt = doubt_of_porous(contrast, semantic)
    kind = match_kind(len(before), len(after))
    in_lane = lane_share_of_claim(decision, parts, rules.lanes, rules.decisions)
    return ObjectChange(
        tuple(before), tuple(after), semantic, kind, measures, decision, plant, in_lane, doubt
    )


@switchable("fixed_objects", never)
def is_fixed(objects: Sequence[ObjectInstance], config: DecisionConfig) -> bool:
    """Tell whether objects of one epoch are longer or taller than movable ones: a fence, a wall or a pole."""
    voxels, limits = join_voxels(objects), config.mobile
    if len(voxels) == 0:
        return False
    length = float(np.linalg.norm(np.ptp(voxels.xyz[:, :2], axis=0)))
    return length > limits.longest or float(voxels.height.max()) > limits.tallest


def is_roof_on_posts(
    before: Sequence[ObjectInstance], after: Sequence[ObjectInstance], rules: ObjectRules
) -> bool:
    """Tell the roof of a carport that one epoch alone has from a fragment of a wall or of eaves.

    It is level and wide, and nothing is enclosed below it.
    """
    if before and after:
        return False
    voxels, bare = join_voxels((*before, *after)), rules.ground.bare(0 if before else 1)
    width = footprint_sides(voxels.xyz)[0] + rules.ground.cell  # places are middles of cells
    wide = width >= rules.measures.carving.roof_width
    return wide and bool(are_level(voxels).mean() > 0.5) and is_open_roof(voxels, bare)


def _with_tops(measures: Measures, plant: PlantMeasures, lod: float) -> Measures:
    """Report the change of the height of a plant as that of the tops of its columns, where they are known."""
    if not math.isfinite(plant.rise):
        return measures
    half = math.hypot(1.96 * plant.rise_sigma, lod)
    return replace(measures, delta_h=plant.rise, height_bounds=Interval(plant.rise - half, plant.rise + half))


def _observed_fraction(parts: Sequence[ObjectInstance], measures: Measures, rules: ObjectRules) -> float:
    """Return the observed fraction of an object of one epoch, what the view may not have reached included.

    The lower part of a crown is enough to claim the crown, if that part is known to be free.
    """
    if all(space.below_view is None for space in rules.spaces):
        return measures.observed_fraction
    return observed_fraction(join_voxels(parts), join_voxels(()), rules.measures)


@switchable("misclassified_ground", no_decision)
def decide_misclassified_ground(semantic: Semantic, objects: Sequence[ObjectInstance]) -> Decision | None:
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
def decide_floating_line(
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
