"""Decision rules: from measures to a label, with the reason in words (method, part E)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

from pydantic import Field

from subiaco_change.decisions.measures import Measures
from subiaco_change.decisions.space_carving import Interval
from subiaco_change.method_numbers import NUMBERS
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.config import StrictModel

_EXACT = NUMBERS.rules.least_half_width
_PATCH = NUMBERS.rules.voxels_per_patch
#: Why nothing is said of an object that both epochs saw.
NO_LEVEL = "Too few points lie at this place for a level of detection: nothing is claimed."


class ClassRules(StrictModel):
    """Thresholds of one class."""

    FORMER_NAMES: ClassVar[Mapping[str, str]] = {"carried": "min_net_change"}

    min_iou: float = Field(
        ge=0,
        le=1,
        description="Voxel intersection over union above which two matched objects are compared for "
        "changes [1]",
    )
    same_iou: float = Field(
        0.20, ge=0, le=1, description="Voxel intersection over union above which an object is unchanged [1]"
    )
    height: float = Field(gt=0, description="Smallest height change that is reported [m]")
    volume: float = Field(
        gt=0, description="Smallest volume change that is reported, as a fraction of the volume"
    )
    shift: float = Field(gt=0, description="Largest centroid distance of an unchanged object [m]")
    min_net_change: float = Field(
        0.0,
        ge=0,
        description="Fraction of new or gone surface, observed by the other epoch, that must support a "
        "change (Decision 13); 0 asks for none",
    )
    certain: float = Field(
        0.5,
        ge=0,
        le=1,
        description="Fraction of the limit that the nearer bound of a building's change must exceed; 1 "
        "asks for the whole interval beyond the limit",
    )
    height_volume: float = Field(
        0.25,
        ge=0,
        description="Fraction of the volume limit that the upper bound of a building's volume change must "
        "reach to support its height change",
    )
    followed: float = Field(
        0.5,
        ge=0,
        le=1,
        description="Fraction of the height limit by which the top of all points of a low plant must have "
        "moved with the median of its columns",
    )
    surface: float = Field(
        math.inf,
        gt=0,
        description="Fraction of new or gone surface that is a change of volume by itself; inf for never",
    )
    outline: float = Field(
        math.inf,
        gt=0,
        description="Shift of the outline, as a fraction of its distance from the middle, that is a "
        "change by itself; inf for never",
    )


class DecisionConfig(StrictModel):
    """Table of section E; defaults are the paper's."""

    building: ClassRules = ClassRules(min_iou=0.10, height=0.50, volume=0.10, shift=1.5)
    vegetation: ClassRules = ClassRules(
        min_iou=0.08, height=0.30, volume=0.15, shift=2.0, min_net_change=0.10, surface=0.15, outline=0.08
    )
    mobile: ClassRules = ClassRules(min_iou=0.20, height=math.inf, volume=math.inf, shift=2.0)
    lod_factor: float = Field(
        1.2, gt=0, description="Limit of a height change as a multiple of the level of detection (paper)"
    )
    lod_floor: float = Field(0.10, ge=0, description="Smallest limit of a height change [m] (Decision 4)")
    min_observed: float = Field(
        0.3,
        ge=0,
        le=1,
        description="Observed fraction of a place below which no change is claimed (Decision 14)",
    )
    large_voxels: int = Field(
        100,
        ge=1,
        description="Observed voxels (0.5 m) from which a large part of an unmatched object was observed, "
        "so that min_observed_large applies. Raise it to claim less",
    )
    min_observed_large: float = Field(
        0.15,
        ge=0,
        le=1,
        description="Observed fraction of the place of a large unmatched object from which a change is "
        "claimed",
    )
    large_free: float = Field(
        0.9,
        ge=0,
        le=1,
        description="Fraction of the observed part of a large unmatched object that must be free for "
        "min_observed_large to apply",
    )
    min_empty: float = Field(
        0.6,
        ge=0,
        le=1,
        description="Fraction of the observed place that must be free in the other epoch for an object to "
        "be Added or Removed",
    )
    trail_moved: float = Field(
        0.6,
        gt=0.5,
        le=1,
        description="Mean probability of having moved from which an object of one epoch alone is a ghost "
        "trail; maps without beam times use the trail_passes settings",
    )
    trail_uncertain: float = Field(
        0.5,
        gt=0,
        le=1,
        description="Probability of having moved, from beam times, from which an object of one epoch "
        "alone is Unobserved",
    )
    min_free: float = Field(
        0.8,
        ge=0.5,
        lt=1,
        description="Probability that an object is absent in the other survey, from crossing beams, below "
        "which nothing is claimed. Raise it to claim less",
    )
    min_free_surface: float = Field(
        0.7,
        ge=0.5,
        lt=1,
        description="Probability that the place of the new or lost surface of a plant was free in the other "
        "survey, below which nothing is claimed. Raise it to claim less",
    )
    least_volume: float = Field(
        2.0,
        ge=0,
        description="Volume that a building of one survey alone must enclose to be Added or Removed [m3]. "
        "Raise it to claim no small sheds",
    )
    trail_passes: float = Field(
        2.0,
        gt=0,
        description="Passes per return, at the densest quarter of points, from which a building-like "
        "object of one epoch is a ghost trail [1]",
    )
    trail_passes_thin: float = Field(
        5.0,
        gt=0,
        description="Passes per return from which an object of one epoch that is no building is a ghost "
        "trail [1]; beams graze thin objects",
    )
    trail_passes_lane: float = Field(
        1.3,
        gt=0,
        description="Passes per return from which an object of one epoch in a lane with known traffic is "
        "a ghost trail [1]",
    )
    trail_passes_high: float = Field(
        1.0,
        gt=0,
        description="Passes per return from which a high object that its own survey observed from both "
        "sides is a ghost trail [1]",
    )
    vehicle_top: float = Field(
        4.4,
        gt=0,
        description="Height above ground that no road vehicle exceeds [m]; what is higher did not move "
        "while it was mapped",
    )
    vehicle_above: float = Field(
        0.05,
        gt=0,
        lt=1,
        description="Fraction of the voxels of an object above `vehicle_top` from which the object is no "
        "vehicle",
    )
    trail_high: float = Field(
        2.6,
        gt=0,
        description="Height above ground of its top from which an object counts as high in the ghost "
        "trail rules [m]",
    )
    trail_through: float = Field(
        0.65,
        gt=0,
        le=1,
        description="Fraction of the surface that its own survey must observe on both sides for a high "
        "object to be a ghost trail",
    )
    trail_top: float = Field(
        3.8, gt=0, description="Largest height above ground of the top of a moving object [m]"
    )
    min_voxels: int = Field(
        3,
        ge=1,
        description="Number of observed voxels above the foot of an object below which no change is claimed",
    )


