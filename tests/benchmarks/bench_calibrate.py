# ruff: noqa: T201
"""How far calibration by injection on the map of *before* alone can be trusted; all simulated.

    for seed in 101 102 103 1 2 3 4 5; do
      subiaco simulate out/cal/default-$seed --preset default --seed $seed --duration 14 --maps-only \\
        --mode 512x10 --set map_every=2
    done
    python tests/benchmarks/bench_calibrate.py pairs out/cal/* --into out/cal_rows
    python tests/benchmarks/bench_calibrate.py copies out/cal/default-? --seeds 0 1 --into out/cal_rows
    python tests/benchmarks/bench_calibrate.py copies out/cal/default-? --seeds 1000 1001 --into out/cal_rows
    python tests/benchmarks/bench_calibrate.py tell out/cal_rows

``pairs`` runs change detection on the two epochs of a survey and judges its rows by the truth. ``copies``
knows the map of *before* alone: it does what ``subiaco calibrate`` does to one injected copy a seed. Both
take the epochs as registered. ``tell`` compares, on the rows of the reporting pairs (seeds below 100), the
calibration error of confidences fitted to the truth of the tuning pairs (100 and above) with those
fitted to the copies of that very street; and tries the smallest change stated from copies of seeds below
1000 on the copies of seeds from 1000 on, and the other way round.
"""

from __future__ import annotations

import argparse
import pickle
import time
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from subiaco_change.config import ChangeConfig
from subiaco_change.decisions.confidence_config import Coefficients, ConfidenceConfig
from subiaco_change.pipeline import detect_changes
from subiaco_evaluation.confidence_fit import BINS, fit_confidence, judged_rows, pair_points
from subiaco_evaluation.injection.config import InjectionConfig
from subiaco_evaluation.injection.detectability import fit_curves, outcomes, smallest_table, statement
from subiaco_evaluation.injection.inject import inject
from subiaco_evaluation.injection.source_objects import label_scene
from subiaco_evaluation.layouts import in_after_frame
from subiaco_evaluation.scores import reliability
from subiaco_evaluation.truth import read_truth
from subiaco_geo.maps import load_epoch

EDITS = {"inserted": 20, "removed": 12, "moved": 6, "grown": 12, "cut": 12, "patches": 14}
FIRST_TUNING = 100  # seed of a survey; see config/seeds.yaml
FRESH = 1000  # first seed of copies that nothing is fitted on


def pair(survey: Path) -> dict[str, object]:
    """Judge the rows of a survey's own two epochs."""
    before, after = load_epoch(survey / "before"), load_epoch(survey / "after")
    result = detect_changes(before, after, ChangeConfig(), transform=np.eye(4))
    real = in_after_frame(read_truth(survey))
    points = pair_points(result, real["before"], real["after"])
    return {"rows": judged_rows(result, points, survey.name)}


def copies(survey: Path, seeds: list[int], into: Path) -> None:
    """Find injected changes in copies of the map of *before*; a file a copy."""
    epoch = load_epoch(survey / "before", survey / "before" / "truth" / "trajectory.tum")
    scene = None
    for seed in seeds:
        path = into / f"{survey.name}_copy{seed}.pkl"
        if path.exists():
            continue
        started = time.process_time()
        config = InjectionConfig(seed=seed, **EDITS)
        scene = scene or label_scene(epoch, config)
        injected = inject(epoch, config, scene=scene)
        if seed % 2:
            injected = injected.turned_round()
        result = detect_changes(injected.before, injected.after, ChangeConfig(), transform=np.eye(4))
        points = pair_points(result, injected.before.cloud, injected.after.cloud)
        changes = outcomes(pd.DataFrame(injected.rows), points, result, seed)
        rows = judged_rows(result, points, f"{survey.name} {seed}")
        path.write_bytes(pickle.dumps({"rows": rows, "changes": changes}))
        claims = rows[rows["kind"] != "unchanged"]
        spent = time.process_time() - started
        print(
            f"{path.name}: {spent:.0f} CPU s, {changes['found'].sum()} of {len(changes)} changes found, "
            f"{claims['right'].sum()} of {len(claims)} claims right",
            flush=True,
        )


def trusts(rows: pd.DataFrame, models: dict[str, object]) -> NDArray[np.float64]:
    """Return the confidence (N,) of every row; that of the shipped model where none was fitted."""
    trust = np.empty(len(rows))
    x = np.array(rows["features"].tolist())
    shipped = ConfidenceConfig().model_dump()
    for kind in rows["kind"].unique():
        mine = (rows["kind"] == kind).to_numpy()
        model = Coefficients.model_validate(models.get(kind, shipped[kind]))
        trust[mine] = model.probability(x[mine])
    return trust


def tell(folder: Path) -> None:
    """Print both comparisons."""
    pairs = {p.stem.split("_")[0]: _read(p)["rows"] for p in sorted(folder.glob("*_pair.pkl"))}
    found = {p.stem: _read(p) for p in sorted(folder.glob("*_copy*.pkl"))}
    tuning = [rows for name, rows in pairs.items() if _seed(name) >= FIRST_TUNING]
    truth = fit_confidence(pd.concat(tuning), "truth")
    judged = []
    for name, rows in pairs.items():
        own = [v["rows"] for k, v in found.items() if k.split("_")[0] == name and _copy(k) < FRESH]
        if _seed(name) < FIRST_TUNING and own:
            fitted = fit_confidence(pd.concat(own), "copies")
            judged.append(rows.assign(truth=trusts(rows, truth), copies=trusts(rows, fitted)))
    print("| street | rows | right | ECE by truth | by injection |\n|---|---|---|---|---|")
    for rows in [*judged, pd.concat(judged).assign(survey="pooled")] if judged else []:
        for label, part in (("all", rows), ("changed", rows[rows["kind"] != "unchanged"])):
            right = part["right"].to_numpy(bool)
            errors = [
                reliability(part[n].to_numpy(), right, BINS)["ece_fraction"] for n in ("truth", "copies")
            ]
            name = f"{part['survey'].iloc[0]}, {label}"
            print(f"| {name} | {len(part)} | {right.mean():.3f} | {errors[0]:.3f} | {errors[1]:.3f} |")
    every = pd.concat([v["changes"] for v in found.values()], ignore_index=True)
    halves = every[every["copy"] < FRESH], every[every["copy"] >= FRESH]
    for stated, fresh in (halves, halves[::-1]):
        curves = fit_curves(stated)
        print(smallest_table(stated, curves).to_string(index=False))
        print(statement(fresh, curves).to_string(index=False))


def _read(path: Path) -> dict[str, pd.DataFrame]:
    return pickle.loads(path.read_bytes())  # written by this script


def _seed(name: str) -> int:
    return int(name.rsplit("-", 1)[1])


def _copy(name: str) -> int:
    return int(name.rsplit("copy", 1)[1])


def main() -> None:
    """Run one of the three."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("what", choices=("pairs", "copies", "tell"))
    parser.add_argument("paths", nargs="+", type=Path)
    parser.add_argument("--into", type=Path, default=Path("out/cal_rows"))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1])
    words = parser.parse_args()
    if words.what == "tell":
        tell(words.paths[0])
        return
    words.into.mkdir(parents=True, exist_ok=True)
    for survey in words.paths:
        if words.what == "copies":
            copies(survey, words.seeds, words.into)
        elif not (words.into / f"{survey.name}_pair.pkl").exists():
            (words.into / f"{survey.name}_pair.pkl").write_bytes(pickle.dumps(pair(survey)))
            print(survey.name, flush=True)


if __name__ == "__main__":
    main()
