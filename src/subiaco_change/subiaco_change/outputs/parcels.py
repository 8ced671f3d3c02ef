"""Changes by parcel: one row for every lot."""

from __future__ import annotations

from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd
import pyogrio
from pyproj.exceptions import ProjError
from rasterio.features import rasterize, shapes
from rasterio.transform import from_origin
from shapely.errors import ShapelyError
from shapely.geometry import MultiPolygon, box, shape

from subiaco_change.outputs.rasters import COVERAGE, Coverage
from subiaco_change.outputs.reviews import is_rejected
from subiaco_geo.codes import CHANGED, CHANGED_LABELS, Change
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, Ints

#: What libraries raise where a vector file is damaged.
_FAULTS = (
    pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError, pyogrio.errors.FeatureError,
    pyogrio.errors.GeometryError, pyogrio.errors.CRSError, OSError, ValueError, ShapelyError, ProjError,
    LookupError, TypeError, OverflowError,
)  # fmt: skip
OUTSIDE = "outside all lots"  # name of the row that takes what lies on no lot
_SUMS = (
    "rejected",
    "changed_m2",
    "net_m3",
    "area_m2",
    "observed_fraction",
)  # columns of a lot beside the counts
_BOTH = next(code for code, name in COVERAGE.items() if name == "both")


def read_lots(path: Path, crs: str | None) -> gpd.GeoDataFrame:
    """Read lots from any vector file, in the CRS of the change table.

    Parameters
    ----------
    path : Path
        GeoPackage, GeoJSON, shapefile ...; its first layer.
    crs : str or None
        Of the table; None where the maps are local.

    Returns
    -------
    GeoDataFrame
        ``lot`` (the file's ``lot_id``, ``lot``, ``id`` or ``name``, else the row number), every attribute of
        the file, ``geometry``. An attribute named as a column of :func:`build_parcels` gets the suffix
        ``_lot``.

    Raises
    ------
    InputError
        No file, no polygons, no CRS, or a map without CRS.
    """
    if crs is None:
        raise InputError(
            f"{path}: the maps have no CRS, so lots cannot be placed on them; leave --parcels out"
        )
    try:
        frame = gpd.read_file(path, engine="pyogrio")
    except _FAULTS as error:
        said = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{path}: no lots could be read ({said}); give a GeoPackage or GeoJSON") from error
    if "geometry" not in frame.columns or frame.crs is None:
        raise InputError(f"{path}: lots need polygons with a CRS; assign one in QGIS and export again")
    areas = frame[frame.geometry.geom_type.isin(["Polygon", "MultiPolygon"])]
    if len(areas) == 0:
        raise InputError(f"{path}: holds no polygons; give a layer of lots")
    names = {str(column).lower(): column for column in areas.columns}
    key = next((names[k] for k in ("lot_id", "lot", "id", "name") if k in names), None)
    lots = [str(v) for v in (areas.index if key is None else areas[key])]
    named = [areas.geometry.name, *([key] if str(key).lower() == "lot" else [])]
    own = areas.drop(columns=named).rename(columns=_attribute_name).reset_index(drop=True)
    kept = pd.concat([pd.DataFrame({"lot": lots}), own.loc[:, ~own.columns.duplicated()]], axis=1)
    try:
        outlines = areas.geometry.to_crs(crs).make_valid()
    except (ShapelyError, ProjError) as error:
        said = " ".join(str(error).split())
        raise InputError(f"{path}: outlines of lots are damaged ({said}); repair them in QGIS") from error
    if not np.isfinite(outlines.bounds.to_numpy()).all():
        raise InputError(f"{path}: lots lie outside the area of {crs}; check the CRS of the file")
    return gpd.GeoDataFrame(kept, geometry=outlines.values, crs=crs)


def refuse_lots_elsewhere(path: Path, lots: gpd.GeoDataFrame, low: Floats, high: Floats) -> None:
    """Refuse lots of which none touches the extent of the later map, (2,) or more each [m], in their CRS.

    Raises
    ------
    InputError
        Names both extents.
    """
    west, south, east, north = lots.total_bounds.tolist()
    if lots.intersects(box(low[0], low[1], high[0], high[1])).any():
        return
    raise InputError(
        f"{path}: no lot touches the later map: the lots span E {west:.0f} to {east:.0f}, N {south:.0f} to"
        f" {north:.0f}, the map E {low[0]:.0f} to {high[0]:.0f}, N {low[1]:.0f} to {high[1]:.0f} in"
        f" {lots.crs}; check the CRS of the file and its zone"
    )


def _attribute_name(column: str) -> str:
    """Name of an attribute of the lots beside our columns; GeoPackage compares names without case."""
    taken = {"lot", "fid", "geom", "geometry", *(c.label.lower() for c in Change), *_SUMS}
    return f"{column}_lot" if str(column).lower() in taken else str(column)


