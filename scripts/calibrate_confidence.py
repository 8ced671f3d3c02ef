"""Fit the confidence of change rows on simulated surveys, and print the configuration.

Each survey is a folder of ``subiaco simulate --maps-only``, of a seed of `calibration` in config/seeds.yaml:

    python scripts/calibrate_confidence.py out/sim106 out/sim107 ... > config/confidence.yaml
    subiaco change BEFORE AFTER --config config/confidence.yaml ...
"""

from __future__ import annotations

import argparse
import datetime as dt
import sys
from pathlib import Path

import pandas as pd
import yaml

from subiaco_change.config import ChangeConfig
from subiaco_change.evaluation.confidence_fit import fit_confidence, judged_rows, pair_points
from subiaco_change.evaluation.layouts import in_after_frame
from subiaco_change.evaluation.truth import read_truth
from subiaco_change.pipeline import detect_changes
from subiaco_geo.maps import load_epoch


def rows_of(survey: Path) -> pd.DataFrame:
    """Return the judged rows of a survey."""
    result = detect_changes(load_epoch(survey / "before"), load_epoch(survey / "after"), ChangeConfig())
    real = in_after_frame(read_truth(survey))
    return judged_rows(result, pair_points(result, real["before"], real["after"]), survey.name)


def main() -> None:
    """Fit on the surveys named and print the slice ``confidence`` of the change configuration."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("surveys", nargs="+", type=Path)
    surveys = parser.parse_args().surveys
    rows = pd.concat([rows_of(survey) for survey in surveys])
    names = ", ".join(s.name for s in surveys)
    today = dt.datetime.now(dt.UTC).date()
    slice_ = fit_confidence(rows, f"simulated: {names}; {today}")
    yaml.safe_dump({"/**": {"ros__parameters": {"confidence": slice_}}}, sys.stdout, sort_keys=False)


if __name__ == "__main__":
    main()
