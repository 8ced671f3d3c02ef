# ruff: noqa: T201
"""Simple and learned methods beside ours: on reporting seeds, and untouched on other sensors and a real pair.

    make learned
    python tests/benchmarks/bench_learned.py out/learned --surveys sim/easy_1 sim/default_1 sim/hard_1 \
        --suburb sim/suburb_101 --dense sim/dense_101 \
        --bare sim/easy_101 sim/default_101 sim/suburb_101 --site $SUBIACO_TEST_DATA

One row alone, on one survey, beside the row that the intervals refer to, as a page of its own:

    python tests/benchmarks/bench_learned.py out/row --surveys sim/easy_1 --methods dsm siamese-kpconv \
        --page out/row.md

A survey is an output of ``subiaco simulate --maps-only``. Bare clouds are made of one as
``bench_evidence_matrix.py`` makes them. Every method takes the registration that 'subiaco change' found.
What is there in the work folder is not run again, so a stopped run goes on.
A learned method takes the weights that are shipped; ``--also ROW=FILE`` adds a row of other weights.
"""

from __future__ import annotations

import argparse
import datetime as dt
import json
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from bench_evidence_matrix import ENDINGS, write_foreign
from bench_real import revision
from bench_real_site import read_site, score
from bench_real_site import read_truth as read_drawn
from tabulated import table

from subiaco_change.config import ChangeConfig
from subiaco_change.job import read_transform, run_change
from subiaco_change.pipeline import detect_changes
from subiaco_change.request import ChangeRequest
from subiaco_evaluation.baseline_run import (
    METHODS,
    PDAL_METHOD,
    compare_pair,
    detect_simply,
    require_method,
)
from subiaco_evaluation.baselines.cells import Pair
from subiaco_evaluation.baselines.pair_preparation import prepare_pair
from subiaco_evaluation.config import BaselineConfig
from subiaco_evaluation.layouts import Prediction, in_after_frame, read_prediction
from subiaco_evaluation.learned.methods import LEARNED_METHODS, POINT_METHODS
from subiaco_evaluation.learned.weights_file import SHIPPED, read_record
from subiaco_evaluation.paired import paired_difference
from subiaco_evaluation.scores import describe
from subiaco_evaluation.scoring import EvaluationConfig, score_cells
from subiaco_evaluation.truth import read_truth
from subiaco_geo.codes import Change
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Ints
from subiaco_geo.maps import load_epoch

OURS = "subiaco"
ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "results" / "learned.md"
PICTURES = ROOT / "docs" / "pictures"
_HEAD = """# Learned methods beside simple ones and ours

Written by `tests/benchmarks/bench_learned.py` on {day}, revision `{revision}`; do not edit. The surveys are
**simulated**. The networks were trained on tuning seeds of the simulator, at the sizes in the first table:
much smaller and shorter than published. The page compares what a CPU can train in minutes; it does not
repeat the publications.
"""
_GROUPS = {
    "surveys": """## Reporting seeds

No method was tuned, trained or chosen on these surveys: {names}. Cells of 0.5 m, the published protocol,
all surveys pooled.
""",
    "suburb": """## Streets of another generator

The networks learned streets of the presets `easy`, `default` and `hard`. A second generator drew the streets
of {names} (preset `suburb`): no network was trained on them. The rules of `subiaco` were tuned on this
family.
""",
    "dense": """## Streets that nothing was tuned on

No network was trained, no rule tuned and no single error looked at on streets of the preset `dense`: {names}.
The seed is one of those by which the method is watched while rules are written.
""",
    "bare": """## Bare clouds, another sensor

Clouds without trajectory, normals and visibility, thinned anew at 0.2 m (*before*) and 0.3 m (*after*), as
another program delivers them: {names}. The streets of `suburb` were seen with other sensors, OS0-32 before
and OS1-128 after. No network was trained on these streets, sensors or grids; the networks are untouched.
""",
}
_SURVEYS = ("surveys", "suburb", "dense")  # groups of cases that are outputs of 'subiaco simulate'
_SITE = """## A real building site

One real site, seen twice by a handheld scanner (MultiChange3D), scored against what was drawn by eye. An
object is right when half of its points carry a right label.
"""