@dataclass(frozen=True)
class Decision:
    """Label, the rule that gave it, and by how much it was met (1 is just met).

    ``sigmas``: standard deviations between the measure and its limit, positive beyond it; NaN where unknown.
    """

    change: Change
    reason: str
    margin: float
    sigmas: float = math.nan


def decide(
    semantic: Semantic,
    in_before: bool,
    in_after: bool,
    measures: Measures,
    lod: float,
    config: DecisionConfig,
    matched: Callable[[], Decision] | None = None,
) -> Decision:
    """Decide one object.

    Parameters
    ----------
    semantic : Semantic
    in_before, in_after : bool
        Whether the object exists in each epoch.
    measures : Measures
    lod : float
        Median level of detection of its points [m]; inf where none is known.
    config : DecisionConfig
    matched : callable, optional
        Decides an object that can be compared in both epochs instead of the rules of its class.
    """
    if not _enough_seen(measures, in_before and in_after, config):
        return Decision(Change.UNOBSERVED, _unobserved(measures, config), 1.0 - measures.observed_fraction)
    if not (in_before and in_after):
        decision = _single(in_after, measures, config)
        return _enclosing(decision, measures, config) if semantic is Semantic.BUILDING else decision
    if semantic in (Semantic.MOBILE, Semantic.OTHER):
        return _mobile(measures, config)
    return _compare(semantic, measures, lod, config, matched)


def _compare(
    semantic: Semantic,
    measures: Measures,
    lod: float,
    config: DecisionConfig,
    matched: Callable[[], Decision] | None,
) -> Decision:
    """Decide a building or a plant that stands in both epochs."""
    rules = config.building if semantic is Semantic.BUILDING else config.vegetation
    if measures.iou <= rules.min_iou:
        return Decision(
            Change.UNCHANGED,
            f"The 3D overlap {measures.iou:.2f} does not exceed the limit of {rules.min_iou:.2f}:"
            " too little to compare, and no change is claimed.",
            0.5,
        )
    if matched is not None:
        return matched()
    gate = max(config.lod_factor * lod, config.lod_floor)
    if not math.isfinite(gate):
        return Decision(Change.UNOBSERVED, NO_LEVEL, 0.0)
    by_class = _building if semantic is Semantic.BUILDING else _by_measures
    return by_class(measures, gate, rules)


