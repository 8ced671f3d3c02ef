"""Rows of the change table as compressed data of the page, and their pictures in chunks loaded when seen."""

from __future__ import annotations

import base64
import gzip
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np

from subiaco_change.outputs.geopackage import layers_of
from subiaco_change.outputs.parcels import OUTSIDE
from subiaco_change.outputs.reviews import review_states
from subiaco_geo.atomic import whole_directory
from subiaco_geo.codes import CHANGED_LABELS
from subiaco_report.evidence_pictures import Evidence, svg_path
from subiaco_report.pictures import Block
from subiaco_report.top_views import Frame

#: Pictures of a chunk; a page of the table shows half as many rows.
CHUNK = 100
#: Folder beside the report that holds what is not in the page, and the file that marks it as ours.
FOLDER, MARKER = "report_files", "README.txt"
_ABOUT = "Pictures of report.html, which loads them when they are seen. Keep this folder beside it.\n"
_TEXTS = ("object_uid", "reason", "review", "reviewer", "note")
#: Attributes of lots that name their street.
_STREETS = ("street", "street_name", "streetname", "road", "road_name")
_POSITIONS = ("x", "y", "z")  # given to the millimetre, so that they can be copied

#: A table with more rows than this gives the page its changed rows only.
_MOST_ROWS = 5000

Columns = Sequence[tuple[str, str, int | None, str]]


def pack(document: Any) -> str:
    """Return JSON as gzip in base64: what the page unpacks with ``DecompressionStream``."""
    text = json.dumps(document, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return base64.b64encode(gzip.compress(text.encode("utf-8"), 6, mtime=0)).decode("ascii")


def page_rows(table: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
    """Return the rows of the page: changed ones first, the surest on top; of large tables no others."""
    kept = table if len(table) <= _MOST_ROWS else table[table["label"].isin(CHANGED_LABELS)]
    changed = kept["label"].isin(CHANGED_LABELS)
    ordered = kept.assign(_changed=changed).sort_values(
        ["_changed", "confidence", "object_id"], ascending=[False, False, True]
    )
    return ordered.drop(columns="_changed")


def row_data(
    rows: gpd.GeoDataFrame, columns: Columns, frame: Frame, places: Sequence[str], streets: Sequence[str] = ()
) -> dict[str, Any]:
    """Return the rows column by column, with outlines for the map.

    Parameters
    ----------
    rows : GeoDataFrame
        In the order in which the page shows them first.
    columns : sequence
        Columns of the page; see :data:`subiaco_report.page.TABLE_COLUMNS`.
    frame : Frame
        Of the map.
    places : sequence of str
        Lot or block of every row.
    streets : sequence of str
        Street of every row; empty where lots name none.

    Returns
    -------
    dict
        Lists by column; missing numbers are None. ``shape``: outline as an SVG path [m] from the north-west
        corner of the map; ``box``: its bounds there; ``state``: of the review.
    """
    data: dict[str, Any] = {}
    for name, _, decimals, _ in columns:
        if decimals is None:
            data[name] = rows[name].fillna("").astype(str).tolist()
            continue
        values = np.round(
            rows[name].to_numpy(dtype=np.float64), 3 if name in _POSITIONS else max(decimals, 2)
        )
        whole = decimals == 0
        data[name] = [None if not np.isfinite(v) else int(v) if whole else float(v) for v in values]
    for name in _TEXTS:
        data[name] = rows[name].fillna("").astype(str).tolist()
    data["state"] = review_states(rows).tolist()
    data["place"] = list(places)
    data["street"] = list(streets) or [""] * len(rows)
    data["shape"] = [svg_path(shape, frame.west, frame.north) for shape in rows.geometry]
    bounds = rows.geometry.bounds.to_numpy().reshape(-1, 4)
    corner = np.array([frame.west, frame.north])
    low, high = bounds[:, :2] - corner, bounds[:, 2:] - corner
    boxes = np.round(np.stack([low[:, 0], -high[:, 1], high[:, 0], -low[:, 1]], axis=1), 1)
    data["box"] = boxes.tolist()
    return data


def streets_of(rows: gpd.GeoDataFrame, package: Path) -> list[str]:
    """Return the street of the lot that holds each row; none where lots name no streets."""
    lots = _lots(package)
    names = {} if lots is None else {str(column).lower(): column for column in lots.columns}
    column = next((names[name] for name in _STREETS if name in names), None)
    if lots is None or column is None:
        return []
    return _on_lots(rows, lots, column, "")


def places_of(rows: gpd.GeoDataFrame, blocks: Sequence[Block], package: Path) -> list[str]:
    """Return the lot that holds each row where the GeoPackage has lots, else the block of 80 m."""
    lots = _lots(package)
    if lots is not None:
        return _on_lots(rows, lots, "lot", OUTSIDE)
    names = np.full(len(rows), "", dtype=object)
    x, y = rows["x"].to_numpy(), rows["y"].to_numpy()
    for block in blocks:
        west, south, east, north = block.core
        names[(x >= west) & (x < east) & (y >= south) & (y < north)] = block.name
    return [str(name) for name in names]


def _lots(package: Path) -> gpd.GeoDataFrame | None:
    """Return the lots of a change directory, with their attributes; None without lots."""
    if "parcels" not in layers_of(package):
        return None
    lots = gpd.read_file(package, layer="parcels", engine="pyogrio")
    return lots[lots["lot"] != OUTSIDE]


def _on_lots(rows: gpd.GeoDataFrame, lots: gpd.GeoDataFrame, column: str, outside: str) -> list[str]:
    """Return an attribute of the lot that holds each row."""
    names = np.full(len(rows), outside, dtype=object)
    row, lot = lots.sindex.query(rows.geometry.representative_point().values, predicate="intersects")
    names[row] = lots[column].fillna(outside).astype(str).to_numpy()[lot]
    return [str(name) for name in names]


def picture_chunks(order: Sequence[int], drawn: Mapping[int, Evidence]) -> list[dict[str, Any]]:
    """Return the pictures by object id in chunks of :data:`CHUNK` rows of the page.

    A picture is a list of the WebP in base64, outline, ends of the footprint in a section, scale bar in
    pixels and in metres, and the note; see :class:`~subiaco_report.evidence_pictures.Evidence`.
    """
    chunks = []
    for start in range(0, len(order), CHUNK):
        held = [(number, drawn[number]) for number in order[start : start + CHUNK] if number in drawn]
        chunks.append(
            {
                str(number): [
                    base64.b64encode(found.webp).decode("ascii"),
                    found.outline,
                    found.ticks,
                    found.bar,
                    found.bar_m,
                    found.note,
                ]
                for number, found in held
            }
        )
    return chunks


def write_chunks(directory: Path, chunks: Sequence[Mapping[str, Any]], files: Mapping[str, bytes]) -> None:
    """Write the folder beside the report: a script for every chunk, and other pictures by name.

    Scripts rather than JSON, because browsers let a page from the file system load no other form of data.
    """
    with whole_directory(directory / FOLDER, overwrite=True, marker=MARKER) as target:
        (target / MARKER).write_text(_ABOUT)
        for number, chunk in enumerate(chunks):
            text = json.dumps(chunk, separators=(",", ":"), ensure_ascii=False)
            (target / f"{number}.js").write_text(f"subiacoChunk({number},{text});\n", encoding="utf-8")
        for name, content in files.items():
            (target / name).write_bytes(content)
