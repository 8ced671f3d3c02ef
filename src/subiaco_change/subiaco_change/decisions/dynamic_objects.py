"""Ghost trails of moving objects, distinguished from standing objects by the beams that crossed them.

Trails that the semantics did not detect look like plants, walls or fragments of one epoch alone. Their own
survey saw them pass: beams went through each place before and after. But beams also graze what is thinner
than a voxel or ends below the sensor, so that a hedge lets by as many as the trail of a slow lorry.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from subiaco_change.decisions.config import DecisionConfig
from subiaco_change.decisions.rules import Decision
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import always, applies, no_decision, switchable
from subiaco_change.objects.measures import footprint_sides
from subiaco_change.objects.voxel_objects import (
    EpochView,
    ObjectInstance,
    is_ghost_trail,
    join_voxels,
    observed_on_both_sides,
)
from subiaco_change.segmentation.ground_model import Mask
from subiaco_geo.codes import ONE_EPOCH, Change, Semantic
from subiaco_geo.frames import Floats

Observed = Callable[[Floats], Mask]
Moved = Callable[[Floats], Floats]
_BESIDE = NUMBERS.dynamic_objects.visibility_step
_LANE = NUMBERS.dynamic_objects.lane_reach
_WITHIN = NUMBERS.dynamic_objects.lane_share


@dataclass(frozen=True)
class OwnEpochEvidence:
    """What the survey of an epoch itself knows of the places where its objects stand.

    ``observed`` tells which places (N, 3) it saw; ``traffic`` holds the trails it is sure of; ``ground``
    (G, 2) the ground points, where nothing counted beams.
    """

    observed: Observed
    traffic: cKDTree
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


def own_epoch_evidence(view: EpochView, observed: Observed) -> OwnEpochEvidence:
    """Gather what the survey of an epoch knows of itself."""
    return OwnEpochEvidence(
        observed,
        cKDTree(view.xyz[is_ghost_trail(view)]),
        cKDTree(view.xyz[view.semantic == Semantic.GROUND, :2]) if view.passed is None else None,
    )


@switchable("trail_of_one_epoch", no_decision)
def decide_moving_object_trail(
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
        return _by_probability(moved, objects, rules, free) if fits_a_vehicle(objects, rules) else None
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
    uncertain = _chance_of_moving(objects, rules)
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


@switchable("higher_than_vehicles", always)
def fits_a_vehicle(objects: Sequence[ObjectInstance], rules: DecisionConfig) -> bool:
    """Tell whether objects may be what a road vehicle left: no part of them is higher than vehicles are.

    A wall of a house that a survey met for a second only is as brief as a vehicle that passed, but higher.
    """
    heights = np.concatenate([t.voxels.height for t in objects])
    return float(np.mean(heights > rules.vehicle_top)) < rules.vehicle_above


def _chance_of_moving(objects: Sequence[ObjectInstance], rules: DecisionConfig) -> float:
    """Return the probability that objects moved that are no higher than vehicles.

    Where the times of beams tell nothing, as of what was met for a moment in a yard behind the houses, walls
    farther apart than the sides of a vehicle did not move.
    """
    moved = upper_moving_probability(objects)
    stood = moved <= rules.trail_uncertain and all(t.semantic is Semantic.BUILDING for t in objects)
    wide = stood and footprint_sides(join_voxels(objects).xyz)[0] > rules.vehicle_width
    return 0.0 if applies("wider_than_vehicles", wide) else moved


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
    moved = _chance_of_moving(objects, rules) if fits_a_vehicle(objects, rules) else 0.0
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
