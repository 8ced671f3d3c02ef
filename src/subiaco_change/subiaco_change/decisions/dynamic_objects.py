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

from subiaco_change.decisions.rules import Decision, DecisionConfig
from subiaco_change.decisions.voxel_objects import EpochView, Thing, join_voxels, looked_across, trails
from subiaco_change.segmentation.ground_model import Mask
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.frames import Floats

Observed = Callable[[Floats], Mask]
_BESIDE = 0.5  # so far beside a surface lies the next voxel of the visibility layer [m]
_LANE = 1.0  # what lies this near a known trail lies in its lane [m]
_WITHIN = 0.9  # share of its points that must


@dataclass(frozen=True)
class OwnSurvey:
    """What the survey of an epoch itself knows of the places where its things stand.

    ``observed`` tells which places (N, 3) it saw; ``traffic`` holds the trails it is sure of.
    """

    observed: Observed
    traffic: cKDTree

    def through(self, things: Sequence[Thing]) -> float:
        """Share of the surface of things on both sides of which the survey looked."""
        voxels = join_voxels(things)
        return float(looked_across(voxels.xyz, voxels.normal, self.observed, _BESIDE).mean())

    def in_lane(self, things: Sequence[Thing]) -> bool:
        """Tell whether things lie where traffic is known to have passed."""
        places = np.concatenate([t.xyz for t in things])
        distance = self.traffic.query(places, distance_upper_bound=_LANE)[0]
        return bool(np.isfinite(distance).mean() >= _WITHIN)


def own_survey(view: EpochView, observed: Observed) -> OwnSurvey:
    """Gather what the survey of an epoch knows of itself."""
    return OwnSurvey(observed, cKDTree(view.xyz[trails(view)]))


def is_moving_object_trail(
    things: Sequence[Thing], semantic: Semantic, own: OwnSurvey | None, rules: DecisionConfig
) -> Decision | None:
    """Tell a trail from a thing: by the probability that its points moved, else by counts of beams.

    What is as likely to have moved as not is claimed to be neither (Decision 21).
    """
    moved = moved_share(things)
    if moved is not None:
        return _by_probability(moved, things, rules)
    top = max(float(t.voxels.height.max()) for t in things)
    passed = min(float(np.quantile(t.passed, 0.25)) if len(t.passed) else 0.0 for t in things)
    least = min(rules.trail_passes_high, rules.trail_passes_lane)
    if top > rules.trail_top or passed < least:
        return None
    enough = _enough(things, top, semantic, own, rules)
    if passed < enough:
        return None
    reason = (
        f"Moved while it was mapped: {passed:.1f} beams passed for each that returned, above the limit of"
    )
    reason += f" {enough:.1f} (counts alone, the map keeps no times): the trail of a moving object."
    return Decision(Change.NOT_REPORTED, reason, passed / enough)


def _by_probability(moved: float, things: Sequence[Thing], rules: DecisionConfig) -> Decision | None:
    """Decide by the mean probability of having moved: moved, too uncertain to say, or None where it stood."""
    if moved >= rules.trail_moved:
        reason = f"Probability of {moved:.0%} of having moved while it was mapped"
        reason += f" exceeds the limit of {rules.trail_moved:.0%}: the trail of a moving object."
        return Decision(Change.NOT_REPORTED, reason, moved / rules.trail_moved)
    uncertain = moved_at_most(things)
    if uncertain < rules.trail_uncertain:
        return None
    reason = f"It may have moved while it was mapped (probability {uncertain:.0%},"
    reason += f" limit {rules.trail_uncertain:.0%}): nothing is claimed."
    return Decision(Change.UNOBSERVED, reason, 1.0 - uncertain)


def moved_at_most(things: Sequence[Thing]) -> float:
    """Probability that things moved: the mean of their points or the median, whichever is larger."""
    points = np.concatenate([t.moved for t in things])
    return float(max(points.mean(), np.median(points)))


def moved_share(things: Sequence[Thing]) -> float | None:
    """Mean probability of the points of things to have moved; None where a map has no times."""
    if not things or any(len(t.moved) != len(t.points) or len(t.points) == 0 for t in things):
        return None
    return float(np.concatenate([t.moved for t in things]).mean())


def trusted(decision: Decision, things: Sequence[Thing], confidence: float) -> tuple[float, str]:
    """Return the confidence in what one epoch alone holds, and the reason, where it may have moved.

    What was seen for a moment only, and never again, is as likely a trail as an object.
    """
    if decision.change not in (Change.ADDED, Change.REMOVED) or moved_share(things) is None:
        return confidence, decision.reason
    moved = moved_at_most(things)
    if 1.0 - moved >= confidence:
        return confidence, decision.reason
    told = f"{decision.reason}; it may have moved while it was mapped (probability {moved:.0%})"
    return 1.0 - moved, told


def _enough(
    things: Sequence[Thing], top: float, semantic: Semantic, own: OwnSurvey | None, rules: DecisionConfig
) -> float:
    """Smallest number of passing beams per returned beam at which objects are a ghost trail."""
    enough = rules.trail_passes if semantic is Semantic.BUILDING else rules.trail_passes_thin
    if own is None:
        return enough
    if own.in_lane(things):
        enough = min(enough, rules.trail_passes_lane)
    if top >= rules.trail_high and own.through(things) >= rules.trail_through:
        enough = min(enough, rules.trail_passes_high)
    return enough
