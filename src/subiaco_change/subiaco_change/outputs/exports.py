"""A change directory in the forms that other programs ask for."""

from __future__ import annotations

from pathlib import Path

import geopandas as gpd

from subiaco_change.outputs.clouds import labelled_path
from subiaco_change.outputs.reviews import read_reviewed
from subiaco_change.outputs.table import write_geopackage, write_parquet
from subiaco_geo.atomic import whole_directory
from subiaco_geo.errors import InputError
from subiaco_geo.exports import CLOUD_ENDINGS, copy_cloud

#: What GeoJSON asks for (RFC 7946).
_GEOJSON_CRS = "EPSG:4326"


def export_changes(directory: Path, output: Path, kind: str, *, cloudcompare: bool = False) -> list[Path]:
    """Write the labelled clouds or the table of a change directory in another form.

    Parameters
    ----------
    directory : Path
        Change directory.
    output : Path
        New directory.
    kind : str
        ``laz``, ``copc``, ``ply`` (clouds of both epochs), ``gpkg``, ``parquet`` or ``geojson`` (the table,
        reviews included; GeoJSON in longitude and latitude).
    cloudcompare : bool
        Name PLY fields so that CloudCompare loads them.

    Returns
    -------
    list of Path

    Raises
    ------
    InputError
        Not a change directory, a kind that it does not have, a table without
        CRS as GeoJSON, or an output that exists.
    """
    if kind not in (*CLOUD_ENDINGS, "gpkg", "parquet", "geojson"):
        raise InputError(f"{directory}: a table of changes has no {kind}; give another --to")
    table = read_reviewed(directory)
    if table is None:
        raise InputError(f"{directory}: not the output of 'subiaco change' (no changes.csv, changes.parquet)")
    with whole_directory(output) as target:
        if kind in CLOUD_ENDINGS:
            for epoch in ("before", "after"):
                copy_cloud(
                    labelled_path(directory, epoch),
                    target / f"{epoch}_labelled{CLOUD_ENDINGS[kind]}",
                    ellipsoidal=False,
                    cloudcompare=cloudcompare,
                )
        else:
            _write_table(target, table, kind)
    return sorted(output.iterdir())


def _write_table(target: Path, table: gpd.GeoDataFrame, kind: str) -> None:
    if kind == "gpkg":
        write_geopackage(target / "changes.gpkg", table)
    elif kind == "parquet":
        write_parquet(target / "changes.parquet", table)
    elif table.crs is None:
        raise InputError("the table has no CRS, so it has no longitude and latitude; give --to gpkg")
    else:
        table.to_crs(_GEOJSON_CRS).to_file(target / "changes.geojson", driver="GeoJSON", engine="pyogrio")
