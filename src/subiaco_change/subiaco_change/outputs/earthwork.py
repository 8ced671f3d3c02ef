"""Cut and fill of the ground by polygons, with the uncertainty of the volumes."""

from __future__ import annotations

from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd
import rasterio
from rasterio.features import geometry_mask
from rasterio.windows import Window
from shapely.geometry.base import BaseGeometry

from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats

#: Columns of volumes beside the polygons and their attributes.
VOLUMES = ("cut_m3", "fill_m3", "net_m3", "net_95_m3", "compared_m2", "compared_fraction", "changed_m2")
_Z95 = 1.96  # of a normal distribution, two-sided 95 %


def cut_and_fill(raster: Path, polygons: gpd.GeoDataFrame, sigma_common: float) -> gpd.GeoDataFrame:
    """Add up the difference of the ground inside every polygon.

    Parameters
    ----------
    raster : Path
        ``ground_difference.tif`` of
        :func:`~subiaco_change.outputs.difference_rasters.write_difference_rasters`.
    polygons : GeoDataFrame
        In the CRS of the raster, with attributes, which are kept.
    sigma_common : float
        Standard deviation of an error that all cells share, that is, of the registration [m].

    Returns
    -------
    GeoDataFrame
        The polygons with ``cut_m3`` and ``fill_m3`` (cells whose difference exceeds their level of detection;
        both positive), ``net_m3`` (fill less cut), ``net_95_m3`` (half width of its 95 % interval),
        ``compared_m2`` (cells with ground in both epochs), its share ``compared_fraction`` of the polygon,
        and ``changed_m2`` (cells beyond the level of detection).

    Notes
    -----
    The interval covers the true net volume of all compared cells, also of those whose change is too small to
    be detected. Its variance is that of the common error times the squared area, plus the other variances of
    the cells, taken as independent: level of detection over 1.96, squared, less the common variance. A cell
    without a level of detection takes the largest of the polygon.

    Raises
    ------
    InputError
        A polygon's CRS is not that of the raster.
    """
    with rasterio.open(raster) as dataset:
        if polygons.crs is None or dataset.crs is None or polygons.crs.to_2d() != dataset.crs:
            raise InputError(f"{raster}: the polygons are in another CRS; bring them to {dataset.crs}")
        rows = [_volumes(dataset, shape, sigma_common) for shape in polygons.geometry]
    frame = pd.DataFrame(rows, columns=list(VOLUMES), index=polygons.index)
    clash = {name: f"{name}_lot" for name in VOLUMES if name in polygons.columns}
    return gpd.GeoDataFrame(pd.concat([polygons.rename(columns=clash), frame], axis=1), crs=polygons.crs)


def _volumes(dataset: rasterio.DatasetReader, shape: BaseGeometry, common: float) -> tuple[float, ...]:
    """Return the columns of :data:`VOLUMES` for one polygon."""
    window = _window(dataset, shape)
    if window is None:
        return 0.0, 0.0, 0.0, float("nan"), 0.0, 0.0, 0.0
    difference, level = dataset.read((1, 2), window=window).astype(np.float64)
    transform = dataset.window_transform(window)
    inside = geometry_mask([shape], difference.shape, transform, invert=True)
    area = abs(transform.a * transform.e)
    compared = inside & np.isfinite(difference)
    changed = compared & (np.abs(difference) > np.where(np.isfinite(level), level, np.inf))
    fill = float(difference[changed & (difference > 0)].sum() * area)
    cut = float(-difference[changed & (difference < 0)].sum() * area)
    half = area * _half_width(level[compared], common)
    seen = np.count_nonzero(compared) * area
    share = min(seen / max(shape.area, 1e-9), 1.0)
    numbers = (cut, fill, fill - cut, half, seen, share, np.count_nonzero(changed) * area)
    return tuple(round(number, 3) for number in numbers)


def _half_width(levels: Floats, common: float) -> float:
    """Half width of the 95 % interval of a sum of cells [m]; NaN where no cell has a level of detection."""
    known = np.isfinite(levels)
    if not known.any():
        return float("nan")
    filled = np.where(known, levels, levels[known].max())
    own = np.maximum((filled / _Z95) ** 2 - common**2, 0.0)
    return _Z95 * float(np.sqrt((common * len(levels)) ** 2 + own.sum()))


def _window(dataset: rasterio.DatasetReader, shape: BaseGeometry) -> Window | None:
    """Return the cells around a polygon, None where it lies beside the raster."""
    west, south, east, north = shape.bounds
    left, top = ~dataset.transform * (west, north)
    right, bottom = ~dataset.transform * (east, south)
    first, last = max(int(np.floor(left)), 0), min(int(np.ceil(right)), dataset.width)
    upper, lower = max(int(np.floor(top)), 0), min(int(np.ceil(bottom)), dataset.height)
    return Window(first, upper, last - first, lower - upper) if last > first and lower > upper else None
