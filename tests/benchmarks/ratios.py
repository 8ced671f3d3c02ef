"""Ratios of a benchmark run against the recorded ones: has anything become slower beside its peers?

A ratio is a column that begins with *of* (time of a peer, in the same run: more is worse) or with *times real
time* (less is worse). Seconds are those of a machine and are not compared, nor are ratios of wall times:
other work on the machine changes them, processor time hardly.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

TOLERANCE = 1.0 / 3.0  # by which a ratio may worsen; runs on one machine differ by a tenth
_MORE_IS_WORSE, _LESS_IS_WORSE, _WALL = "of ", "times real time", ", wall"


def ratios(found: Mapping[str, Any]) -> Iterator[tuple[str, str, float]]:
    """Give (benchmark and row, column, value) of every ratio of a run."""
    for name, result in found["benchmarks"].items():
        for row in result["rows"]:
            said = ", ".join(str(value) for value in row.values() if isinstance(value, str))
            for column, value in row.items():
                ratio = column.startswith((_MORE_IS_WORSE, _LESS_IS_WORSE)) and not column.endswith(_WALL)
                if ratio and isinstance(value, int | float):
                    yield f"{name}: {said}", column, float(value)


def worsened(
    recorded: Mapping[str, Any], measured: Mapping[str, Any], tolerance: float = TOLERANCE
) -> tuple[list[str], int]:
    """Return a line for every ratio that worsened by more than the tolerance, and how many were compared."""
    before = {(row, column): value for row, column, value in ratios(recorded)}
    lines, compared = [], 0
    for row, column, value in ratios(measured):
        old = before.get((row, column))
        if old is None or old <= 0 or value <= 0:
            continue
        compared += 1
        factor = value / old if column.startswith(_MORE_IS_WORSE) else old / value
        if factor > 1.0 + tolerance:
            lines.append(f"{row}, {column}: {value:g}, recorded {old:g} ({factor:.2f} times as bad)")
    return lines, compared
