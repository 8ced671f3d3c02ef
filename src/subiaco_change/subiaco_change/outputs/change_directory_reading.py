"""Reading of a change directory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import geopandas as gpd

from subiaco_change.outputs.clouds import labelled_path, open_labelled, read_labelled
from subiaco_change.outputs.documents import RegistrationDocument, RunDocument, read_document
from subiaco_change.outputs.reviews import read_reviewed
from subiaco_geo.cloud_windows import CloudFile
from subiaco_geo.clouds import PointCloud
from subiaco_geo.errors import InputError


@dataclass(frozen=True)
class ChangeDirectory:
    """A change directory as read back.

    ``table`` has the columns of ``docs/reference/change-table.md``, footprints, and reviews of every file;
    ``registration`` and ``run`` are the parsed JSON files.
    """

    path: Path
    table: gpd.GeoDataFrame
    registration: Mapping[str, Any]
    run: Mapping[str, Any]

    @cached_property
    def before(self) -> PointCloud:
        """The labelled cloud of *before* in the frame of *after*, whole in memory."""
        return read_labelled(self.path, "before")

    @cached_property
    def after(self) -> PointCloud:
        """The labelled cloud of *after*, whole in memory."""
        return read_labelled(self.path, "after")

    def open(self, epoch: str) -> CloudFile:
        """Open the labelled cloud of an epoch without reading it."""
        return open_labelled(self.path, epoch)


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
    for epoch in ("before", "after"):
        labelled_path(directory, epoch)
    table = read_reviewed(directory)
    assert table is not None  # both files are there
    return ChangeDirectory(
        directory,
        table,
        read_document(directory / "registration.json", RegistrationDocument),
        read_document(directory / "run.json", RunDocument),
    )
