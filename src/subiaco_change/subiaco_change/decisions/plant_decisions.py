"""Decision on a plant that both epochs contain, against the unchanged plants of the pair (Decision 18)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from subiaco_change.decisions.config import DecisionConfig, PlantLimits
from subiaco_change.decisions.rules import NO_LEVEL, Decision, percent_of_earlier
from subiaco_change.decisions.vegetation_null import PLANT_MEASURES, Expected, PlantMeasures, VegetationNull
from subiaco_change.method_rules.switches import applies, switchable, third_argument
from subiaco_geo.codes import Change

_NAMES = {
    "outline": "the outline",
    "top": "the top",
    "volume": "the volume",
    "surface": "the surface",
    "rise": "the top",
    "base": "the base",
}


@dataclass(frozen=True)
class _Excess:
    """One measure beyond what an unchanged plant of the pair shows, with its limit."""

    measure: str
    value: float
    expected: Expected
    limit: float
    sd: float

    @property
    def unit(self) -> str:
        """Unit of the value, as :data:`PLANT_MEASURES` names it."""
        return PLANT_MEASURES[self.measure]

    @property
    def limit_of_side(self) -> str:
        """The limit on the side of the excess: of a growth and of a loss the percentages differ."""
        return _quantity(math.copysign(self.limit, self.excess), self.unit, sign=False, more=self.more)

    @property
    def more(self) -> int:
        """Further digits without which the excess and its limit would read alike."""
        sides = (self.excess, math.copysign(self.limit, self.excess))
        excess, limit = (_quantity(value, self.unit, sign=False) for value in sides)
        return int(excess == limit)

    @property
    def excess(self) -> float:
        """What is left once the shift of the unchanged plants is subtracted."""
        return self.value - self.expected.shift

    @property
    def strength(self) -> float:
        """Excess in limits, signed; zero where it was not measured or has the other sign than the value."""
        if not math.isfinite(self.excess) or self.excess * self.value <= 0:
            return 0.0
        return self.excess / self.limit

    @property
    def sigmas(self) -> float:
        """Standard deviations by which the excess passes its limit; negative where it does not."""
        return (abs(self.strength) - 1.0) * self.limit / self.sd


def decide_plant(plant: PlantMeasures, lod: float, config: DecisionConfig, null: VegetationNull) -> Decision:
    """Decide one plant of both epochs.

    Parameters
    ----------
    plant : PlantMeasures
        At equal point density.
    lod : float
        Its level of detection [m].
    config : DecisionConfig
    null : VegetationNull
        Of the pair.
    """
    gate = max(config.lod_factor * lod, config.lod_floor)
    if not math.isfinite(gate):
        return _decide_tops_alone(plant, config, null)
    section = _decide_section(plant, null) if math.isfinite(plant.section) else None
    if section is not None and plant.section_only:
        return _supported(section, plant, config)
    whole = _decide_whole(plant, gate, config.vegetation, null)
    chosen = section if section is not None and whole.change is Change.UNCHANGED else whole
    return _supported(chosen, plant, config)


def _decide_tops_alone(plant: PlantMeasures, config: DecisionConfig, null: VegetationNull) -> Decision:
    """Decide a plant without level of detection: by the tops of its columns, whose error is their own."""
    tops = _excesses(plant, config.lod_floor, config.vegetation, null)["rise"]
    if abs(tops.strength) <= 1:
        return Decision(Change.UNOBSERVED, NO_LEVEL, 0.0)
    return _supported(_decision(plant, tops), plant, config)


def _tops_moved(decision: Decision, plant: PlantMeasures, config: DecisionConfig) -> bool:
    """Tell whether the tops of a plant carry a claim: the space above them was observed, column by column."""
    sign = {Change.INCREASED: 1.0, Change.DECREASED: -1.0}.get(decision.change, 0.0)
    return not plant.section_only and sign * plant.rise > config.vegetation.height


def place_was_free(decision: Decision, plant: PlantMeasures, config: DecisionConfig) -> float:
    """Return how probable it is that the place of what a plant gained or lost was free; 1 without a claim."""
    if _tops_moved(decision, plant, config):
        return 1.0
    free = {Change.INCREASED: plant.free_gained, Change.DECREASED: plant.free_lost}
    return free.get(decision.change, 1.0)


def _supported(decision: Decision, plant: PlantMeasures, config: DecisionConfig) -> Decision:
    """Leave a plant unchanged whose claim its height contradicts, or whose place was not seen free."""
    if decision.change not in (Change.INCREASED, Change.DECREASED) or _tops_moved(decision, plant, config):
        return decision
    grew = decision.change is Change.INCREASED
    free = place_was_free(decision, plant, config)
    if not applies("surface_was_free", free < config.min_free_surface):
        return decision
    other, surface = ("earlier", "new") if grew else ("later", "lost")
    return _withdrawn(
        decision,
        f"the probability that the place of the {surface} surface was free in the {other} survey is"
        f" {free:.0%}, less than the limit of {config.min_free_surface:.0%}",
    )


def _withdrawn(decision: Decision, objection: str) -> Decision:
    """Leave a plant unchanged whose change was measured, and say why the change is not claimed."""
    measured = decision.reason.removesuffix(f": {_CONCLUSIONS[decision.change]}.")
    return Decision(Change.UNCHANGED, f"{measured}, but {objection}: no change is claimed.", 1.0, 0.0)


def _decide_section(plant: PlantMeasures, null: VegetationNull) -> Decision:
    """Decide a hedge by the tops of its section; a piece of one only where the space above was observed.

    Of a piece that one survey hardly met, a beam or two over each column show no free space.
    """
    expected = null.expected(plant, "rise")
    limit = max(plant.section_gate, null.certain * expected.sd)
    decision = _decision(plant, _Excess("rise", plant.section, expected, limit, expected.sd))
    if decision.change is Change.UNCHANGED or not plant.section_only or not _are_tops_unseen(plant):
        return decision
    return _withdrawn(decision, "the space above the lower tops was not observed")


def _are_tops_unseen(plant: PlantMeasures) -> bool:
    """Tell whether both epochs have columns of a plant, and the space above the lower tops is not known."""
    return applies("unseen_tops_of_plants", plant.tops_unseen)


def _decide_whole(plant: PlantMeasures, gate: float, rules: PlantLimits, null: VegetationNull) -> Decision:
    """Decide by the tops of the columns or the outline where they moved, else by volume and surface.

    The tops of its columns say more of a plant than its highest voxels, of which few beams tell.
    """
    found = _excesses(plant, gate, rules, null)
    columns, outline = found["rise"], found["outline"]
    known = math.isfinite(plant.rise)
    extent = [columns, outline]
    for measure in extent:
        if abs(measure.strength) > 1:
            return _decision(plant, measure)
    voxels_tell = not known and not _are_tops_unseen(plant)
    names = ("top", "volume", "surface") if voxels_tell else ("volume", "surface")
    candidates = [found[name] for name in names]
    by_surface = _decide_by_surface(plant, candidates, extent, found, rules)
    if by_surface is not None:
        return by_surface
    measured = [e for e in (*extent, *candidates) if math.isfinite(e.value)] or candidates
    unchanged = _decision(plant, max(measured, key=lambda e: abs(e.strength)))
    return unchanged if known else replace(unchanged, sigmas=0.0)  # a top that nobody saw may have moved


def _decide_by_surface(
    plant: PlantMeasures,
    candidates: Sequence[_Excess],
    extent: Sequence[_Excess],
    found: dict[str, _Excess],
    rules: PlantLimits,
) -> Decision | None:
    """Decide by measures that rest on new and lost surface; None where none of them exceeds its limit."""
    surface = found["surface"]
    fired = [e for e in candidates if abs(e.strength) > 1]
    base = found["base"]
    leaves = [
        e for e in fired if applies("extent_carries_surface", _is_foliage(plant, e, extent, base, rules))
    ]
    fired = [e for e in fired if e not in leaves]
    held = [
        e
        for e in fired
        if not applies(
            "surface_carries_change",
            math.copysign(1.0, e.strength) * surface.excess < rules.min_net_change,
        )
    ]
    if held:
        rising = {e.strength > 0 for e in held}
        upwards = found["volume"].excess > 0 if len(rising) == 2 else rising == {True}
        return _decision(plant, max(held, key=lambda e: e.strength if upwards else -e.strength))
    if fired:
        return _without_surface(plant, max(fired, key=lambda e: abs(e.strength)), surface, rules)
    return _of_leaves(plant, max(leaves, key=lambda e: abs(e.strength))) if leaves else None


def _is_foliage(
    plant: PlantMeasures, found: _Excess, extent: Sequence[_Excess], base: _Excess, rules: PlantLimits
) -> bool:
    """Tell whether surface appeared or disappeared in a plant whose tops, outline and base did not follow.

    Leaves that fall open a crown to beams and leave its extent as it is. A part of it that is missing on one
    side is no matter of leaves.
    """
    sign = math.copysign(1.0, found.strength)
    grew = found.strength > 0
    part = plant.rise_of_part if grew else plant.fall_of_part
    if part > rules.height or _has_part_on_side(plant, sign, rules):
        return False
    known = [e.strength for e in extent if math.isfinite(e.value)]
    return bool(known) and max(sign * s for s in known) < rules.followed and sign * base.strength <= 1.0


def _has_part_on_side(plant: PlantMeasures, sign: float, rules: PlantLimits) -> bool:
    """Tell whether a plant gained (a sign above 0) or lost a part on one side.

    Then its surface need not have changed by as much as leaves make it change.
    """
    return (plant.gained_on_side if sign > 0 else plant.lost_on_side) >= rules.side


def _of_leaves(plant: PlantMeasures, found: _Excess) -> Decision:
    """Leave a plant unchanged whose surface changed while what is known of its extent did not."""
    extent = "neither the top nor the outline of the plant followed"
    if math.isfinite(plant.base):
        extent = "neither the top nor the outline nor the base of the plant followed"
    if not math.isfinite(plant.rise):
        extent = "the outline of the plant did not follow, and its top was not observed"
    reason = (
        f"{_compared(plant, found)} exceeds the limit of {found.limit_of_side},"
        f" but {extent}: leaves differ, and no change is claimed."
    )
    return Decision(Change.UNCHANGED, reason, 1.0, 0.0)


def _without_surface(plant: PlantMeasures, found: _Excess, surface: _Excess, rules: PlantLimits) -> Decision:
    """Leave a plant unchanged whose top or volume changed while its surface did not."""
    share = _quantity(surface.excess, surface.unit)
    least = _quantity(math.copysign(rules.min_net_change, found.strength), surface.unit, sign=False)
    reason = (
        f"{_compared(plant, found)} exceeds the limit of {found.limit_of_side},"
        f" but the surface changed by only {share} (limit {least}):"
        " no change is claimed."
    )
    return Decision(Change.UNCHANGED, reason, 1.0, 0.0)


def _excesses(
    plant: PlantMeasures, gate: float, rules: PlantLimits, null: VegetationNull
) -> dict[str, _Excess]:
    """Return every measure of a whole plant with its limit: the rule's, or the scatter of the pair."""
    share = rules.height_share * plant.height
    top = max(share if applies("tops_of_tall_plants", share > rules.height) else rules.height, gate)
    hedge = max(rules.volume * plant.height, gate)
    rise = hedge if applies("volume_of_hedges", plant.kind == "hedge" and hedge < top) else top
    limits = {
        "outline": rules.outline * plant.reach
        if applies("outline_of_plants", math.isfinite(plant.reach))
        else math.inf,
        "top": top,
        "rise": rise,
        "volume": rules.volume,
        "surface": rules.min_net_change if _has_part_on_side(plant, plant.surface, rules) else rules.surface,
        "base": max(rules.base, gate),
    }
    found = {}
    for measure, limit in limits.items():
        expected = null.expected(plant, measure)
        sd = _sigma(plant, measure, expected.sd)
        least = max(limit, null.certain * sd)
        if applies("leaves_of_the_pair", expected.leaves > least):
            least = expected.leaves
        found[measure] = _Excess(measure, plant.value(measure), expected, least, sd)
    return found


