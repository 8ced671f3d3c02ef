"""Page of the rules that decide or move a label, generated from their registry."""

from __future__ import annotations

from reference_pages.markdown import GENERATED, cell, code, table
from subiaco_change.config import ChangeConfig
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules import RULE_GROUPS
from subiaco_change.method_rules.places import rule_places
from subiaco_change.method_rules.switches import Rule
from subiaco_geo.settings import setting_values

_INTRODUCTION = """\
A rule decides or moves the label of an object, a patch of ground or a point. Each rule is applied in one
place, and can be switched off: `--set 'rules_off=[thin_volumes]'`. `subiaco ablate --rules` switches off each
rule in turn and reports what the rule is worth. The rules marked *real data* keep real recordings free of
false claims and are judged on real pairs too."""


def page() -> str:
    """Return the page."""
    places = rule_places()
    values = setting_values(ChangeConfig())
    values |= {f"method_numbers.{name}": value for name, value in setting_values(NUMBERS).items()}
    parts = ["# Rules of the method", GENERATED, _INTRODUCTION]
    for title, rules in RULE_GROUPS.items():
        rows = (
            (code(rule.name), cell(_reason(rule)), _numbers(rule, values), code(places[rule.name][0]))
            for rule in rules
        )
        parts += [f"## {title}", table(("rule", "reason", "numbers", "place"), rows)]
    return "\n\n".join(parts) + "\n"


def _reason(rule: Rule) -> str:
    return f"{rule.reason} *Real data.*" if rule.guards else rule.reason


def _numbers(rule: Rule, values: dict[str, object]) -> str:
    return "<br>".join(f"{code(name)} {cell(values[name])}" for name in rule.numbers)
