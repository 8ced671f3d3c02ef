"""``report.html``: a change directory explained to the person who has to act on it."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

from subiaco_change.outputs.raster import Coverage, build_coverage
from subiaco_change.outputs.reading import ChangeDirectory, read_change_directory
from subiaco_change.records import CHANGE_COLOURS
from subiaco_change.report import pictures
from subiaco_geo.atomic import whole_file
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.frames import rotation_angle

CHANGED_LABELS = tuple(c.label for c in (Change.ADDED, Change.REMOVED, Change.INCREASED, Change.DECREASED))
_MEANINGS = {
    Change.ADDED: "only in the later epoch, at a place that the earlier one looked at",
    Change.REMOVED: "only in the earlier epoch, at a place that the later one looked at",
    Change.INCREASED: "in both epochs, larger or higher now",
    Change.DECREASED: "in both epochs, smaller or lower now",
    Change.UNCHANGED: "in both epochs, no difference beyond the level of detection",
    Change.NOT_REPORTED: "movable things such as cars that were matched; left out on purpose",
    Change.UNOBSERVED: "the other epoch could not see the place: nothing is claimed",
}
_SHOWN = ("change", "projection", "height", "semantics", "instances")
#: Table columns of the report: column, heading, decimals (None for text), unit or explanation.
TABLE_COLUMNS: tuple[tuple[str, str, int | None, str], ...] = (
    ("object_id", "ID", 0, "object number, as in the pictures and files"),
    ("label", "Label", None, "what happened"),
    ("class", "Class", None, "what it is"),
    ("confidence", "Confidence", 2, "see 'How to read this report'"),
    ("delta_h_m", "Δh [m]", 2, "change of height (95th percentile)"),
    ("delta_v_m3", "ΔV [m³]", 1, "change of volume, 2.5D columns"),
    ("delta_v_surface_m3", "ΔV surface [m³]", 1, "change of occupied surface voxels"),
    ("delta_c_m", "Δc [m]", 2, "shift of the centroid"),
    ("iou_3d", "IoU 3D", 2, "overlap of occupied voxels, 1 = identical"),
    ("d_perp_m", "D⊥ [m]", 3, "displacement along the surface normal"),
    ("lod95_m", "LoD95 [m]", 3, "smallest displacement that can be told from noise"),
    ("observed_fraction", "Observed", 2, "share of the object's place that the other epoch saw"),
    ("evidence", "Evidence", None, "how we know what the other epoch saw"),
    ("match_kind", "Match", None, "one to one, split, merge or none"),
    ("id_before", "Before", None, "ids in the earlier epoch"),
    ("id_after", "After", None, "ids in the later epoch"),
    ("x", "East [m]", 1, "centroid"),
    ("y", "North [m]", 1, "centroid"),
    ("z", "Height [m]", 1, "centroid"),
    ("reason", "Why", None, "the rule that decided"),
)


def build_report(directory: Path) -> Path:
    """(Re)build ``report.html`` and ``overview.png`` from a change directory alone.

    Returns
    -------
    Path
        The report.

    Raises
    ------
    InputError
        The directory is not a complete change directory.
    """
    change = read_change_directory(directory)
    blocks = pictures.block_grid([change.before, change.after])
    marks = changed_marks(change.table)
    whole = pictures.overview(change.before, change.after, blocks, marks)
    context = report_context(change) | {
        "overview": _data_uri(whole),
        "blocks": open_fullest([_block_context(change, block, marks) for block in blocks]),
        "evaluation": _evaluation(directory),
    }
    with whole_file(directory / "overview.png") as path:
        path.write_bytes(whole)
    with whole_file(directory / "report.html") as path:
        path.write_text(_environment().get_template("report.html.j2").render(context), encoding="utf-8")
    return directory / "report.html"


def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("subiaco_change", "templates"),
        autoescape=select_autoescape(default=True, default_for_string=True),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["number"] = number
    return environment


def number(value: Any, decimals: int = 2) -> str:
    """Format a number with narrow thousands gaps; missing values are a dash."""
    if value is None or not np.isfinite(float(value)):
        return "–"
    return f"{float(value):,.{decimals}f}".replace(",", "\u202f")


def changed_marks(table: pd.DataFrame) -> list[pictures.Mark]:
    """Return the numbers of the changed objects at their positions."""
    rows = table[table["label"].isin(CHANGED_LABELS)]
    return [
        pictures.Mark(x, y, str(i)) for x, y, i in zip(rows["x"], rows["y"], rows["object_id"], strict=True)
    ]


def report_context(change: ChangeDirectory) -> dict[str, Any]:
    """Return what the template needs beside the pictures."""
    coverage = build_coverage(change.before, change.after)
    return {
        "run": change.run,
        "registration": registration_facts(change.registration),
        "lod": lod_facts(change),
        "unseen": unseen_facts(change.table, coverage),
        "legend": legend(),
        "summary": summary(change.table),
        "columns": TABLE_COLUMNS,
        "rows": table_rows(change.table),
        "labels": [c.label for c in Change],
        "classes": [s.label for s in Semantic],
        "warnings": [*change.run.get("warnings", []), *change.registration.get("warnings", [])],
        "calibrated": bool(change.run.get("confidence_calibrated", False)),
        "assumed": int((change.table["evidence"] == "assumed").sum()),
    }


def legend() -> list[dict[str, str]]:
    """Return label, colour and meaning of every outcome."""
    return [{"label": c.label, "colour": f"rgb{CHANGE_COLOURS[c]}", "meaning": _MEANINGS[c]} for c in Change]


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


def lod_facts(change: ChangeDirectory) -> dict[str, Any]:
    """Return median and 95th percentile LoD95 [cm], and the share without any claim."""
    lod95 = np.concatenate(
        [np.asarray(c.fields["lod95"], dtype=np.float64) for c in (change.before, change.after)]
    )
    finite = lod95[np.isfinite(lod95)]
    quantiles = np.percentile(finite, [50.0, 95.0]) * 100.0 if len(finite) else (None, None)
    return {
        "median_cm": quantiles[0],
        "p95_cm": quantiles[1],
        "no_claim_percent": 100.0 * (1.0 - len(finite) / len(lod95)),
    }


def unseen_facts(table: pd.DataFrame, coverage: Coverage) -> dict[str, Any]:
    """Return how much could not be compared: objects, and ground area [m2]."""
    return {
        "objects": int((table["label"] == Change.UNOBSERVED.label).sum()),
        "both_m2": coverage.area(1),
        "only_before_m2": coverage.area(2),
        "only_after_m2": coverage.area(3),
    }


def summary(table: pd.DataFrame) -> list[dict[str, Any]]:
    """Return counts by class (rows) and label, with totals last."""
    counts = pd.crosstab(table["class"], table["label"]).reindex(
        index=[s.label for s in Semantic], columns=[c.label for c in Change], fill_value=0
    )
    counts.loc["all"] = counts.sum()
    return [
        {"class": name, "counts": row.tolist(), "total": int(row.sum())} for name, row in counts.iterrows()
    ]


def table_rows(table: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the rows, changed ones first and the surest of those on top."""
    changed = table["label"].isin(CHANGED_LABELS)
    ordered = table.assign(_changed=changed).sort_values(
        ["_changed", "confidence", "object_id"], ascending=[False, False, True]
    )
    colours = {c.label: f"rgb{CHANGE_COLOURS[c]}" for c in Change}
    return [
        {
            "colour": colours[row["label"]],
            "changed": row["_changed"],
            **{c: row[c] for c, *_ in TABLE_COLUMNS},
        }
        for row in ordered.to_dict("records")
    ]


def _block_context(
    change: ChangeDirectory, block: pictures.Block, marks: list[pictures.Mark]
) -> dict[str, Any]:
    drawn = pictures.block_pictures(change.before, change.after, block, marks)
    inside = [m.text for m in marks if block.holds(m.x, m.y)]
    return {
        "name": block.name,
        "core": block.core,
        "changed": inside,
        "pictures": [
            {"kind": kind, "caption": pictures.KINDS[kind], "uri": _data_uri(drawn[kind])} for kind in _SHOWN
        ],
    }


def open_fullest(blocks: list[dict[str, Any]], most: int = 2) -> list[dict[str, Any]]:
    """Mark the blocks with most changed objects as open; the others unfold on demand."""
    ranked = sorted(range(len(blocks)), key=lambda i: (-len(blocks[i]["changed"]), i))[:most]
    return [block | {"open": index in ranked} for index, block in enumerate(blocks)]


def _data_uri(png: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(png).decode("ascii")


def _evaluation(directory: Path) -> dict[str, Any] | None:
    path = directory / "evaluation.json"
    return json.loads(path.read_text()) if path.is_file() else None
