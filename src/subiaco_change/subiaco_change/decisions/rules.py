"""Decision rules: from measures to a label, with the reason in words (method, part E)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from subiaco_change.decisions.config import BuildingLimits, DecisionConfig
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import applies, first_argument, switchable
from subiaco_change.objects.measures import Measures
from subiaco_change.objects.space_carving import Interval
from subiaco_geo.codes import ONE_EPOCH, Change, Semantic

_EXACT = NUMBERS.rules.least_half_width
_OPPOSED = NUMBERS.rules.opposed_height
_PATCH = NUMBERS.rules.voxels_per_patch
_MOST_GROWTH = NUMBERS.rules.stated_growth
_WHOLE = NUMBERS.rules.seen_whole
#: Why nothing is said of an object that both epochs saw.
NO_LEVEL = "Too few points lie at this place for a level of detection: nothing is claimed."


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
    plant: Callable[[], Decision] | None = None,
    roof: bool = False,
    fixed: bool = False,
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
    plant : callable, optional
        Decides a plant of both epochs.
    roof : bool, optional
        Whether a building of one epoch is a roof on posts, which encloses no volume.
    fixed : bool, optional
        Whether nobody moves an object of class other: it is a fence or a pole in both epochs.
    """
    if not _enough_seen(measures, config):
        return Decision(Change.UNOBSERVED, _unobserved(measures, config), 1.0 - measures.observed_fraction)
    if not (in_before and in_after):
        decision = _single(in_after, measures, config)
        encloses = semantic is Semantic.BUILDING and not roof
        return _enclosing(decision, measures, config) if encloses else decision
    if semantic in (Semantic.MOBILE, Semantic.OTHER):
        return _mobile(measures, config, fixed)
    return _compare(semantic, measures, lod, config, plant)


def _compare(
    semantic: Semantic,
    measures: Measures,
    lod: float,
    config: DecisionConfig,
    plant: Callable[[], Decision] | None,
) -> Decision:
    """Decide a building or a plant that both epochs have."""
    least = config.vegetation.min_iou if plant else config.building.min_iou
    if measures.iou <= least and not _is_bounded(semantic, measures):
        return Decision(
            Change.UNCHANGED,
            f"The 3D overlap {measures.iou:.2f} does not exceed the limit of {least:.2f}:"
            " too little to compare, and no change is claimed.",
            0.5,
        )
    if plant is not None:
        return plant()
    gate = max(config.lod_factor * lod, config.lod_floor)
    if not math.isfinite(gate):
        return Decision(Change.UNOBSERVED, NO_LEVEL, 0.0)
    return _building(measures, gate, config.building)


def _is_bounded(semantic: Semantic, measures: Measures) -> bool:
    """Tell whether the bounds of a building say what became of it, however little both epochs share."""
    bounds = measures.height_bounds
    return semantic is Semantic.BUILDING and bounds is not None and math.isfinite(bounds.low)


def _enough_seen(measures: Measures, config: DecisionConfig) -> bool:
    """Tell whether the other epoch observed enough of the place to claim anything (Decision 14)."""
    return measures.observed_voxels >= config.min_voxels and measures.observed_fraction >= config.min_observed


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
    if applies("probably_free", measures.free < config.min_free):
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


@switchable("enclosed_volume", first_argument)
def _enclosing(decision: Decision, measures: Measures, config: DecisionConfig) -> Decision:
    """Claim a building of one survey alone only where it surely encloses a volume.

    Beams that ran along a wall leave unknown what lies behind it: then the bounds of the volume reach zero,
    and what one survey alone has may be the side of something that both survey vehicles passed.
    """
    if decision.change not in ONE_EPOCH:
        return decision
    sign = 1.0 if decision.change is Change.ADDED else -1.0
    stated = measures.stated_volume
    bounds = () if stated is None else (sign * stated.low, sign * stated.high)
    least = min(value for value in (abs(measures.delta_v), *bounds, math.inf) if not math.isnan(value))
    if least >= config.least_volume:
        return decision
    which = "later" if decision.change is Change.ADDED else "earlier"
    reason = (
        f"Only the {which} survey has the object, and as far as was observed the object encloses"
        f" {max(least, 0.0):.1f} m³ (limit {config.least_volume:g} m³): it may be a fragment of a wall, and"
        " nothing is claimed."
    )
    return Decision(Change.UNOBSERVED, reason, 0.0)


