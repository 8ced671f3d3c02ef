"""Planned routes, cut into segments in local metres."""

from __future__ import annotations

import json
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from subiaco_geo.crs import EnuFrame
from subiaco_geo.errors import InputError, reason_of
from subiaco_geo.frames import Floats

_CSV_NAMES = (("lat", "latitude"), ("lon", "lng", "longitude"))


def densified(way: Floats, step: float) -> Floats:
    """Return points at most ``step`` apart along a line (N, 2)."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))])
    wanted = np.linspace(0.0, along[-1], max(2, int(np.ceil(along[-1] / step)) + 1))
    return np.column_stack([np.interp(wanted, along, way[:, axis]) for axis in range(2)])


def cut_line(line: Floats, step: float) -> list[Floats]:
    """Cut a line (N, 2) into pieces of about ``step``, corners kept."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    count = max(1, round(along[-1] / step))
    cuts = np.linspace(0.0, along[-1], count + 1)
    pieces = []
    for start, stop in pairwise(cuts):
        inside = along[(along > start) & (along < stop)]
        wanted = np.concatenate([[start], inside, [stop]])
        pieces.append(np.column_stack([np.interp(wanted, along, line[:, axis]) for axis in range(2)]))
    return pieces


def middle(piece: Floats) -> Floats:
    """Return the point (2,) half way along a line (N, 2)."""
    dense = densified(piece, 1.0)
    return np.asarray(dense[len(dense) // 2])


def read_route(path: Path) -> list[Floats]:
    """Read a planned route: GeoJSON (LineString, MultiLineString) or CSV with lat and lon columns.

    Returns
    -------
    list of (N, 2) float64
        Latitude, longitude [deg] of every line.

    Raises
    ------
    InputError
        The file cannot be read, or holds no line.
    """
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"{path}: cannot be read ({reason_of(error)}); give a GeoJSON or CSV file"
        ) from error
    try:
        lines = _csv_lines(text) if Path(path).suffix.lower() == ".csv" else _geojson_lines(json.loads(text))
    except (ValueError, KeyError, TypeError, IndexError, StopIteration) as error:
        raise InputError(
            f"{path}: holds no route; give a GeoJSON line, or CSV with columns lat,lon in degrees"
        ) from error
    lines = [line for line in lines if len(line) > 1]
    if not lines or any(not np.isfinite(line).all() or np.abs(line[:, 0]).max() > 90 for line in lines):
        raise InputError(f"{path}: holds no line in degrees; a route needs two points or more")
    return lines


def _geojson_lines(item: Any) -> list[Floats]:
    kind = item["type"]
    if kind == "FeatureCollection":
        return [line for feature in item["features"] for line in _geojson_lines(feature)]
    if kind == "Feature":
        return _geojson_lines(item["geometry"])
    if kind == "LineString":
        return [np.array([point[:2] for point in item["coordinates"]], dtype=np.float64)[:, ::-1]]
    if kind == "MultiLineString":
        return [np.array([p[:2] for p in line], dtype=np.float64)[:, ::-1] for line in item["coordinates"]]
    return []


def _csv_lines(text: str) -> list[Floats]:
    header, *rows = [line.split(",") for line in text.splitlines() if line.strip()]
    names = [name.strip().lower() for name in header]
    columns = [names.index(next(n for n in options if n in names)) for options in _CSV_NAMES]
    return [np.array([[float(row[c]) for c in columns] for row in rows], dtype=np.float64)]


def route_enu(lines: Sequence[Floats], frame: EnuFrame) -> list[Floats]:
    """Bring lines of latitude and longitude (N, 2) [deg] to east and north [m]."""
    height = frame.height
    return [frame.from_geodetic(line[:, 0], line[:, 1], np.full(len(line), height))[:, :2] for line in lines]
