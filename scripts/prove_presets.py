"""Prove that a simulated preset is hard: score simple differencing with the true registration over seeds.

python scripts/prove_presets.py --preset default --seeds reporting --work out/proof
python scripts/prove_presets.py --tune --seeds tuning --work out/tuning   # the simple methods' settings
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from tune_baselines import SEARCHED, prepare, tune

from subiaco_evaluation.config import BaselineConfig
from subiaco_evaluation.scores import describe
from subiaco_sim.config import SimulationConfig
from subiaco_sim.survey import simulate

SEEDS_FILE = Path(__file__).parents[1] / "config" / "seeds.yaml"
LIMITS = {"dsm": 65.0, "nn": 55.0}


@dataclass(frozen=True)
class Row:
    """Scores [percent] of one method on one seed, or of all seeds pooled."""

    method: str
    seed: str
    scores: dict[str, Any]

    def text(self) -> str:
        """Return the row of the table."""
        iou = self.scores["iou_percent"]
        parts = "  ".join(f"{name[:3]} {value:5.1f}" for name, value in iou.items() if value is not None)
        return f"{self.method:5} {self.seed:>6}  mIoU {self.scores['miou_percent']:5.1f}   {parts}"


def seeds_of(name: str) -> list[int]:
    """Return a named list of seeds, or the numbers of a comma-separated list."""
    listed = yaml.safe_load(SEEDS_FILE.read_text())
    return [int(s) for s in listed[name]] if name in listed else [int(s) for s in name.split(",")]


def survey_of(work: Path, preset: str, seed: int) -> Path:
    """Simulate fused maps of a seed unless they are there already."""
    out = work / f"{preset}-{seed}"
    if not out.exists():
        config = SimulationConfig(preset=preset, seed=seed, maps_only=True, mode="512x10", map_every=2)
        simulate(out, config)
    return out


def prove(work: Path, preset: str, seeds: list[int], keep: bool) -> list[Row]:
    """Score every method on every seed at the true registration, and on all of them together."""
    config = BaselineConfig()
    pooled = {method: np.zeros((5, 6), dtype=np.int64) for method in LIMITS}
    rows = []
    for seed in seeds:
        case = prepare(survey_of(work, preset, seed), config)
        for method in LIMITS:
            matrix = case.score(method, config)
            pooled[method] += matrix
            rows.append(Row(method, str(seed), describe(matrix)))
            print(rows[-1].text(), flush=True)
    for method, limit in LIMITS.items():
        rows.append(Row(method, "all", describe(pooled[method])))
        print(rows[-1].text(), f"(limit {limit:g})")
    if not keep:
        shutil.rmtree(work)
    return rows


def tuned(options: argparse.Namespace) -> int:
    """Tabulate settings of the simple methods; exit 2 where a seed is for reporting."""
    seeds = seeds_of(options.seeds or "tuning")
    if reported := sorted(set(seeds) & set(seeds_of("reporting"))):
        print(
            f"seeds {reported}: figures are reported on them; tune on others ({SEEDS_FILE})", file=sys.stderr
        )
        return 2
    surveys = [survey_of(options.work, options.preset, seed) for seed in seeds]
    best = tune(surveys, options.methods, options.rounds)
    if options.json:
        options.json.write_text(json.dumps({"seeds": seeds, "best": best}, indent=1))
    if not options.keep:
        shutil.rmtree(options.work)
    return 0


def main() -> int:
    """Run the proof; exit 1 where a pooled score is over its limit."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--preset", default="default")
    parser.add_argument("--seeds", help="tuning, reporting (the default), or numbers with commas")
    parser.add_argument("--tune", action="store_true", help="tabulate the methods' settings, on tuning seeds")
    parser.add_argument("--methods", nargs="+", default=list(SEARCHED), choices=SEARCHED, help="to tune")
    parser.add_argument("--rounds", type=int, default=1, help="of tuning, each over every setting")
    parser.add_argument("--work", type=Path, required=True, help="folder for surveys and results")
    parser.add_argument("--keep", action="store_true", help="leave them there, and use what is there")
    parser.add_argument("--json", type=Path, help="also write the table here")
    options = parser.parse_args()
    options.work.mkdir(parents=True, exist_ok=True)
    if options.tune:
        return tuned(options)
    rows = prove(options.work, options.preset, seeds_of(options.seeds or "reporting"), options.keep)
    if options.json:
        options.json.write_text(json.dumps([vars(row) for row in rows], indent=1))
    pooled = {row.method: row.scores["miou_percent"] for row in rows if row.seed == "all"}
    return int(any(pooled[method] >= LIMITS[method] for method in LIMITS))


if __name__ == "__main__":
    sys.exit(main())
