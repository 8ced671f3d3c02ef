"""``report.html``: a change directory explained to the person who has to act on it."""

from __future__ import annotations

import base64
import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

from subiaco_change.outputs.change_directory_reading import ChangeDirectory, read_change_directory
from subiaco_change.outputs.geopackage import layers_of
from subiaco_change.outputs.reviews import review_counts
from subiaco_change.records import SEMANTIC_COLOURS
from subiaco_geo.atomic import whole_file
from subiaco_geo.cloud_windows import CloudFile
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.errors import InputError
from subiaco_geo.work.executors import Start
from subiaco_report import evidence_pictures as evidence
from subiaco_report import pictures
from subiaco_report.city_map import city_map
from subiaco_report.cloud_windows import Gathered, gather
from subiaco_report.colours import height_range
from subiaco_report.facts import (
    cell_level_cm,
    changed_rows,
    findings,
    is_simulated,
    least_observed,
    legend,
    lod_facts,
    number,
    registration_facts,
    summary,
    unseen_facts,
)
from subiaco_report.project_facts import project_facts
from subiaco_report.row_data import (
    CHUNK,
    FOLDER,
    pack,
    page_rows,
    picture_chunks,
    places_of,
    row_data,
    streets_of,
    write_chunks,
)
from subiaco_report.summary import build_summary, epoch_facts, largest_rows
from subiaco_report.viewer.build import viewer_link

_SHOWN = ("change", "projection", "height", "semantics", "instances")
#: Blocks beyond these, those with fewest changes, are left out: what bounds the report.
_MOST_BLOCKS = 40
#: Changed rows beyond these have no picture: what bounds the time.
_MOST_PICTURES = 20_000
#: Beyond so many changes, pictures lie in a folder beside the page.
_MOST_INSIDE = 500
#: Numbers drawn over the picture of a block, those of the surest changes.
_MOST_MARKS = 40
#: Table columns of the report: column, heading, decimals (None for text), unit or explanation.
#: Those of :data:`MORE` unfold on demand.
TABLE_COLUMNS: tuple[tuple[str, str, int | None, str], ...] = (
    ("object_id", "ID", 0, "object number, as in the pictures and files"),
    ("label", "Label", None, "what happened"),
    ("class", "Class", None, "what it is"),
    ("confidence", "Confidence", 2, "see 'How to read this report'"),
    ("delta_h_m", "Δh [m]", 2, "change of height (95th percentile)"),
    ("delta_v_m3", "ΔV [m³]", 1, "change of volume, 2.5D columns"),
    ("delta_h_low_m", "Δh from [m]", 2, "lower bound of the change of height"),
    ("delta_h_high_m", "Δh to [m]", 2, "upper bound of the change of height"),
    ("delta_v_low_m3", "ΔV from [m³]", 1, "lower bound of the change of volume"),
    ("delta_v_high_m3", "ΔV to [m³]", 1, "upper bound of the change of volume"),
    ("height_before_m", "Height before [m]", 1, "95 % height above ground in the earlier survey"),
    ("height_after_m", "Height after [m]", 1, "95 % height above ground in the later survey"),
    ("area_m2", "Area [m²]", 1, "area of the footprint"),
    ("delta_v_surface_m3", "ΔV surface [m³]", 1, "change of occupied surface voxels"),
    ("delta_c_m", "Δc [m]", 2, "shift of the centroid"),
    ("iou_3d", "IoU 3D", 2, "overlap of occupied voxels, 1 = identical"),
    ("d_perp_m", "D⊥ [m]", 3, "displacement along the surface normal"),
    ("lod95_m", "LoD95 [m]", 3, "smallest displacement that is distinguishable from noise"),
    ("observed_fraction", "Observed", 2, "share of the object's place that the other epoch saw"),
    ("evidence", "Evidence", None, "how we know what the other epoch saw"),
    ("match_kind", "Match", None, "one to one, split, merge or none"),
    ("id_before", "Before", None, "ids in the earlier epoch"),
    ("id_after", "After", None, "ids in the later epoch"),
    ("x", "East [m]", 1, "centroid"),
    ("y", "North [m]", 1, "centroid"),
    ("z", "Height [m]", 1, "centroid"),
)
MORE = (
    "delta_h_low_m",
    "delta_h_high_m",
    "delta_v_low_m3",
    "delta_v_high_m3",
    "height_before_m",
    "height_after_m",
    "area_m2",
    "delta_v_surface_m3",
    "delta_c_m",
    "iou_3d",
    "d_perp_m",
    "match_kind",
    "id_before",
    "id_after",
    "x",
    "y",
    "z",
)


