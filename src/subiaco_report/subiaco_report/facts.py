"""Figures and texts of a change directory for its pages."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd

from subiaco_change.decisions.config import DecisionConfig
from subiaco_change.outputs.rasters import Coverage
from subiaco_change.outputs.reviews import is_rejected
from subiaco_change.records import CHANGE_COLOURS
from subiaco_geo.codes import CHANGED_LABELS, Change, Semantic
from subiaco_geo.config import read_parameters
from subiaco_geo.findings import Finding
from subiaco_geo.frames import rotation_angle
from subiaco_geo.simulated import SIMULATIONS
from subiaco_report.cloud_windows import LodCounts

_MEANINGS = {
    Change.ADDED: "only in the later epoch, at a place that the earlier one observed",
    Change.REMOVED: "only in the earlier epoch, at a place that the later one observed",
    Change.INCREASED: "in both epochs, larger or higher now",
    Change.DECREASED: "in both epochs, smaller or lower now",
    Change.UNCHANGED: "in both epochs, no difference beyond the level of detection",
    Change.NOT_REPORTED: "left out on purpose: movable things such as cars, ghost trails of moving objects,"
    " and objects that are part of the ground",
    Change.UNOBSERVED: "nothing is claimed: the other survey saw too little of the place, or what it saw does"
    " not decide",
}


#: Colours that people with any kind of colour vision tell apart (Okabe and Ito, 2008).
SAFE_COLOURS = CHANGE_COLOURS | {
    Change.ADDED: (0, 158, 115),
    Change.REMOVED: (204, 121, 167),
    Change.INCREASED: (0, 114, 178),
    Change.DECREASED: (230, 159, 0),
}
_SIGNS = dict(zip(Change, ("+", "\u2212", "\u25b2", "\u25bc", "=", "\u00b7", "?"), strict=True))


def findings(run: Mapping[str, Any], registration: Mapping[str, Any]) -> list[dict[str, str]]:
    """Return what speaks against a result, what is serious first; of a run without a list, its warnings."""
    if "findings" in run:
        return list(run["findings"])
    texts = [*registration.get("warnings", []), *run.get("warnings", [])]
    return [Finding("unnamed", "warning", text).document() for text in texts]


def is_simulated(run: Mapping[str, Any]) -> bool:
    """Tell whether an epoch of the run was simulated, as far as is known."""
    return bool(run.get("notes", {}).get(SIMULATIONS))


def changed_rows(table: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
    """Return the rows called changed, those that a reviewer rejected too, the surest first."""
    rows = table[table["label"].isin(CHANGED_LABELS)]
    return rows.sort_values(["confidence", "object_id"], ascending=[False, True])


def number(value: Any, decimals: int = 2) -> str:
    """Format a number with narrow thousands gaps; missing values are a dash."""
    if value is None or not np.isfinite(float(value)):
        return "–"
    return f"{float(value):,.{decimals}f}".replace(",", "\u202f")


def legend() -> list[dict[str, str]]:
    """Return label, colour, colour for the colour-blind, sign and meaning of every outcome."""
    return [
        {
            "label": c.label,
            "colour": f"rgb{CHANGE_COLOURS[c]}",
            "safe": f"rgb{SAFE_COLOURS[c]}",
            "sign": _SIGNS[c],
            "meaning": _MEANINGS[c],
        }
        for c in Change
    ]


def registration_facts(registration: Mapping[str, Any]) -> dict[str, Any]:
    """Return the registration numbers in the units that people think in."""
    std = np.array([np.nan if v is None else v for v in registration["pose_std"]], dtype=np.float64)
    local = np.array(registration["T_local_about_origin"], dtype=np.float64)
    return {
        "method": registration["method"],
        "rmse_cm": _scaled(registration["rmse_m"], 100.0),
        "inlier_percent": _scaled(registration["inlier_ratio"], 100.0),
        "sigma_cm": _scaled(registration["sigma_reg_m"], 100.0),
        "shift_m": float(np.linalg.norm(local[:3, 3])),
        "turn_deg": float(np.degrees(rotation_angle(local))),
        "std_turn_mdeg": (np.degrees(std[:3]) * 1000.0).tolist(),
        "std_shift_mm": (std[3:] * 1000.0).tolist(),
        "origin": registration["origin"],
        "degenerate": registration["degenerate"],
    }


def _scaled(value: float | None, factor: float) -> float | None:
    return None if value is None else float(value) * factor


def lod_facts(lod: LodCounts) -> dict[str, Any]:
    """Return median and 95th percentile LoD95 of all points [cm], None for none, and the share without."""
    return {
        "median_cm": _scaled(lod.percentile(50.0), 100.0),
        "p95_cm": _scaled(lod.percentile(95.0), 100.0),
        "no_claim_percent": 100.0 * lod.unclaimed,
    }


def cell_level_cm(run: Mapping[str, Any]) -> float | None:
    """Return the median LoD95 over the cells of 5 m that have one [cm], as ``run.json`` states it."""
    return _scaled(run.get("level_of_detection", {}).get("median_where_known_m"), 100.0)


def least_observed(directory: Path) -> float:
    """Return ``decisions.min_observed`` of the run: the share below which an object is hardly observed."""
    path = directory / "config.yaml"
    found: Any = read_parameters(path) if path.is_file() else {}
    for name in ("decisions", "min_observed"):
        found = found.get(name) if isinstance(found, dict) else None
    return DecisionConfig().min_observed if found is None else float(found)


def unseen_facts(table: pd.DataFrame, coverage: Coverage, least: float) -> dict[str, Any]:
    """Return of how much nothing is claimed: objects, and ground area [m2].

    Of the objects that are Unobserved, the other survey observed less than the share ``least`` of the place
    (``little_seen``), or what it observed does not decide (``undecided``).
    """
    unobserved = table.loc[table["label"] == Change.UNOBSERVED.label, "observed_fraction"]
    little = int((unobserved < least).sum())
    return {
        "objects": len(unobserved),
        "little_seen": little,
        "undecided": len(unobserved) - little,
        "least_percent": 100.0 * least,
        "both_m2": coverage.area(1),
        "only_before_m2": coverage.area(2),
        "only_after_m2": coverage.area(3),
        "undecided_m2": coverage.area(4),
    }


def summary(table: pd.DataFrame) -> list[dict[str, Any]]:
    """Return counts by class (rows) and label, with totals last; rejected rows are left out."""
    table = table[~is_rejected(table)]
    counts = pd.crosstab(table["class"], table["label"]).reindex(
        index=[s.label for s in Semantic], columns=[c.label for c in Change], fill_value=0
    )
    counts.loc["all"] = counts.sum()
    return [
        {"class": name, "counts": row.tolist(), "total": int(row.sum())} for name, row in counts.iterrows()
    ]