def build_parcels(table: gpd.GeoDataFrame, lots: gpd.GeoDataFrame, coverage: Coverage) -> gpd.GeoDataFrame:
    """Add up the changes of every lot.

    An object counts once, on the lot that holds most of its footprint; its
    area and volume are shared by footprint area. A row that a reviewer rejected counts as
    ``rejected`` and as nothing else. What lies on no lot stands in
    a last row, so that the rows add up to the table.

    Returns
    -------
    GeoDataFrame
        ``lot``, a count for every label, ``rejected``, ``changed_m2`` (footprints of what changed),
        ``net_m3`` (2.5D), ``area_m2`` of the lot, ``observed_fraction``, then the attributes of the lots.
    """
    owner, place, share = _shares(table, lots)
    home = np.full(len(table), len(lots))
    home[owner] = place  # pairs are sorted by share: the largest is written last
    size, rejected = len(lots) + 1, is_rejected(table)
    columns: dict[str, object] = {"lot": [*lots["lot"], OUTSIDE]}
    for change in (*CHANGED, Change.UNCHANGED, Change.UNOBSERVED):
        chosen = (table["label"] == change.label).to_numpy() & ~rejected
        columns[change.label.lower()] = np.bincount(home[chosen], minlength=size)
    columns["rejected"] = np.bincount(home[rejected], minlength=size)
    changed = table["label"].isin(CHANGED_LABELS).to_numpy() & ~rejected
    outline = np.where(changed, table.geometry.area.to_numpy(), 0.0)
    volume = np.where(changed, table["delta_v_m3"].fillna(0.0).to_numpy(dtype=np.float64), 0.0)
    columns["changed_m2"] = np.round(np.bincount(place, outline[owner] * share, minlength=size), 3)
    columns["net_m3"] = np.round(np.bincount(place, volume[owner] * share, minlength=size), 3)
    area = lots.geometry.area.to_numpy()
    columns["area_m2"] = np.round([*area, np.nan], 1)
    columns["observed_fraction"] = np.round([*_observed(lots, area, coverage), np.nan], 3)
    geometry = [*lots.geometry, MultiPolygon()]
    attributes = pd.DataFrame(lots.drop(columns=["lot", lots.geometry.name])).convert_dtypes(
        convert_string=False, convert_floating=False
    )
    frame = pd.concat([pd.DataFrame(columns), attributes.reset_index(drop=True)], axis=1)
    return gpd.GeoDataFrame(frame, geometry=geometry, crs=lots.crs)


def rebuild_parcels(package: Path, table: gpd.GeoDataFrame, coverage: Coverage) -> gpd.GeoDataFrame:
    """Recompute the layer ``parcels`` of a GeoPackage, with the lots and attributes that it holds.

    The layer is replaced; its style stays.
    """
    old = gpd.read_file(package, layer="parcels", engine="pyogrio")
    counted = {c.label.lower() for c in Change}
    own = [name for name in old.columns if name not in counted and name not in _SUMS]
    lots = old.loc[old["lot"] != OUTSIDE, own].reset_index(drop=True)
    parcels = build_parcels(table, lots, coverage)
    parcels.to_file(package, layer="parcels", driver="GPKG", engine="pyogrio", geometry_type="MultiPolygon")
    return parcels


def _shares(table: gpd.GeoDataFrame, lots: gpd.GeoDataFrame) -> tuple[Ints, Ints, Floats]:
    """Return objects, lots and footprint shares as pairs (P,) sorted by share.

    The shares of an object add up to one: where lots overlap they divide the
    footprint, and what lies on none goes to the row after the last lot.
    """
    owner, lot = lots.sindex.query(table.geometry.values, predicate="intersects")
    cut = table.geometry.values[owner].intersection(lots.geometry.values[lot]).area
    on_lots = np.bincount(owner, cut, minlength=len(table))
    whole = np.maximum(table.geometry.area.to_numpy(), on_lots)
    rest = np.arange(len(table))
    owner, lot = np.concatenate([owner, rest]), np.concatenate([lot, np.full(len(table), len(lots))])
    share = np.concatenate([cut, whole - on_lots]) / np.maximum(whole, 1e-12)[owner]
    order = np.argsort(share, kind="stable")
    return owner[order], lot[order], share[order]


def _observed(lots: gpd.GeoDataFrame, area: Floats, coverage: Coverage) -> Floats:
    """Share of every lot that both epochs saw; what lies off the raster was not seen."""
    rows, columns = coverage.code.shape
    transform = from_origin(coverage.west, coverage.north, coverage.cell, coverage.cell)
    pairs = [(geometry, number + 1) for number, geometry in enumerate(lots.geometry)]
    index = rasterize(pairs, (rows, columns), transform=transform, dtype=np.int32)
    seen = np.bincount(index[coverage.code == _BOTH], minlength=len(lots) + 1)[1:]
    return np.minimum(seen * coverage.cell**2 / np.maximum(area, 1e-9), 1.0)


def coverage_polygons(coverage: Coverage, crs: str | None) -> gpd.GeoDataFrame:
    """Return what was seen as polygons: ``seen`` (both, only ...), ``area_m2``, median ``lod95_m``."""
    transform = from_origin(coverage.west, coverage.north, coverage.cell, coverage.cell)
    rows = []
    for code, name in COVERAGE.items():
        mask = coverage.code == code
        if name == "neither" or not mask.any():
            continue
        parts = [shape(outline) for outline, _ in shapes(coverage.code, mask, transform=transform)]
        lod = coverage.lod95[mask]
        lod95 = float(np.median(lod[np.isfinite(lod)])) if np.isfinite(lod).any() else np.nan
        rows.append((name, coverage.area(code), round(lod95, 4), MultiPolygon(parts)))
    frame = pd.DataFrame(rows, columns=["seen", "area_m2", "lod95_m", "geometry"])
    return gpd.GeoDataFrame(frame, geometry="geometry", crs=crs)
