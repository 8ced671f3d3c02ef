"""Footprints as a DXF drawing of R12, which every CAD program reads, with its row at each outline."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import geopandas as gpd
import pandas as pd

from subiaco_geo.codes import Change
from subiaco_geo.frames import Floats

#: Colour of the AutoCAD index for each label: green, red, blue, orange, greys.
_COLOURS = {
    Change.ADDED.label: 3,
    Change.REMOVED.label: 1,
    Change.INCREASED.label: 5,
    Change.DECREASED.label: 30,
    Change.UNCHANGED.label: 8,
    Change.NOT_REPORTED.label: 9,
    Change.UNOBSERVED.label: 9,
}
_APPLICATION = "SUBIACO"  # owner of the extended data
_LONGEST = 250  # characters of a string of extended data
_TEXT_HEIGHT = 1.0  # of the object number [m]

DxfGroup = tuple[int, Any]
_ENTITIES: tuple[DxfGroup, ...] = ((0, "SECTION"), (2, "ENTITIES"))


def write_dxf(path: Path, table: gpd.GeoDataFrame) -> None:
    """Write the footprints of a change table as closed polylines, a layer for each label.

    Every outline carries ``column=value`` of its row as extended data of the application ``SUBIACO``, and the
    object number as a text at its centroid. Coordinates are those of the table [m]; the elevation is ``z``.

    Parameters
    ----------
    path : Path
    table : GeoDataFrame
    """
    groups = [*_head({name.upper(): colour for name, colour in _COLOURS.items()}), *_ENTITIES]
    columns = [name for name in table.columns if name != table.geometry.name]
    for row, shape in zip(table[columns].to_dict("records"), table.geometry, strict=True):
        data = [f"{name}={_text(row[name])}"[:_LONGEST] for name in columns]
        for polygon in shape.geoms:
            for ring in (polygon.exterior, *polygon.interiors):
                groups += _polyline(row["label"].upper(), ring.coords[:-1], row["z"], data)
        groups += _label(row, shape.representative_point().coords[0])
    _write(path, groups)


def write_contour_dxf(path: Path, lines: gpd.GeoDataFrame) -> None:
    """Write contours (``height_m``, lines) as polylines of the layer ``CONTOUR`` at their heights."""
    groups: list[DxfGroup] = [*_head({"CONTOUR": 8}), *_ENTITIES]
    for height, line in zip(lines["height_m"], lines.geometry, strict=True):
        groups += _polyline("CONTOUR", line.coords, float(height), [], closed=False)
    _write(path, groups)


def write_section_dxf(path: Path, drawn: Iterable[tuple[str, int, Floats]]) -> None:
    """Write profiles (layer, section, corners (N, 2)) as polylines that carry ``section=number``."""
    groups: list[DxfGroup] = [*_head({"GROUND": 30, "SURFACE": 5}), *_ENTITIES]
    for layer, number, corners in drawn:
        groups += _polyline(layer, corners, 0.0, [f"section={number}"], closed=False)
    _write(path, groups)


def _write(path: Path, groups: list[DxfGroup]) -> None:
    """Write the groups of a drawing and its end."""
    pairs = [*groups, (0, "ENDSEC"), (0, "EOF")]
    text = "".join(f"{code}\n{value}\n" for code, value in pairs)
    path.write_text(text, encoding="ascii", errors="replace", newline="\r\n")


def _text(value: Any) -> str:
    """Write a cell in one line; missing values are empty."""
    return "" if pd.isna(value) else " ".join(str(value).split())


def _head(layers: Mapping[str, int]) -> Iterator[DxfGroup]:
    """Version, layers with their colours, and the application of the extended data."""
    yield from [(0, "SECTION"), (2, "HEADER"), (9, "$ACADVER"), (1, "AC1009"), (0, "ENDSEC")]
    yield from [(0, "SECTION"), (2, "TABLES"), (0, "TABLE"), (2, "LAYER"), (70, len(layers))]
    for name, colour in layers.items():
        yield from [(0, "LAYER"), (2, name), (70, 0), (62, colour), (6, "CONTINUOUS")]
    yield from [(0, "ENDTAB"), (0, "TABLE"), (2, "APPID"), (70, 1), (0, "APPID"), (2, _APPLICATION), (70, 0)]
    yield from [(0, "ENDTAB"), (0, "ENDSEC")]


def _polyline(
    layer: str, corners: Any, height: float, data: list[str], *, closed: bool = True
) -> Iterator[DxfGroup]:
    yield from [(0, "POLYLINE"), (8, layer), (66, 1), (10, 0.0), (20, 0.0), (30, f"{height:.3f}")]
    yield (70, int(closed))
    if data:
        yield (1001, _APPLICATION)
    yield from ((1000, text) for text in data)
    for corner in corners:
        yield from [(0, "VERTEX"), (8, layer), (10, f"{corner[0]:.3f}"), (20, f"{corner[1]:.3f}")]
        yield (30, f"{height:.3f}")
    yield from [(0, "SEQEND"), (8, layer)]


def _label(row: dict[str, Any], place: tuple[float, ...]) -> Iterator[DxfGroup]:
    yield from [(0, "TEXT"), (8, str(row["label"]).upper()), (10, f"{place[0]:.3f}"), (20, f"{place[1]:.3f}")]
    yield from [(30, f"{row['z']:.3f}"), (40, _TEXT_HEIGHT), (1, row["object_id"])]
