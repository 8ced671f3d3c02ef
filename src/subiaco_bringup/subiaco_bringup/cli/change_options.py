"""Options of the verbs that compare two epochs, and the request that they make."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from subiaco_bringup.defaults import config_files
from subiaco_geo.config import load_config
from subiaco_geo.errors import InputError

if TYPE_CHECKING:
    from subiaco_change.request import ChangeRequest

EPOCH_HELP = "Map directory, or a bare cloud: .ply, .las, .laz, .copc.laz, .pcd."
Before = Annotated[Path, typer.Argument(metavar="BEFORE", help=EPOCH_HELP)]
After = Annotated[Path, typer.Argument(metavar="AFTER", help=EPOCH_HELP)]
TrajectoryFile = Annotated[
    Path | None,
    typer.Option(metavar="F", help="Scanner trajectory of a bare cloud: TUM, SBET, RTKLIB .pos or CSV."),
]

TransformFile = Annotated[
    Path | None,
    typer.Option(
        metavar="F",
        help="Known transform from BEFORE to AFTER: 4 rows of 4 numbers, or registration.json.",
    ),
]
RegistrationName = Annotated[
    str | None, typer.Option(help="'identity' compares the epochs as they are, without registration.")
]
WithoutParts = Annotated[
    list[str] | None,
    typer.Option(
        metavar="PART",
        help="Disable a component: lod, class_association, semantics or objects; may be repeated.",
    ),
]
ParcelsFile = Annotated[
    Path | None,
    typer.Option(
        metavar="LOTS",
        help="Polygons (.gpkg, .geojson, .shp), such as lots, for which the changes are summed up.",
    ),
]
GivenSemantics = Annotated[
    str | None,
    typer.Option(
        metavar="given|asprs",
        help="'given' takes the class of every point from its field semantic, 'asprs' from its ASPRS "
        "classification.",
    ),
]
GivenInstances = Annotated[
    str | None,
    typer.Option(metavar="given", help="'given' takes the object of every point from its field instance."),
]
StageFolder = Annotated[
    str | None,
    typer.Option(
        metavar="DIR|URL",
        help="Keep the results of every stage in this folder, or in object storage (s3://bucket/folder, "
        "http://...); a later run uses them again.",
    ),
]
DryRun = Annotated[
    int | None,
    typer.Option(
        metavar="N",
        min=1,
        help="Compare the N largest tiles only, and estimate time, memory and disk of the whole run.",
    ),
]
FromStage = Annotated[
    str | None,
    typer.Option("--from", metavar="STAGE", help="Repeat this stage and all later stages."),
]
Workers = Annotated[
    int | None,
    typer.Option(metavar="N", min=1, help="Number of processes [all cores]. Does not change the result."),
]
Scheduler = Annotated[
    str | None,
    typer.Option(metavar="ADDRESS", help="Address of a dask cluster to work on, e.g. tcp://host:8786."),
]


def known_transform(transform: Path | None, registration: str | None) -> NDArray[np.float64] | None:
    """Return the T_after_before (4, 4) that the options give, None to register."""
    from subiaco_change.job import read_transform

    if registration not in (None, "identity"):
        raise InputError(f"--registration {registration}: only 'identity' is known; leave it out to register")
    if registration is not None and transform is not None:
        raise InputError("--transform and --registration identity exclude each other; give one of them")
    if registration is not None:
        return np.eye(4)
    return None if transform is None else read_transform(transform)


def worker_count(workers: int | None) -> int:
    """Return the number of workers that is asked for, or that of the cores that this process may use."""
    if workers is not None:
        return workers
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _given(semantics: str | None, instances: str | None) -> tuple[str, ...]:
    """Return the point fields that replace stages."""
    if semantics not in (None, "given", "asprs"):
        raise InputError(f"--semantics {semantics}: give 'given' or 'asprs', or leave it out")
    if instances not in (None, "given"):
        raise InputError(f"--instances {instances}: only 'given' is known; leave it out to have them found")
    if semantics == "asprs" and instances is None:
        return ("classification",)
    if semantics == "asprs":
        raise InputError("--instances given needs --semantics given: ASPRS classes name no objects")
    if instances is not None and semantics is None:
        raise InputError("--instances given needs --semantics given: objects are of a class")
    return (*(("semantic",) if semantics else ()), *(("instance",) if instances else ()))


def change_request(
    *,
    transform: Path | None,
    registration: str | None,
    without: Sequence[str] | None,
    semantics: str | None,
    instances: str | None,
    keep_stages: str | None,
    from_stage: str | None,
    workers: int | None,
    config: Sequence[Path] | None,
    settings: Sequence[str] | None,
    **same: Any,
) -> ChangeRequest:
    """Return the request that the options make; ``same`` are those that are called as in the request."""
    from subiaco_change.config import ChangeConfig, with_parts_disabled
    from subiaco_change.request import ChangeRequest

    model = load_config(ChangeConfig, config_files("change", tuple(config or ())), settings or [])
    return ChangeRequest.of(
        transform=known_transform(transform, registration), given=_given(semantics, instances),
        workers=worker_count(workers), stages=keep_stages, redo=from_stage,
        config=with_parts_disabled(model, without or ()), **same,
    )  # fmt: skip
