"""Registry of the rules that decide or move a label: name, stages, reason and numbers of each.

A rule is applied in one place, which names it (:func:`~subiaco_change.method_rules.switches.switchable` or
:func:`~subiaco_change.method_rules.switches.applies`). The setting ``rules_off`` switches rules off for
``subiaco ablate --rules``, which shows what each of them is worth.
"""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches

from subiaco_change.method_rules.comparison_rules import (
    BUILDING_RULES,
    MOVING_OBJECT_RULES,
    OCCUPANCY_RULES,
    SPLITTING_RULES,
)
from subiaco_change.method_rules.other_rules import GROUND_RULES, PLANT_RULES, POINT_RULES
from subiaco_change.method_rules.segmentation_rules import SEGMENTATION_RULES
from subiaco_change.method_rules.switches import Rule

#: Rules by what they are about, in the order of the stages.
RULE_GROUPS: dict[str, tuple[Rule, ...]] = {
    "Segmentation": SEGMENTATION_RULES,
    "Occupancy": OCCUPANCY_RULES,
    "Moving objects": MOVING_OBJECT_RULES,
    "Splitting and merging": SPLITTING_RULES,
    "Buildings": BUILDING_RULES,
    "Plants": PLANT_RULES,
    "Ground": GROUND_RULES,
    "Single points": POINT_RULES,
}
#: All rules by name.
RULES: dict[str, Rule] = {rule.name: rule for group in RULE_GROUPS.values() for rule in group}
#: Groups of stages that ``Rule.stages`` names: a rule changes the keys of results of its own stages alone.
STAGES_OF_RULES = ("segmentation", "comparison", "plants", "ground", "labels")


def known_rules(names: Iterable[str]) -> tuple[str, ...]:
    """Return names of rules in the order of the registry.

    Raises
    ------
    ValueError
        A name is not that of a rule.
    """
    wanted = set(names)
    strange = sorted(wanted - set(RULES))
    if strange:
        close = get_close_matches(strange[0], RULES, n=1)
        advice = f"did you mean {close[0]}?" if close else "see the page of rules in the reference"
        raise ValueError(f"{strange[0]!r} is no rule; {advice}")
    return tuple(name for name in RULES if name in wanted)


def rules_of_stages(names: Iterable[str], stages: Iterable[str]) -> tuple[str, ...]:
    """Return those of some rules that act in some groups of stages."""
    here = set(stages)
    return tuple(name for name in names if here & set(RULES[name].stages))