def _mobile(measures: Measures, config: DecisionConfig, fixed: bool) -> Decision:
    rules = config.mobile
    if measures.iou > rules.same_iou and measures.delta_c >= rules.shift and fixed:
        reason = (
            f"The 3D overlap {measures.iou:.2f} exceeds the limit of {rules.same_iou:.2f}, and the object is"
            f" longer than {rules.longest:g} m or taller than {rules.tallest:g} m: the object stayed. Its"
            f" centroid moved by {measures.delta_c:.2f} m because the surveys saw different parts of it."
        )
        return Decision(Change.UNCHANGED, reason, 1.0)
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


def percent_of_earlier(share: float, *, sign: bool = True, digits: int = 0) -> str:
    """Write a change that is a share of the mean of both surveys as a percentage of the earlier one.

    A share of -2 is the loss of everything, and a share of +2 a growth from nothing.
    """
    held = min(max(share, -2.0), 2.0)
    change = 2.0 * held / (2.0 - held) if held < 2.0 else math.inf
    if change > _MOST_GROWTH:
        return f"more than {100 * _MOST_GROWTH:{'+' if sign else ''}.0f} %"
    return f"{100 * change:+z.{digits}f} %" if sign else f"{100 * abs(change):.{digits}f} %"


def _building(measures: Measures, gate: float, rules: BuildingLimits) -> Decision:
    """Decide by the bounds of height and volume.

    A label needs the middle of the bounds beyond the limit, and both bounds on its side of zero: an extension
    of 16 % that is known to lie between 9 and 17 % has grown, and a wrong sign cannot come out. The nearer
    bound must exceed a part of the limit, or walls must stand where the other survey saw free space on both
    sides. Bounds that straddle the limit are stated in the reason, and lower the confidence.

    Where height and volume say the opposite, the volume's sign wins (Decision 12).
    """
    height = measures.height_bounds or Interval(measures.delta_h, measures.delta_h)
    possible, volume = _possible_volume(measures, rules), shown_volume(measures, rules)
    limit = max(rules.height, gate)
    whole = max(measures.volume, 1e-6)
    room = rules.volume * whole
    bounds = (
        Interval(_share(height.low, limit), _share(height.high, limit)),
        Interval(volume.low / room, volume.high / room),
    )
    known = math.isfinite(height.low)
    up = _rise(*bounds, measures.gained_surface if known else 0.0, room, rules)
    down = _rise(-bounds[0], -bounds[1], measures.lost_surface if known else 0.0, room, rules)
    evidence = f"Height change {_span(height)} (limit {limit:.2f} m), volume change"
    stated = possible.widened(measures.volume_resolution)
    evidence += f" {_volume_words(stated, volume, measures, rules)}: "
    straddles = any(bound.low <= side <= bound.high for bound in bounds for side in (-1.0, 1.0))
    if straddles:
        evidence += "space that a survey did not observe decides whether a limit is exceeded, and "
    if max(up, down) <= 1:
        evidence += "no change is claimed." + _unseen_rest(measures.observed_fraction)
        either = max(_sigmas(bounds), _sigmas(tuple(-bound for bound in bounds)))
        return Decision(Change.UNCHANGED, evidence, 1.0 if straddles else max(up, down, 0.0), either)
    rising = up > 1 and (down <= 1 or volume.middle > 0)
    change = Change.INCREASED if rising else Change.DECREASED
    turned = bounds if rising else tuple(-bound for bound in bounds)
    part = "a whole" if any(bound.low > 1.0 for bound in turned) else "the middle of an"
    evidence += f"{part} interval exceeds its limit"
    if all(bound.low < rules.certain for bound in turned):
        surface = measures.gained_surface if rising else measures.lost_surface
        walls, other = ("new walls stand", "earlier") if rising else ("former walls stood", "later")
        evidence += f", and {surface:.0f} m² of {walls} where the {other} survey saw free space on both sides"
    evidence += f": the building {'grew' if rising else 'shrank'}."
    return Decision(change, evidence, up if rising else down, _sigmas(turned))