def _enough_seen(measures: Measures, matched: bool, config: DecisionConfig) -> bool:
    """Tell whether the other epoch observed enough of the place to claim anything."""
    if measures.observed_voxels < config.min_voxels:
        return False
    if measures.observed_fraction >= config.min_observed:
        return True
    free = max(measures.gone_share, measures.new_share) >= config.large_free
    large = measures.observed_voxels >= config.large_voxels
    return not matched and large and free and measures.observed_fraction >= config.min_observed_large


def _unobserved(measures: Measures, config: DecisionConfig) -> str:
    """Say why nothing is claimed of a place that the other survey hardly observed."""
    share = measures.observed_fraction
    if share >= config.min_observed:
        return (
            f"The other survey observed {measures.observed_voxels} voxels of the object's place, fewer than"
            f" the limit of {config.min_voxels}: nothing is claimed."
        )
    return (
        f"The other survey observed {share:.0%} of the object's place, less than the limit of"
        f" {config.min_observed:.0%}: nothing is claimed."
    )


def _single(in_after: bool, measures: Measures, config: DecisionConfig) -> Decision:
    empty = measures.new_share if in_after else measures.gone_share
    sigmas = (empty - config.min_empty) / math.sqrt(
        max(empty * (1 - empty), 0.01) / max(measures.observed_voxels / _PATCH, 1.0)
    )
    if empty < config.min_empty:
        reason = (
            f"The object has no partner of its class, but {empty:.0%} of its observed place was free in the"
            f" other survey, less than the limit of {config.min_empty:.0%}"
            f" ({measures.observed_fraction:.0%} of the place was observed): the place is occupied in both"
            " surveys."
        )
        return Decision(Change.UNCHANGED, reason, (1 - empty) / max(1 - config.min_empty, 1e-9), sigmas)
    if measures.free < config.min_free:
        reason = (
            f"The probability that the object's place was free in the other survey is {measures.free:.0%},"
            f" less than the limit of {config.min_free:.0%}: nothing is claimed."
        )
        return Decision(Change.UNOBSERVED, reason, 1.0 - measures.free)
    change = Change.ADDED if in_after else Change.REMOVED
    own, other = ("later", "earlier") if in_after else ("earlier", "later")
    reason = (
        f"Only the {own} survey has the object; the {other} survey observed"
        f" {measures.observed_fraction:.0%} of its place, and {empty:.0%} of the observed place was free"
        f" (limit {config.min_empty:.0%}): the object {'is new' if in_after else 'was removed'}."
    )
    return Decision(change, reason, empty / max(config.min_empty, 1e-9), sigmas)


def _enclosing(decision: Decision, measures: Measures, config: DecisionConfig) -> Decision:
    """Claim a building of one survey alone only where it encloses a volume; else it is a piece of a wall."""
    if decision.change not in (Change.ADDED, Change.REMOVED):
        return decision
    if not abs(measures.delta_v) < config.least_volume:
        return decision
    which = "later" if decision.change is Change.ADDED else "earlier"
    reason = (
        f"Only the {which} survey has the object, but the object encloses {abs(measures.delta_v):.1f} m³"
        f" (limit {config.least_volume:g} m³): it is a fragment of a wall, and nothing is claimed."
    )
    return Decision(Change.UNOBSERVED, reason, 0.0)


def _mobile(measures: Measures, config: DecisionConfig) -> Decision:
    rules = config.mobile
    if measures.iou > rules.same_iou and measures.delta_c < rules.shift:
        reason = (
            f"The 3D overlap {measures.iou:.2f} exceeds the limit of {rules.same_iou:.2f}, and the"
            " centroid moved by"
            f" {measures.delta_c:.2f} m, less than the limit of {rules.shift:.2f} m: the object stayed."
        )
        return Decision(Change.UNCHANGED, reason, 1.0)
    reason = (
        f"The 3D overlap {measures.iou:.2f} (limit {rules.same_iou:.2f}) and centroid shift"
        f" {measures.delta_c:.2f} m"
        f" (limit {rules.shift:.2f} m): a movable object that moved is not reported."
    )
    return Decision(Change.NOT_REPORTED, reason, 1.0)