@switchable("own_error_of_plants", third_argument)
def _sigma(plant: PlantMeasures, measure: str, scatter: float) -> float:
    """Return the standard deviation of a measure of an unchanged plant: the scatter and its own error.

    The own error of a share is that of a count of voxels: neighbouring voxels are seen, or not, in pairs.
    """
    if measure in ("volume", "surface"):
        return max(scatter, math.sqrt(min(abs(plant.surface), 1.0) / max(0.5 * plant.voxels, 1.0)))
    return math.hypot(scatter, plant.error(measure))


_CONCLUSIONS = {
    Change.UNCHANGED: "no change is claimed",
    Change.INCREASED: "the plant grew",
    Change.DECREASED: "the plant shrank",
}


def _decision(plant: PlantMeasures, found: _Excess) -> Decision:
    """Say what was compared, the value, what the other plants did, the limit and the conclusion."""
    if not math.isfinite(found.value):
        return Decision(
            Change.UNCHANGED,
            f"{plant.kind.capitalize()}: the surveys share too few points of the plant, and no change is"
            " claimed.",
            0.0,
        )
    change = Change.UNCHANGED
    if abs(found.strength) > 1:
        change = Change.INCREASED if found.strength > 0 else Change.DECREASED
    verb = "does not exceed" if change is Change.UNCHANGED else "exceeds"
    reason = f"{_compared(plant, found)} {verb} the limit of {found.limit_of_side}: {_CONCLUSIONS[change]}."
    return Decision(change, reason, abs(found.strength), found.sigmas)


