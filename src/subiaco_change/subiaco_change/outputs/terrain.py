"""Terrain of a map: ground model, surface model and hillshade as cloud-optimised GeoTIFF, contours, sections.

Sections along given lines are profiles of ground and surface, as GeoPackage, DXF and CSV.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd
import pyogrio
import rasterio
from contourpy import contour_generator
from numpy.typing import NDArray
from rasterio.windows import Window
from shapely.geometry import LineString

from subiaco_change.outputs.difference_rasters import RasterGrid, highest_points, raster_profile, write_cog
from subiaco_change.outputs.drawing_exchange import write_contour_dxf, write_section_dxf
from subiaco_change.segmentation.ground_model import GroundConfig, fit_ground
from subiaco_geo.atomic import whole_directory
from subiaco_geo.cloud_windows import CloudFile
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats
from subiaco_geo.sources import open_epoch

#: Models that are cut, and the rasters that hold them.
MODELS = {"ground": "dtm.tif", "surface": "dsm.tif"}


@dataclass(frozen=True)
class TerrainSection:
    """One line and the heights along it.

    ``number`` counts lines from 1; ``chainage`` (N,) [m] from the start of the line; ``place`` (N, 2) east
    and north [m]; ``heights`` (N,) [m] by model, NaN where a model is not known.
    """

    number: int
    chainage: Floats
    place: Floats
    heights: dict[str, Floats]

    def pieces(self, model: str) -> Iterator[NDArray[np.int64]]:
        """Yield the runs of two stations or more whose height is known."""
        known = np.flatnonzero(np.isfinite(self.heights[model]))
        for run in np.split(known, np.flatnonzero(np.diff(known) > 1) + 1):
            if len(run) > 1:
                yield run


def read_section_lines(path: Path, crs: str | None) -> list[LineString]:
    """Read the lines of a file in the CRS of the map; a file without CRS is in that of the map.

    Raises
    ------
    InputError
        The file cannot be read or holds no line.
    """
    try:
        found = gpd.read_file(path, engine="pyogrio")
    except (pyogrio.errors.DataSourceError, OSError) as error:
        raise InputError(
            f"{path}: no lines can be read from it ({error}); give .gpkg, .geojson or .shp"
        ) from error
    if crs is not None and found.crs is not None:
        found = found.to_crs(crs)
    lines = [shape for shape in found.geometry.explode() if isinstance(shape, LineString)]
    if not lines:
        raise InputError(f"{path}: holds no line; draw the sections as lines")
    return lines


def write_sections(lines: list[LineString], folder: Path, crs: str | None) -> None:
    """Cut the terrain models of a folder along lines.

    Writes ``sections.gpkg`` (layer ``sections``: three-dimensional profiles by ``section`` and ``model``),
    ``sections.dxf`` (profiles drawn flat, chainage to the right and height upwards, one section beside the
    other) and ``sections.csv`` (a row for each station).

    Parameters
    ----------
    lines : list of LineString
        In the CRS of the rasters.
    folder : Path
        With ``dtm.tif`` and ``dsm.tif``.
    crs : str or None
    """
    sections = [_cut(number, line, folder) for number, line in enumerate(lines, 1)]
    rows = [
        {
            "section": s.number,
            "model": model,
            "geometry": LineString(np.column_stack([s.place, heights])[run]),
        }
        for s in sections
        for model, heights in s.heights.items()
        for run in s.pieces(model)
    ]
    if rows:
        table = gpd.GeoDataFrame(rows, crs=crs)
        table.to_file(folder / "sections.gpkg", layer="sections", driver="GPKG", engine="pyogrio")
    write_section_dxf(folder / "sections.dxf", _drawn(sections))
    frames = [
        pd.DataFrame(
            {"section": s.number, "chainage_m": s.chainage, "east": s.place[:, 0], "north": s.place[:, 1]}
            | {f"{model}_m": heights for model, heights in s.heights.items()}
        )
        for s in sections
    ]
    pd.concat(frames).to_csv(folder / "sections.csv", index=False, float_format="%.3f")


def _cut(number: int, line: LineString, folder: Path) -> TerrainSection:
    heights: dict[str, Floats] = {}
    chainage, place = np.zeros(0), np.zeros((0, 2))
    for model, name in MODELS.items():
        with rasterio.open(folder / name) as raster:
            if len(chainage) == 0:
                chainage = np.append(np.arange(0.0, line.length, raster.res[0]), line.length)
                place = np.array([line.interpolate(at).coords[0][:2] for at in chainage])
            values = np.array([value[0] for value in raster.sample(place)], dtype=np.float64)
            inside = (place >= raster.bounds[:2]).all(axis=1) & (place <= raster.bounds[2:]).all(axis=1)
            heights[model] = np.where(inside, values, np.nan)
    return TerrainSection(number, chainage, place, heights)


def _drawn(sections: list[TerrainSection]) -> Iterator[tuple[str, int, Floats]]:
    """Yield layer, section and corners (N, 2) of what is drawn, each section 10 m right of the last."""
    start = 0.0
    for section in sections:
        for model, heights in section.heights.items():
            for run in section.pieces(model):
                corners = np.column_stack([start + section.chainage, heights])[run]
                yield model.upper(), section.number, corners
        start += float(section.chainage[-1]) + 10.0


_MARGIN = 30.0  # around a window, so that the ground filter sees past the widest roof that it removes [m]
_BLOCK = 1024  # cells along the edge of a block in which contours are drawn
_SHORTEST = 2.0  # of a contour [m]: shorter ones are noise of single cells
_RASTERS = ("dtm", "dsm", "hillshade")


def export_terrain(
    directory: Path,
    output: Path,
    cell: float = 0.5,
    interval: float = 0.5,
    sections: Path | None = None,
) -> list[Path]:
    """Write ``dtm.tif``, ``dsm.tif``, ``hillshade.tif``, ``contours.gpkg`` and ``contours.dxf`` of a map.

    The ground model (DTM) is the filtered ground of
    :func:`~subiaco_change.segmentation.ground_model.fit_ground`, known within 4 m of a ground cell. The
    surface model (DSM) is the highest point of a cell. Contours are cut at the edges of blocks of 1,024
    cells.

    Parameters
    ----------
    directory : Path
        Map directory, or a cloud.
    output : Path
        New directory.
    cell : float
        Edge of a cell [m].
    interval : float
        Height between contours [m].
    sections : Path, optional
        File of lines along which both models are cut; see
        :func:`~subiaco_change.outputs.terrain.write_sections`.

    Returns
    -------
    list of Path

    Raises
    ------
    InputError
        Not a map, or an output that exists.
    """
    cloud = CloudFile(open_epoch(directory).cloud, ())
    crs = next(cloud.parts()).crs
    cut = [] if sections is None else read_section_lines(sections, crs)
    grid = RasterGrid.around(cloud.low, cloud.high, cell)
    with whole_directory(output) as target:
        plain = {name: target / f"{name}.plain.tif" for name in _RASTERS}
        profile = raster_profile(grid, crs, count=1)
        with (
            rasterio.open(plain["dtm"], "w", **profile) as dtm,
            rasterio.open(plain["dsm"], "w", **profile) as dsm,
        ):
            for window, bounds in grid.windows():
                _write_window(cloud, dtm, dsm, window, bounds, cell)
        shaded = profile | {"dtype": "uint8", "nodata": 0}
        with rasterio.open(plain["dsm"]) as dsm, rasterio.open(plain["hillshade"], "w", **shaded) as shade:
            for window, _ in grid.windows():
                shade.write(_shade(dsm, window, cell), 1, window=window)
        with rasterio.open(plain["dtm"]) as dtm:
            lines = gpd.GeoDataFrame(
                list(_contours(dtm, interval)), columns=["height_m", "geometry"], crs=crs
            )
        for name, source in plain.items():
            write_cog(source, target / f"{name}.tif")
            source.unlink()
        if cut:
            write_sections(cut, target, crs)
        if len(lines):
            lines.to_file(target / "contours.gpkg", layer="contours", driver="GPKG", engine="pyogrio")
            write_contour_dxf(target / "contours.dxf", lines)
    return sorted(output.iterdir())


def _write_window(
    cloud: CloudFile,
    dtm: rasterio.io.DatasetWriter,
    dsm: rasterio.io.DatasetWriter,
    window: Window,
    bounds: tuple[float, float, float, float],
    cell: float,
) -> None:
    """Fit the ground of a window with its surroundings, and write both models of it."""
    west, south, east, north = bounds
    around = cloud.inside(west - _MARGIN, south - _MARGIN, east + _MARGIN, north + _MARGIN)
    if len(around) == 0:
        return
    shape = (int(window.height), int(window.width))
    model = fit_ground(around.xyz, GroundConfig())
    x = west + (np.arange(shape[1]) + 0.5) * cell - around.origin[0]
    y = north - (np.arange(shape[0]) + 0.5) * cell - around.origin[1]
    centres = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    ground = np.where(model.supported(centres), model.height(centres) + around.origin[2], np.nan)
    dtm.write(ground.reshape(shape).astype(np.float32), 1, window=window)
    inner = cloud.inside(*bounds).world()
    column = np.clip(((inner[:, 0] - west) // cell).astype(np.int64), 0, shape[1] - 1)
    row = np.clip(((north - inner[:, 1]) // cell).astype(np.int64), 0, shape[0] - 1)
    surface = highest_points(row * shape[1] + column, inner[:, 2], shape[0] * shape[1])
    dsm.write(surface.reshape(shape).astype(np.float32), 1, window=window)


def _shade(dsm: rasterio.DatasetReader, window: Window, cell: float) -> NDArray[np.uint8]:
    """Shade a window with a cell around it; 1 to 255, 0 where nothing is known."""
    wide = Window(window.col_off - 1, window.row_off - 1, window.width + 2, window.height + 2)
    heights = dsm.read(1, window=wide, boundless=True, fill_value=np.nan).astype(np.float64)
    shade = hillshade(heights, cell)[1:-1, 1:-1]
    return np.where(np.isfinite(shade), 1.0 + 254.0 * np.nan_to_num(shade), 0.0).astype(np.uint8)


def _contours(dtm: rasterio.DatasetReader, interval: float) -> Iterator[tuple[float, LineString]]:
    """Yield height and line of every contour, block by block."""
    if interval <= 0.0:
        raise InputError(f"contours: an interval of {interval} m is no interval; give more than 0 m")
    for row in range(0, dtm.height, _BLOCK):
        for column in range(0, dtm.width, _BLOCK):
            size = min(_BLOCK + 1, dtm.width - column), min(_BLOCK + 1, dtm.height - row)
            if min(size) < 2:
                continue
            window = Window(column, row, *size)
            heights = np.ma.masked_invalid(dtm.read(1, window=window).astype(np.float64))
            if heights.count() == 0:
                continue
            place = dtm.window_transform(window)
            x = place.c + (np.arange(size[0]) + 0.5) * place.a
            y = place.f + (np.arange(size[1]) + 0.5) * place.e
            yield from _lines(x, y, heights, interval)


def _lines(
    x: Floats, y: Floats, heights: np.ma.MaskedArray[tuple[int, int], np.dtype[np.float64]], interval: float
) -> Iterator[tuple[float, LineString]]:
    made = contour_generator(x, y, heights)
    first, last = (int(np.ceil(float(v) / interval)) for v in (heights.min(), heights.max()))
    for step in range(first, last + 1):
        level = round(step * interval, 6)
        for points in made.lines(level):
            line = LineString(np.asarray(points)) if len(points) > 1 else None
            if line is not None and line.length >= _SHORTEST:
                yield level, line


def hillshade(height: Floats, pixel: float) -> Floats:
    """Return shading 0..1 (rows, columns) of heights [m] lit from the north-west, NaN kept."""
    if min(height.shape) < 2:
        return np.where(np.isfinite(height), 0.7, np.nan)
    level = np.nanmedian(height) if np.isfinite(height).any() else 0.0
    smooth = np.where(np.isfinite(height), height, level)
    down, right = np.gradient(smooth, pixel)
    light = np.array([-1.0, 1.0, 1.6]) / np.linalg.norm([-1.0, 1.0, 1.6])
    normal_length = np.sqrt(right**2 + down**2 + 1.0)
    shade = (-right * light[0] + down * light[1] + light[2]) / normal_length
    return np.where(np.isfinite(height), np.clip(0.25 + 0.75 * shade, 0.0, 1.0), np.nan)
