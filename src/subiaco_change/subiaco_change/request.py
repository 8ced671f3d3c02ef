"""Requests for a comparison: what the command, the action, the launch file and the Python API build alike."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field

from subiaco_change.config import ChangeConfig
from subiaco_geo.frames import Floats, is_rigid
from subiaco_geo.requests import Request
from subiaco_geo.work.object_store import is_url

_Row = tuple[float, float, float, float]
_Rows = tuple[_Row, _Row, _Row, _Row]
#: Departure of a given rotation from an orthonormal matrix that rounding in a text file explains.
_ROTATION_ROUNDING = 1e-3


def _rows_of(value: Any) -> Any:
    """Return the rows of a transform, given as an array, as rows of numbers, or as ``identity``."""
    if isinstance(value, str) and value == "identity":
        value = np.eye(4)
    if isinstance(value, np.ndarray):
        value = value.tolist()
    return value


def _rigid(rows: _Rows | None) -> _Rows | None:
    """Refuse a transform that is not a rotation and a shift."""
    if rows is not None and not is_rigid(np.array(rows), _ROTATION_ROUNDING):
        raise ValueError("not rigid; give a rotation and a shift without scale, with the last row 0 0 0 1")
    return rows


def _place(value: Any) -> Any:
    """Return a folder as a path, and leave a URL as it is."""
    return Path(value) if isinstance(value, str) and not is_url(value) else value


def _with_class(given: tuple[str, ...]) -> tuple[str, ...]:
    if "instance" in given and "semantic" not in given:
        raise ValueError("instance needs semantic too, because an object has a class")
    if "classification" in given and len(given) > 1:
        raise ValueError("classification and semantic both give the classes; name one of them")
    return given


class ComparisonRequest(Request):
    """Which two epochs to compare, by any method, and where the result is written."""

    before: Path = Field(description="Map directory or bare cloud of the earlier epoch")
    after: Path = Field(description="Map directory or bare cloud of the later epoch")
    output: Path = Field(description="Change directory to write")
    trajectory_before: Path | None = Field(
        None,
        description="Poses of the sensor (TUM, SBET, RTKLIB, CSV) for a bare cloud of the earlier epoch",
    )
    trajectory_after: Path | None = Field(
        None, description="Poses of the sensor (TUM, SBET, RTKLIB, CSV) for a bare cloud of the later epoch"
    )
    transform: Annotated[_Rows | None, BeforeValidator(_rows_of), AfterValidator(_rigid)] = Field(
        None,
        description="Known T_after_before in world coordinates, four rows of four numbers [m]; 'identity' "
        "where the epochs are registered already; without it they are registered",
    )
    parcels: Path | None = Field(
        None, description="Vector file of polygons, such as lots, by which the changes are summed up"
    )
    overwrite: bool = Field(False, description="Replace a change directory that exists")

    @property
    def T_after_before(self) -> Floats | None:
        """The known transform (4, 4) in world coordinates [m]; None where the epochs are to be registered."""
        return None if self.transform is None else np.array(self.transform, dtype=np.float64)


class ChangeRequest(ComparisonRequest):
    """A comparison by our own method: everything that decides its result, and who computes it."""

    given: Annotated[
        tuple[Literal["semantic", "instance", "classification"], ...], AfterValidator(_with_class)
    ] = Field(
        (),
        description="Point fields that replace the segmentation: semantic, semantic and instance, or "
        "classification (ASPRS classes)",
    )
    workers: int = Field(
        1, ge=1, description="Number of processes on this machine; does not change the result"
    )
    scheduler: str | None = Field(
        None, description="Address of a dask scheduler, such as tcp://host:8786, in place of local processes"
    )
    stages: Annotated[Path | str | None, BeforeValidator(_place)] = Field(
        None,
        description="Folder, or URL in object storage (s3://bucket/stages), in which the results of all "
        "stages are kept; without it they are kept beside the output until the run has succeeded, so that a "
        "stopped run continues",
    )
    redo: str | None = Field(
        None, description="Stage that is repeated, with all later ones, although results of it are kept"
    )
    config: ChangeConfig = Field(ChangeConfig(), description="Settings of the method")
