"""Reviews of a table: which rows are accepted or rejected, and how reviews stay with objects later on."""

from __future__ import annotations

import csv
import io
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from subiaco_change.outputs.table import REVIEW_COLUMNS, STATISTICS, read_csv, read_stored, with_footprints
from subiaco_geo.codes import CHANGED_LABELS
from subiaco_geo.csv_cells import restore_cell
from subiaco_geo.errors import InputError, reason_of
from subiaco_geo.frames import Ints

_REVIEWS = """
select object_uid, review, reviewer, note from objects
union all select object_uid, review, reviewer, note from ground
"""
#: What the report saves and a run reads beside the table.
REVIEW_FILE = "reviews.csv"
_MIN_OVERLAP = 0.3  # footprints of one class that overlap so much (IoU) are one object in two runs


def read_reviewed(directory: Path) -> gpd.GeoDataFrame | None:
    """Return the previous table with its footprints and every review that people gave.

    Reviews are read from ``changes.gpkg``, ``changes.csv`` and ``reviews.csv``. The GeoParquet holds them as
    they were stored last: a cell that differs from it was edited since. Where several files edited one cell,
    the later of this list holds.
    """
    if not (directory / "changes.csv").is_file() or not (directory / "changes.parquet").is_file():
        return None
    frame, stored = read_csv(directory / "changes.csv"), read_stored(directory / "changes.parquet")
    table = with_footprints(frame, stored, directory / "changes.parquet")
    if "object_uid" not in frame.columns or "object_uid" not in stored.columns:
        return table
    typed = frame.set_index("object_uid")[list(REVIEW_COLUMNS)]
    known = _reviews_of(stored)
    table[list(REVIEW_COLUMNS)] = known.reindex(frame["object_uid"]).fillna("").to_numpy()
    if (directory / "changes.gpkg").is_file():
        table = apply_reviews(table, _drawn(directory / "changes.gpkg"), known)
    table = apply_reviews(table, typed, known)
    if (directory / REVIEW_FILE).is_file():
        table = apply_reviews(table, read_review_file(directory / REVIEW_FILE))
    return table


def _reviews_of(frame: pd.DataFrame) -> pd.DataFrame:
    """Return the review columns of a table as texts, by ``object_uid``."""
    texts = frame.drop_duplicates("object_uid").set_index("object_uid")
    return texts.reindex(columns=list(REVIEW_COLUMNS), fill_value="").fillna("").astype(str)


def _drawn(package: Path) -> pd.DataFrame:
    """Return the reviews of a GeoPackage."""
    try:
        with closing(sqlite3.connect(package)) as connection:
            return _reviews_of(pd.read_sql_query(_REVIEWS, connection))
    except (sqlite3.Error, pd.errors.DatabaseError, OverflowError, UnicodeDecodeError) as error:
        said = " ".join(str(error).split())[-200:]
        raise InputError(
            f"{package}: reviews cannot be read ({said}); repair it in QGIS or move it away"
        ) from error


def apply_reviews(
    table: gpd.GeoDataFrame, reviews: pd.DataFrame, known: pd.DataFrame | None = None
) -> gpd.GeoDataFrame:
    """Return a table with the review columns that differ from what was stored.

    Parameters
    ----------
    table : GeoDataFrame
    reviews, known : DataFrame
        Review columns by ``object_uid``: as they are now, and as they were stored; None applies all.
    """
    result = table.copy()
    for name in (n for n in REVIEW_COLUMNS if n in reviews.columns):
        now = reviews[name]
        if known is not None:
            now = now[now != known[name].reindex(now.index)]
        edited = result["object_uid"].map(now[~now.index.duplicated()])
        result[name] = edited.where(edited.notna(), result[name])
    return result


