"""Fit the confidence of change rows on simulated surveys, and print the configuration.

Each survey is a folder of ``subiaco simulate --maps-only``. Tuning seeds only: 100 and above.

    python scripts/calibrate_confidence.py out/sim101 out/sim102 ... > config/confidence.yaml
    subiaco change BEFORE AFTER --config config/confidence.yaml ...
"""

from __future__ import annotations

import argparse
import datetime as dt
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import yaml
from scipy.special import expit

from subiaco_change.changes.confidence import FEATURES, Coefficients, fit, kind_of
from subiaco_change.config import ChangeConfig
from subiaco_change.evaluation.layouts import in_after_frame
from subiaco_change.evaluation.objects import row_verdicts, together, transfer
from subiaco_change.evaluation.scores import reliability
from subiaco_change.evaluation.truth import read_truth
from subiaco_change.pipeline import detect_changes
from subiaco_geo.frames import Floats
from subiaco_geo.maps import load_epoch

RADIUS, SHARE, BINS = 0.3, 0.5, 10  # as subiaco evaluate


def rows_of(survey: Path) -> pd.DataFrame:
    """Return the judged rows of a survey: kind, features, right, survey."""
    result = detect_changes(load_epoch(survey / "before"), load_epoch(survey / "after"), ChangeConfig())
    real = in_after_frame(read_truth(survey))
    pairs = (transfer(getattr(result, e), real[e], RADIUS) for e in ("before", "after"))
    fields = ("object_id", "confidence", "features")
    table = pd.DataFrame([{name: getattr(r, name) for name in fields} for r in result.records])
    table["label"] = [r.change.label for r in result.records]
    table["class"] = [r.semantic.label for r in result.records]
    table["kind"] = [kind_of(r.change) for r in result.records]
    verdicts = row_verdicts(table, together(*pairs), SHARE)
    table = table.set_index("object_id").join(verdicts[["scored", "right"]])
    judged = (table["scored"] > 0) & table["kind"].notna() & (table["features"].map(len) == len(FEATURES))
    return table[judged].assign(survey=survey.name)


def predict(model: Coefficients, x: Floats) -> Floats:
    """Return the confidences (N,) of features (N, 5)."""
    return np.asarray(expit(model.intercept + x @ np.array([getattr(model, name) for name in FEATURES])))


def held_out(rows: pd.DataFrame) -> Floats:
    """Return the confidence of every row by models fitted on the other surveys."""
    found = np.full(len(rows), np.nan)
    x = np.array(rows["features"].tolist())
    right = rows["right"].to_numpy(bool)
    for kind in rows["kind"].unique():
        for survey in rows["survey"].unique():
            mine = (rows["kind"] == kind).to_numpy()
            left = mine & (rows["survey"] == survey).to_numpy()
            rest = mine & ~left
            if left.any() and rest.any():
                found[left] = predict(fit(x[rest], right[rest]), x[left])
    return found


def main() -> None:
    """Fit on the surveys named and print the slice ``confidence`` of the change configuration."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("surveys", nargs="+", type=Path)
    surveys = parser.parse_args().surveys
    rows = pd.concat([rows_of(survey) for survey in surveys])
    models = {}
    for kind, part in rows.groupby("kind"):
        x = np.array(part["features"].tolist())
        models[kind] = fit(x, part["right"].to_numpy(bool)).model_dump()
    changed = rows[rows["kind"] != "unchanged"]
    trust = held_out(changed)
    known = np.isfinite(trust)
    curve = reliability(trust[known], changed["right"].to_numpy(bool)[known], BINS)
    names = ", ".join(s.name for s in surveys)
    today = dt.datetime.now(dt.UTC).date()
    slice_ = {
        "fitted_on": f"{names}; {len(changed)} changed of {len(rows)} rows; {today}",
        "held_out_ece": round(float(curve["ece_fraction"]), 3),
        **models,
    }
    yaml.safe_dump({"/**": {"ros__parameters": {"confidence": slice_}}}, sys.stdout, sort_keys=False)


if __name__ == "__main__":
    main()
