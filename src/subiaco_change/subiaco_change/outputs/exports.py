"""Exports of a change directory to formats of other programs."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable
from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd

from subiaco_change.outputs.clouds import change_palette, labelled_path, with_asprs_codes
from subiaco_change.outputs.drawing_exchange import write_dxf
from subiaco_change.outputs.foxglove import write_foxglove
from subiaco_change.outputs.geopackage import embed_styles, layers_of, write_geopackage, write_layer
from subiaco_change.outputs.parcels import rebuild_parcels
from subiaco_change.outputs.rasters import read_coverage
from subiaco_change.outputs.reviews import read_reviewed, selected_by_review
from subiaco_change.outputs.table import write_csv, write_parquet
from subiaco_geo.atomic import whole_directory
from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import CHANGED, Change
from subiaco_geo.crs import crs_text
from subiaco_geo.errors import InputError
from subiaco_geo.exports import CLOUD_ENDINGS, copy_cloud
from subiaco_geo.output_heights import above_geoid, geoid_shift, write_heights_note

_LOG = logging.getLogger(__name__)
#: Longest text of a shapefile [byte].
_LONGEST_TEXT = 254
#: What GeoJSON (RFC 7946) and KML ask for.
_LONGITUDE_LATITUDE = "EPSG:4326"
TABLE_KINDS = ("gpkg", "parquet", "geojson", "csv", "shp", "kml", "dxf")
FOXGLOVE = "foxglove"
#: Names of at most ten characters for shapefiles; other columns are short enough.
SHORT_NAMES = {
    "match_kind": "match_kind", "delta_v_m3": "delta_v_m3", "delta_v_surface_m3": "dv_surf_m3",
    "observed_fraction": "observed", "score_paper": "score", "confidence": "confidence",
    "delta_h_low_m": "dh_low_m", "delta_h_high_m": "dh_high_m", "delta_v_low_m3": "dv_low_m3",
    "delta_v_high_m3": "dv_high_m3", "height_before_m": "h_before_m", "height_after_m": "h_after_m",
    "date_before": "date_befor", "date_after": "date_after", "object_uid": "object_uid",
    "evidence_changed": "evid_chang", "d_perp_m": "d_perp_m", "id_before": "id_before",
}  # fmt: skip


def export_changes(
    directory: Path,
    output: Path,
    kind: str,
    *,
    cloudcompare: bool = False,
    review: str = "all",
    geoid: Path | None = None,
) -> list[Path]:
    """Write the labelled clouds or the table of a change directory in another form.

    Parameters
    ----------
    directory : Path
        Change directory.
    output : Path
        New directory.
    kind : str
        ``laz``, ``copc``, ``ply`` (clouds of both epochs; LAZ with ASPRS classes), ``foxglove`` (one MCAP
        file with clouds, outlines and table), or one of :data:`TABLE_KINDS` (the table, reviews included).
        A GeoPackage has every layer of ``changes.gpkg``; GeoJSON and KML are in longitude and latitude; a
        shapefile has :data:`SHORT_NAMES`, which ``columns.csv`` lists.
    cloudcompare : bool
        Name PLY fields so that CloudCompare loads them.
    review : str
        Rows to write by their review: ``all``, ``accepted`` or ``not-rejected``. In clouds, points of a
        change that is left out get code 254, NotReported.
    geoid : Path, optional
        Geoid model: heights of points and column ``z`` are above it; differences of heights are the same.

    Returns
    -------
    list of Path

    Raises
    ------
    InputError
        Not a change directory, a kind that it does not have, a table without
        CRS as GeoJSON or KML, or an output that exists.
    """
    _refuse_what_is_none(directory, kind)
    table = read_reviewed(directory)
    if table is None:
        raise InputError(f"{directory}: not the output of 'subiaco change' (no changes.csv, changes.parquet)")
    chosen = selected_by_review(table, review)
    left_out = table.loc[~chosen, "object_id"].to_numpy(dtype=np.int64)
    if geoid is not None:
        if kind == FOXGLOVE:
            raise InputError("--geoid: foxglove shows a local frame; give another --to")
        table = _above_geoid(table, geoid)
    with whole_directory(output) as target:
        if geoid is not None:
            write_heights_note(target, geoid)
        if kind == FOXGLOVE:
            write_foxglove(target / "changes.mcap", directory, table[chosen], left_out)
        elif kind in CLOUD_ENDINGS:
            for epoch in ("before", "after"):
                copy_cloud(
                    labelled_path(directory, epoch),
                    target / f"{epoch}_labelled{CLOUD_ENDINGS[kind]}",
                    ellipsoidal=False,
                    cloudcompare=cloudcompare,
                    convert=_conversion(left_out, geoid, classify=kind != "ply"),
                )
        else:
            _write_table(target, table[chosen], kind)
            if kind == "gpkg":
                _copy_layers(directory, target / "changes.gpkg", table[chosen])
    return sorted(output.iterdir())


def _refuse_what_is_none(directory: Path, kind: str) -> None:
    """Refuse a file in place of a directory, and forms that change directories lack."""
    if directory.is_file():
        raise InputError(f"{directory}: is a file; give a map directory or a change directory to export")
    if kind not in (*CLOUD_ENDINGS, *TABLE_KINDS, FOXGLOVE):
        raise InputError(f"{directory}: a table of changes has no {kind}; give another --to")


def _above_geoid(table: gpd.GeoDataFrame, geoid: Path) -> gpd.GeoDataFrame:
    """Return the table with heights above a geoid; ``z`` alone is a height, all else are differences."""
    crs = None if table.crs is None else crs_text(table.crs)
    shift = geoid_shift(table[["x", "y"]].to_numpy(dtype=np.float64), crs, geoid)
    return table.assign(z=(table["z"] + shift).round(3))


def _conversion(
    left_out: np.ndarray, geoid: Path | None, *, classify: bool
) -> Callable[[PointCloud], PointCloud]:
    """Return what is done to every part of a cloud: labels of rows left out, heights, ASPRS classes."""

    def convert(cloud: PointCloud) -> PointCloud:
        if len(left_out):
            change = np.asarray(cloud.fields["change"]).copy()
            hidden = np.isin(cloud.fields["instance"], left_out) & np.isin(change, CHANGED)
            change[hidden] = Change.NOT_REPORTED
            red, green, blue = change_palette()[change.astype(np.int64)].T
            cloud = cloud.with_fields(change=change, red=red, green=green, blue=blue)
        if geoid is not None:
            cloud = above_geoid(cloud, geoid)
        return with_asprs_codes(cloud) if classify else cloud

    return convert


def _write_table(target: Path, table: gpd.GeoDataFrame, kind: str) -> None:
    if kind == "gpkg":
        write_geopackage(target / "changes.gpkg", table)
    elif kind == "parquet":
        write_parquet(target / "changes.parquet", table)
    elif kind == "csv":
        write_csv(target / "changes.csv", table)
    elif kind == "shp":
        short = table.rename(columns=SHORT_NAMES)
        _write_shapefile(target / "changes.shp", short)
        pairs = {"column": table.columns[:-1], "shapefile": short.columns[:-1]}
        pd.DataFrame(pairs).to_csv(target / "columns.csv", index=False)
    elif kind == "dxf":
        write_dxf(target / "changes.dxf", table)
    elif table.crs is None:
        raise InputError("the table has no CRS, so it has no longitude and latitude; give --to gpkg")
    else:
        placed = table.to_crs(_LONGITUDE_LATITUDE)
        if kind == "geojson":
            placed.to_file(target / "changes.geojson", driver="GeoJSON", engine="pyogrio")
        else:
            named = placed.assign(Name=placed["label"] + " " + placed["object_id"].astype(str))
            named = named.assign(Description=placed["reason"])
            named.to_file(target / "changes.kml", driver="KML", engine="pyogrio")


def _write_shapefile(path: Path, table: gpd.GeoDataFrame) -> None:
    """Write a shapefile, and say once how many texts it cuts."""
    texts = pd.DataFrame(table.drop(columns=table.geometry.name)).select_dtypes(["object", "string"])
    cut = sum(
        isinstance(text, str) and len(text.encode()) > _LONGEST_TEXT for text in texts.to_numpy().ravel()
    )
    with warnings.catch_warnings():  # one warning for each cut text
        warnings.filterwarnings("ignore", message=".*truncated", category=RuntimeWarning)
        table.to_file(path, engine="pyogrio", encoding="UTF-8")
    if cut:
        _LOG.warning(
            "%s: %d texts, such as reasons, were cut, because Shapefile allows %d characters",
            path.name, cut, _LONGEST_TEXT,
        )  # fmt: skip


def _copy_layers(directory: Path, package: Path, table: gpd.GeoDataFrame) -> None:
    """Copy the layers beside the table; lots are counted from the rows that the export has."""
    source = directory / "changes.gpkg"
    layers = layers_of(source)
    held = [name for name in ("coverage", "parcels") if name in layers]
    for name in held:
        write_layer(package, name, gpd.read_file(source, layer=name, engine="pyogrio"))
    if "parcels" in held:
        rebuild_parcels(package, table, read_coverage(directory / "coverage.tif"))
    embed_styles(package, held)