@dataclass(frozen=True)
class Case:
    """Two epochs, their truth, and the table that they belong to."""

    group: str
    name: str
    before: Path
    after: Path
    truth: Path


def survey_case(path: Path, group: str = "surveys") -> Case:
    """Return the case of a simulated survey."""
    return Case(group, path.name, path / "before", path / "after", path)


def bare_case(survey: Path, work: Path) -> Case:
    """Return the case of the bare clouds of a survey, which are made where they are missing."""
    folder = work / "bare" / survey.name / "clouds"
    if not (folder / "after.tum").is_file():
        write_foreign(survey, folder)
    clouds = [folder / f"{epoch}.{ending}" for epoch, ending in ENDINGS.items()]
    return Case("bare", survey.name, clouds[0], clouds[1], survey)


def run_ours(case: Case, work: Path) -> Path:
    """Run 'subiaco change' on a case, unless it was run before; return its change directory."""
    out = work / case.group / case.name / OURS
    if not (out / "changes.csv").is_file():
        shutil.rmtree(out, ignore_errors=True)
        run_change(ChangeRequest(before=case.before, after=case.after, output=out))
    return out


def resolve(name: str, also: Mapping[str, Path]) -> tuple[str, BaselineConfig]:
    """Return the method of a row and its settings; a row of ``also`` takes its own file of weights."""
    if name not in also:
        return name, BaselineConfig()
    settings = BaselineConfig.model_validate({"learned": {"weights": str(also[name])}})
    return str(read_record(also[name])["method"]), settings


def matrices(case: Case, methods: Sequence[str], also: Mapping[str, Path], work: Path) -> dict[str, Ints]:
    """Return the 5x6 matrices of the tiles of a case (T, 5, 6) by method; what is there is not run again."""
    folder = work / case.group / case.name
    ours = run_ours(case, work)
    missing = [m for m in (OURS, *methods) if not (folder / f"{m}.npy").is_file()]
    if missing:
        truth = read_truth(case.truth)
        real, pair = in_after_frame(truth), None
        for method in missing:
            started = time.perf_counter()
            if method == OURS:
                said = read_prediction(ours, truth)
            else:
                pair = pair or registered(case, ours, BaselineConfig())
                found = compare_pair(pair, *resolve(method, also))
                said = Prediction(found.before, found.after)
            np.save(folder / f"{method}.npy", score_cells(said, real, EvaluationConfig())[1])
            print(f"{case.group} {case.name} {method}: {time.perf_counter() - started:.0f} s", flush=True)
    return {m: np.load(folder / f"{m}.npy") for m in (OURS, *methods)}


def registered(case: Case, ours: Path, config: BaselineConfig) -> Pair:
    """Return the epochs of a case by the registration that 'subiaco change' found."""
    transform = read_transform(ours / "registration.json")
    return prepare_pair(load_epoch(case.before), load_epoch(case.after), config, transform)[0]


def group_rows(
    cases: Sequence[Case], methods: Sequence[str], also: Mapping[str, Path], work: Path
) -> list[dict[str, Any]]:
    """Return a row for every method, scored over all cases of a group."""
    by_case = [matrices(case, methods, also, work) for case in cases]
    tiles = {m: np.concatenate([found[m] for found in by_case]) for m in (OURS, *methods)}
    rows = []
    for method, found in tiles.items():
        total = describe(found.sum(axis=0))
        row = {"method": method, "accuracy %": total["accuracy_percent"], "mF1 %": total["mf1_percent"]}
        row |= {"mIoU %": total["miou_percent"], "mIoU of changes %": total["miou_change_percent"]}
        row |= {f"{label} IoU %": value for label, value in total["iou_percent"].items()}
        row["not decided %"] = total["abstention_percent"]
        if method != "dsm":
            step = paired_difference(found, tiles["dsm"], 1000, 0)["miou"]
            low, high = step["interval_95_percent"]
            row["mIoU less dsm, 95 %"] = f"{step['difference_percent']:+.1f} ({low:+.1f} to {high:+.1f})"
        rows.append({k: round(v, 1) if isinstance(v, float) else v for k, v in row.items()})
    return rows


