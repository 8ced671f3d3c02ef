"""Verdict on a map: checks with limits, and one sentence."""

from __future__ import annotations

from typing import Any

from subiaco_mapping.map_quality.config import MapQualityConfig
from subiaco_mapping.map_quality.time_series import BESIDE

#: Check, where its figure stands in the facts, its limit in the configuration.
_CHECKS = (
    ("Withheld fixes, horizontal RMSE", ("withheld", "horizontal_rmse_m"), "max_horizontal"),
    ("Withheld fixes, vertical RMSE", ("withheld", "vertical_rmse_m"), "max_vertical"),
    ("Withheld fixes that contradict the map", ("withheld", "share_contradicting"), "max_contradicting"),
    ("Withheld errors over stated sigma", ("withheld", "error_over_sigma"), "max_ratio"),
    ("Seams between drives, 95 %", ("loops", "between", "seam_p95_m"), "max_seam"),
    ("Seams within a drive, 95 %", ("loops", "within", "seam_p95_m"), "max_seam"),
    ("Wall thickness, 95 %", ("walls", "thickness_p95_m"), "max_wall"),
    ("Pause between drives", ("pause_days",), "max_pause_days"),
    ("Share of the way that one reason flags", ("flagged", "share"), "max_flagged"),
)
_OPENINGS = {
    "good": "Good",
    "contradicted": "Contradicted by its own fixes",
    "check": "Look before you sign",
    "unchecked": "Not checked against fixes",
    "local": "Local map, without coordinates",
}


def checks(facts: dict[str, Any], limits: MapQualityConfig) -> list[dict[str, Any]]:
    """Hold figures against their limits; what could not be measured has neither value nor answer."""
    found = []
    for name, path, limit in _CHECKS:
        value, most = _at(facts, path), float(getattr(limits, limit))
        answer = None if value is None else value <= most
        found.append(
            {
                "name": name,
                "value": value,
                "limit": most,
                "ok": answer,
                "unit": _unit(path[-1]),
                "setting": f"quality.{limit}",
            }
        )
    return found


def _at(facts: Any, path: tuple[str, ...]) -> float | None:
    for key in path:
        facts = facts.get(key) if isinstance(facts, dict) else None
    return None if facts is None else float(facts)


def _unit(name: str) -> str:
    if name.endswith("_days"):
        return "days"
    return "m" if name.endswith("_m") else "%" if name.startswith("share") else "times"


def amount(value: float | None, unit: str = "m") -> str:
    """Write a figure for people: millimetres below a decimetre, a dash where there is none."""
    if value is None:
        return "–"
    if unit == "days":
        return f"{value:.1f} days"
    if unit == "%":
        return f"{100 * value:.1f} %"
    if unit == "times":
        return f"{value:.2f} times"
    return f"{1000 * value:.0f} mm" if abs(value) < 0.1 else f"{value:.2f} m"


def verdict(facts: dict[str, Any]) -> dict[str, Any]:
    """Return ``grade`` (a key of ``_OPENINGS``), one ``sentence`` with numbers, and what is ``wrong``."""
    wrong = [
        f"{one['name']}: {amount(one['value'], one['unit'])}, limit {amount(one['limit'], one['unit'])}"
        for one in facts["checks"]
        if one["ok"] is False
    ]
    unchecked = not isinstance(facts["withheld"], dict)
    grade = "check" if wrong else "unchecked" if unchecked else "good"
    if not facts["georeferenced"]:
        grade = "local"
    elif facts.get("contradicted"):
        grade = "contradicted"
        wrong.insert(0, "; ".join(facts["contradicted"]))
    said = "; ".join(_said(facts)) or "nothing could be measured"
    return {"grade": grade, "sentence": f"{_OPENINGS[grade]}: {said}.", "wrong": wrong}


def _said(facts: dict[str, Any]) -> list[str]:
    """Return the clauses of the sentence."""
    held, walls, said = facts["withheld"], facts["walls"], []
    if any(one["unit"] == "days" and one["ok"] is False for one in facts["checks"]):
        said.append(
            f"its drives lie {facts['pause_days']:.0f} days apart, so that what changed between them is in "
            "the map twice or half: map the drives of each survey by themselves"
        )
    if isinstance(held, dict):
        said.append(
            f"{held['fixes'] - held['contradicting']} of {held['fixes']} RTK fixes that this check left out "
            f"lie {amount(held['horizontal_rmse_m'])} horizontally and {amount(held['vertical_rmse_m'])} "
            f"vertically off the path (RMS), {held['error_over_sigma']:.1f} times what was stated"
            + (f", and {held['contradicting']} contradict it" if held["contradicting"] else "")
        )
    if facts["georeferenced"]:
        beside = facts["positions"]["sigma_vertical_beside_median_m"]
        said.append(f"heights {BESIDE:.0f} m from the vehicle have a standard deviation of {amount(beside)}")
    for kind, words in (("between", "drives meet each other"), ("within", "drives meet themselves")):
        seam = _at(facts, ("loops", kind, "seam_p95_m"))
        if seam is not None:
            said.append(f"{words} to {amount(seam)} (95 %)")
    if walls["patches"]:
        said.append(
            f"walls are {amount(walls['thickness_median_m'])} thick (95 % under "
            f"{amount(walls['thickness_p95_m'])})"
        )
    metres = facts["flagged"]["metres"]
    worst = max(metres, key=metres.__getitem__, default=None)
    way = facts["positions"]["length_m"]
    if worst is None:
        said.append(f"nothing on {way:.0f} m of way was flagged")
    else:
        said.append(f"{metres[worst]:.0f} of {way:.0f} m are flagged '{worst.replace('_', ' ')}'")
    return said
