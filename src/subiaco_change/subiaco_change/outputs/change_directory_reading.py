"""Reading of a change directory, whose JSON files are checked."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import geopandas as gpd
from pydantic import AllowInfNan, BaseModel, ConfigDict, Field, ValidationError

from subiaco_change.outputs.clouds import labelled_path, open_labelled, read_labelled
from subiaco_change.outputs.reviews import read_reviewed
from subiaco_geo.cloud_windows import CloudFile
from subiaco_geo.clouds import PointCloud
from subiaco_geo.errors import InputError

_Number = Annotated[float, AllowInfNan(False)]
_Row = Annotated[list[_Number], Field(min_length=4, max_length=4)]
_Pose = Annotated[list[_Row], Field(min_length=4, max_length=4)]


class _Document(BaseModel):
    """What readers rely on; whatever else a file holds is kept as it is."""

    model_config = ConfigDict(extra="allow", frozen=True)


class _Epochs(_Document):
    before: int = Field(ge=0)
    after: int = Field(ge=0)


class _Source(_Document):
    path: str


class _Sources(_Document):
    before: _Source | None
    after: _Source | None


class _Drive(_Document):
    first: datetime | None = None
    last: datetime | None = None
    km: _Number | None = None


class _Drives(_Document):
    before: _Drive | None = None
    after: _Drive | None = None


class _Notes(_Document):
    epochs: _Drives = _Drives()


class _Finding(_Document):
    code: str
    severity: str
    sentence: str
    remedy: str


class RunDocument(_Document):
    """``run.json``: sources, points and coordinate system of a run, and what limits its confidences."""

    table_hash: str
    versions: dict[str, str | None]
    inputs: _Sources
    points: _Epochs
    notes: _Notes = _Notes()
    crs: str | None
    confidence_calibrated: bool = False
    confidence_not_calibrated: list[str] = Field(default_factory=list)
    warnings: list[str] = Field(default_factory=list)
    findings: list[_Finding] = Field(default_factory=list)


class RegistrationDocument(_Document):
    """``registration.json``: the transform between two epochs and how well it is known."""

    T_after_before: _Pose
    T_local_about_origin: _Pose
    origin: Annotated[list[_Number], Field(min_length=3, max_length=3)]
    pose_std: Annotated[list[_Number | None], Field(min_length=6, max_length=6)]
    rmse_m: _Number | None
    inlier_ratio: _Number | None
    sigma_reg_m: _Number | None
    degenerate: list[str]
    method: str
    warnings: list[str] = Field(default_factory=list)


def read_document(path: Path, model: type[_Document]) -> dict[str, Any]:
    """Return the content of a JSON file of a change directory.

    Parameters
    ----------
    path : Path
    model : type
        :class:`RunDocument` or :class:`RegistrationDocument`: the fields that must be there, and their types.

    Raises
    ------
    InputError
        The file is not JSON, or a field is missing or of another type.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        model.model_validate(document)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(name) for name in first["loc"]) or "content"
        raise InputError(f"{path}: {where}: {first['msg']}; run 'subiaco change' again") from error
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: not valid JSON ({error}); run 'subiaco change' again") from error
    return dict(document)


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
