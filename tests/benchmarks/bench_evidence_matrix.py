# ruff: noqa: T201
"""Scores by kind of evidence: maps with their visibility layer, bare clouds with and without trajectory.

    python tests/benchmarks/bench_evidence_matrix.py out/surveys/* -o docs/results/evidence-matrix.md
    python tests/benchmarks/bench_evidence_matrix.py --simulate out/matrix -o docs/results/evidence-matrix.md

Surveys come from ``subiaco simulate --maps-only``; ``--simulate`` makes those that are missing: every preset
with the same sensor in both epochs, and with 64 beams before and 128 after. Bare clouds are what another
fusion program would deliver: sampled anew at a leaf of 0.2 m and 0.3 m by one random point a voxel, in random
order, without normals, counts or spread; *before* as PLY, *after* as LAZ; the trajectory as TUM. All figures
are simulated. Rows pool the seeds. After each row the table is written, and the row kept in WORK/rows.jsonl:
a run with the same surveys and source code goes on after the last row.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

import subiaco_change
import subiaco_evaluation
import subiaco_geo
from subiaco_change.job import run_change
from subiaco_change.request import ChangeRequest
from subiaco_evaluation.scoring import evaluate
from subiaco_geo.atomic import whole_file
from subiaco_geo.cloud_io import read_cloud, write_cloud
from subiaco_geo.clouds import PointCloud, voxel_indices, voxel_keys
from subiaco_geo.trajectories import Trajectory, read_tum, write_tum

EVIDENCE = ("map", "trajectory", "bare")
NAMES = {
    "map": "map with visibility layer",
    "trajectory": "bare cloud + trajectory",
    "bare": "bare cloud alone",
}
LEAVES = {"before": 0.2, "after": 0.3}
ENDINGS = {"before": "ply", "after": "laz"}
EPOCHS = ("before", "after")
_HEAD = """# Scores by kind of evidence

Written by `python tests/benchmarks/bench_evidence_matrix.py`; do not edit. **Simulated**: presets of
`subiaco simulate`, tuning seeds. Bare clouds are sampled anew at 0.2 m and 0.3 m, without normals or
counts, as PLY and LAZ. Columns in percent of the published protocol, objects by row and by change.

"""
PRESETS = ("easy", "default", "hard")
SENSORS = {
    "same sensor": ("beams_before=128", "beams_after=128"),
    "64 and 128 beams": ("beams_before=64", "beams_after=128"),
}


@dataclass(frozen=True)
class Case:
    """One simulated survey; ``row`` names its preset and sensors."""

    folder: Path
    row: tuple[str, str]


def foreign_cloud(cloud: PointCloud, leaf: float, seed: int) -> PointCloud:
    """Return a cloud as another fusion program delivers it: one random point a voxel, intensity only."""
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(cloud))
    keys = voxel_keys(voxel_indices(cloud.xyz[order] + rng.uniform(0, leaf, 3), leaf))
    chosen = order[rng.permutation(np.unique(keys, return_index=True)[1])]
    fields = {name: cloud.fields[name][chosen] for name in ("intensity",) if name in cloud.fields}
    return PointCloud(cloud.xyz[chosen], cloud.origin, cloud.crs, fields)


def write_foreign(survey: Path, folder: Path, seed: int = 0) -> None:
    """Write both epochs of a simulated survey as bare clouds, with their trajectories beside them."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, epoch in enumerate(EPOCHS):
        cloud = foreign_cloud(read_cloud(survey / epoch / "map.ply"), LEAVES[epoch], 2 * seed + number)
        write_cloud(folder / f"{epoch}.{ENDINGS[epoch]}", cloud)
        way = read_tum(survey / epoch / "truth" / "trajectory.tum")
        moved = np.ones(len(way), dtype=np.bool_)  # poses at rest are written once by most programs
        moved[1:] = np.linalg.norm(np.diff(way.positions, axis=0), axis=1) > 0.01
        write_tum(folder / f"{epoch}.tum", Trajectory(way.times_ns[moved], way.poses[moved]))


def job_of(case: Case, evidence: str, work: Path) -> ChangeRequest:
    """Return the change job of a case under one kind of evidence."""
    place = work / case.folder.name
    output = place / evidence
    if evidence == "map":
        folder = case.folder
        return ChangeRequest.of(
            before=folder / "before", after=folder / "after", output=output, overwrite=True
        )
    foreign = place / "foreign"
    if not (foreign / "after.tum").is_file():
        write_foreign(case.folder, foreign)
    clouds = [foreign / f"{epoch}.{ENDINGS[epoch]}" for epoch in EPOCHS]
    ways = [foreign / f"{epoch}.tum" if evidence == "trajectory" else None for epoch in EPOCHS]
    return ChangeRequest.of(
        before=clouds[0], after=clouds[1], output=output, overwrite=True,
        trajectory_before=ways[0], trajectory_after=ways[1],
    )  # fmt: skip


def case_of(folder: Path) -> Case:
    """Tell preset and sensors of a simulated survey from its ``scene.yaml``."""
    scene = yaml.safe_load((folder / "truth" / "scene.yaml").read_text())
    beams = [scene["config"][f"beams_{epoch}"] for epoch in EPOCHS]
    sensors = "same sensor" if beams[0] == beams[1] else f"{beams[0]} and {beams[1]} beams"
    return Case(folder, (str(scene["preset"]), sensors))