def _volume_words(stated: Interval, shown: Interval, measures: Measures, rules: BuildingLimits) -> str:
    """Write the bounds of a change of volume, of which no more than all is lost, and what was seen of it."""
    whole = max(measures.volume, 1e-6)
    low, high = (max(bound / whole, -1.0) for bound in (stated.low, stated.high))
    words = f"{low:+z.0%} to {high:+z.0%} (limit {rules.volume:.0%}"
    if shown != _possible_volume(measures, rules):
        one, other = ("gain", "loss") if shown == measures.gained else ("loss", "gain")
        seen = sorted(abs(bound) / whole for bound in (shown.low, shown.high))
        least, most = (min(share, 1.0) if one == "loss" else share for share in seen)
        words += f"; a {one} of {least:.0%} to {most:.0%} was seen, a {other} is only possible"
    return f"{words})"


def _unseen_rest(observed: float) -> str:
    """Say of how much of a building bounds hold, where one survey saw less of it than the other."""
    if observed >= _WHOLE:
        return ""
    return f" Both surveys saw {observed:.0%} of the building's surfaces: of the rest nothing is known."


def _possible_volume(measures: Measures, _: BuildingLimits) -> Interval:
    """Return the bounds of the change of volume [m3]."""
    return measures.volume_bounds or Interval(measures.delta_v, measures.delta_v)


@switchable("unseen_opposes_nothing", _possible_volume)
def shown_volume(measures: Measures, rules: BuildingLimits) -> Interval:
    """Return the bounds of the change of volume, less the opposite change that no survey shows [m3].

    Behind a wing that was demolished a house may have been built upon where the earlier survey did not look.
    That is possible, but no evidence against what was seen.
    """
    gained, lost = measures.gained, measures.lost
    if gained is None or lost is None:
        return _possible_volume(measures, rules)
    up = gained.low > 0.0 or measures.gained_surface >= rules.sign_surface
    down = lost.low > 0.0 or measures.lost_surface >= rules.sign_surface
    if up == down:
        return _possible_volume(measures, rules)
    return gained if up else -lost


def _span(height: Interval) -> str:
    """Write the bounds of a change of height."""
    known = math.isfinite(height.low) and math.isfinite(height.high)
    return f"{height.low:+z.2f} to {height.high:+z.2f} m" if known else "not known"


def _rise(height: Interval, volume: Interval, surface: float, room: float, rules: BuildingLimits) -> float:
    """Return by how much a rise of a building is met; that of its height needs volume or walls that carry it.

    Where one epoch saw little of a house, the columns that both know may be of its neighbours; and where a
    house was replaced, its veranda may have risen while its gable fell. ``surface`` is
    the area of the walls of what was built on that the other epoch would have met [m2]: it tells the sign,
    unless the height says the opposite, or is not known to its limit, so that unseen roofs decide. To the
    depth ``sign_depth`` behind it, ``room`` must fit: the volume of the limit [m3].
    """
    carried = volume.high >= rules.height_volume or surface >= rules.height_surface
    opposed = volume.middle < -_OPPOSED
    unsupported = applies("volume_supports_height", not carried or opposed)
    known = height.middle > -_OPPOSED and height.high - height.low <= 2.0
    shown = surface >= max(rules.sign_surface, room / rules.sign_depth) and known
    nearer = 0.0 if applies("sign_by_surface", shown) else rules.certain
    return max(0.0 if unsupported else _beyond(height, rules.certain), _beyond(volume, nearer))


def _beyond(bound: Interval, certain: float) -> float:
    """Return by how much a rise, in units of its limit, is met: by the middle, where the sign is certain."""
    straddles = applies("sign_certain", bound.low <= certain and bound.middle > 1.0)
    return 1.0 if straddles else bound.middle


def _sigmas(bounds: Sequence[Interval]) -> float:
    """Return by how many standard deviations a rise exceeds its limit; bounds lie two from the middle."""
    return max(2.0 * (b.middle - 1.0) / max(0.5 * (b.high - b.low), _EXACT) for b in bounds)


def _share(value: float, limit: float) -> float:
    """Value as a share of its limit; 0 where it is not known."""
    return value / limit if math.isfinite(value) else 0.0
