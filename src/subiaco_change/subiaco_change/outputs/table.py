"""The change table: records to rows, rows to CSV, GeoPackage and GeoParquet, checked by a JSON Schema."""

from __future__ import annotations

import hashlib
import json
import re
from collections import Counter
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
from pyproj.exceptions import ProjError
from shapely.errors import ShapelyError
from shapely.geometry import MultiPolygon, Point, Polygon
from shapely.geometry.base import BaseGeometry

from subiaco_change.outputs.building_outline import regular_outline
from subiaco_change.records import ChangeRecord
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.csv_cells import escape_cell, restore_cell
from subiaco_geo.errors import InputError

#: Columns of the contract, in its order.
COLUMNS = (
    "object_id",
    "class",
    "label",
    "id_before",
    "id_after",
    "match_kind",
    "delta_h_m",
    "delta_v_m3",
    "delta_v_surface_m3",
    "delta_c_m",
    "iou_3d",
    "d_perp_m",
    "lod95_m",
    "observed_fraction",
    "evidence",
    "score_paper",
    "confidence",
    "n_before",
    "n_after",
    "x",
    "y",
    "z",
    "delta_h_low_m",
    "delta_h_high_m",
    "delta_v_low_m3",
    "delta_v_high_m3",
    "height_before_m",
    "height_after_m",
    "area_m2",
    "date_before",
    "date_after",
)
#: Columns that :func:`table_hash` covers. A column that is added to :data:`COLUMNS` later enters it only when
#: the method changes with it, so that a hash stays comparable between versions.
HASHED_COLUMNS = COLUMNS[: COLUMNS.index("date_after") + 1]
#: Columns that tables of version 1 lack; they read as missing values.
_LATER = COLUMNS[COLUMNS.index("delta_h_low_m") :]
#: Columns that people fill in; they survive a rerun of the same pair.
REVIEW_COLUMNS = ("review", "reviewer", "note")
ALL_COLUMNS = (*COLUMNS, "object_uid", "reason", *REVIEW_COLUMNS, "evidence_changed")
TEXT_COLUMNS = (
    "class",
    "label",
    "id_before",
    "id_after",
    "match_kind",
    "evidence",
    "date_before",
    "date_after",
    "object_uid",
    "reason",
    *REVIEW_COLUMNS,
    "evidence_changed",
)
STATISTICS = (
    "delta_h_m",
    "delta_v_m3",
    "delta_v_surface_m3",
    "delta_c_m",
    "iou_3d",
    "d_perp_m",
    "lod95_m",
    "observed_fraction",
    "score_paper",
    "confidence",
    "delta_h_low_m",
    "delta_h_high_m",
    "delta_v_low_m3",
    "delta_v_high_m3",
    "height_before_m",
    "height_after_m",
    "area_m2",
)
#: What libraries raise where a GeoParquet file is damaged.
_PARQUET_FAULTS = (OSError, ValueError, LookupError, TypeError, ShapelyError, ProjError, NotImplementedError)
_DECIMALS = dict.fromkeys(STATISTICS, 4) | {"x": 3, "y": 3, "z": 3}
_POINT_RADIUS = 0.25  # half a voxel of the decisions [m]: footprint of an object without area
_CELL = 1.0  # rounding of positions in object_uid [m]


def join_ids(ids: Sequence[int]) -> str:
    """Join object ids with ``;``; no id is the empty string."""
    return ";".join(str(i) for i in ids)


def footprint_polygon(record: ChangeRecord) -> MultiPolygon:
    """Return the footprint as a multipolygon, a small disc where it has no area."""
    shape: BaseGeometry = record.footprint
    if shape is None or shape.is_empty:
        shape = Point(record.x, record.y)
    if shape.area == 0.0:
        shape = shape.buffer(_POINT_RADIUS)
    if isinstance(shape, MultiPolygon):
        return shape
    if isinstance(shape, Polygon):
        return MultiPolygon([shape])
    return MultiPolygon([part for part in getattr(shape, "geoms", []) if isinstance(part, Polygon)])


def object_uids(records: Sequence[ChangeRecord]) -> list[str]:
    """Return one identifier a record, stable over reruns of the same pair.

    It hashes the class and the position rounded to a metre in the frame of
    *after*; a second object of that class in that cell gets a suffix.
    """
    seen: Counter[str] = Counter()
    uids = []
    for record in records:
        cell = (round(record.x / _CELL), round(record.y / _CELL), round(record.z / _CELL))
        text = f"{record.semantic.label}:{cell[0]}:{cell[1]}:{cell[2]}"
        uid = hashlib.sha256(text.encode()).hexdigest()[:12]
        uids.append(uid if seen[uid] == 0 else f"{uid}-{seen[uid]}")
        seen[uid] += 1
    return uids


def _row(record: ChangeRecord, dates: tuple[str, str]) -> dict[str, object]:
    named = {
        "date_before": dates[0],
        "date_after": dates[1],
        "class": record.semantic.label,
        "label": record.change.label,
        "id_before": join_ids(record.id_before),
        "id_after": join_ids(record.id_after),
    }
    return {name: named.get(name, getattr(record, name, None)) for name in COLUMNS}


