"""``summary.html``: two pages for readers who need no table."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from typing import Any

import geopandas as gpd
import numpy as np
from numpy.typing import NDArray

from subiaco_change.decisions.confidence import BANDS
from subiaco_change.outputs.change_directory_reading import ChangeDirectory
from subiaco_change.outputs.geopackage import COVERAGE_COLOURS
from subiaco_change.outputs.rasters import COVERAGE, Coverage
from subiaco_change.outputs.reviews import is_rejected, review_counts
from subiaco_change.records import CHANGE_COLOURS
from subiaco_geo.codes import CHANGED_LABELS, Change
from subiaco_report.city_map import city_map, webp_uri
from subiaco_report.cloud_windows import Gathered
from subiaco_report.evidence_pictures import Evidence
from subiaco_report.facts import (
    changed_rows,
    findings,
    is_simulated,
    least_observed,
    lod_facts,
    summary,
    unseen_facts,
)

#: From, to, and the range in words.
SPANS = tuple(zip(BANDS, (1.01, *BANDS[:-1]), ("0.9 and more", "0.7 to 0.9", "below 0.7"), strict=True))
_LARGEST = 10


def build_summary(
    change: ChangeDirectory, found: Gathered, pictures: Mapping[int, Evidence]
) -> dict[str, Any]:
    """Return what the template of the summary needs.

    Parameters
    ----------
    change : ChangeDirectory
    found : Gathered
        Of its clouds.
    pictures : mapping of int to Evidence
        By object id, for every changed row.
    """
    claimed = changed_rows(change.table)
    changed = claimed[~is_rejected(claimed)]
    largest = largest_rows(changed)
    found_findings = findings(change.run, change.registration)
    measured = {band["low"]: band for band in change.run.get("confidence_bands", [])}
    calibrated = bool(change.run.get("confidence_calibrated", False))
    return {
        "simulated": is_simulated(change.run),
        "epochs": epoch_facts(change.run),
        "crs": change.run.get("crs"),
        "counts": [row for row in counts(change.table) if row["total"]],
        "labels": list(CHANGED_LABELS),
        "colours": {c.label: f"rgb{CHANGE_COLOURS[c]}" for c in Change},
        "changed": len(changed),
        "reviews": review_counts(change.table),
        "bands": [
            {
                "name": span,
                "count": int(changed["confidence"].between(low, high, inclusive="left").sum()),
                "measured": measured.get(low),
            }
            for low, high, span in SPANS
        ],
        "calibrated": calibrated,
        "not_calibrated": change.run.get("confidence_not_calibrated", []),
        "assumed": int((changed["evidence"] == "assumed").sum()),
        "lod": lod_facts(found.lod),
        "unseen": unseen_facts(change.table, found.coverage, least_observed(change.path)),
        "map": city_map(found.city, largest),
        "coverage": coverage_picture(found.coverage),
        "largest": [dict(row, picture=pictures[row["object_id"]]) for row in largest.to_dict("records")],
        "alarms": [f for f in found_findings if f["severity"] == "serious"],
        "warnings": [f for f in found_findings if f["severity"] != "serious"],
    }


def largest_rows(changed: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
    """Return the ten changed rows of largest volume, 2.5D, the largest first."""
    size = changed["delta_v_m3"].abs().fillna(0.0)
    return changed.loc[size.sort_values(ascending=False, kind="stable").index[:_LARGEST]]


def counts(table: gpd.GeoDataFrame) -> list[dict[str, Any]]:
    """Return counts of the four changes by class, and a last row of all."""
    index = [[c.label for c in Change].index(label) for label in CHANGED_LABELS]
    return [
        {"class": row["class"], "counts": picked, "total": sum(picked)}
        for row in summary(table)
        for picked in [[row["counts"][i] for i in index]]
    ]


def epoch_facts(run: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return name, days and kilometres of both epochs, None for what is not known."""
    known = run.get("notes", {}).get("epochs", {})
    facts = []
    for epoch in ("before", "after"):
        source, said = run["inputs"][epoch], known.get(epoch) or {}
        days = [day_of(said[key]) for key in ("first", "last") if said.get(key)]
        facts.append(
            {
                "epoch": epoch,
                "name": source["path"] if source else None,
                "days": " to ".join(dict.fromkeys(days)) or None,
                "km": said.get("km"),
                "points": run["points"][epoch],
            }
        )
    return facts


def day_of(text: str) -> str:
    """Write the day of an ISO time in words."""
    return f"{datetime.fromisoformat(text):%-d %B %Y}"


def coverage_picture(coverage: Coverage) -> dict[str, Any]:
    """Return a picture of what each epoch saw, and its legend with areas."""
    palette: NDArray[np.uint8] = np.array(
        [COVERAGE_COLOURS.get(COVERAGE[code], (255, 255, 255)) for code in sorted(COVERAGE)], dtype=np.uint8
    )
    step = -(-max(coverage.code.shape) // 900)
    picture = palette[coverage.code[::step, ::step]]
    grown = np.repeat(np.repeat(picture, 2, axis=0), 2, axis=1)
    entries = [
        {"name": name, "colour": f"rgb{COVERAGE_COLOURS[name]}", "area_m2": coverage.area(code)}
        for code, name in COVERAGE.items()
        if name in COVERAGE_COLOURS
    ]
    return {"uri": webp_uri(grown), "entries": entries}
