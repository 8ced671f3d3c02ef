"""Sections of terrain along given lines: profiles of ground and surface as GeoPackage, DXF and CSV."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd
import pyogrio
import rasterio
from numpy.typing import NDArray
from shapely.geometry import LineString

from subiaco_change.outputs.drawing_exchange import write_section_dxf
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats

#: Models that are cut, and the rasters that hold them.
MODELS = {"ground": "dtm.tif", "surface": "dsm.tif"}


@dataclass(frozen=True)
class Section:
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


def _cut(number: int, line: LineString, folder: Path) -> Section:
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
    return Section(number, chainage, place, heights)


def _drawn(sections: list[Section]) -> Iterator[tuple[str, int, Floats]]:
    """Yield layer, section and corners (N, 2) of what is drawn, each section 10 m right of the last."""
    start = 0.0
    for section in sections:
        for model, heights in section.heights.items():
            for run in section.pieces(model):
                corners = np.column_stack([start + section.chainage, heights])[run]
                yield model.upper(), section.number, corners
        start += float(section.chainage[-1]) + 10.0