def build_table(
    records: Sequence[ChangeRecord], crs: str | None, dates: tuple[str, str] = ("", "")
) -> gpd.GeoDataFrame:
    """Build the table in the order of object ids, missing statistics as NaN.

    Parameters
    ----------
    records : sequence of ChangeRecord
    crs : str or None
        System of the footprints and of ``x y z``.
    dates : (str, str)
        Day of the survey *before* and of *after*, ISO 8601; empty where not known.

    Returns
    -------
    GeoDataFrame
        Columns :data:`ALL_COLUMNS`, then ``geometry``; numbers rounded as in the files.
    """
    ordered = sorted(records, key=lambda r: r.object_id)
    ids = [r.object_id for r in ordered]
    if len(set(ids)) != len(ids):
        raise InputError("change records: object_id is not unique; every object needs its own")
    frame = pd.DataFrame([_row(r, dates) for r in ordered], columns=list(COLUMNS))
    for name in STATISTICS:
        values = frame[name].astype(np.float64)
        frame[name] = values.where(np.isfinite(values))
    frame = frame.round(_DECIMALS).astype(dict.fromkeys(("object_id", "n_before", "n_after"), np.int64))
    frame["object_uid"] = object_uids(ordered)
    frame["reason"] = [r.reason for r in ordered]
    for name in (*REVIEW_COLUMNS, "evidence_changed"):
        frame[name] = ""
    geometry = gpd.GeoSeries([footprint_polygon(r) for r in ordered], crs=crs)
    return gpd.GeoDataFrame(frame, geometry=geometry, crs=crs)