def _by_measures(measures: Measures, gate: float, rules: ClassRules) -> Decision:
    """Decide by height or volume; where both directions fire, the volume's sign wins (Decision 12)."""
    limit = max(rules.height, gate)
    relative = measures.delta_v / max(measures.volume, 1e-6)
    height = measures.delta_h / limit if math.isfinite(measures.delta_h) else 0.0
    up, down = _strengths(height, relative / rules.volume, measures, rules)
    evidence = f"Height change {measures.delta_h:+.2f} m (limit {limit:.2f} m), volume change {relative:+.0%}"
    evidence += (
        f" (limit {rules.volume:.0%}), new or lost surface {measures.net_changed_fraction:+.0%} (limit"
    )
    evidence += f" {rules.min_net_change:.0%}): "
    if up <= 1 and down <= 1:
        return Decision(Change.UNCHANGED, f"{evidence}no change beyond the limits.", max(up, down))
    rising = measures.delta_v > 0 if up > 1 and down > 1 else up > 1
    change = Change.INCREASED if rising else Change.DECREASED
    return Decision(change, f"{evidence}the object {'grew' if rising else 'shrank'}.", up if rising else down)


def _building(measures: Measures, gate: float, rules: ClassRules) -> Decision:
    """Decide by the bounds of height and volume.

    A label needs the middle of the bounds beyond the limit, and both bounds on its side of zero: an extension
    of 16 % that is known to lie between 9 and 17 % has grown, and a wrong sign cannot come out. Bounds that
    straddle the limit are told, and cost confidence.

    Where height and volume say the opposite, the volume's sign wins (Decision 12).
    """
    height = measures.height_bounds or Interval(measures.delta_h, measures.delta_h)
    volume = measures.volume_bounds or Interval(measures.delta_v, measures.delta_v)
    limit = max(rules.height, gate)
    whole = max(measures.volume, 1e-6)
    room = rules.volume * whole
    bounds = (
        Interval(_share(height.low, limit), _share(height.high, limit)),
        Interval(volume.low / room, volume.high / room),
    )
    up = _rise(*bounds, rules)
    down = _rise(-bounds[0], -bounds[1], rules)
    evidence = f"Height change {_span(height)} (limit {limit:.2f} m), volume change"
    evidence += f" {volume.low / whole:+.0%} to {volume.high / whole:+.0%} (limit {rules.volume:.0%}): "
    straddles = any(bound.low <= side <= bound.high for bound in bounds for side in (-1.0, 1.0))
    if straddles:
        evidence += "space that a survey did not see decides whether a limit is exceeded, and "
    if max(up, down) <= 1:
        evidence += "no change is claimed."
        return Decision(Change.UNCHANGED, evidence, 1.0 if straddles else max(up, down, 0.0))
    rising = up > 1 and (down <= 1 or volume.middle > 0)
    change = Change.INCREASED if rising else Change.DECREASED
    evidence += f"the building {'grew' if rising else 'shrank'} by its middle estimate."
    return Decision(change, evidence, up if rising else down, _sigmas(bounds, rising))


def _span(height: Interval) -> str:
    """Write the bounds of a change of height."""
    known = math.isfinite(height.low) and math.isfinite(height.high)
    return f"{height.low:+.2f} to {height.high:+.2f} m" if known else "not known"


def _rise(height: Interval, volume: Interval, rules: ClassRules) -> float:
    """Return by how much a rise of a building is met; that of its height needs volume that carries it.

    Where one epoch saw little of a house, the columns that both know may be of its neighbours.
    """
    supported = math.isnan(volume.high) or volume.high >= rules.height_volume
    return max(_beyond(height, rules.certain) if supported else 0.0, _beyond(volume, rules.certain))


def _beyond(bound: Interval, certain: float) -> float:
    """Return by how much a rise, in units of its limit, is met: by the middle, where the sign is certain."""
    return bound.middle if bound.low >= certain else min(bound.middle, 1.0)


def _sigmas(bounds: Sequence[Interval], rising: bool) -> float:
    """Return by how many standard deviations a change exceeds its limit; bounds lie two from the middle."""
    turned = bounds if rising else [-bound for bound in bounds]
    return max(2.0 * (b.middle - 1.0) / max(0.5 * (b.high - b.low), _EXACT) for b in turned)


def _share(value: float, limit: float) -> float:
    """Value as a share of its limit; 0 where it is not known."""
    return value / limit if math.isfinite(value) else 0.0


def _strengths(height: float, volume: float, measures: Measures, rules: ClassRules) -> tuple[float, float]:
    """How far the rules for more and for less are met; at most 1 where no surface carries the change.

    Columns tell the volume where their tops were seen. A crown whose top was
    not seen shows in its sides: there the share of new or lost surface
    decides.
    """
    side = measures.net_changed_fraction / rules.surface
    up, down = max(height, volume, side), max(-height, -volume, -side)
    if measures.net_changed_fraction < rules.min_net_change:
        up = min(up, 1.0)
    if -measures.net_changed_fraction < rules.min_net_change:
        down = min(down, 1.0)
    return up, down