def read_complete(directory: Path) -> ChangeDirectory:
    """Read a change directory that holds all that the pages are made of.

    Raises
    ------
    InputError
        The directory is not a complete change directory.
    """
    change = read_change_directory(directory)
    if "object_uid" not in change.table.columns:
        table = directory / "changes.csv"
        raise InputError(f"{table}: column object_uid is missing; run 'subiaco change' again")
    layers_of(directory / "changes.gpkg")  # raises where it is missing
    return change


def build_report(directory: Path) -> Path:
    """(Re)build ``report.html``, ``overview.png`` and ``summary.html`` from a change directory alone.

    Returns
    -------
    Path
        The report.

    Raises
    ------
    InputError
        The directory is not a complete change directory.
    """
    return write_report(read_complete(directory))


def write_report(
    change: ChangeDirectory, start: Start = partial, viewer: Callable[[], object] | None = None
) -> Path:
    """Write the files of :func:`build_report` into a change directory, of :func:`read_complete`.

    Parameters
    ----------
    change : ChangeDirectory
    start : callable, optional
        Begins work beside this process: :meth:`subiaco_geo.work.executors.Executor.start`.
    viewer : callable, optional
        Waits for the 3D viewer, which the report links, where it is being written.

    Returns
    -------
    Path
        The report.
    """
    directory = change.path
    changed = changed_rows(change.table)
    found = gather(change)
    blocks, marks = found.blocks.blocks(), changed_marks(changed)
    pictured = pictured_rows(changed, _MOST_PICTURES)
    drawing = start(evidence.evidence_pictures, found.epochs, pictured)
    drawing_blocks = [
        start(_block_context, found.epochs, block, [m for m in marks if block.holds(m.x, m.y)])
        for block in fullest_blocks(blocks, marks, _MOST_BLOCKS)
    ]
    overview = pictures.overview(found.overview, blocks, marks)
    rows = page_rows(change.table)
    drawn_blocks = [drawing_block() for drawing_block in drawing_blocks]
    drawn = dict(zip(pictured["object_id"], drawing(), strict=True))
    chunks = picture_chunks([int(number) for number in changed["object_id"]], drawn)
    inside = len(changed) <= _MOST_INSIDE
    files = {} if inside else _block_files(drawn_blocks)
    places = places_of(rows, blocks, directory / "changes.gpkg")
    streets = streets_of(rows, directory / "changes.gpkg")
    if viewer is not None:
        viewer()
    link = viewer_link(directory)
    context = report_context(change, found) | {
        "map": city_map(found.city, changed.iloc[:0]),
        "data": pack(
            _page_document(change, found, rows, (places, streets), changed, drawn) | {"viewer": link}
        ),
        "viewer": link,
        "chunks": [json.dumps(chunk, separators=(",", ":")) for chunk in chunks] if inside else [],
        "places": sorted(set(places) - {""}, key=_by_number),
        "streets": sorted(set(streets) - {""}),
        "project": project_facts(directory),
        "epochs": epoch_facts(change.run),
        "reviews": review_counts(change.table),
        "linked": {str(number) for number in rows["object_id"]},
        "without_picture": len(changed) - len(drawn),
        "blocks": open_fullest(drawn_blocks),
        "left_out": len(blocks) - len(drawn_blocks),
        "evaluation": _evaluation(directory),
    }
    with whole_file(directory / "overview.png") as path:
        path.write_bytes(overview)
    if inside:
        shutil.rmtree(directory / FOLDER, ignore_errors=True)
    else:
        write_chunks(directory, chunks, files)
    with whole_file(directory / "report.html") as path:
        path.write_text(environment().get_template("report.html.j2").render(context), encoding="utf-8")
    with whole_file(directory / "summary.html") as path:
        text = environment().get_template("summary.html.j2").render(build_summary(change, found, drawn))
        path.write_text(text, encoding="utf-8")
    return directory / "report.html"


def _page_document(
    change: ChangeDirectory,
    found: Gathered,
    rows: gpd.GeoDataFrame,
    places: tuple[list[str], list[str]],
    changed: gpd.GeoDataFrame,
    drawn: Mapping[int, evidence.Evidence],
) -> dict[str, Any]:
    """Return what the script of the page works on."""
    frame = found.city.frame
    return {
        "hash": str(change.run.get("table_hash", "")),
        "crs": change.run.get("crs"),
        "columns": [[*column, column[0] in MORE] for column in TABLE_COLUMNS],
        "rows": row_data(rows, TABLE_COLUMNS, frame, *places),
        "left_out": len(change.table) - len(rows),
        "chunk": CHUNK,
        "folder": FOLDER,
        "place_of": {
            str(number): index for index, number in enumerate(changed["object_id"]) if number in drawn
        },
        "panel": _panel(),
        "map": {"width": frame.shape[1] * frame.pixel, "height": frame.shape[0] * frame.pixel},
    }


def _by_number(name: str) -> tuple[int, str]:
    """Order names of places: shorter ones first, so that A2 stands before A10."""
    return len(name), name