def with_regular_outlines(table: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
    """Return a table whose buildings have footprints with right angles, of the same areas."""
    is_building = (table["class"] == Semantic.BUILDING.label).to_numpy()
    shapes = [
        regular_outline(shape) if chosen else shape
        for shape, chosen in zip(table.geometry, is_building, strict=True)
    ]
    return table.set_geometry(gpd.GeoSeries(shapes, index=table.index, crs=table.crs))


def table_hash(table: pd.DataFrame) -> str:
    """Return a hash of what the method found: :data:`HASHED_COLUMNS` and footprints of :func:`build_table`.

    Reasons, names and reviews of earlier runs do not enter it, nor do the outlines of
    :func:`with_regular_outlines`.
    """
    computed = table[list(HASHED_COLUMNS)]
    digest = hashlib.sha256(computed.to_csv(index=False, lineterminator="\n").encode())
    for shape in table.geometry:
        digest.update(shape.normalize().wkt.encode())
    return digest.hexdigest()[:16]


def write_csv(path: Path, table: pd.DataFrame, float_format: str | None = None) -> None:
    """Write every column but the footprint; missing values are empty, and no text is a formula."""
    frame = pd.DataFrame(table.drop(columns="geometry", errors="ignore"))
    for name in frame.select_dtypes(["object", "string"]).columns:
        frame[name] = frame[name].map(lambda cell: escape_cell(cell) if isinstance(cell, str) else cell)
    frame.to_csv(path, index=False, lineterminator="\n", float_format=float_format)


def read_csv(path: Path) -> pd.DataFrame:
    """Read a table written by :func:`write_csv`, texts as texts.

    Spreadsheets that separate cells by semicolons and write decimal commas are read too.

    Raises
    ------
    InputError
        Not a CSV, or a column of the contract is missing.
    """
    try:
        frame = _read_cells(path)
    except ValueError as error:  # pandas' own, too: empty, not text, rows of different length
        reason = " ".join(str(error).split())
        raise InputError(f"{path}: not a change table ({reason}); run 'subiaco change' again") from error
    missing = [name for name in COLUMNS if name not in frame.columns and name not in _LATER]
    if missing:
        raise InputError(f"{path}: column {missing[0]} is missing; run 'subiaco change' again")
    for name in (*_LATER, "reason", *REVIEW_COLUMNS, "evidence_changed"):
        if name not in frame.columns:
            frame[name] = "" if name in TEXT_COLUMNS else np.nan
    texts = [name for name in TEXT_COLUMNS if name in frame.columns]
    frame[texts] = frame[texts].fillna("").map(restore_cell)
    _refuse_strange(path, frame)
    return frame


def _read_cells(path: Path) -> pd.DataFrame:
    with path.open(encoding="utf-8-sig") as stream:
        first = stream.readline()
    if first.count(";") <= first.count(","):
        return pd.read_csv(path, dtype=dict.fromkeys(TEXT_COLUMNS, str), keep_default_na=True)
    frame = pd.read_csv(path, sep=";", dtype=str, keep_default_na=True, encoding="utf-8-sig")
    for name in frame.columns.difference(TEXT_COLUMNS):
        frame[name] = pd.to_numeric(frame[name].str.replace(",", "."))
    return frame


def _refuse_strange(path: Path, frame: pd.DataFrame) -> None:
    """Refuse cells that no table of ours holds: texts for numbers, unknown labels, an id twice."""
    if len(frame) == 0:
        return
    again = "undo the edit, or run 'subiaco change' again"
    for name in (*STATISTICS, "object_id", "n_before", "n_after", "x", "y", "z"):
        if not pd.api.types.is_numeric_dtype(frame[name].dtype):
            raise InputError(f"{path}: column {name} holds what is no number; {again}")
    for name in ("object_id", "n_before", "n_after", "x", "y", "z"):
        if not np.isfinite(frame[name].to_numpy(dtype=np.float64)).all():
            raise InputError(f"{path}: column {name} lacks a value; {again}")
    if not pd.api.types.is_integer_dtype(frame["object_id"].dtype) or frame["object_id"].duplicated().any():
        raise InputError(f"{path}: column object_id does not number the objects; {again}")
    for name, allowed in (("class", Semantic), ("label", Change)):
        known = [code.label for code in allowed]
        strange = frame.loc[~frame[name].isin(known), name]
        if len(strange):
            raise InputError(
                f"{path}: column {name} holds {strange.iloc[0]!r:.40}, not one of {', '.join(known)}; {again}"
            )


def read_stored(path: Path) -> gpd.GeoDataFrame:
    """Read a table written by :func:`write_parquet`: the review columns as they were stored, and footprints.

    Raises
    ------
    InputError
        The file is damaged, or holds no footprints.
    """
    try:
        stored = gpd.read_parquet(path)
        stored.geometry.is_empty.any()  # a damaged outline is found here
    except _PARQUET_FAULTS as error:
        said = " ".join(str(error).split())[-300:]
        raise InputError(f"{path}: footprints cannot be read ({said}); run 'subiaco change' again") from error
    if "object_id" not in stored.columns or stored["object_id"].duplicated().any():
        raise InputError(f"{path}: column object_id does not number the objects; run 'subiaco change' again")
    return stored


def with_footprints(table: pd.DataFrame, stored: gpd.GeoDataFrame, path: Path) -> gpd.GeoDataFrame:
    """Give a table the footprints of a stored one, by object id.

    Raises
    ------
    InputError
        An object of the table has none; ``path`` is the file of the stored one.
    """
    found = table["object_id"].map(stored.set_index("object_id").geometry)
    outlines = gpd.GeoSeries(found, crs=stored.crs)
    lacking = table.loc[(outlines.isna() | outlines.is_empty).to_numpy(), "object_id"]
    if len(lacking):
        raise InputError(
            f"{path}: no footprint of object {lacking.iloc[0]}; the files beside it are of another run:"
            " run 'subiaco change' again"
        )
    return gpd.GeoDataFrame(table, geometry=outlines, crs=stored.crs)


def write_parquet(path: Path, table: gpd.GeoDataFrame) -> None:
    """Write GeoParquet with every row and column."""
    table.to_parquet(path, index=False)


SCHEMA_FILE = "change_table.schema.json"


@cache
def table_schema() -> dict[str, Any]:
    """Return the JSON Schema of the rows of a change table."""
    text = files("subiaco_change.outputs").joinpath(SCHEMA_FILE).read_text(encoding="utf-8")
    found: dict[str, Any] = json.loads(text)
    return found


def schema_faults(table: pd.DataFrame) -> list[str]:
    """Compare a table with its schema, column by column.

    Parameters
    ----------
    table : DataFrame
        Rows as they are written; the footprint is not compared.

    Returns
    -------
    list of str
        A line for every column that is missing, unknown, or holds values that the schema does not allow.
    """
    columns: dict[str, dict[str, Any]] = table_schema()["items"]["properties"]
    names = [name for name in table.columns if name != "geometry"]
    found = [f"column {name} is missing" for name in columns if name not in names]
    found += [f"column {name} is not in the schema" for name in names if name not in columns]
    for name in names:
        if name in columns:
            wrong = table.loc[_wrong(table[name], columns[name]), name]
            if len(wrong):
                found.append(f"column {name}: {len(wrong)} values such as {wrong.iloc[0]!r}")
    return found


def _wrong(values: pd.Series, rule: dict[str, Any]) -> pd.Series:
    """Tell which values break a rule of the schema."""
    types = [rule["type"]] if isinstance(rule["type"], str) else rule["type"]
    empty = values.isna()
    if "string" in types:
        text = values.fillna("").astype(str)
        wrong = pd.Series(False, index=values.index)
        if "enum" in rule:
            wrong |= ~text.isin(rule["enum"])
        if "pattern" in rule:
            wrong |= ~text.map(lambda value: re.search(rule["pattern"], value) is not None).astype(bool)
        return wrong
    number = pd.to_numeric(values, errors="coerce")
    low, high = rule.get("minimum", -np.inf), rule.get("maximum", np.inf)
    wrong = ~empty & ~number.between(low, high)
    if "integer" in types and "number" not in types:
        wrong |= ~empty & (number % 1 != 0)
    return wrong | (empty & ("null" not in types))