def _compared(plant: PlantMeasures, found: _Excess) -> str:
    """Write the value, what the other plants of the pair did, and the excess."""
    expected, unit = found.expected, found.unit
    others = "crowns" if plant.kind == "crown" else "hedges and shrubs"
    spread = _quantity(expected.sd, "m" if unit == "m" else "share", sign=False)
    scatter = f"(standard deviation {spread})"
    if expected.count:
        rest = f"the other {expected.count - 1} {others} of this pair by"
        rest += f" {_quantity(expected.shift, unit)} {scatter}"
    else:
        rest = f"this pair has too few {others}, so that the scatter of simulated pairs counts {scatter}"
    changed = f"{plant.kind.capitalize()}: {_NAMES[found.measure]} changed by {_quantity(found.value, unit)}"
    return f"{changed}, {rest}. The excess of {_quantity(found.excess, unit, more=found.more)}"


def _quantity(value: float, unit: str, *, sign: bool = True, more: int = 0) -> str:
    if unit == "share of mean":
        return percent_of_earlier(value, sign=sign, digits=more)
    shown = value if sign else abs(value)
    plus = "+" if sign else ""
    return f"{shown:{plus}z.{2 + more}f} m" if unit == "m" else f"{100 * shown:{plus}z.{more}f} %"
