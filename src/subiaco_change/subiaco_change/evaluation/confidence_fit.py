"""Fitting the confidence of table rows to what turned out right."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from scipy.special import expit

from subiaco_change.changes.confidence import FEATURES, Coefficients, fit, kind_of, rising_of
from subiaco_change.evaluation.objects import PointPairs, row_verdicts, together, transfer
from subiaco_change.evaluation.scores import reliability
from subiaco_change.records import ChangeResult
from subiaco_geo.clouds import PointCloud
from subiaco_geo.frames import Floats

RADIUS, SHARE, BINS = 0.3, 0.5, 10  # as subiaco evaluate


def pair_points(result: ChangeResult, before: PointCloud, after: PointCloud) -> PointPairs:
    """Carry truth (both epochs in the frame of *after*) to the points of a result."""
    return together(transfer(result.before, before, RADIUS), transfer(result.after, after, RADIUS))


def judged_rows(result: ChangeResult, points: PointPairs, survey: str) -> pd.DataFrame:
    """Return the rows that truth can judge: ``kind``, ``features``, ``right``, ``survey``."""
    fields = ("object_id", "confidence", "features")
    table = pd.DataFrame([{name: getattr(r, name) for name in fields} for r in result.records])
    table["label"] = [r.change.label for r in result.records]
    table["class"] = [r.semantic.label for r in result.records]
    table["kind"] = [kind_of(r.change) for r in result.records]
    verdicts = row_verdicts(table, points, SHARE)
    table = table.set_index("object_id").join(verdicts[["scored", "right"]])
    judged = (table["scored"] > 0) & table["kind"].notna() & (table["features"].map(len) == len(FEATURES))
    return table[judged].assign(survey=survey)


def predict(model: Coefficients, x: Floats) -> Floats:
    """Return the confidences (N,) of features (N, 5)."""
    return np.asarray(expit(model.intercept + x @ np.array([getattr(model, name) for name in FEATURES])))


def held_out(rows: pd.DataFrame) -> Floats:
    """Return the confidence of every row by models fitted on the other surveys; NaN where there are none."""
    found = np.full(len(rows), np.nan)
    x = np.array(rows["features"].tolist())
    right = rows["right"].to_numpy(bool)
    for kind in rows["kind"].unique():
        for survey in rows["survey"].unique():
            mine = (rows["kind"] == kind).to_numpy()
            left = mine & (rows["survey"] == survey).to_numpy()
            rest = mine & ~left
            if left.any() and rest.any():
                found[left] = predict(fit(x[rest], right[rest], rising=rising_of(kind)), x[left])
    return found


def held_out_error(rows: pd.DataFrame) -> float:
    """Return the expected calibration error over changed rows of surveys left out of the fit."""
    changed = rows[rows["kind"] != "unchanged"]
    if len(changed) == 0:
        return float("nan")
    trust = held_out(changed)
    known = np.isfinite(trust)
    curve = reliability(trust[known], changed["right"].to_numpy(bool)[known], BINS)
    return float(curve["ece_fraction"])


def fit_confidence(rows: pd.DataFrame, fitted_on: str) -> dict[str, Any]:
    """Fit a model a kind of row; return the slice ``confidence`` of the change configuration.

    A kind without rows keeps the shipped model.
    """
    models = {}
    for kind, part in rows.groupby("kind"):
        x = np.array(part["features"].tolist())
        models[kind] = fit(x, part["right"].to_numpy(bool), rising=rising_of(str(kind))).model_dump()
    changed = int((rows["kind"] != "unchanged").sum())
    error = held_out_error(rows)
    return {
        "fitted_on": f"{fitted_on}; {changed} changed of {len(rows)} rows",
        "held_out_ece": round(error, 3) if np.isfinite(error) else 1.0,
        **models,
    }
