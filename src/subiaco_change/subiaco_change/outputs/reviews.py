"""What people wrote into a table stays with its objects when the pair is run again."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd

from subiaco_change.outputs.table import REVIEW_COLUMNS, STATISTICS, read_csv, with_footprints
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Ints

_REVIEWS = """
select object_uid, review, reviewer, note from objects
union all select object_uid, review, reviewer, note from ground
"""
_MIN_OVERLAP = 0.3  # footprints of one class that overlap so much (IoU) are one object in two runs


def read_reviewed(directory: Path) -> gpd.GeoDataFrame | None:
    """Return the previous table with its footprints and the reviews typed into its CSV or its GeoPackage."""
    if not (directory / "changes.csv").is_file():
        return None
    frame = read_csv(directory / "changes.csv")
    package = directory / "changes.gpkg"
    if package.is_file() and "object_uid" in frame.columns:
        edited = _typed_into(package)
        for name in REVIEW_COLUMNS:
            typed = frame["object_uid"].map(edited[name]).fillna("")
            frame[name] = frame[name].where(frame[name] != "", typed)
    if not (directory / "changes.parquet").is_file():
        return None
    return with_footprints(directory, frame)


def _typed_into(package: Path) -> pd.DataFrame:
    """Return the reviews of a GeoPackage as texts, by ``object_uid``."""
    try:
        with closing(sqlite3.connect(package)) as connection:
            edited = pd.read_sql_query(_REVIEWS, connection)
    except (sqlite3.Error, pd.errors.DatabaseError, OverflowError, UnicodeDecodeError) as error:
        said = " ".join(str(error).split())[-200:]
        raise InputError(
            f"{package}: reviews cannot be read ({said}); repair it in QGIS or move it away"
        ) from error
    texts = edited.fillna("").astype(str).drop_duplicates("object_uid")
    return texts.set_index("object_uid")


def same_objects(table: gpd.GeoDataFrame, previous: gpd.GeoDataFrame) -> tuple[Ints, Ints]:
    """Pair the rows (P,), (P,) of two tables that are one object: same class, footprints that overlap most.

    Every row is in one pair at most; the largest overlaps are taken first.
    """
    if len(table) == 0 or len(previous) == 0:
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    old, new = table.sindex.query(previous.geometry.values, predicate="intersects")
    alike = table["class"].to_numpy()[new] == previous["class"].to_numpy()[old]
    old, new = old[alike], new[alike]
    first, second = table.geometry.values[new], previous.geometry.values[old]
    shared = first.intersection(second).area
    overlap = shared / np.maximum(first.area + second.area - shared, 1e-12)
    taken_new, taken_old, pairs = set(), set(), []
    for k in np.lexsort((old, new, -overlap)):
        if overlap[k] >= _MIN_OVERLAP and new[k] not in taken_new and old[k] not in taken_old:
            taken_new.add(new[k])
            taken_old.add(old[k])
            pairs.append((new[k], old[k]))
    rows = np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2)
    return rows[:, 0], rows[:, 1]


def carry_reviews(
    table: gpd.GeoDataFrame, previous: gpd.GeoDataFrame
) -> tuple[gpd.GeoDataFrame, pd.DataFrame]:
    """Give objects that were there before their ``object_uid`` and their reviews back.

    Parameters
    ----------
    table : GeoDataFrame
        Of this run.
    previous : GeoDataFrame
        Of :func:`read_reviewed`.

    Returns
    -------
    table : GeoDataFrame
        A reviewed row whose label or statistics moved says so in ``evidence_changed``.
    lost : DataFrame
        Reviewed rows of the previous table that have no object in this one.
    """
    if "object_uid" not in previous.columns:
        return table, previous.iloc[:0]
    result = table.copy()
    new, old = same_objects(table, previous)
    result["object_uid"] = _uids(result["object_uid"].tolist(), previous["object_uid"].tolist(), new, old)
    reviewed = (previous[list(REVIEW_COLUMNS)] != "").any(axis=1).to_numpy(copy=True)
    for n, o in zip(new, old, strict=True):
        if reviewed[o]:
            row, before = result.index[n], previous.iloc[o]
            for name in REVIEW_COLUMNS:
                result.loc[row, name] = before[name]
            result.loc[row, "evidence_changed"] = _difference(result.iloc[n], before)
    reviewed[old] = False
    return result, pd.DataFrame(previous[reviewed].drop(columns="geometry"))


def _uids(fresh: list[str], known: list[str], new: Ints, old: Ints) -> list[str]:
    """Known names for the objects of both runs; a fresh one that a known object bears gets a suffix."""
    names: dict[int, str] = {int(n): known[o] for n, o in zip(new, old, strict=True)}
    used = set(names.values())
    for row, uid in enumerate(fresh):
        if row in names:
            continue
        name, count = uid, 1
        while name in used:
            name, count = f"{uid}-{count}", count + 1
        names[row] = name
        used.add(name)
    return [names[row] for row in range(len(fresh))]


def _difference(new: pd.Series, old: pd.Series) -> str:
    """Name what differs between two rows of one object, ``""`` for nothing."""
    if new["label"] != old["label"]:
        return f"label was {old['label']}"
    moved = [n for n in STATISTICS if not np.isclose(new[n], old[n], atol=1e-3, equal_nan=True)]
    return "; ".join(f"{n} was {old[n]}" for n in moved)
