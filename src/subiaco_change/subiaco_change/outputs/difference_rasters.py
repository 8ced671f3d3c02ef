"""Height of both epochs and their difference as cloud-optimised GeoTIFF, and cut and fill by polygons."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import rasterio
from numpy.typing import NDArray
from rasterio.features import geometry_mask
from rasterio.shutil import copy as copy_raster
from rasterio.transform import from_origin
from rasterio.windows import Window
from shapely.geometry.base import BaseGeometry

from subiaco_change.outputs.clouds import open_labelled
from subiaco_geo.atomic import whole_file
from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats

#: Bands of a raster, heights and differences [m].
BANDS = ("difference", "lod95", "before", "after")
_BLOCK = 256  # cells along the edge of a window
_MOST_CELLS = 1 << 31  # of a raster
_EMPTY = float("nan")


@dataclass(frozen=True)
class RasterGrid:
    """A north-up grid: west and north edge [m], rows, columns, and edge of a cell [m]."""

    west: float
    north: float
    rows: int
    columns: int
    cell: float

    @classmethod
    def around(cls, low: Floats, high: Floats, cell: float) -> RasterGrid:
        """Return the grid on whole multiples of a cell [m] that holds an extent (2 or more,) [m].

        Raises
        ------
        InputError
            A cell that is not positive, or one so small that a raster would pass two thousand million cells.
        """
        if cell <= 0.0:
            raise InputError(f"--cell {cell}: must be larger than 0 m")
        first, last = np.floor(low[:2] / cell), np.floor(high[:2] / cell) + 1
        columns, rows = (last - first).astype(np.int64).tolist()
        if rows * columns > _MOST_CELLS:
            raise InputError(f"a raster of {rows} x {columns} cells is too large; give a larger --cell")
        return cls(float(first[0] * cell), float(last[1] * cell), rows, columns, cell)

    def windows(self) -> Iterator[tuple[Window, tuple[float, float, float, float]]]:
        """Yield windows of at most 256 cells a side with west, south, east, north [m]."""
        for row in range(0, self.rows, _BLOCK):
            for column in range(0, self.columns, _BLOCK):
                height, width = min(_BLOCK, self.rows - row), min(_BLOCK, self.columns - column)
                west, north = self.west + column * self.cell, self.north - row * self.cell
                bounds = (west, north - height * self.cell, west + width * self.cell, north)
                yield Window(column, row, width, height), bounds


def write_difference_rasters(directory: Path, target: Path, cell: float = 0.5) -> list[Path]:
    """Write ``surface_difference.tif`` and ``ground_difference.tif`` from the labelled clouds.

    The surface of a cell is the highest point of an epoch without moving objects (NotReported); the ground is
    the mean height of its ground points. ``difference`` is *after* less *before* where both epochs have
    points, ``lod95`` the median level of detection of the points of the cell: a smaller difference is not
    distinguishable from noise at 95 %. Cells without a value are NaN.

    Parameters
    ----------
    directory : Path
        Change directory.
    target : Path
        Existing folder.
    cell : float
        Edge of a cell [m].

    Returns
    -------
    list of Path

    Raises
    ------
    InputError
        As :meth:`RasterGrid.around`.
    """
    epochs = open_labelled(directory, "before"), open_labelled(directory, "after")
    low, high = np.minimum(*(e.low for e in epochs)), np.maximum(*(e.high for e in epochs))
    grid = RasterGrid.around(low, high, cell)
    crs = next(epochs[1].parts()).crs
    paths = [target / "surface_difference.tif", target / "ground_difference.tif"]
    plain = [path.with_suffix(".plain.tif") for path in paths]
    profile = raster_profile(grid, crs, count=len(BANDS))
    try:
        with (
            rasterio.open(plain[0], "w", **profile) as surface,
            rasterio.open(plain[1], "w", **profile) as ground,
        ):
            for window, bounds in grid.windows():
                pair = [epoch.inside(*bounds) for epoch in epochs]
                if not any(len(cloud) for cloud in pair):
                    continue
                for dataset, is_ground in ((surface, False), (ground, True)):
                    dataset.write(_bands(pair, window, bounds, cell, is_ground), window=window)
            for dataset in (surface, ground):
                dataset.descriptions = BANDS
        for source, path in zip(plain, paths, strict=True):
            write_cog(source, path)
    finally:
        for source in plain:
            source.unlink(missing_ok=True)
    return paths


def raster_profile(grid: RasterGrid, crs: str | None, count: int) -> dict[str, Any]:
    """Return the profile of a tiled float32 GeoTIFF with NaN where nothing is known."""
    return {
        "driver": "GTiff",
        "height": grid.rows,
        "width": grid.columns,
        "count": count,
        "dtype": "float32",
        "crs": crs,
        "transform": from_origin(grid.west, grid.north, grid.cell, grid.cell),
        "nodata": _EMPTY,
        "tiled": True,
        "blockxsize": _BLOCK,
        "blockysize": _BLOCK,
        "compress": "deflate",
        "bigtiff": "if_safer",
    }


def write_cog(source: Path, path: Path) -> None:
    """Copy a GeoTIFF as a cloud-optimised one, with overviews."""
    with whole_file(path) as temporary:
        copy_raster(source, temporary, driver="COG", compress="deflate", predictor="yes")


def _bands(
    pair: list[PointCloud], window: Window, bounds: tuple[float, ...], cell: float, is_ground: bool
) -> NDArray[np.float32]:
    """Return the bands (4, rows, columns) of a window."""
    shape = (int(window.height), int(window.width))
    heights, flats, levels = [], [], []
    for cloud in pair:
        semantic, change = (np.asarray(cloud.fields[name]) for name in ("semantic", "change"))
        kept = semantic == Semantic.GROUND if is_ground else change != Change.NOT_REPORTED
        part = cloud.select(np.flatnonzero(kept))
        world = part.world()
        column = np.clip(((world[:, 0] - bounds[0]) // cell).astype(np.int64), 0, shape[1] - 1)
        row = np.clip(((bounds[3] - world[:, 1]) // cell).astype(np.int64), 0, shape[0] - 1)
        flat = row * shape[1] + column
        heights.append(_height(flat, world[:, 2], shape[0] * shape[1], is_ground))
        flats.append(flat)
        levels.append(np.asarray(part.fields["lod95"], dtype=np.float64))
    level = _median(np.concatenate(flats), np.concatenate(levels), shape[0] * shape[1])
    difference = heights[1] - heights[0]
    stack = np.stack([difference, np.where(np.isfinite(difference), level, np.nan), *heights])
    return stack.reshape(len(BANDS), *shape).astype(np.float32)


def _height(
    flat: NDArray[np.int64], z: NDArray[np.float64], size: int, is_ground: bool
) -> NDArray[np.float64]:
    """Mean of ground points, highest of others, for every cell; NaN without points."""
    if is_ground:
        count = np.bincount(flat, minlength=size)
        total = np.bincount(flat, z, minlength=size)
        return np.where(count > 0, total / np.maximum(count, 1), np.nan)
    return highest_points(flat, z, size)


def highest_points(flat: NDArray[np.int64], z: NDArray[np.float64], size: int) -> NDArray[np.float64]:
    """Return the height (size,) of the highest point of every cell [m], NaN without points."""
    highest = np.full(size, -np.inf)
    np.maximum.at(highest, flat, z)
    return np.where(np.isfinite(highest), highest, np.nan)


def _median(flat: NDArray[np.int64], values: NDArray[np.float64], size: int) -> NDArray[np.float64]:
    """Lower median of the finite values for every cell, NaN where there is none."""
    known = np.isfinite(values)
    order = np.lexsort((values[known], flat[known]))
    cells, ordered = flat[known][order], values[known][order]
    result = np.full(size, np.nan)
    occupied, starts, counts = np.unique(cells, return_index=True, return_counts=True)
    result[occupied] = ordered[starts + (counts - 1) // 2]
    return result


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