def case_rows(
    cases: Sequence[Case], methods: Sequence[str], also: Mapping[str, Path], work: Path
) -> list[dict[str, Any]]:
    """Return the mIoU of every method on every case of a group [percent]."""
    rows: list[dict[str, Any]] = [{"mIoU %": method} for method in (OURS, *methods)]
    for case in cases:
        found = matrices(case, methods, also, work)
        for row in rows:
            row[case.name] = round(describe(found[row["mIoU %"]].sum(axis=0))["miou_percent"], 1)
    return rows


def site_row(data: Path, method: str, also: Mapping[str, Path], work: Path) -> dict[str, Any]:
    """Return the row of a method on the real building site, as the epochs lie; kept once it was run."""
    kept = work / "site" / f"{method}.json"
    if not kept.is_file():
        epochs = read_site(data, 0), read_site(data, 1)
        if method == OURS:
            result = detect_changes(*epochs, ChangeConfig(), transform=np.eye(4))
        else:
            result = detect_simply(*epochs, *resolve(method, also), transform=np.eye(4))
        found, wrong = score(result, read_drawn())
        row = {"method": method, "objects right": f"{sum(s >= 0.5 for *_, s in found)} of {len(found)}"}
        row["claims"] = sum(r.change < Change.UNCHANGED for r in result.records)
        row["claims outside of every change"] = len(wrong)
        row["area of those m2"] = round(sum(r.footprint.area for r in wrong), 1)
        kept.parent.mkdir(parents=True, exist_ok=True)
        kept.write_text(json.dumps(row), encoding="utf-8")
        print(row, flush=True)
    return dict(json.loads(kept.read_text(encoding="utf-8")))


def finished(cases: Sequence[Case], methods: Sequence[str], work: Path) -> tuple[list[Case], list[str]]:
    """Return the cases with a result of ours, and the methods with a result on every one of these."""
    good = [c for c in cases if (work / c.group / c.name / f"{OURS}.npy").is_file()]
    return good, [m for m in methods if all((work / c.group / c.name / f"{m}.npy").is_file() for c in good)]


def training_rows(methods: Sequence[str], also: Mapping[str, Path]) -> list[dict[str, Any]]:
    """Return what the records of the shipped weights and of those in ``also`` say."""
    rows = []
    for method in methods:
        record = read_record(also.get(method, SHIPPED / f"{method}.npz"))
        points = record["method"] in POINT_METHODS
        part = "point_training" if points else "raster_training"
        inputs = ["1", *record["config"]["point_network"]["features"]] if points else ["heights"]
        parts = [*record.get("earlier", []), record]
        begun = sum(r["epochs"] for r in parts[:-1])
        rows.append({
            "method": method, "parameters": record["parameters"], "input": ", ".join(inputs),
            "learned on": ", ".join(record["surveys"]),
            "validated on": ", ".join(record["validation_surveys"]), "epochs": begun + record["epochs"],
            "cylinders or patches": sum(r["epochs"] * r["config"][part]["samples"] for r in parts),
            "hours": round(sum(r["hours"] for r in parts), 3), "best epoch": begun + record["best_epoch"] + 1,
            "validation mIoU %": record["validation_miou_percent"],
            "moving objects": record.get("moving_objects", "left out" if points else "unchanged"),
            "power of the shares": record["prior_power"],
            "seed": record["config"]["seed"], "revision": record["revision"],
        })  # fmt: skip
    return rows


