"""``benchmarks.json`` as a page for people."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

_HEAD = """# Benchmarks

Written by `make bench`, with [benchmarks.json](../../benchmarks.json); do not edit. Peers took the same
inputs in the same run; the project simulates them: **simulated**, preset `default`, tuning seed {seed}.
Factors are of the peer that is named. CPU seconds are of one thread unless something else is said; wall
times are those of this machine alone. Peers beyond our dependencies: `tests/benchmarks/requirements.txt`.
"""


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return rows as a markdown table; a column that a row lacks stays empty."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    lines = [columns, ["---"] * len(columns)]
    lines += [[_cell(row.get(name, "")) for name in columns] for row in rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _cell(value: object) -> str:
    if isinstance(value, float) and (value == 0 or abs(value) >= 1e-4):
        return f"{value:.10g}"
    return f"{value:,}" if isinstance(value, int) else str(value)


def page(found: Mapping[str, Any]) -> str:
    """Return the whole page."""
    parts = [_HEAD.format(seed=found["seed"]), _machine(found["machine"]), _surveys(found["surveys"])]
    for result in found["benchmarks"].values():
        parts.append(f"## {result['title']}\n\n" + "\n".join(f"    {line}" for line in result["commands"]))
        if result["rows"]:
            parts.append(table(result["rows"]))
        notes = [*result["remarks"], *(f"{name} absent: {why}" for name, why in result["absent"].items())]
        if notes:
            parts.append("\n".join(f"* {note}." for note in notes))
    return "\n\n".join(part.rstrip() for part in parts) + "\n"


def _machine(facts: Mapping[str, Any]) -> str:
    words = facts | {"packages": ", ".join(f"{name} {v}" for name, v in facts["packages"].items())}
    return table([{"": name.replace("_", " "), "this run": str(value)} for name, value in words.items()])


def _surveys(commands: Mapping[str, str]) -> str:
    return "Inputs:\n\n" + "\n".join(f"    {line}" for line in commands.values())
