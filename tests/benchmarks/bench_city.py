# ruff: noqa: T201
"""What a change run costs as the city grows, by stage and by worker; and beside py4dgeo's M3C2.

    python tests/benchmarks/bench_city.py mosaic SURVEY ... --count 4 -o out/city4
    python tests/benchmarks/bench_city.py run out/city1 out/city2 out/city4 --workers 2
    python tests/benchmarks/bench_city.py m3c2 SURVEY --workers 2

A SURVEY is what ``subiaco simulate --maps-only`` writes (folders *before* and *after*). A mosaic lays streets
side by side, 400 m apart: it costs what a city of so much street costs, its changes are those of the streets.
``m3c2`` needs the package py4dgeo installed beside, and runs both in turn on this machine.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shutil
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from subiaco_change.config import ChangeConfig
from subiaco_change.job import ChangeJob, Work, run_change
from subiaco_geo.clouds import PointCloud, unpack_voxel_keys, voxel_keys
from subiaco_geo.maps import SurveyMap, load_epoch, write_map
from subiaco_geo.visibility import VisibilityGrid

PITCH = 400.0  # between streets [m]
EPOCHS = ("before", "after")


def moved(survey: SurveyMap, step: np.ndarray) -> SurveyMap:
    """Return a map moved in the plane; the step is whole voxels."""
    cloud, grid = survey.cloud, survey.visibility
    place = PointCloud(cloud.xyz + step, cloud.origin, cloud.crs, {"intensity": cloud.fields["intensity"]})
    if grid is None:
        return SurveyMap(place)
    index = unpack_voxel_keys(grid.keys) + np.round(step / grid.voxel).astype(np.int64)
    return SurveyMap(
        place, visibility=VisibilityGrid(grid.origin, grid.voxel, voxel_keys(index), grid.hits, grid.passes)
    )


def together(surveys: Sequence[SurveyMap]) -> SurveyMap:
    """Join maps of one origin and CRS."""
    first = surveys[0]
    origin = first.cloud.origin
    clouds = [s.cloud.rebased(origin) for s in surveys]
    cloud = PointCloud(
        np.concatenate([c.xyz for c in clouds]), origin, first.cloud.crs,
        {"intensity": np.concatenate([c.fields["intensity"] for c in clouds])},
    )  # fmt: skip
    grids = [s.visibility for s in surveys if s.visibility is not None]
    if len(grids) < len(surveys):
        return SurveyMap(cloud)
    base = grids[0]
    rows = []
    for grid in grids:
        shift = np.round((grid.origin - base.origin) / grid.voxel).astype(np.int64)
        rows.append(voxel_keys(unpack_voxel_keys(grid.keys) + shift))
    keys = np.concatenate(rows)
    order = np.argsort(keys, kind="stable")
    hits, passes = (np.concatenate([getattr(g, n) for g in grids])[order] for n in ("hits", "passes"))
    return SurveyMap(cloud, visibility=VisibilityGrid(base.origin, base.voxel, keys[order], hits, passes))


def make_mosaic(surveys: Sequence[Path], count: int, output: Path) -> None:
    """Lay ``count`` streets side by side, the surveys in turn."""
    side = math.ceil(math.sqrt(count))
    for epoch in EPOCHS:
        loaded = {path: load_epoch(path / epoch) for path in surveys}
        parts = []
        for k in range(count):
            step = np.array([PITCH * (k % side), PITCH * (k // side), 0.0])
            parts.append(moved(loaded[surveys[k % len(surveys)]], step))
        whole = together(parts)
        write_map(output / epoch, whole)
        print(f"{output / epoch}: {len(whole.cloud) / 1e6:.2f} M points")


def tree_peak(stop: list[bool], peak: list[float]) -> None:
    """Follow the memory of this process and its workers [MiB], by unique pages."""
    me = psutil.Process()
    while not stop[0]:
        total = 0.0
        for process in (me, *me.children(recursive=True)):
            try:
                total += process.memory_full_info().uss / 2**20
            except psutil.Error:
                continue
        peak[0] = max(peak[0], total)
        time.sleep(0.5)


def run_once(survey: Path, workers: int, *, report: bool) -> dict[str, Any]:
    """Run the whole change command in this process; return what it cost."""
    import threading

    from subiaco_change.outputs import directory

    built = directory.build_report
    if not report:
        directory.build_report = lambda *_: None
    output = survey / f"change_{workers}"
    shutil.rmtree(output, ignore_errors=True)
    stop, peak = [False], [0.0]
    watcher = threading.Thread(target=tree_peak, args=(stop, peak), daemon=True)
    watcher.start()
    wall, cpu = time.perf_counter(), total_cpu()
    job = ChangeJob(survey / "before", survey / "after", output, work=Work(workers))
    try:
        run_change(job, ChangeConfig())
    finally:
        stop[0] = True
        watcher.join()
        directory.build_report = built
    wall, cpu = time.perf_counter() - wall, total_cpu() - cpu
    notes = json.loads((output / "run.json").read_text())
    if workers > 1:  # the workers are children of the server that they were forked from
        cpu += sum(cost["cpu_s"] for cost in notes["stages"].values())
    points = sum(notes["points"].values())
    tiles = notes["stages"]["labels"]["tasks"]
    return {
        "survey": survey.name, "workers": workers, "points": points, "tiles": tiles, "wall_s": wall,
        "cpu_s": cpu, "peak_mib": peak[0], "stages": notes["stages"], "table_hash": notes["table_hash"],
    }  # fmt: skip


def total_cpu() -> float:
    """Processor seconds of this process."""
    used = os.times()
    return used.user + used.system


def show_runs(rows: Sequence[dict[str, Any]]) -> None:
    """Print runs side by side, their exponent, and what 1,400 tiles would cost."""
    print(
        "| survey | workers | points, M | tiles | wall s | CPU s | CPU s a tile | peak MiB, all processes |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for r in rows:
        print(
            f"| {r['survey']} | {r['workers']} | {r['points'] / 1e6:.2f} | {r['tiles']} | {r['wall_s']:.0f} "
            f"| {r['cpu_s']:.0f} | {r['cpu_s'] / r['tiles']:.2f} | {r['peak_mib']:.0f} |"
        )
    largest = max(rows, key=lambda r: r["tiles"])
    print("\n| stage | tasks | CPU s | share % | largest process MiB |\n|---|---|---|---|---|")
    whole = sum(c["cpu_s"] for c in largest["stages"].values())
    for stage, cost in largest["stages"].items():
        share = 100 * cost["cpu_s"] / whole
        print(f"| {stage} | {cost['tasks']} | {cost['cpu_s']:.1f} | {share:.1f} | {cost['peak_mib']:.0f} |")
    if len({r["tiles"] for r in rows}) > 2:
        x, y = (np.log([r[name] for r in rows]) for name in ("tiles", "cpu_s"))
        print(f"\nCPU seconds grow as tiles to the power {np.polyfit(x, y, 1)[0]:.3f}")
    per_tile = largest["cpu_s"] / largest["tiles"]
    for cores in (2, 64):
        hours = 1400 * per_tile / cores / 3600
        print(f"1,400 tiles x {per_tile:.2f} CPU s / {cores} cores = {hours:.2f} h, where cores scale")


def time_m3c2(survey: Path) -> tuple[float, float]:
    """Wall and CPU seconds of py4dgeo's M3C2 with every point of *before* a core point."""
    import py4dgeo

    clouds = [load_epoch(survey / epoch).cloud for epoch in EPOCHS]
    origin = clouds[0].origin
    epochs = [py4dgeo.Epoch(np.ascontiguousarray(c.rebased(origin).xyz)) for c in clouds]
    wall, cpu = time.perf_counter(), time.process_time()
    method = py4dgeo.M3C2(
        epochs=tuple(epochs),
        corepoints=epochs[0].cloud,
        cyl_radii=(1.0,),
        normal_radii=(2.0,),
        max_distance=2.0,
    )
    distances, _ = method.run()
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    print(f"M3C2: {len(distances)} core points, {wall:.1f} s wall, {cpu:.1f} CPU s")
    return wall, cpu


