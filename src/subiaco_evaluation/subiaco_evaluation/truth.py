"""The truth of a simulated survey: labelled points of both epochs, objects, and the true transform."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml
from numpy.typing import NDArray

from subiaco_geo.array_files import read_arrays
from subiaco_geo.clouds import PointCloud, from_world
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.config import load_yaml
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats
from subiaco_geo.trajectories import Trajectory, read_tum

EPOCHS = ("before", "after")
_CODES = {"change": [int(c) for c in Change], "class": [int(s) for s in Semantic]}


@dataclass(frozen=True)
class SurveyTruth:
    """What a simulated pair of surveys really looked like.

    ``before`` and ``after`` carry the fields ``object`` int64, ``semantic``
    uint8 and ``change`` uint8 (255 wherever the other drive could not see),
    each in its own map's frame; ``T_after_before`` (4, 4) acts on world
    coordinates; ``trajectories`` are ``T_map_lidar`` by epoch.
    """

    before: PointCloud
    after: PointCloud
    objects: pd.DataFrame
    T_after_before: Floats
    scene: Mapping[str, Any]
    trajectories: Mapping[str, Trajectory]


def read_truth(sim_out: Path) -> SurveyTruth:
    """Read ``OUT/truth`` and ``OUT/<epoch>/truth`` of a simulated survey.

    Raises
    ------
    InputError
        A file is missing or is not what it should be.
    """
    path = sim_out / "truth" / "scene.yaml"
    scene = _read_scene(path)
    try:
        transform = np.asarray(scene.get("T_after_before", np.eye(4)), dtype=np.float64)
    except (ValueError, TypeError, OverflowError) as error:
        raise InputError(f"{path}: T_after_before holds no numbers ({error}); simulate again") from error
    if transform.shape != (4, 4) or not np.isfinite(transform).all():
        raise InputError(f"{path}: T_after_before must be 4x4 and finite, got {transform.shape}")
    clouds = {epoch: read_truth_points(sim_out / epoch / "truth" / "points.npz") for epoch in EPOCHS}
    drives = {epoch: sim_out / epoch / "truth" / "trajectory.tum" for epoch in EPOCHS}
    return SurveyTruth(
        clouds["before"],
        clouds["after"],
        _read_objects(sim_out / "truth" / "objects.csv"),
        transform,
        scene,
        {epoch: read_tum(path) for epoch, path in drives.items() if path.is_file()},
    )


def _read_scene(path: Path) -> dict[str, Any]:
    try:
        scene = load_yaml(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: missing; give the output of 'subiaco simulate'") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not valid YAML; simulate again") from error
    if not isinstance(scene, dict):
        raise InputError(f"{path}: expected a mapping; simulate again")
    return scene


def _read_objects(path: Path) -> pd.DataFrame:
    try:
        return pd.read_csv(path)
    except (OSError, ValueError, OverflowError) as error:  # pandas' own are ValueErrors
        said = " ".join(str(error).split())
        raise InputError(f"{path}: cannot be read ({said}); give the output of 'subiaco simulate'") from error


def read_truth_points(path: Path) -> PointCloud:
    """Read ``points.npz`` with ``xyz``, ``object``, ``class`` and ``change``."""
    names = ("xyz", "object", "class", "change")
    arrays = read_arrays(path, names, "the truth of a simulated epoch", "simulate again")
    for name, allowed in _CODES.items():
        _check_codes(path, name, arrays[name], allowed)
    return from_world(
        arrays["xyz"],
        object=arrays["object"].astype(np.int64),
        semantic=arrays["class"].astype(np.uint8),
        change=arrays["change"].astype(np.uint8),
    )


def _check_codes(path: Path, name: str, values: NDArray[Any], allowed: list[int]) -> None:
    strange = np.setdiff1d(values, allowed)
    if len(strange):
        raise InputError(f"{path}: {name} holds {strange[0]}; allowed are {allowed}")