def simulate(folder: Path, seeds: Sequence[int]) -> list[Path]:
    """Simulate what is missing of the matrix, through the command; return all surveys."""
    found = []
    for preset in PRESETS:
        for sensors, settings in SENSORS.items():
            for seed in seeds:
                target = folder / f"{preset}_{sensors.split()[0]}_{seed}"
                found.append(target)
                if (target / "truth" / "objects.csv").is_file():
                    continue
                command = [sys.executable, "-m", "subiaco_bringup.cli.main", "simulate", str(target)]
                command += ["--preset", preset, "--seed", str(seed), "--maps-only", "--mode", "512x10"]
                for setting in ("map_every=2", *settings):
                    command += ["--set", setting]
                subprocess.run(command, check=True)
    return found


def score(
    cases: Sequence[Case], kinds: Sequence[str], work: Path, output: Path | None = None
) -> list[dict[str, Any]]:
    """Run every case under every kind of evidence; one row a preset, sensors and kind, those of WORK kept.

    Parameters
    ----------
    cases : sequence of Case
    kinds : sequence of str
    work : Path
        Change directories, foreign clouds and ``rows.jsonl`` lie there.
    output : Path, optional
        Page that is written after each row.
    """
    rows: list[dict[str, Any]] = []
    kept = Kept(work / "rows.jsonl", source_hash())
    for name in sorted({case.row for case in cases}):
        group = [case for case in cases if case.row == name]
        for kind in kinds:
            key = [*name, kind, *sorted(case.folder.name for case in group)]
            row = kept.find(key)
            if row is None:
                row = _row(name, kind, len(group), _evaluated(group, kind, work))
                kept.add(key, row)
            rows.append(row)
            print(row, flush=True)
            if output is not None:
                with whole_file(output) as temporary:
                    temporary.write_text(page(rows), encoding="utf-8")
    return rows


def _evaluated(group: Sequence[Case], kind: str, work: Path) -> dict[str, Any]:
    """Compare the surveys of a row under one kind of evidence and score them together."""
    pairs = []
    for case in group:
        job = job_of(case, kind, work)
        run_change(job)
        pairs.append((job.output, case.folder))
    for pair in pairs if len(pairs) > 1 else ():
        one = evaluate([pair])["grid"]
        print(f"{pair[1].name} {kind}: mIoU {one['miou_percent']:.1f}", flush=True)
    return evaluate(pairs)


@dataclass(frozen=True)
class Kept:
    """Rows of earlier runs in a file of JSON lines, each with its key and the hash of the source code."""

    path: Path
    source: str

    def find(self, key: Sequence[str]) -> dict[str, Any] | None:
        """Return the row of a key that this source code gave, or None."""
        if not self.path.is_file():
            return None
        found = None
        for line in self.path.read_text(encoding="utf-8").splitlines():
            record = json.loads(line)
            if record["key"] == list(key) and record["source"] == self.source:
                found = record["row"]
        return found

    def add(self, key: Sequence[str], row: dict[str, Any]) -> None:
        """Append a row."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.open("a", encoding="utf-8") as out:
            out.write(json.dumps({"key": list(key), "source": self.source, "row": row}) + "\n")


def source_hash() -> str:
    """Return a short hash of the source code that compares and scores."""
    digest = hashlib.sha256()
    for package in (subiaco_geo, subiaco_change, subiaco_evaluation):
        root = Path(package.__path__[0])
        for path in sorted(root.rglob("*.py")):
            digest.update(str(path.relative_to(root)).encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def _row(name: tuple[str, str], kind: str, surveys: int, found: dict[str, Any]) -> dict[str, Any]:
    grid, objects = found["grid"], found["objects"] or {}
    changed = (found["reliability"] or {}).get("changed_rows") or {}
    return {
        "preset": name[0],
        "sensors": name[1],
        "evidence": NAMES[kind],
        "surveys": surveys,
        "mIoU": grid["miou_percent"],
        **grid["iou_percent"],
        "abstained": grid["abstention_percent"],
        "objects right": objects.get("precision_percent"),
        "objects found": objects.get("recall_percent"),
        "ECE changed rows": changed.get("ece_fraction"),
    }


def page(rows: Sequence[dict[str, Any]]) -> str:
    """Return the table as a page for people."""
    columns = list(rows[0])
    lines = [columns, ["---"] * len(columns)]
    lines += [[_cell(row[name]) for name in columns] for row in rows]
    table = "\n".join("| " + " | ".join(line) + " |" for line in lines)
    return _HEAD + table + "\n"


def _cell(value: object) -> str:
    if value is None:
        return ""
    return (
        f"{value:.3f}"
        if isinstance(value, float) and value < 1
        else (f"{value:.1f}" if isinstance(value, float) else str(value))
    )


def main() -> None:
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=form)
    parser.add_argument("surveys", nargs="*", type=Path)
    parser.add_argument("--simulate", type=Path)
    parser.add_argument("--seeds", nargs="+", type=int, default=[101, 102])
    parser.add_argument("--kinds", nargs="+", choices=EVIDENCE, default=list(EVIDENCE))
    parser.add_argument("--work", type=Path, default=Path("out/evidence_matrix"))
    parser.add_argument("-o", "--output", type=Path)
    args = parser.parse_args()
    folders = list(args.surveys) + ([] if args.simulate is None else simulate(args.simulate, args.seeds))
    rows = score([case_of(folder) for folder in folders], args.kinds, args.work, args.output)
    print(page(rows))


if __name__ == "__main__":
    main()