def _block_files(blocks: list[dict[str, Any]]) -> dict[str, bytes]:
    """Take the pictures of blocks out of the page; it names them as files of the folder beside it."""
    files = {}
    for block in blocks:
        for picture in block["pictures"]:
            name = f"block_{block['name']}_{picture['kind']}.webp"
            files[name] = base64.b64decode(picture["uri"].partition(",")[2])
            picture["uri"] = f"{FOLDER}/{name}"
    return files


def environment() -> Environment:
    """Return the templates, with filter ``number`` and the sizes of a picture, ``panel``."""
    found = Environment(
        loader=PackageLoader("subiaco_report", "templates"),
        autoescape=select_autoescape(default=True, default_for_string=True),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    found.filters["number"] = number
    found.globals["panel"] = _panel()
    return found


def _panel() -> dict[str, int]:
    """Return the sizes of a picture on the page [pixel]."""
    return {
        "side": evidence.PANEL,
        "head": evidence.HEAD,
        "width": evidence.WIDTH,
        "height": evidence.HEIGHT,
    }


def changed_marks(changed: pd.DataFrame) -> list[pictures.Mark]:
    """Return the numbers of the changed objects at their positions."""
    places = zip(changed["x"], changed["y"], changed["object_id"], strict=True)
    return [pictures.Mark(x, y, str(i)) for x, y, i in places]


def fullest_blocks(
    blocks: list[pictures.Block], marks: list[pictures.Mark], most: int
) -> list[pictures.Block]:
    """Return the blocks with most changed objects, in their own order."""
    x, y = np.array([mark.x for mark in marks]), np.array([mark.y for mark in marks])
    counts = [int(np.count_nonzero(block.holds(x, y))) for block in blocks] if marks else [0] * len(blocks)
    kept = set(sorted(range(len(blocks)), key=lambda i: (-counts[i], i))[:most])
    return [block for index, block in enumerate(blocks) if index in kept]


def pictured_rows(changed: gpd.GeoDataFrame, most: int) -> gpd.GeoDataFrame:
    """Return the changed rows that get a picture: the largest changes, then those of highest confidence."""
    first = largest_rows(changed)
    return pd.concat([first, changed.drop(first.index)]).iloc[:most]


def report_context(change: ChangeDirectory, found: Gathered) -> dict[str, Any]:
    """Return what the template needs beside the pictures."""
    return {
        "run": change.run,
        "registration": registration_facts(change.registration),
        "lod": lod_facts(found.lod),
        "cells_cm": cell_level_cm(change.run),
        "unseen": unseen_facts(change.table, found.coverage, least_observed(change.path)),
        "legend": legend(),
        "summary": summary(change.table),
        "columns": TABLE_COLUMNS,
        "more": MORE,
        "all_rows": len(change.table),
        "class_colours": {s.label: f"rgb{SEMANTIC_COLOURS[s]}" for s in Semantic},
        "labels": [c.label for c in Change],
        "classes": [s.label for s in Semantic],
        "simulated": is_simulated(change.run),
        "findings": findings(change.run, change.registration),
        "calibrated": bool(change.run.get("confidence_calibrated", False)),
        "not_calibrated": change.run.get("confidence_not_calibrated", []),
        "assumed": int((change.table["evidence"] == "assumed").sum()),
    }


def _block_context(
    epochs: Sequence[CloudFile], block: pictures.Block, marks: list[pictures.Mark]
) -> dict[str, Any]:
    """Return pictures of a block, and the marks that it holds in metres from the north-west corner."""
    before, after = (epoch.inside(*block.bounds) for epoch in epochs)
    drawn = pictures.block_pictures(before, after, block)
    west, south, east, north = block.bounds
    return {
        "name": block.name,
        "core": block.core,
        "side": east - west,
        "corner": (west, south),
        "heights": height_range((before, after)),
        "changed": [m.text for m in marks],
        "marks": [{"x": m.x - west, "y": north - m.y, "text": m.text} for m in marks[:_MOST_MARKS]],
        "pictures": [
            {"kind": kind, "caption": pictures.KINDS[kind], "uri": _data_uri(drawn[kind])} for kind in _SHOWN
        ],
    }


def open_fullest(blocks: list[dict[str, Any]], most: int = 2) -> list[dict[str, Any]]:
    """Mark the blocks with most changed objects as open; the others unfold on demand."""
    ranked = sorted(range(len(blocks)), key=lambda i: (-len(blocks[i]["changed"]), i))[:most]
    return [block | {"open": index in ranked} for index, block in enumerate(blocks)]


def _data_uri(picture: bytes) -> str:
    return "data:image/webp;base64," + base64.b64encode(picture).decode("ascii")


def _evaluation(directory: Path) -> dict[str, Any] | None:
    path = directory / "evaluation.json"
    return json.loads(path.read_text()) if path.is_file() else None
