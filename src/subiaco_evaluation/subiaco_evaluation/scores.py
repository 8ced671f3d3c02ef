"""Scores from confusion matrices, and how sure they are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.codes import Change
from subiaco_geo.frames import Floats, Ints

#: The five scored labels in the order of rows and columns; the sixth column is *not decided*.
LABELS = tuple(Change(code).label for code in range(5))
_UNDECIDED = 5

Codes = NDArray[np.integer[Any]]


def confusion(truth: Codes, predicted: Codes, classes: int = 5) -> Ints:
    """Count a confusion matrix with a column for what was not decided.

    Parameters
    ----------
    truth, predicted : (N,) integer
        Codes 0 to ``classes - 1``. Truth outside of them is left out, a
        prediction outside counts in the last column: a miss of its class.
    classes : int

    Returns
    -------
    (classes, classes + 1) int64
        Rows truth, columns prediction.
    """
    if truth.shape != predicted.shape:
        raise ValueError(f"truth {truth.shape} and predicted {predicted.shape} must have one shape")
    scored = (truth >= 0) & (truth < classes)
    rows = truth[scored].astype(np.int64)
    columns = predicted[scored].astype(np.int64)
    columns = np.where((columns < 0) | (columns >= classes), classes, columns)
    flat = np.bincount(rows * (classes + 1) + columns, minlength=classes * (classes + 1))
    return flat.reshape(classes, classes + 1).astype(np.int64)


def _ratio(part: Floats, whole: Floats) -> Floats:
    """Divide, NaN where there is nothing to divide by."""
    return np.divide(part, whole, out=np.full(np.shape(part), np.nan), where=whole > 0)


def class_iou(matrix: Ints) -> Floats:
    """Return IoU per class, fraction; NaN where a class is neither there nor predicted."""
    hits = np.diag(matrix).astype(np.float64)
    union = matrix.sum(axis=1) + matrix[:, : len(matrix)].sum(axis=0) - hits
    return _ratio(hits, union)


def class_f1(matrix: Ints) -> Floats:
    """Return F1 per class, fraction; NaN like :func:`class_iou`."""
    hits = np.diag(matrix).astype(np.float64)
    total = matrix.sum(axis=1) + matrix[:, : len(matrix)].sum(axis=0)
    return _ratio(2.0 * hits, total.astype(np.float64))


def nanmean(values: Floats) -> float:
    """Return the mean of what is there, NaN when nothing is."""
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else float("nan")


def scores(matrix: Ints) -> dict[str, float]:
    """Return the headline scores of a 5x6 change matrix [percent]."""
    total = float(matrix.sum())
    iou, f1 = class_iou(matrix), class_f1(matrix)
    hits, missed = float(np.trace(matrix[:, :5])), float(matrix[:, _UNDECIDED].sum())
    return {
        "accuracy_percent": 100.0 * hits / total if total else float("nan"),
        "mf1_percent": 100.0 * nanmean(f1),
        "miou_percent": 100.0 * nanmean(iou),
        "miou_change_percent": 100.0 * nanmean(iou[:4]),
        "abstention_percent": 100.0 * missed / total if total else float("nan"),
    }


def describe(matrix: Ints) -> dict[str, Any]:
    """Return scores, per-class values [percent] and the matrix itself."""
    named = {"iou_percent": class_iou(matrix), "f1_percent": class_f1(matrix)}
    return {
        **scores(matrix),
        **{key: dict(zip(LABELS, (100.0 * v).tolist(), strict=True)) for key, v in named.items()},
        "confusion_rows_truth": matrix.tolist(),
        "confusion_columns": [*LABELS, "not decided"],
    }


def risk_coverage(
    correct: NDArray[np.bool_], confidence: Floats, total: int, steps: int = 20
) -> list[dict[str, float]]:
    """Return the error among the surest decisions against how much they cover.

    Parameters
    ----------
    correct : (N,) bool
        Of everything decided.
    confidence : (N,) float
    total : int
        Everything that has a truth, decided or not.
    steps : int
        Points of the curve.

    Returns
    -------
    list of dict
        ``coverage_fraction``, ``risk_fraction``, ``confidence_at_least``; surest first.
    """
    if len(correct) == 0 or total == 0:
        return []
    order = np.argsort(-confidence, kind="stable")
    wrong = np.cumsum(~correct[order])
    kept = np.unique(np.linspace(1, len(order), min(steps, len(order))).round().astype(int))
    return [
        {
            "coverage_fraction": float(n / total),
            "risk_fraction": float(wrong[n - 1] / n),
            "confidence_at_least": float(confidence[order[n - 1]]),
        }
        for n in kept
    ]


def reliability(confidence: Floats, correct: NDArray[np.bool_], bins: int = 10) -> dict[str, Any]:
    """Return a reliability table and the expected calibration error [fraction].

    Bins are equally wide; a confidence of exactly 1 belongs to the last.
    """
    usable = np.isfinite(confidence)
    value, right = confidence[usable], correct[usable]
    slot = np.minimum((value * bins).astype(np.int64), bins - 1)
    table, error = [], 0.0
    for index in range(bins):
        inside = slot == index
        count = int(inside.sum())
        mean = float(value[inside].mean()) if count else float("nan")
        rate = float(right[inside].mean()) if count else float("nan")
        error += abs(mean - rate) * count / len(value) if count else 0.0
        table.append({"from": index / bins, "to": (index + 1) / bins, "rows": count,
                      "mean_confidence": mean, "right_fraction": rate})  # fmt: skip
    return {"rows": len(value), "ece_fraction": error if len(value) else float("nan"), "bins": table}


def bootstrap(
    matrices: Sequence[Ints], measure: Callable[[Ints], dict[str, float]], draws: int, seed: int
) -> dict[str, list[float]]:
    """Return 95 % intervals of scores by drawing scenes with replacement.

    Returns
    -------
    dict
        Lower and upper end by score; empty for fewer than two scenes.
    """
    if len(matrices) < 2:
        return {}
    rng = np.random.default_rng(seed)
    stacked = np.stack(matrices)
    chosen = rng.integers(len(stacked), size=(draws, len(stacked)))
    drawn = [measure(stacked[rows].sum(axis=0)) for rows in chosen]
    names = drawn[0].keys()
    return {n: [float(q) for q in np.nanpercentile([d[n] for d in drawn], [2.5, 97.5])] for n in names}
