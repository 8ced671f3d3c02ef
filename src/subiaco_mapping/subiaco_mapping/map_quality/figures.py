"""Figures of the quality page."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from subiaco_geo.frames import Floats
from subiaco_geo.maps import plain
from subiaco_geo.simulated import SIMULATIONS
from subiaco_geo.survey_map import SurveyMap
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.manifest import CONTRADICTED, LEGEND
from subiaco_mapping.map_quality.gnss_holdout import FixErrors, fix_errors, holdout_check
from subiaco_mapping.map_quality.time_series import STATES, Series, series_of
from subiaco_mapping.map_quality.verdict import checks, verdict
from subiaco_mapping.map_quality.wall_thickness import WallCoverage, Walls, coverage, wall_thickness
from subiaco_mapping.survey_graph.solution import GraphSolution

_DAY_NS = 86_400_000_000_000


@dataclass(frozen=True)
class Assessment:
    """Everything that the report tells and draws.

    Parameters
    ----------
    series : list of Series
    used : FixErrors
        Fixes that act on the map, against it.
    withheld : FixErrors or str
        Or why there are none.
    walls : Walls
    coverage : WallCoverage
    facts : dict
        Plain values, those of ``quality.json``.
    """

    series: list[Series]
    used: FixErrors
    withheld: FixErrors | str
    walls: Walls
    coverage: WallCoverage
    facts: dict[str, Any]


def assess(survey: SurveyMap, solution: GraphSolution, config: MappingConfig) -> Assessment:
    """Measure a map.

    Parameters
    ----------
    survey : SurveyMap
        With its manifest.
    solution : GraphSolution
        What the map was built from, with its graph.
    config : MappingConfig
    """
    assert solution.graph is not None
    series = series_of(solution, config)
    used, withheld = _used(solution), holdout_check(solution, config)
    walls, cells = wall_thickness(survey.cloud), coverage(survey.cloud)
    facts: dict[str, Any] = {
        "verdict": {},  # filled below, first in the file
        "georeferenced": solution.frame is not None,
        "crs": survey.crs,
        "simulated": bool(survey.info.get(SIMULATIONS)),
        "sequences": {one.name: _sequence_facts(one) for one in series},
        "pause_days": _pause_days(survey),
        "positions": _position_facts(series),
        "fixes_used": _by_state(used),
        "contradicted": _contradicted(survey),
        "withheld": withheld if isinstance(withheld, str) else withheld.described(),
        "control": survey.info.get("control"),
        "loops": solution.loops.described(),
        "walls": walls.described(),
        "coverage": cells.described(),
        "flagged": _flagged(survey, sum(one.way for one in series)),
        "moving_points": None if survey.moving is None else len(survey.moving),
    }
    facts["checks"] = checks(facts, config.quality)
    facts["verdict"] = verdict(facts)
    return Assessment(series, used, withheld, walls, cells, plain(facts))


def _pause_days(survey: SurveyMap) -> float | None:
    """Return the longest time between consecutive scans of a map [days]; None without scans."""
    way = survey.trajectory
    if way is None or len(way) < 2:
        return None
    return float(np.diff(np.sort(way.times_ns)).max()) / _DAY_NS


def _contradicted(survey: SurveyMap) -> list[str]:
    """Say of which sequences most fixes contradict the map."""
    sequences = survey.manifest.get("sequences", {})
    return [
        f"{name}: {facts['gnss']['contradicting']} of {facts['gnss']['used']} fixes are farther off the map "
        "than they state; check their stamps, heights and the antenna's place"
        for name, facts in sequences.items()
        if CONTRADICTED in facts.get("flagged", {})
    ]


def _used(solution: GraphSolution) -> FixErrors:
    assert solution.graph is not None
    fixes = {k: c.gnss for k, c in solution.graph.chains.items() if c.gnss is not None and len(c.gnss.index)}
    every = {number: np.arange(len(own.index)) for number, own in fixes.items()}
    return fix_errors(fixes, solution.graph.solved.chains, every, independent=False)


def _by_state(used: FixErrors) -> dict[str, dict[str, float]]:
    parts = {name: used.of_state(state) for state, name in STATES.items() if state >= 0}
    return {name: part.described() for name, part in reversed(parts.items()) if len(part)}


def _sequence_facts(one: Series) -> dict[str, Any]:
    shares = {name: float((one.state == state).mean()) for state, name in STATES.items()}
    moved = np.linalg.norm(one.correction[:, :3], axis=1)
    return {
        "length_m": one.way,
        "seconds": float(one.seconds[-1]),
        "states": {name: share for name, share in shares.items() if share > 0},
        "largest_correction_m": float(moved.max()),
        "largest_correction_deg": float(np.abs(one.correction[:, 3]).max()),
    }


def _position_facts(series: list[Series]) -> dict[str, float]:
    sigma = np.concatenate([one.sigma for one in series])
    horizontal = np.hypot(sigma[:, 0], sigma[:, 1])
    return {
        "poses": len(sigma),
        "length_m": sum(one.way for one in series),
        **_quantiles("sigma_horizontal", horizontal),
        **_quantiles("sigma_vertical", sigma[:, 2]),
        **_quantiles("sigma_vertical_beside", np.concatenate([one.sigma_beside for one in series])),
    }


def _quantiles(name: str, values: Floats) -> dict[str, float]:
    median, high = np.quantile(values, [0.5, 0.95])
    return {f"{name}_median_m": float(median), f"{name}_p95_m": float(high)}


def _flagged(survey: SurveyMap, way: float) -> dict[str, Any]:
    """Return every flagged stretch, and the longest share of the way that one reason flags."""
    rows = [
        {"sequence": name, "reason": reason, "meaning": _meaning(survey, reason), **stretch}
        for name, facts in survey.manifest.get("sequences", {}).items()
        for reason, found in facts.get("flagged", {}).items()
        for stretch in found
    ]
    metres: dict[str, float] = {}
    for row in rows:
        metres[row["reason"]] = metres.get(row["reason"], 0.0) + row.get("length_m", 0.0)
    return {"stretches": rows, "metres": metres, "share": max(metres.values(), default=0.0) / max(way, 1e-9)}


def _meaning(survey: SurveyMap, reason: str) -> str:
    legend = {**LEGEND, **survey.manifest.get("legend", {})}
    return str(legend.get(reason, "")).removeprefix("flag: ")