def main() -> None:
    """Read the command line and run."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("mosaic", "run", "m3c2"))
    parser.add_argument("surveys", nargs="+", type=Path)
    parser.add_argument("--count", type=int, default=4)
    parser.add_argument("--workers", type=int, nargs="+", default=[2])
    parser.add_argument("--report", action="store_true", help="build the report too")
    parser.add_argument("-o", "--output", type=Path)
    given = parser.parse_args()
    if given.what == "mosaic":
        make_mosaic(given.surveys, given.count, given.output)
        return
    if given.what == "m3c2":
        wall, cpu = time_m3c2(given.surveys[0])
        run = run_once(given.surveys[0], given.workers[0], report=given.report)
        print(f"change run: {run['wall_s']:.1f} s wall, {run['cpu_s']:.1f} CPU s")
        print(f"ratio: {run['wall_s'] / wall:.2f} of wall time, {run['cpu_s'] / cpu:.2f} of CPU time")
        return
    rows = []
    for workers in given.workers:
        for survey in given.surveys:
            rows.append(run_once(survey, workers, report=given.report))
            last = rows[-1]
            print(f"{survey.name}, {workers} workers: {last['wall_s']:.0f} s, table {last['table_hash']}")
    show_runs(rows)
    if given.output is not None:
        given.output.write_text(json.dumps(rows, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
