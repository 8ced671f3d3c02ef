"""Ghost trails of moving objects, distinguished from standing objects by the beams that crossed them.

Trails that the semantics did not detect look like plants, walls or fragments of one epoch alone. Their own
survey saw them pass: beams went through each place before and after. But beams also graze what is thinner
than a voxel or ends below the sensor, so that a hedge lets by as many as the trail of a slow lorry.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from subiaco_change.decisions.config import DecisionConfig
from subiaco_change.decisions.rules import Decision
from subiaco_change.decisions.voxel_objects import (
    NO_OBJECT,
    EpochView,
    ObjectInstance,
    is_ghost_trail,
    join_voxels,
    observed_on_both_sides,
)
from subiaco_change.geometry import in_box_around
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import always, applies, no_decision, switchable
from subiaco_change.segmentation.ground_model import Mask
from subiaco_geo.codes import ONE_EPOCH, Change, Semantic
from subiaco_geo.frames import Floats, Ints

Observed = Callable[[Floats], Mask]
Moved = Callable[[Floats], Floats]
_BESIDE = NUMBERS.dynamic_objects.visibility_step
_LANE = NUMBERS.dynamic_objects.lane_reach
_WITHIN = NUMBERS.dynamic_objects.lane_share
_WALL = NUMBERS.dynamic_objects.wall_contact
_TRAIL_WIDTH = NUMBERS.dynamic_objects.trail_width
_ALONE = NUMBERS.dynamic_objects.strip_length
_NARROW = NUMBERS.dynamic_objects.strip_width
_ROAD = NUMBERS.dynamic_objects.road_beneath
_PERSON_WIDTH = NUMBERS.dynamic_objects.person_width
_PERSON_TOP = NUMBERS.dynamic_objects.person_top
_PERSON_GROUND = NUMBERS.dynamic_objects.person_ground
_PERSON_FOOT = NUMBERS.dynamic_objects.person_foot
_SEEN_BENEATH = NUMBERS.dynamic_objects.ground_beneath
_FILLED = NUMBERS.dynamic_objects.opaque_points
_HIDES_NOTHING = NUMBERS.dynamic_objects.ground_unhidden
_SIDE = NUMBERS.dynamic_objects.side_points
_SHOWN_BENEATH = NUMBERS.dynamic_objects.ground_shown
_CELL = NUMBERS.dynamic_objects.footprint_cell
_RING = NUMBERS.dynamic_objects.ring_cells
_WALKED = NUMBERS.dynamic_objects.walked_length
_PIECE = NUMBERS.dynamic_objects.piece_reach
_PIECES = 40  # of a strip of which the width is measured


@dataclass(frozen=True)
class OwnEpochEvidence:
    """What the survey of an epoch itself knows of the places where its objects stand.

    ``observed`` tells which places (N, 3) it saw; ``traffic`` holds the trails it is sure of, ``buildings``
    the points of buildings, whose instances (B,) are ``building_of``; ``ground`` (G, 2) the ground points,
    where nothing counted beams.
    """

    observed: Observed
    traffic: cKDTree
    buildings: cKDTree | None = None
    building_of: Ints | None = None
    ground: cKDTree | None = None

    def through(self, objects: Sequence[ObjectInstance]) -> float:
        """Share of the surface of objects on both sides of which the survey looked."""
        voxels = join_voxels(objects)
        return float(observed_on_both_sides(voxels.xyz, voxels.normal, self.observed, _BESIDE).mean())

    def in_lane(self, objects: Sequence[ObjectInstance]) -> bool:
        """Tell whether objects lie where traffic is known to have passed."""
        places = np.concatenate([t.xyz for t in objects])
        distance = self.traffic.query(places, distance_upper_bound=_LANE)[0]
        return bool(np.isfinite(distance).mean() >= _WITHIN)

    def adjoins_building(self, objects: Sequence[ObjectInstance]) -> bool:
        """Tell whether objects touch another building over the height of a wall: vehicles keep clear."""
        if self.buildings is None or self.building_of is None or self.buildings.n == 0:
            return False
        places = np.concatenate([t.xyz for t in objects])
        near = self.buildings.query_ball_point(places, _BESIDE)
        slot = np.repeat(np.arange(len(places)), [len(n) for n in near])
        found = np.concatenate([np.asarray(n, dtype=np.int64) for n in near])
        other = ~np.isin(self.building_of[found], [t.instance for t in objects])
        heights = places[np.unique(slot[other]), 2]
        return len(heights) > 0 and float(np.ptp(heights)) >= _WALL


def own_epoch_evidence(view: EpochView, observed: Observed) -> OwnEpochEvidence:
    """Gather what the survey of an epoch knows of itself."""
    building = (view.semantic == Semantic.BUILDING) & (view.instance != NO_OBJECT)
    return OwnEpochEvidence(
        observed,
        cKDTree(view.xyz[is_ghost_trail(view)]),
        cKDTree(view.xyz[building]),
        view.instance[building].astype(np.int64),
        cKDTree(view.xyz[view.semantic == Semantic.GROUND, :2]) if view.passed is None else None,
    )


@switchable("strip_on_road", no_decision)
def is_strip_on_road(
    objects: Sequence[ObjectInstance], own: OwnEpochEvidence | None, rules: DecisionConfig
) -> Decision | None:
    """Tell a strip as wide as a vehicle, and longer, from a hedge or a wall by the road seen beneath it.

    A vehicle hides the road for a moment, a standing object for the whole survey.
    """
    if own is None or own.ground is None or own.ground.n == 0 or not fits_a_vehicle(objects, rules):
        return None
    places = np.concatenate([t.xyz for t in objects])[:, :2]
    length, width = strip_of(places)
    if length < _ALONE or not _NARROW <= width <= _TRAIL_WIDTH:
        return None
    beneath = _road_beneath(places, own.ground.data)
    if beneath < _ROAD:
        return None
    reason = (
        f"The object is a strip {length:.1f} m long and {width:.1f} m wide (limits {_ALONE:g} m and"
        f" {_NARROW:g} to {_TRAIL_WIDTH:g} m), and its own survey saw the ground beneath with"
        f" {beneath:.0%} of the points beside it (limit {_ROAD:.0%}): the ghost trail of a moving vehicle."
    )
    return Decision(Change.NOT_REPORTED, reason, beneath / _ROAD)


@switchable("person_on_the_way", no_decision)
def may_be_a_person(
    objects: Sequence[ObjectInstance], semantic: Semantic, own: OwnEpochEvidence | None
) -> Decision | None:
    """Tell a strip as thin and as tall as a person, in a cloud without counts of beams.

    People walk and cycle. A fence is thinner, most hedges are wider and hide the ground; between these, shape
    does not tell.
    """
    if own is None or own.ground is None or semantic not in (Semantic.VEGETATION, Semantic.OTHER):
        return None
    xy = np.concatenate([t.xyz for t in objects])[:, :2]
    length, width = strip_of(xy)[0], _local_width(xy)
    foot, top = np.quantile(np.concatenate([t.voxels.height for t in objects]), [0.05, 0.95])
    thin = _PERSON_WIDTH[0] <= width <= _PERSON_WIDTH[1] and length >= _WALKED
    if not thin or foot > _PERSON_FOOT or not _PERSON_TOP[0] <= top <= _PERSON_TOP[1]:
        return None
    if _road_beneath(xy, own.ground.data) < _PERSON_GROUND:
        return None
    reason = (
        f"The object is a strip {length:.1f} m long, {width:.1f} m wide and {top:.1f} m high, and the cloud"
        " has no counts of beams: it may be the ghost trail of a pedestrian or cyclist, and nothing is"
        " claimed."
    )
    return Decision(Change.UNOBSERVED, reason, 0.0)


@dataclass(frozen=True)
class Contrast:
    """How an object stands out from the ground beside it; NaN where that is not known.

    ``filled`` and ``beneath``: points of the object, and ground points beneath it, over the ground points on
    an area as large as its footprint. ``side``: points of the object over those on an area as large as its
    longer side.
    """

    filled: float = math.nan
    beneath: float = math.nan
    side: float = math.nan


def contrast_with_ground(
    objects: Sequence[ObjectInstance],
    semantic: Semantic,
    own: OwnEpochEvidence | None,
    rules: DecisionConfig,
) -> Contrast:
    """Compare what may be a vehicle with the ground beside it; not known where beams were counted."""
    if semantic is Semantic.BUILDING or own is None or own.ground is None:
        return Contrast()
    if not fits_a_vehicle(objects, rules):
        return Contrast()
    return _beside_ground(np.concatenate([t.xyz for t in objects]), own.ground.data)


@switchable("hides_no_ground", no_decision)
def hides_no_ground(found: Contrast) -> Decision | None:
    """Tell what its own survey saw the ground through as if nothing stood there, without counts of beams.

    Whatever stands hides some of the ground beneath it, even a car with clearance that was seen from afar.
    """
    if not (found.filled < _FILLED and found.beneath >= _HIDES_NOTHING):
        return None
    reason = (
        f"The object has {found.filled:.1f} times as many points as the ground beside it on the same area"
        f" (limit {_FILLED:g}), its own survey saw {found.beneath:.0%} of the ground beneath (limit"
        f" {_HIDES_NOTHING:.0%}), and the cloud has no counts of beams: it may be a ghost trail, and nothing"
        " is claimed."
    )
    return Decision(Change.UNOBSERVED, reason, 0.0)


@switchable("shows_no_side", no_decision)
def shows_no_side(found: Contrast) -> Decision | None:
    """Tell what has fewer points than one of its sides would have, on ground that was seen.

    A standing object shows at least the side that faces the sensor, and beams meet an upright surface more
    closely than the ground beside it. Of what passed, a few sweeps met a part here and a part there.
    """
    if not (found.side < _SIDE and found.beneath >= _SHOWN_BENEATH):
        return None
    reason = (
        f"The object has {found.side:.1f} times as many points as the ground beside it has on an area as"
        f" large as a side of the object (limit {_SIDE:g}), its own survey saw {found.beneath:.0%} of the"
        f" ground beneath (limit {_SHOWN_BENEATH:.0%}), and the cloud has no counts of beams: it may be a"
        " ghost trail, and nothing is claimed."
    )
    return Decision(Change.UNOBSERVED, reason, 0.0)


def _no_doubt(*_: object) -> str:
    """Return nothing."""
    return ""


@switchable("ground_shines_through", _no_doubt)
def doubt_of_porous(found: Contrast, semantic: Semantic) -> str:
    """Say why what neither fills nor hides its place may be a trail, in a cloud without counts of beams.

    A standing object hides the ground beneath, and most show a surface that a survey samples as densely as
    the ground beside. Traffic was elsewhere while most beams came: they met the ground in its place. A car of
    which one side was seen from afar looks alike, so the object is claimed with a low confidence.
    """
    if semantic not in (Semantic.VEGETATION, Semantic.OTHER):
        return ""
    if not (found.filled < _FILLED and found.beneath >= _SEEN_BENEATH):
        return ""
    return (
        f"The object has {found.filled:.1f} times as many points as the ground beside it on the same area"
        f" (limit {_FILLED:g}), {found.beneath:.0%} of the ground beneath was seen (limit"
        f" {_SEEN_BENEATH:.0%}), and the cloud has no counts of beams: it may be the ghost trail of a"
        " vehicle, and the confidence is lowered."
    )


def _beside_ground(xyz: Floats, ground: Floats) -> Contrast:
    """Compare points (N, 3) of an object with the ground points (G, 2) in the cells around."""
    xy = xyz[:, :2]
    low = np.floor(xy.min(axis=0) / _CELL).astype(np.int64) - 2 * _RING
    shape = np.floor(xy.max(axis=0) / _CELL).astype(np.int64) - low + 2 * _RING + 1
    near = ground[in_box_around(ground, xy, 2 * _RING * _CELL)]
    counts = []
    for places in (xy, near):
        cell = np.floor(places / _CELL).astype(np.int64) - low
        inside = ((cell >= 0) & (cell < shape)).all(axis=1)
        number = np.zeros(shape, dtype=np.int64)
        np.add.at(number, tuple(cell[inside].T), 1)
        counts.append(number)
    block = np.ones((3, 3))
    footprint = ndimage.binary_closing(counts[0] > 0, block)
    beside = ndimage.binary_dilation(footprint, block, iterations=_RING)
    beside &= ~ndimage.binary_dilation(footprint, block)
    known = counts[1][beside & (counts[1] > 0)]
    if len(known) < _RING:
        return Contrast()
    usual = float(np.median(known))
    expected = usual * np.count_nonzero(footprint)
    bottom, top = np.quantile(xyz[:, 2], [0.025, 0.975])
    side = usual / _CELL**2 * max(strip_of(xy)[0], _CELL) * max(top - bottom, _CELL)
    return Contrast(len(xy) / expected, float(counts[1][footprint].sum()) / expected, len(xy) / side)


def _road_beneath(xy: Floats, ground: Floats) -> float:
    """Density of ground points (G, 2) between the sides of a strip (N, 2) over that beside it, 1 at most."""
    middle = xy.mean(axis=0)
    axes = np.linalg.eigh((xy - middle).T @ (xy - middle))[1]
    across, along = ((xy - middle) @ axes).T
    reach = float(np.quantile(np.abs(along), 0.975))
    low, high = np.quantile(across, [0.025, 0.975])
    place = (ground - middle) @ axes
    place = place[np.abs(place[:, 1]) <= reach]
    inside = np.count_nonzero((place[:, 0] > low) & (place[:, 0] < high))
    around = np.count_nonzero((place[:, 0] > 2 * low - high) & (place[:, 0] < 2 * high - low)) - inside
    return min(1.0, inside / max(0.5 * around, 1.0))


def strip_of(xy: Floats) -> tuple[float, float]:
    """Length and width of points (N, 2) along and across their main direction, less one in twenty [m]."""
    step = xy - xy.mean(axis=0)
    low, high = np.quantile(step @ np.linalg.eigh(step.T @ step)[1], [0.025, 0.975], axis=0)
    width, length = (high - low).tolist()
    return length, width


def _local_width(xy: Floats) -> float:
    """Width of the pieces that points (N, 2) consist of, median of a sample [m]: a way may bend."""
    some = xy[:: -(-len(xy) // _PIECES)]
    return float(np.median([strip_of(xy[near])[1] for near in cKDTree(xy).query_ball_point(some, _PIECE)]))


@switchable("trail_of_one_epoch", no_decision)
def is_moving_object_trail(
    objects: Sequence[ObjectInstance],
    semantic: Semantic,
    own: OwnEpochEvidence | None,
    rules: DecisionConfig,
    free: float = 1.0,
) -> Decision | None:
    """Tell a trail from an object: by the probability that its points moved, else by counts of beams.

    Nothing is claimed of an object that is as likely to have moved as not (Decision 21). A change needs both
    that the object stood and that its place was ``free`` in the other epoch with this probability.
    """
    moved = mean_moving_probability(objects)
    if moved is not None:
        return (
            _by_probability(moved, objects, rules, free)
            if may_have_moved(objects, semantic, own, rules)
            else None
        )
    top = max(float(t.voxels.height.max()) for t in objects)
    passed = min(float(np.quantile(t.passed, 0.25)) if len(t.passed) else 0.0 for t in objects)
    least = min(rules.trail_passes_high, rules.trail_passes_lane)
    if top > rules.trail_top or passed < least:
        return None
    enough = _passes_limit(objects, top, semantic, own, rules)
    if passed < enough:
        return None
    reason = (
        f"{passed:.1f} beams passed through the object for each beam that was returned, more than the limit"
        f" of {enough:.1f} (counts alone, the map keeps no times): the ghost trail of a moving object."
    )
    return Decision(Change.NOT_REPORTED, reason, passed / enough)


def _by_probability(
    moved: float, objects: Sequence[ObjectInstance], rules: DecisionConfig, free: float
) -> Decision | None:
    """Decide by the mean probability of having moved: moved, too uncertain to say, or None where it stood."""
    if moved >= rules.trail_moved:
        reason = (
            f"The object's probability of {moved:.0%} of having moved during mapping exceeds the limit of"
        )
        reason += f" {rules.trail_moved:.0%}: the ghost trail of a moving object."
        return Decision(Change.NOT_REPORTED, reason, moved / rules.trail_moved)
    uncertain = upper_moving_probability(objects)
    doubt = 1.0 - joint_probability(uncertain, free)
    if doubt < rules.trail_uncertain:
        return None
    reason = f"The object may have moved during mapping (probability {uncertain:.0%}"
    if uncertain < rules.trail_uncertain:
        reason += f"), or its place may not have been free (together {doubt:.0%}"
    reason += f", limit {rules.trail_uncertain:.0%}): nothing is claimed."
    return Decision(Change.UNOBSERVED, reason, 1.0 - doubt)


@switchable("stood_and_free", lambda moved, _: 1.0 - moved)
def joint_probability(moved: float, free: float) -> float:
    """Return the probability that an object stood, and that its place was free in the other epoch."""
    return (1.0 - moved) * free


def may_have_moved(
    objects: Sequence[ObjectInstance], semantic: Semantic, own: OwnEpochEvidence | None, rules: DecisionConfig
) -> bool:
    """Tell whether objects may be what a road vehicle left: as low as one, and no part of a building."""
    if not fits_a_vehicle(objects, rules):
        return False
    wall = own is not None and semantic is Semantic.BUILDING and own.adjoins_building(objects)
    return not applies("wall_at_building", wall)


@switchable("higher_than_vehicles", always)
def fits_a_vehicle(objects: Sequence[ObjectInstance], rules: DecisionConfig) -> bool:
    """Tell whether objects may be what a road vehicle left: no part of them is higher than vehicles are.

    A wall of a house that a survey met for a second only is as brief as a vehicle that passed, but higher.
    """
    heights = np.concatenate([t.voxels.height for t in objects])
    return float(np.mean(heights > rules.vehicle_top)) < rules.vehicle_above


def upper_moving_probability(objects: Sequence[ObjectInstance]) -> float:
    """Probability that objects moved: the mean of their points or the median, whichever is larger."""
    points = np.concatenate([t.moved for t in objects])
    return float(max(points.mean(), np.median(points)))


def mean_moving_probability(objects: Sequence[ObjectInstance]) -> float | None:
    """Mean probability of the points of objects to have moved; None where a map has no times."""
    if not objects or any(len(t.moved) != len(t.points) or len(t.points) == 0 for t in objects):
        return None
    return float(np.concatenate([t.moved for t in objects]).mean())


def _unlimited(decision: Decision, _: object, confidence: float, *__: object) -> tuple[float, str]:
    """Return the confidence and the reason as they are."""
    return confidence, decision.reason


@switchable("confidence_of_brief_objects", _unlimited)
def limit_confidence(
    decision: Decision,
    objects: Sequence[ObjectInstance],
    confidence: float,
    rules: DecisionConfig,
    free: float = 1.0,
) -> tuple[float, str]:
    """Return the confidence in what one epoch alone holds, and the reason, where it may have moved.

    An object that was seen for a moment only is as likely a ghost trail as an object. It is a change if it
    stood and its place was ``free`` in the other epoch with this probability.
    """
    if decision.change not in ONE_EPOCH or mean_moving_probability(objects) is None:
        return confidence, decision.reason
    moved = upper_moving_probability(objects) if fits_a_vehicle(objects, rules) else 0.0
    together = joint_probability(moved, free)
    if together >= confidence or moved <= 0.0:
        return confidence, decision.reason
    return together, f"{decision.reason} The confidence is lowered: {_doubts(moved, free)}."


def _doubts(moved: float, free: float) -> str:
    """Say why what one epoch alone holds may be no change; a probability that rounds to zero is not named."""
    doubts = (
        (moved, "the object moved during mapping"),
        (1.0 - free, "its place was occupied in the other survey"),
    )
    named = [(f"{probability:.0%}", doubt) for probability, doubt in doubts]
    return ", and ".join(f"with a probability of {share} {doubt}" for share, doubt in named if share != "0%")


def _passes_limit(
    objects: Sequence[ObjectInstance],
    top: float,
    semantic: Semantic,
    own: OwnEpochEvidence | None,
    rules: DecisionConfig,
) -> float:
    """Smallest number of passing beams per returned beam at which objects are a ghost trail."""
    enough = rules.trail_passes if semantic is Semantic.BUILDING else rules.trail_passes_thin
    if own is None:
        return enough
    if applies("trail_in_lane", own.in_lane(objects)):
        enough = min(enough, rules.trail_passes_lane)
    through = top >= rules.trail_high and own.through(objects) >= rules.trail_through
    if applies("trail_seen_through", through):
        enough = min(enough, rules.trail_passes_high)
    return enough