def page(found: dict[str, Any]) -> str:
    """Return the page of what was found."""
    parts = [_HEAD.format(**found), "Training, by the records in the files of weights:"]
    parts.append(table(found["training"]))
    for row in found["training"]:
        picture = f"learned-{row['method']}.png"
        if (PICTURES / picture).is_file():
            parts.append(f"![Learning curve of {row['method']}](../pictures/{picture})")
    for group, text in _GROUPS.items():
        if group in found:
            parts += [text.format(names=", ".join(found[f"{group}_names"])), table(found[group])]
            if len(found[f"{group}_names"]) > 1:
                parts += ["One by one:", table(found[f"{group}_each"])]
    if "site" in found:
        parts += [_SITE, table(found["site"])]
    if found["absent"]:
        parts.append("\n".join(f"* {name} was not run: {why}." for name, why in found["absent"].items()))
    if found.get("remarks"):
        parts.append("## What the figures say\n\n" + "\n".join(f"* {line}" for line in found["remarks"]))
    return "\n\n".join(part.rstrip() for part in parts) + "\n"


def available(methods: Sequence[str]) -> tuple[list[str], dict[str, str]]:
    """Return the methods that can be run here, and why others cannot."""
    good, absent = [], {}
    for method in methods:
        try:
            require_method(method, BaselineConfig())
            good.append(method)
        except InputError as error:
            absent[method] = str(error).removeprefix(f"{method}: ")
    return good, absent


def main() -> None:
    """Run what is missing and write the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("work", type=Path)
    parser.add_argument("--surveys", type=Path, nargs="*", default=[])
    parser.add_argument("--suburb", type=Path, nargs="*", default=[])
    parser.add_argument("--dense", type=Path, nargs="*", default=[])
    parser.add_argument("--bare", type=Path, nargs="*", default=[])
    parser.add_argument("--site", type=Path, metavar="DATA", help="folder that holds real_pair_site")
    parser.add_argument("--methods", nargs="*", help="rows to run beside ours; all without it")
    parser.add_argument("--also", nargs="*", default=[], metavar="ROW=WEIGHTS", help="rows of other weights")
    parser.add_argument("--remarks", type=Path, help="text file; a line is a remark below the tables")
    parser.add_argument("--page", type=Path, default=PAGE)
    parser.add_argument("--finished", action="store_true", help="run nothing; write what was run before")
    given = parser.parse_args()
    methods, absent = available(given.methods or [*METHODS, PDAL_METHOD, *LEARNED_METHODS])
    also = {name: Path(path) for name, _, path in (words.partition("=") for words in given.also)}
    learned = [*(m for m in methods if m in LEARNED_METHODS), *also]
    methods = [*methods, *also]
    day = dt.datetime.now(dt.UTC).date().isoformat()
    found: dict[str, Any] = {"day": day, "revision": revision(), "absent": absent}
    found["training"] = training_rows(learned, also)
    cases = [survey_case(path, group) for group in _SURVEYS for path in getattr(given, group)]
    cases += [bare_case(path, given.work) for path in given.bare]
    for group in _GROUPS:
        chosen, able = [case for case in cases if case.group == group], methods
        if given.finished:
            chosen, able = finished(chosen, methods, given.work)
        if chosen and "dsm" in able:
            names = [c.name for c in chosen]
            found |= {group: group_rows(chosen, able, also, given.work), f"{group}_names": names}
            found[f"{group}_each"] = case_rows(chosen, able, also, given.work)
    if given.site is not None:
        kept = [m for m in (OURS, *methods) if (given.work / "site" / f"{m}.json").is_file()]
        able = kept if given.finished else [OURS, *methods]
        found["site"] = [site_row(given.site, method, also, given.work) for method in able]
    if given.remarks is not None:
        found["remarks"] = given.remarks.read_text(encoding="utf-8").splitlines()
    data = given.page.parent / "data" / f"{given.page.stem}.json"
    data.parent.mkdir(parents=True, exist_ok=True)
    data.write_text(json.dumps(found, indent=1), encoding="utf-8")
    given.page.write_text(page(found), encoding="utf-8")
    print(f"{given.page}: written")


if __name__ == "__main__":
    main()
