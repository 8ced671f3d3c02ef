"""The change table as layers of a GeoPackage, with the styles and forms that QGIS applies by itself."""

from __future__ import annotations

import warnings
from pathlib import Path

import geopandas as gpd

from subiaco_change.outputs.style import embed_styles
from subiaco_geo.codes import Semantic


def write_geopackage(path: Path, table: gpd.GeoDataFrame) -> None:
    """Write layers ``objects`` and ``ground``, with styles that QGIS applies by itself."""
    is_ground = table["class"] == Semantic.GROUND.label
    for layer, rows in (("objects", table[~is_ground]), ("ground", table[is_ground])):
        write_layer(path, layer, rows)
    embed_styles(path, ("objects", "ground"))


def write_layer(package: Path, name: str, frame: gpd.GeoDataFrame) -> None:
    """Add a layer of polygons to a GeoPackage, or replace it."""
    with warnings.catch_warnings():  # a local map has no CRS, and says so elsewhere
        warnings.filterwarnings("ignore", message="'crs' was not provided")
        frame.to_file(package, layer=name, driver="GPKG", engine="pyogrio", geometry_type="MultiPolygon")
