"""Fit of the confidence of table rows to the labels that were right."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import expit

from subiaco_change.decisions.confidence import BANDS, kind_of
from subiaco_change.decisions.confidence_config import CALIBRATED, FEATURES, Coefficients
from subiaco_change.records import ChangeResult
from subiaco_change.visibility_evidence import KINDS
from subiaco_evaluation.object_matching import PointPairs, row_verdicts, together, transfer
from subiaco_evaluation.scores import reliability
from subiaco_geo.clouds import PointCloud
from subiaco_geo.frames import Floats

RADIUS, SHARE, BINS = 0.3, 0.5, 10  # as subiaco evaluate
LEAST = 30  # changed rows of a kind of evidence from which on its calibration can be judged


def pair_points(result: ChangeResult, before: PointCloud, after: PointCloud) -> PointPairs:
    """Carry truth (both epochs in the frame of *after*) to the points of a result."""
    return together(transfer(result.before, before, RADIUS), transfer(result.after, after, RADIUS))


def judged_rows(result: ChangeResult, points: PointPairs, survey: str) -> pd.DataFrame:
    """Return the rows that truth can judge: ``kind``, ``features``, ``right``, ``evidence``, ``survey``."""
    fields = ("object_id", "confidence", "features", "evidence")
    table = pd.DataFrame([{name: getattr(r, name) for name in fields} for r in result.records])
    table["label"] = [r.change.label for r in result.records]
    table["class"] = [r.semantic.label for r in result.records]
    table["kind"] = [kind_of(r.change) for r in result.records]
    verdicts = row_verdicts(table, points, SHARE)
    table = table.set_index("object_id").join(verdicts[["scored", "right"]])
    judged = (table["scored"] > 0) & table["kind"].notna() & (table["features"].map(len) == len(FEATURES))
    return table[judged].assign(survey=survey)


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
                model = fit(x[rest], right[rest], rising=rising_of(kind))
                found[left] = model.probability(x[left])
    return found


def held_out_errors(rows: pd.DataFrame) -> dict[str, float]:
    """Return the expected calibration error over changed rows of surveys left out of the fit.

    By kind of evidence, with at least :data:`LEAST` changed rows, and of all rows under ``all``.
    """
    changed = rows[rows["kind"] != "unchanged"]
    if len(changed) == 0:
        return {"all": float("nan")}
    trust = held_out(changed)
    known = np.isfinite(trust)
    right = changed["right"].to_numpy(bool)
    groups = {"all": known}
    for kind, count in changed["evidence"].value_counts().sort_index().items():
        if count >= LEAST:
            groups[str(kind)] = known & (changed["evidence"] == kind).to_numpy()
    return {
        name: float(reliability(trust[mine], right[mine], BINS)["ece_fraction"])
        for name, mine in groups.items()
    }


def measured_bands(rows: pd.DataFrame) -> list[dict[str, float | int]]:
    """Count the changed rows that were right by bands of confidence, by models fitted on the other surveys.

    Returns
    -------
    list of dict
        Fields of ``confidence_config.MeasuredBand``; a band without rows is left out.
    """
    changed = rows[rows["kind"] != "unchanged"]
    if len(changed) == 0:
        return []
    trust, right = held_out(changed), changed["right"].to_numpy(bool)
    found: list[dict[str, float | int]] = []
    for low, high in zip(BANDS, (1.01, *BANDS), strict=False):
        inside = (trust >= low) & (trust < high)
        if inside.any():
            count, hits = int(inside.sum()), int((inside & right).sum())
            found.append({"low": low, "high": high, "right": hits, "claims": count})
    return found


def held_out_error(rows: pd.DataFrame) -> float:
    """Return the error of :func:`held_out_errors` over all kinds of evidence."""
    return held_out_errors(rows)["all"]


def fit_confidence(
    rows: pd.DataFrame, fitted_on: str, clouds: Literal["simulated", "own"] = "simulated"
) -> dict[str, Any]:
    """Fit a model a kind of row; return the slice ``confidence`` of the change configuration.

    A kind without rows keeps the shipped model. Of the kinds of evidence, those are named that were right as
    often as their confidences said on surveys left out of the fit. ``clouds``: see
    :class:`~subiaco_change.decisions.confidence_config.ConfidenceConfig`.
    """
    models = {}
    for kind, part in rows.groupby("kind"):
        x = np.array(part["features"].tolist())
        models[kind] = fit(x, part["right"].to_numpy(bool), rising=rising_of(str(kind))).model_dump()
    changed = int((rows["kind"] != "unchanged").sum())
    errors = held_out_errors(rows)
    kinds = [kind for kind, error in errors.items() if kind != "all" and error <= CALIBRATED]
    return {
        "fitted_on": f"{fitted_on}; {changed} changed of {len(rows)} rows",
        "held_out_ece": round(errors["all"], 3) if np.isfinite(errors["all"]) else 1.0,
        "bands": measured_bands(rows),
        "evidence": kinds,
        "clouds": clouds,
        **models,
    }


#: More of this evidence never makes a label less certain.
RISING = ("gate", "observed", "size", "purity")


#: Densities that differ more, weaker evidence, or a pair with more rows near limits never make a label surer.
FALLING = ("density", *KINDS[1:], "near_limits")


def rising_of(kind: str) -> tuple[str, ...]:
    """Name the evidence of a kind of row that may only raise its confidence."""
    return RISING if kind == "unchanged" else ("margin", *RISING)


def fit(x: Floats, right: NDArray[np.bool_], ridge: float = 1.0, rising: Sequence[str] = ()) -> Coefficients:
    """Fit one model by penalised likelihood.

    Parameters
    ----------
    x : (N, 13) float64
        Evidence of the rows, :func:`features`.
    right : (N,) bool
        Whether the label was right.
    ridge : float
        Weight of the squared slopes; the intercept is free, so the mean
        confidence is the share of right labels.
    rising : sequence of str
        Evidence whose slope may not be negative: few rows would else say that
        less of it is more.
    """
    sign = np.where(right, 1.0, -1.0)

    def loss(w: Floats) -> tuple[float, Floats]:
        z = sign * (w[0] + x @ w[1:])
        pull = -sign * expit(-z)
        gradient = np.concatenate([[pull.sum()], x.T @ pull + 2 * ridge * w[1:]])
        return float(np.logaddexp(0.0, -z).sum() + ridge * (w[1:] ** 2).sum()), gradient

    bounds = [
        (None, None),
        *((0.0 if name in rising else None, 0.0 if name in FALLING else None) for name in FEATURES),
    ]
    found = minimize(loss, np.zeros(x.shape[1] + 1), jac=True, method="L-BFGS-B", bounds=bounds)
    values = [round(float(v), 3) for v in found.x]
    return Coefficients(intercept=values[0], **dict(zip(FEATURES, values[1:], strict=True)))
