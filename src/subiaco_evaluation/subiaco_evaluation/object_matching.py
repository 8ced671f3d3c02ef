"""Truth carried to predicted points, and from points to objects."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from subiaco_evaluation.grid import first_of_each
from subiaco_geo.clouds import PointCloud, sort_spatially
from subiaco_geo.codes import CHANGED, CHANGED_LABELS, Change
from subiaco_geo.frames import Ints

NO_TRUTH = 255
_CODE = {change.label: int(change) for change in Change}


@dataclass(frozen=True)
class PointPairs:
    """Predicted points with the truth of their place, both epochs together.

    All arrays are (N,): change codes (255 where there is no truth in reach),
    class codes, predicted ``instance`` and true ``object``, and ``matched``.
    """

    change: Ints
    true_change: Ints
    semantic: Ints
    true_semantic: Ints
    instance: Ints
    true_object: Ints
    matched: NDArray[np.bool_]


def one_a_voxel(predicted: PointCloud, leaf: float) -> PointCloud:
    """Keep one point of every label and object in a voxel of an edge [m, world]; all where it is 0.

    Scores of objects then do not depend on how dense the labelled clouds are.
    """
    if leaf <= 0 or len(predicted) == 0:
        return predicted
    said = [predicted.fields[name] for name in ("change", "instance") if name in predicted.fields]
    rows = np.column_stack([np.floor(predicted.world() / leaf).astype(np.int64), *said])
    return predicted.select(np.sort(first_of_each(rows, np.arange(len(rows), dtype=np.float64))))


def transfer(predicted: PointCloud, truth: PointCloud, radius: float) -> PointPairs:
    """Give every predicted point the truth of the nearest truth point of its epoch.

    Parameters
    ----------
    predicted, truth : PointCloud
        One epoch, both in the frame of *after*.
    radius : float
        Farther truth does not count [m].
    """
    local = truth.rebased(predicted.origin)
    order = sort_spatially(predicted.xyz)
    distance, nearest = np.empty(len(order)), np.empty(len(order), dtype=np.int64)
    distance[order], nearest[order] = cKDTree(local.xyz).query(
        predicted.xyz[order], distance_upper_bound=radius
    )
    matched = np.isfinite(distance)
    index = np.where(matched, nearest, 0)

    def true(name: str, missing: int) -> Ints:
        return np.where(matched, np.asarray(local.fields[name])[index].astype(np.int64), missing)

    def said(name: str, missing: int) -> Ints:
        values = predicted.fields.get(name)
        return np.full(len(order), missing) if values is None else np.asarray(values).astype(np.int64)

    return PointPairs(
        said("change", NO_TRUTH), true("change", NO_TRUTH), said("semantic", -1), true("semantic", -1),
        said("instance", -1), true("object", -1), matched,
    )  # fmt: skip


def together(first: PointPairs, second: PointPairs) -> PointPairs:
    """Join the points of both epochs."""
    pairs = zip(vars(first).values(), vars(second).values(), strict=True)
    return PointPairs(*(np.concatenate(pair) for pair in pairs))


def _share_by(keys: Ints, hits: NDArray[np.bool_]) -> pd.DataFrame:
    frame = pd.DataFrame({"key": keys, "hit": hits})
    return frame.groupby("key")["hit"].agg(["mean", "size"])


def row_verdicts(table: pd.DataFrame, points: PointPairs, share: float) -> pd.DataFrame:
    """Judge every table row by the truth of its points.

    Returns
    -------
    DataFrame
        ``label``, ``class``, ``confidence``, ``points``, ``scored`` (points whose
        truth is one of the five labels) and ``right`` (at least ``share`` of
        them carry the row's label), one row a table row.
    """
    scored = (points.true_change < 5) & (points.instance >= 0)
    codes = table.set_index("object_id")["label"].map(_CODE)
    said = codes.reindex(points.instance[scored]).to_numpy()
    hit = _share_by(points.instance[scored], said == points.true_change[scored])
    population = pd.Series(points.instance[points.instance >= 0]).value_counts()
    result = table[["object_id", "label", "class", "confidence"]].set_index("object_id")
    return result.assign(
        points=population.reindex(result.index).fillna(0).astype(int),
        scored=hit["size"].reindex(result.index).fillna(0).astype(int),
        right=(hit["mean"].reindex(result.index).fillna(0.0) >= share - 1e-9),
    )


def true_changes(truth: PointCloud, points: PointPairs, min_points: int, min_size: float) -> pd.DataFrame:
    """Return the real changes worth finding: one row a true object and changed label.

    ``found`` is the share of its predicted points that carry its label. An
    object counts from ``min_points`` predicted points and a longest side of
    ``min_size`` [m] on; ``truth`` holds both epochs in the frame of *after*.
    """
    change = np.asarray(truth.fields["change"]).astype(np.int64)
    real = np.isin(change, CHANGED)
    keys = np.asarray(truth.fields["object"])[real] * 8 + change[real]
    extent = pd.DataFrame(truth.xyz[real], columns=list("xyz")).groupby(keys).agg(["min", "max"])
    sides = [extent[axis]["max"] - extent[axis]["min"] for axis in "xyz"]
    size = pd.concat(sides, axis=1).max(axis=1) if len(keys) else pd.Series(dtype=float)
    mine = np.isin(points.true_change, CHANGED)
    hit = _share_by(
        points.true_object[mine] * 8 + points.true_change[mine],
        points.change[mine] == points.true_change[mine],
    )
    frame = pd.DataFrame({"size_m": size}).join(hit.rename(columns={"mean": "found", "size": "points"}))
    frame = frame.fillna({"found": 0.0, "points": 0})
    return frame[(frame["points"] >= min_points) & (frame["size_m"] >= min_size)]


def changed_rows(verdicts: pd.DataFrame, min_points: int) -> pd.DataFrame:
    """Return the rows that claim a change and have enough points."""
    labels = list(CHANGED_LABELS)
    return verdicts[verdicts["label"].isin(labels) & (verdicts["points"] >= min_points)]


def object_counts(
    verdicts: pd.DataFrame, real: pd.DataFrame, share: float, min_points: int
) -> dict[str, int]:
    """Count claims, right claims, claims without truth, real changes and found ones."""
    claims = changed_rows(verdicts, min_points)
    judged = claims[claims["scored"] > 0]
    blind = claims[claims["scored"] == 0]
    return {
        "predicted": len(judged),
        "right": int(judged["right"].sum()),
        "true": len(real),
        "found": int((real["found"] >= share - 1e-9).sum()),
        "claims_in_unobserved_places": len(blind),
        "claims_in_unobserved_places_above_half_confidence": int((blind["confidence"] > 0.5).sum()),
    }


def rates(counts: dict[str, int]) -> dict[str, Any]:
    """Add precision and recall [percent] to object counts."""
    predicted, real = counts["predicted"], counts["true"]
    return {
        **counts,
        "precision_percent": 100.0 * counts["right"] / predicted if predicted else float("nan"),
        "recall_percent": 100.0 * counts["found"] / real if real else float("nan"),
    }
