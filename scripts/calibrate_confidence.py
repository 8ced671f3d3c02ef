"""Fit the confidence of change rows on simulated surveys, and print the configuration.

Each survey is a folder of ``subiaco simulate --maps-only``, of a seed of `calibration` in config/seeds.yaml.
Every survey is compared once for each kind of evidence: with its visibility layer, bare with trajectories,
and bare.

    python scripts/calibrate_confidence.py out/default_106 out/hard_106 ... --rows out/rows > confidence.yaml
    subiaco change BEFORE AFTER --config confidence.yaml ...

``--rows FOLDER`` keeps the judged rows of every survey and kind of evidence: a second call takes them from
there and fits at once.
"""

from __future__ import annotations

import argparse
import datetime as dt
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

from subiaco_change.config import ChangeConfig
from subiaco_change.pipeline import detect_changes
from subiaco_evaluation.confidence_fit import fit_confidence, held_out_errors, judged_rows, pair_points
from subiaco_evaluation.layouts import in_after_frame
from subiaco_evaluation.truth import read_truth
from subiaco_geo.maps import load_epoch
from subiaco_geo.survey_map import SurveyMap
from subiaco_geo.work.task_runner import TaskRunner

#: Evidence of a survey by name: what its maps are left without.
VARIANTS: dict[str, tuple[str, ...]] = {
    "layer": (),
    "trajectory": ("visibility",),
    "bare": ("visibility", "trajectory", "uncertainty"),
}


def bare_of(survey: SurveyMap, without: tuple[str, ...]) -> SurveyMap:
    """Return a map without some of what it knows beside its points."""
    nothing: dict[str, Any] = dict.fromkeys(without)
    return replace(survey, **nothing)


def _epoch(folder: Path) -> SurveyMap:
    """Load an epoch with its trajectory: the true one, where the simulator fused the map."""
    true = folder / "truth" / "trajectory.tum"
    return load_epoch(folder, None if (folder / "map.yaml").is_file() else true)


def rows_of(survey: Path, variants: list[str], kept: Path | None) -> pd.DataFrame:
    """Return the judged rows of a survey with every kind of evidence."""
    found, real, bench = [], None, TaskRunner()  # kinds of evidence share the stages that they can
    for name in variants:
        file = None if kept is None else kept / f"{survey.name}-{name}.pkl"
        if file is not None and file.is_file():
            found.append(pd.read_pickle(file))  # noqa: S301  written by this script
            continue
        begun = time.monotonic()
        real = real or in_after_frame(read_truth(survey))
        pair = [bare_of(_epoch(survey / epoch), VARIANTS[name]) for epoch in ("before", "after")]
        result = detect_changes(pair[0], pair[1], ChangeConfig(), runner=bench)
        rows = judged_rows(result, pair_points(result, real["before"], real["after"]), survey.name)
        print(f"{survey.name} {name}: {len(rows)} rows, {time.monotonic() - begun:.0f} s", file=sys.stderr)
        if file is not None:
            file.parent.mkdir(parents=True, exist_ok=True)
            rows.to_pickle(file)
        found.append(rows)
    return pd.concat(found)


def main() -> None:
    """Fit on the surveys named and print the slice ``confidence`` of the change configuration."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("surveys", nargs="+", type=Path)
    parser.add_argument(
        "--evidence", nargs="+", choices=list(VARIANTS), default=list(VARIANTS), help="kinds of evidence"
    )
    parser.add_argument("--rows", type=Path, help="folder that keeps the judged rows")
    parser.add_argument("--workers", type=int, default=1, help="surveys compared in parallel [default: 1]")
    given = parser.parse_args()
    compare = partial(rows_of, variants=given.evidence, kept=given.rows)
    with ProcessPoolExecutor(given.workers, mp_context=get_context("spawn")) as pool:
        rows = pd.concat(list(pool.map(compare, given.surveys)))
    for kind, error in held_out_errors(rows).items():
        print(f"calibration error on surveys left out, {kind}: {error:.3f}", file=sys.stderr)
    names = ", ".join(s.name for s in given.surveys)
    today = dt.datetime.now(dt.UTC).date()
    said = f"simulated: {names}; evidence: {', '.join(given.evidence)}; {today}"
    yaml.safe_dump(
        {"/**": {"ros__parameters": {"confidence": fit_confidence(rows, said)}}}, sys.stdout, sort_keys=False
    )


if __name__ == "__main__":
    main()