def read_review_file(path: Path) -> pd.DataFrame:
    """Read a review file: ``object_uid`` and ``review``, optionally ``reviewer`` and ``note``.

    The file is what the report saves, or a change table. Cells are separated by commas or semicolons.

    Returns
    -------
    DataFrame
        The review columns that the file has, as texts, by ``object_uid``.

    Raises
    ------
    InputError
        No such file, not text, or a column is missing.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"{path}: no reviews could be read ({reason_of(error)}); save them from the report"
        ) from error
    first = text.partition("\n")[0]
    separator = ";" if first.count(";") > first.count(",") else ","
    try:
        reader = csv.DictReader(io.StringIO(text), delimiter=separator)
        names, rows = reader.fieldnames or [], list(reader)
    except csv.Error as error:
        raise InputError(
            f"{path}: no reviews could be read ({reason_of(error)}); save them from the report"
        ) from error
    for name in ("object_uid", "review"):
        if name not in names:
            raise InputError(f"{path}: column {name} is missing; give the file that the report saves")
    kept = [name for name in REVIEW_COLUMNS if name in names]
    found = pd.DataFrame(rows, columns=["object_uid", *kept]).fillna("")
    found[kept] = found[kept].map(restore_cell)
    return found.drop_duplicates("object_uid", keep="last").set_index("object_uid")


def same_objects(table: gpd.GeoDataFrame, previous: gpd.GeoDataFrame) -> tuple[Ints, Ints]:
    """Pair the rows (P,), (P,) of two tables that are one object: same class, footprints that overlap most.

    Every row is in one pair at most; the largest overlaps are taken first.
    """
    if len(table) == 0 or len(previous) == 0:
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    places = previous.geometry.make_valid().values  # tables of earlier versions may hold invalid footprints
    old, new = table.sindex.query(places, predicate="intersects")
    alike = table["class"].to_numpy()[new] == previous["class"].to_numpy()[old]
    old, new = old[alike], new[alike]
    first, second = table.geometry.values[new], places[old]
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


ACCEPTED, REJECTED, OTHER = "accepted", "rejected", "other"
_YES = ("accepted", "accept", "ok", "yes", "y", "true", "correct", "confirmed", "1")
_NO = ("rejected", "reject", "no", "n", "false", "wrong", "0")
_WORDS = dict.fromkeys(_YES, ACCEPTED) | dict.fromkeys(_NO, REJECTED)
#: Selections of rows by their review that exports offer.
SELECTIONS = ("all", "accepted", "not-rejected")


def review_states(table: pd.DataFrame) -> NDArray[np.str_]:
    """Return ``accepted``, ``rejected``, ``other`` or, without review, the empty string for every row (N,).

    The words that count as a yes or a no are those of :data:`_YES` and :data:`_NO`, in any case. A table
    without the column ``review`` has no reviews.
    """
    if "review" not in table.columns:
        return np.full(len(table), "", dtype=np.str_)
    words = table["review"].fillna("").astype(str).str.strip().str.lower()
    return np.array([_WORDS.get(word, OTHER) if word else "" for word in words], dtype="<U8")


def is_rejected(table: pd.DataFrame) -> NDArray[np.bool_]:
    """Tell for every row (N,) whether a reviewer rejected it."""
    return np.asarray(review_states(table) == REJECTED)


def selected_by_review(table: pd.DataFrame, selection: str) -> NDArray[np.bool_]:
    """Tell for every row (N,) whether a selection of :data:`SELECTIONS` holds it.

    Raises
    ------
    InputError
        Another word.
    """
    if selection not in SELECTIONS:
        raise InputError(f"--review {selection}: not known; give {', '.join(SELECTIONS)}")
    states = review_states(table)
    if selection == "accepted":
        return np.asarray(states == ACCEPTED)
    return np.asarray(states != REJECTED) if selection == "not-rejected" else np.ones(len(table), dtype=bool)


def review_counts(table: pd.DataFrame) -> dict[str, Any]:
    """Count the changed rows, and how many of them were reviewed, accepted and rejected."""
    states = review_states(table)[table["label"].isin(CHANGED_LABELS).to_numpy()]
    return {
        "changed": len(states),
        "reviewed": int(np.count_nonzero(states != "")),
        "accepted": int(np.count_nonzero(states == ACCEPTED)),
        "rejected": int(np.count_nonzero(states == REJECTED)),
        "other": int(np.count_nonzero(states == OTHER)),
    }
