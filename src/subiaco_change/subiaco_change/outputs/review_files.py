"""Reviews are taken up into every file of a change directory that holds or counts rows."""

from __future__ import annotations

import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import geopandas as gpd
import pandas as pd

from subiaco_change.outputs import table as outputs_table
from subiaco_change.outputs.change_directory_reading import read_change_directory
from subiaco_change.outputs.parcels import rebuild_parcels
from subiaco_change.outputs.rasters import read_coverage
from subiaco_change.outputs.reviews import REVIEW_FILE, apply_reviews, read_review_file, read_reviewed
from subiaco_geo.atomic import whole_file

#: Name of a review file of which every row is in the table now.
APPLIED = "reviews_applied.csv"
_SPATIAL = ("ST_IsEmpty", "ST_MinX", "ST_MaxX", "ST_MinY", "ST_MaxY")  # which triggers of GeoPackages name


def take_up_reviews(directory: Path, files: list[Path]) -> tuple[gpd.GeoDataFrame, list[str]]:
    """Store reviews in every file of a change directory that holds or counts rows, but the pages.

    Parameters
    ----------
    directory : Path
        Change directory; its own ``reviews.csv`` and what was typed into its CSV or GeoPackage count too.
    files : list of Path
        Review files of :func:`read_review_file`; a later one wins.

    Returns
    -------
    table : GeoDataFrame
        With its reviews.
    unknown : list of str
        ``object_uid`` that the table does not have.

    Raises
    ------
    InputError
        Not a change directory, or not a review file.
    """
    read_change_directory(directory)  # refuses what is none
    table = read_reviewed(directory)
    assert table is not None
    unknown: list[str] = []
    for path in files:
        reviews = read_review_file(path)
        table = apply_reviews(table, reviews)
        unknown += sorted(set(reviews.index) - set(table["object_uid"]))
    with whole_file(directory / "changes.gpkg") as temporary:
        shutil.copyfile(directory / "changes.gpkg", temporary)
        _update_package(temporary, table)
        if (directory / "parcels.csv").is_file():
            parcels = rebuild_parcels(temporary, table, read_coverage(directory / "coverage.tif"))
            with whole_file(directory / "parcels.csv") as target:
                outputs_table.write_csv(target, parcels)
    with whole_file(directory / "changes.csv") as temporary:
        outputs_table.write_csv(temporary, table)
    with whole_file(directory / "changes.parquet") as temporary:
        outputs_table.write_parquet(temporary, table)
    if (directory / REVIEW_FILE).is_file():
        (directory / REVIEW_FILE).replace(directory / APPLIED)
    return table, unknown


def _update_package(path: Path, table: pd.DataFrame) -> None:
    """Write the reviews into the layers ``objects`` and ``ground``; everything else stays as it is."""
    rows = table[["review", "reviewer", "note", "object_uid"]].to_numpy().tolist()
    with closing(sqlite3.connect(path)) as connection, connection:
        for name in _SPATIAL:
            connection.create_function(name, 1, lambda _: 0)
        for layer in ("objects", "ground"):
            query = f"update {layer} set review = ?, reviewer = ?, note = ? where object_uid = ?"  # noqa: S608
            connection.executemany(query, rows)
