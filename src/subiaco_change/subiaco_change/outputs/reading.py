"""Reading a change directory back."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import geopandas as gpd

from subiaco_change.outputs import table as outputs_table
from subiaco_change.outputs.clouds import read_labelled
from subiaco_geo.clouds import PointCloud
from subiaco_geo.errors import InputError


@dataclass(frozen=True)
class ChangeDirectory:
    """A change directory as read back.

    ``table`` has the columns of contracts section 4 and footprints;
    ``before`` and ``after`` are labelled clouds in the frame of *after*;
    ``registration`` and ``run`` are the parsed JSON files.
    """

    path: Path
    table: gpd.GeoDataFrame
    before: PointCloud
    after: PointCloud
    registration: Mapping[str, Any]
    run: Mapping[str, Any]


def read_change_directory(directory: Path) -> ChangeDirectory:
    """Read a change directory back.

    Raises
    ------
    InputError
        It does not exist, is something else, or lacks a file.
    """
    if not directory.is_dir():
        raise InputError(f"{directory}: no such directory; give the output of 'subiaco change'")
    for name in ("changes.csv", "changes.parquet", "registration.json", "run.json"):
        if not (directory / name).is_file():
            raise InputError(f"{directory}: {name} is missing; not the output of 'subiaco change'")
    table = outputs_table.read_csv(directory / "changes.csv")
    shapes = gpd.read_parquet(directory / "changes.parquet", columns=["object_id", "geometry"])
    return ChangeDirectory(
        directory,
        gpd.GeoDataFrame(table, geometry=shapes.geometry.values, crs=shapes.crs),
        read_labelled(directory, "before"),
        read_labelled(directory, "after"),
        _read_json(directory / "registration.json"),
        _read_json(directory / "run.json"),
    )


def _read_json(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not valid JSON ({error}); run 'subiaco change' again") from error
    return dict(document)
