"""Layouts that can be scored: our change directories, labels of other methods, the published files."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from subiaco_change.outputs.change_directory_reading import read_change_directory
from subiaco_evaluation.truth import SurveyTruth
from subiaco_geo.array_files import read_array_file
from subiaco_geo.cloud_io import read_cloud
from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import Change
from subiaco_geo.errors import InputError

_CLOUD_NAMES = {
    "before": ("before_labelled.ply", "before_labelled.laz", "before.ply", "before.laz", "2023.ply"),
    "after": ("after_labelled.ply", "after_labelled.laz", "after.ply", "after.laz", "2025.ply"),
}


@dataclass(frozen=True)
class Prediction:
    """Labelled points of both epochs in the frame of *after*, and what else is known.

    The clouds carry at least ``change``; ``table``, ``registration`` and
    ``run`` are there for change directories of ours only.
    """

    before: PointCloud
    after: PointCloud
    table: pd.DataFrame | None = None
    registration: Mapping[str, Any] | None = None
    run: Mapping[str, Any] | None = None


@dataclass(frozen=True)
class PublishedLoop:
    """One loop of the published evaluation: 2D arrays of codes, -1 where nothing is scored."""

    name: str
    truth: NDArray[np.int64]
    predicted: NDArray[np.int64]
    true_semantic: NDArray[np.int64] | None
    predicted_semantic: NDArray[np.int64] | None


def read_prediction(path: Path, truth: SurveyTruth) -> Prediction:
    """Read what a method said about a simulated pair.

    A change directory of ours; or a directory with ``before`` and ``after``
    as ``.ply``/``.laz`` with a field ``change``; or as ``before.npy`` and
    ``after.npy``, one code a truth point in the order of ``points.npz``.

    Raises
    ------
    InputError
        Nothing that can be scored.
    """
    if (path / "changes.csv").is_file():
        change = read_change_directory(path)
        return Prediction(change.before, change.after, change.table, change.registration, change.run)
    if not path.is_dir():
        raise InputError(f"{path}: no such directory; give a change directory or one with labelled clouds")
    if (path / "before.npy").is_file() and (path / "after.npy").is_file():
        moved = in_after_frame(truth)
        return Prediction(
            _with_codes(path / "before.npy", moved["before"]), _with_codes(path / "after.npy", moved["after"])
        )
    return Prediction(_labelled(path, "before"), _labelled(path, "after"))


def in_after_frame(truth: SurveyTruth) -> dict[str, PointCloud]:
    """Return the truth points of both epochs in the frame of *after*."""
    origin = truth.before.origin
    rotation, shift = truth.T_after_before[:3, :3], truth.T_after_before[:3, 3]
    target = np.round(rotation @ origin + shift, -2) if np.any(origin) else origin
    moved = truth.before.xyz @ rotation.T + (rotation @ origin + shift - target)
    before = PointCloud(moved, target, truth.before.crs, truth.before.fields)
    return {"before": before, "after": truth.after}


def _with_codes(path: Path, cloud: PointCloud) -> PointCloud:
    codes = _load(path)
    if codes.shape != (len(cloud),):
        raise InputError(
            f"{path}: has shape {codes.shape}; expected one code for each of {len(cloud)} truth points"
        )
    return PointCloud(cloud.xyz, cloud.origin, cloud.crs, {"change": _codes(path, codes)})


def _labelled(path: Path, epoch: str) -> PointCloud:
    for name in _CLOUD_NAMES[epoch]:
        if (path / name).is_file():
            cloud = read_cloud(path / name)
            if "change" not in cloud.fields:
                raise InputError(f"{path / name}: no field 'change'; write one code 0-4 or 255 a point")
            return cloud.with_fields(change=_codes(path / name, np.asarray(cloud.fields["change"])))
    raise InputError(
        f"{path}: no labels of epoch {epoch}; expected {', '.join(_CLOUD_NAMES[epoch][:3])} or {epoch}.npy"
    )


def _codes(path: Path, values: NDArray[Any]) -> NDArray[np.uint8]:
    whole = np.where(values == -1, int(Change.UNOBSERVED), values)
    strange = np.setdiff1d(whole, [int(c) for c in Change])
    if len(strange):
        raise InputError(f"{path}: change code {strange[0]} is unknown; use 0-4, or 255 for undecided")
    return np.asarray(whole).astype(np.uint8)


def _load(path: Path) -> NDArray[Any]:
    return read_array_file(path, "a plain .npy array", "save it with numpy.save")


def read_published_loops(root: Path, run: str) -> list[PublishedLoop]:
    """Read the published layout: ``loopNN/gt_change.npy`` and ``change/<run>.npy``.

    Parameters
    ----------
    root : Path
        Holds ``loop*`` directories.
    run : str
        Name of a run: ``loopNN/change/<run>.npy``.

    Raises
    ------
    InputError
        No loops, a file is missing, or shapes differ.
    """
    loops = sorted(p.parent for p in root.glob("loop*/gt_change.npy"))
    if not loops:
        raise InputError(f"{root}: no loop*/gt_change.npy; give the root of the published evaluation files")
    return [_read_loop(loop, run) for loop in loops]


def _read_loop(loop: Path, run: str) -> PublishedLoop:
    truth = _load(loop / "gt_change.npy").astype(np.int64)

    def beside(path: Path) -> NDArray[np.int64]:
        values = _load(path).astype(np.int64)
        if values.shape != truth.shape:
            raise InputError(f"{path}: shape {values.shape} differs from gt_change.npy {truth.shape}")
        return values

    semantic = [loop / "gt_sem.npy", loop / "pred_sem.npy"]
    known = all(path.is_file() for path in semantic)
    return PublishedLoop(
        loop.name,
        truth,
        beside(loop / "change" / f"{run}.npy"),
        beside(semantic[0]) if known else None,
        beside(semantic[1]) if known else None,
    )


def read_published_pair(directory: Path) -> tuple[PointCloud, PointCloud]:
    """Read ``PairN/2023.ply`` and ``2025.ply``: ASCII x y z r g b, each in its own frame, no CRS."""
    epochs = []
    for name in ("2023.ply", "2025.ply"):
        if not (directory / name).is_file():
            raise InputError(f"{directory}: {name} is missing; a published pair holds 2023.ply and 2025.ply")
        epochs.append(read_cloud(directory / name))
    return epochs[0], epochs[1]


def is_published(path: Path) -> bool:
    """Tell whether a directory holds the published evaluation files."""
    return path.is_dir() and any(path.glob("loop*/gt_change.npy"))


def scene_name(truth: SurveyTruth, path: Path) -> str:
    """Return a name for a scene: preset and seed where they are known."""
    scene = truth.scene
    if "preset" in scene and "seed" in scene:
        return json.dumps([scene["preset"], scene["seed"]]).strip("[]").replace('"', "").replace(", ", "-")
    return path.name
