"""Scores against a truth by the published protocol, and by object."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from pydantic import Field

from subiaco_change.outputs.json_text import plain
from subiaco_evaluation import object_matching as objects
from subiaco_evaluation.families import by_family
from subiaco_evaluation.grid import GridConfig, look_up, rasterise
from subiaco_evaluation.layouts import (
    Prediction,
    in_after_frame,
    is_published,
    read_prediction,
    read_published_loops,
    scene_name,
)
from subiaco_evaluation.near_gate import (
    ClearScore,
    near_gate_ids,
    points_without,
    pool_clear,
    verdicts_without,
    without_objects,
)
from subiaco_evaluation.paired import paired_difference, tile_matrices
from subiaco_evaluation.score_files import write_evaluation
from subiaco_evaluation.scores import (
    LABELS,
    bootstrap,
    class_iou,
    confusion,
    describe,
    nanmean,
    reliability,
    risk_coverage,
    scores,
)
from subiaco_evaluation.truth import SurveyTruth, read_truth
from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.config import StrictModel
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, Ints, rotation_angle
from subiaco_geo.simulated import name_simulation
from subiaco_geo.trajectories import Trajectory, read_tum
from subiaco_geo.trajectory_errors import absolute_error, relative_error

__all__ = ["EvaluationConfig", "evaluate", "evaluate_published", "write_evaluation"]


class EvaluationConfig(StrictModel):
    """How predictions are scored."""

    grid: GridConfig = GridConfig()
    radius: float = Field(
        0.3, gt=0.0, description="Largest distance of a truth point that labels a map point [m]"
    )
    object_share: float = Field(
        0.5,
        gt=0.0,
        le=1.0,
        description="Fraction of its points from which an object counts as found or as correct",
    )
    min_points: int = Field(30, ge=1, description="Smallest number of points of an object that is scored")
    min_size: float = Field(
        1.0, ge=0.0, description="Smallest longest side of a real change that is scored [m]"
    )
    rpe_length: float = Field(
        10.0, gt=0.0, description="Length of the trajectory segments for the relative pose error [m]"
    )
    bins: int = Field(10, ge=2, description="Number of bins of the reliability table")
    draws: int = Field(1000, ge=100, description="Number of bootstrap samples over scenes")
    seed: int = Field(0, ge=0, description="Seed of the bootstrap over scenes")


@dataclass(frozen=True)
class SceneScore:
    """Everything counted on one scene; matrices add up over scenes."""

    name: str
    grid: Ints
    points: Ints
    semantics: Ints
    decided: tuple[Floats, Floats]  # per labelled and decided cell: right (0/1), confidence
    cells_left_out: int
    points_left_out: int
    object_counts: dict[str, int] | None = None
    verdicts: pd.DataFrame | None = None
    tiles: Ints | None = None
    registration: dict[str, float] | None = None
    trajectories: Mapping[str, dict[str, float]] | None = None
    clear: ClearScore | None = None
    family: str | None = None


def evaluate(pairs: Sequence[tuple[Path, Path]], config: EvaluationConfig | None = None) -> dict[str, Any]:
    """Score (what a method said, truth) pairs together.

    Parameters
    ----------
    pairs : sequence of (Path, Path)
        A change directory or labels by another method
        (:func:`~subiaco_evaluation.layouts.read_prediction`), and the
        output of ``subiaco simulate``.
    config : EvaluationConfig, optional

    Returns
    -------
    dict
        Content of ``evaluation.json``; units are in the names of the keys, what
        does not exist is None.
    """
    settings = config or EvaluationConfig()
    if not pairs:
        raise InputError("evaluate: no pairs; give CHANGE_DIR TRUTH")
    found, simulations, injected = [], [], []
    for said, truth_path in pairs:
        if is_published(truth_path):
            raise InputError(f"{truth_path}: published files have no points; give --published RUN")
        truth = read_truth(truth_path)
        if truth.scene.get("simulator_hash"):
            simulations.append(name_simulation(truth.scene))
        injected.append(truth.scene.get("preset") == "injected")
        found.append(
            score_scene(read_prediction(said, truth), truth, settings, scene_name(truth, truth_path))
        )
    origin = {"truth_is_simulated": True, "changes_are_injected": all(injected)}
    return {**origin, "simulations": plain(simulations), **plain(pool(found, settings))}


def compare(
    pairs: Sequence[tuple[Path, Path]], others: Sequence[Path], config: EvaluationConfig | None = None
) -> dict[str, Any]:
    """Compare what two methods said of the same truths: paired bootstrap over tiles of 80 m.

    Parameters
    ----------
    pairs : sequence of (Path, Path)
        As :func:`evaluate`.
    others : sequence of Path
        What the other method said, one for each pair.
    config : EvaluationConfig, optional

    Returns
    -------
    dict
        See :func:`~subiaco_evaluation.paired.paired_difference`.
    """
    settings = config or EvaluationConfig()
    if len(others) != len(pairs):
        raise InputError(
            f"--against: {len(others)} for {len(pairs)} pairs; give one for each, in their order"
        )
    found: tuple[list[Ints], list[Ints]] = ([], [])
    for (said, truth_path), other in zip(pairs, others, strict=True):
        truth = read_truth(truth_path)
        real = in_after_frame(truth)
        for path, tiles in zip((said, other), found, strict=True):
            tiles.append(score_cells(read_prediction(path, truth), real, settings)[1])
    first, second = (np.concatenate(tiles) for tiles in found)
    return paired_difference(first, second, settings.draws, settings.seed)


def evaluate_published(root: Path, run: str, config: EvaluationConfig | None = None) -> dict[str, Any]:
    """Score a run laid out like the published files, grids against grids."""
    settings = config or EvaluationConfig()
    found = []
    for loop in read_published_loops(root, run):
        semantics = np.zeros((4, 5), dtype=np.int64)
        if loop.true_semantic is not None and loop.predicted_semantic is not None:
            semantics = confusion(loop.true_semantic.ravel(), loop.predicted_semantic.ravel(), 4)
        matrix = confusion(loop.truth.ravel(), loop.predicted.ravel())
        empty = (np.zeros(0), np.zeros(0))
        found.append(SceneScore(loop.name, matrix, np.zeros((5, 6), np.int64), semantics, empty, 0, 0))
    origin = {"truth_is_simulated": False, "changes_are_injected": False, "run": run}
    return {**origin, **plain(pool(found, settings))}


def score_scene(
    prediction: Prediction, truth: SurveyTruth, config: EvaluationConfig, name: str
) -> SceneScore:
    """Count everything on one scene."""
    real = in_after_frame(truth)
    grid, tiles, decided, left_out = score_cells(prediction, real, config)
    before, after = (objects.one_a_voxel(c, config.grid.leaf) for c in (prediction.before, prediction.after))
    points = objects.together(
        objects.transfer(before, real["before"], config.radius),
        objects.transfer(after, real["after"], config.radius),
    )
    reported = points.matched & (points.change != Change.NOT_REPORTED)
    counts, verdicts = None, None
    if prediction.table is not None:
        verdicts = objects.row_verdicts(prediction.table, points, config.object_share)
        changes = objects.true_changes(joined_truth(real), points, config.min_points, config.min_size)
        counts = objects.object_counts(verdicts, changes, config.object_share, config.min_points)
    return SceneScore(
        name,
        grid,
        confusion(points.true_change[reported], points.change[reported]),
        confusion(points.true_semantic, points.semantic, len(Semantic)),
        decided,
        left_out,
        int((~reported).sum()),
        counts,
        verdicts,
        tiles,
        registration_error(prediction.registration, truth.T_after_before),
        score_trajectories(prediction.run, truth.trajectories, config.rpe_length),
        _score_clear(prediction, real, points, verdicts, near_gate_ids(truth.objects), config),
        truth.scene.get("family"),
    )


def _score_clear(
    prediction: Prediction,
    real: Mapping[str, PointCloud],
    points: objects.PointPairs,
    verdicts: pd.DataFrame | None,
    near: Ints | None,
    config: EvaluationConfig,
) -> ClearScore | None:
    """Count a scene once more without the objects near a gate; None where the truth does not mark them."""
    if near is None:
        return None
    clear = {epoch: without_objects(cloud, near) for epoch, cloud in real.items()}
    counts, kept = None, None
    if prediction.table is not None and verdicts is not None:
        rest = points_without(points, near)
        kept = verdicts_without(
            objects.row_verdicts(prediction.table, rest, config.object_share), points, near
        )
        changes = objects.true_changes(joined_truth(clear), rest, config.min_points, config.min_size)
        counts = objects.object_counts(kept, changes, config.object_share, config.min_points)
    return ClearScore(len(near), score_cells(prediction, clear, config)[0], counts, kept)


def joined_truth(real: Mapping[str, PointCloud]) -> PointCloud:
    """Return the truth points of both epochs as one cloud, with the fields ``object`` and ``change``."""
    before = real["before"].rebased(real["after"].origin)
    fields = {n: np.concatenate([before.fields[n], real["after"].fields[n]]) for n in ("object", "change")}
    return PointCloud(np.concatenate([before.xyz, real["after"].xyz]), real["after"].origin, None, fields)


def score_cells(
    prediction: Prediction, real: Mapping[str, PointCloud], config: EvaluationConfig
) -> tuple[Ints, Ints, tuple[Floats, Floats], int]:
    """Return the 5x6 matrix over cells, of tiles, (right, confidence) of decided ones, cells left out."""
    true = rasterise(*_stack(real["before"], real["after"])[:3], config.grid)
    xyz, change, epoch, confidence = _stack(prediction.before, prediction.after)
    said = rasterise(xyz, change, epoch, config.grid, confidence)
    labelled = true.codes < 5
    codes, trust = look_up(said, true.keys[labelled])
    kept = codes != Change.NOT_REPORTED
    counted = np.where(kept, true.codes[labelled], Change.UNOBSERVED)
    tiles = tile_matrices(true.keys[labelled], counted, codes, config.grid)
    truth_codes, codes, trust = true.codes[labelled][kept], codes[kept], trust[kept]
    decided = codes < 5
    right = (codes == truth_codes)[decided].astype(np.float64)
    return confusion(truth_codes, codes), tiles, (right, trust[decided]), int((~kept).sum())


def _stack(before: PointCloud, after: PointCloud) -> tuple[Floats, Ints, Ints, Floats]:
    clouds = (before, after)
    ones = [np.asarray(c.fields.get("confidence", np.ones(len(c))), dtype=np.float64) for c in clouds]
    return (
        np.concatenate([c.world() for c in clouds]),
        np.concatenate([np.asarray(c.fields["change"]).astype(np.int64) for c in clouds]),
        np.repeat([0, 1], [len(before), len(after)]),
        np.concatenate(ones),
    )


def registration_error(
    registration: Mapping[str, Any] | None, T_after_before: Floats
) -> dict[str, float] | None:
    """Compare ``registration.json`` with the true transform, at its own origin.

    Returns
    -------
    dict or None
        Rotation [deg] and translation [m] error; None without a registration.
    """
    if registration is None:
        return None
    origin = np.array(registration["origin"], dtype=np.float64)
    local = np.array(registration["T_local_about_origin"], dtype=np.float64)
    turned = np.eye(4)
    turned[:3, :3] = local[:3, :3] @ T_after_before[:3, :3].T
    true_shift = T_after_before[:3, :3] @ origin + T_after_before[:3, 3] - origin
    return {
        "rotation_error_deg": float(np.degrees(rotation_angle(turned))),
        "translation_error_m": float(np.linalg.norm(local[:3, 3] - true_shift)),
    }


def score_trajectories(
    run: Mapping[str, Any] | None, truth: Mapping[str, Trajectory], length: float
) -> dict[str, dict[str, float]]:
    """Score the trajectories of the maps that a change run started from, where they are still there."""
    result = {}
    for epoch, reference in truth.items():
        source = ((run or {}).get("inputs") or {}).get(epoch)
        path = Path(source["path"]) / "trajectory.tum" if source else None
        if path is not None and path.is_file():
            estimate = read_tum(path)
            result[epoch] = absolute_error(estimate, reference) | relative_error(estimate, reference, length)
    return result


def pool(found: Sequence[SceneScore], config: EvaluationConfig) -> dict[str, Any]:
    """Add scenes up and score the sums, all together and by family; intervals come from drawing scenes."""
    families = sorted({scene.family for scene in found if scene.family})
    pooled = {name: _pool_scenes([s for s in found if s.family == name], config) for name in families}
    return {**_pool_scenes(found, config), "families": by_family(pooled)}


def _pool_scenes(found: Sequence[SceneScore], config: EvaluationConfig) -> dict[str, Any]:
    grids = [scene.grid for scene in found]
    total = np.sum(grids, axis=0)
    right, trust = (np.concatenate([scene.decided[i] for scene in found]) for i in (0, 1))
    return {
        "protocol": "pooled 5x6 confusion matrix over grid cells, rows truth; not decided is a miss",
        "options": config.model_dump(mode="json"),
        "labels": list(LABELS),
        "grid": describe(total)
        | {
            "cells": int(total.sum()),
            "cells_left_out_not_reported": sum(scene.cells_left_out for scene in found),
            "interval_95_percent": bootstrap(grids, scores, config.draws, config.seed),
            "risk_coverage": risk_coverage(right.astype(bool), trust, int(total.sum())),
        },
        "points": describe(np.sum([scene.points for scene in found], axis=0))
        | {"points_left_out": sum(scene.points_left_out for scene in found)},
        "objects": _pool_objects(found),
        "semantics": describe_semantics(np.sum([scene.semantics for scene in found], axis=0)),
        "reliability": _pool_reliability(found, config.bins),
        "without_near_gate": pool_clear([scene.clear for scene in found], config.bins),
        "scenes": [
            {"name": s.name, **scores(s.grid), "registration": s.registration, "trajectories": s.trajectories}
            for s in found
        ],
    }


def _pool_objects(found: Sequence[SceneScore]) -> dict[str, Any] | None:
    counted = [scene.object_counts for scene in found if scene.object_counts is not None]
    if not counted:
        return None
    return objects.rates({key: sum(counts[key] for counts in counted) for key in counted[0]})


def describe_semantics(matrix: Ints) -> dict[str, Any]:
    """Return per-class IoU and means [percent] of a class matrix."""
    iou = 100.0 * class_iou(matrix)
    names = [s.label for s in Semantic][: len(matrix)]
    return {
        "iou_percent": dict(zip(names, iou.tolist(), strict=True)),
        "miou_percent": nanmean(iou),
        "miou_published_four_percent": nanmean(iou[:4]),
        "confusion_rows_truth": matrix.tolist(),
    }


def _pool_reliability(found: Sequence[SceneScore], bins: int) -> dict[str, Any] | None:
    tables = [scene.verdicts for scene in found if scene.verdicts is not None]
    if not tables:
        return None
    rows = pd.concat(tables)
    rows = rows[(rows["scored"] > 0) & rows["label"].isin(LABELS)]
    changed = rows[rows["label"] != Change.UNCHANGED.label]
    return {
        name: reliability(part["confidence"].to_numpy(np.float64), part["right"].to_numpy(bool), bins)
        for name, part in (("all_rows", rows), ("changed_rows", changed))
    }
