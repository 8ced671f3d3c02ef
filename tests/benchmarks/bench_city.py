# ruff: noqa: T201
"""What a change run costs as the city grows, by stage and by worker; and beside py4dgeo's M3C2.

    python tests/benchmarks/bench_city.py mosaic SURVEY ... --count 4 -o out/city4
    python tests/benchmarks/bench_city.py run out/city1 out/city2 out/city4 --workers 2
    python tests/benchmarks/bench_city.py interrupt out/city4 --workers 2 --kill 600 1200
    python tests/benchmarks/bench_city.py m3c2 SURVEY --workers 2

A SURVEY is what ``subiaco simulate --maps-only`` writes (folders *before* and *after*). A mosaic lays streets
side by side, 400 m apart: it costs what a city of so much street costs, its changes are those of the streets.
``interrupt`` kills the command so many seconds after each start, and starts it again; the last run ends.
``m3c2`` needs the package py4dgeo installed beside, and runs both in turn on this machine.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shutil
import signal
import sys
import threading
import time
import zipfile
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import yaml

from subiaco_change.job import run_change
from subiaco_change.request import ChangeRequest
from subiaco_geo.clouds import PointCloud, unpack_voxel_keys, voxel_keys
from subiaco_geo.maps import load_epoch
from subiaco_geo.ply_io import write_ply_parts
from subiaco_geo.survey_map import SurveyMap
from subiaco_geo.visibility import VisibilityGrid
from subiaco_report.pages import write_pages

PITCH = 400.0  # between streets [m]
SCATTER = 0.01  # of the copies of a point [m]
EPOCHS = ("before", "after")


def scattered(cloud: PointCloud, copies: int, step: np.ndarray, seed: int) -> Iterator[PointCloud]:
    """Yield a cloud moved by a step [m], and copies of it whose points are scattered by :data:`SCATTER`."""
    fields = {"intensity": cloud.fields["intensity"]}
    yield PointCloud(cloud.xyz + step, cloud.origin, cloud.crs, fields)
    rng = np.random.default_rng(seed)
    for _ in range(copies - 1):
        noise = rng.normal(0.0, SCATTER, cloud.xyz.shape)
        yield PointCloud(cloud.xyz + step + noise, cloud.origin, cloud.crs, fields)


def write_beams(path: Path, grids: Callable[[], Iterator[VisibilityGrid]], base: VisibilityGrid) -> None:
    """Write the voxels of many grids of one edge as one, column by column; nothing is compressed."""
    count = sum(len(grid.keys) for grid in grids())
    with zipfile.ZipFile(path, "w", allowZip64=True) as archive:
        for name, value in (("origin", base.origin), ("voxel", np.float64(base.voxel))):
            with archive.open(f"{name}.npy", "w") as stream:
                np.lib.format.write_array(stream, np.asarray(value))
        for name in ("keys", "hits", "passes"):
            kind = {"descr": getattr(base, name).dtype.str, "fortran_order": False, "shape": (count,)}
            with archive.open(f"{name}.npy", "w", force_zip64=True) as stream:
                np.lib.format.write_array_header_1_0(stream, kind)
                for grid in grids():
                    stream.write(getattr(grid, name).tobytes())


def make_mosaic(surveys: Sequence[Path], count: int, copies: int, output: Path) -> None:
    """Lay ``count`` streets side by side, the surveys in turn, street by street."""
    side = math.ceil(math.sqrt(count))
    steps = [np.array([PITCH * (k % side), PITCH * (k // side), 0.0]) for k in range(count)]
    for epoch in EPOCHS:
        loaded = [load_epoch(path / epoch) for path in surveys]
        streets = [(k, loaded[k % len(loaded)], step) for k, step in enumerate(steps)]
        folder = output / epoch
        folder.mkdir(parents=True)
        parts = (part for k, street, step in streets for part in scattered(street.cloud, copies, step, k))
        points = copies * sum(len(street.cloud) for _, street, _ in streets)
        write_ply_parts(folder / "map.ply", parts, points)
        first = loaded[0]
        if first.visibility is not None:
            write_beams(folder / "visibility.npz", partial(moved_beams, streets), first.visibility)
        info = {"crs": first.crs, "heights": "ellipsoidal", "points": points}
        info["origin"] = first.cloud.origin.tolist()
        (folder / "map.yaml").write_text(yaml.safe_dump(info))
        print(f"{folder}: {points / 1e6:.2f} M points")


def moved_beams(streets: Sequence[tuple[int, SurveyMap, np.ndarray]]) -> Iterator[VisibilityGrid]:
    """Yield the beams of the streets at their places, about the origin of the first; steps are whole voxels.

    Voxels are sorted from west to east: streets of one easting come together.
    """
    base = streets[0][1].visibility
    for east in sorted({float(step[0]) for _, _, step in streets}):
        keys, hits, passes = [], [], []
        for _, street, step in streets:
            if step[0] == east:
                grid = street.visibility
                shift = np.round((grid.origin - base.origin + step) / grid.voxel).astype(np.int64)
                keys.append(voxel_keys(unpack_voxel_keys(grid.keys) + shift))
                hits.append(grid.hits)
                passes.append(grid.passes)
        joined = np.concatenate(keys)
        order = np.argsort(joined, kind="stable")
        counts = [np.concatenate(v)[order] for v in (hits, passes)]
        yield VisibilityGrid(base.origin, base.voxel, joined[order], *counts)


class Watch:
    """Follows the memory of this process and its workers [MiB], and the clock, stage by stage."""

    def __init__(self) -> None:
        self.stage, self.begun = "cut", time.perf_counter()
        self.peak: dict[str, float] = {}
        self.wall: dict[str, float] = {}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)
        self._thread.start()

    def tell(self, stage: str, _: float) -> None:
        """Take the progress of a run."""
        if stage != self.stage:
            self._end_stage()
            self.stage = stage

    def _end_stage(self) -> None:
        now = time.perf_counter()
        self.wall[self.stage] = self.wall.get(self.stage, 0.0) + now - self.begun
        self.begun = now

    def close(self) -> None:
        """Stop looking."""
        self._end_stage()
        self._stop.set()
        self._thread.join()

    def _look(self) -> None:
        me = psutil.Process()
        while not self._stop.wait(0.4):
            total = 0.0
            for process in (me, *me.children(recursive=True)):
                try:
                    total += process.memory_full_info().pss / 2**20  # what they share counts once
                except psutil.Error:
                    continue
            self.peak[self.stage] = max(self.peak.get(self.stage, 0.0), total)


def run_once(survey: Path, workers: int, *, report: bool) -> dict[str, Any]:
    """Run the whole change command in this process; return what it cost."""
    output = survey / f"change_{workers}"
    shutil.rmtree(output, ignore_errors=True)
    watch = Watch()
    wall, cpu = time.perf_counter(), total_cpu()
    request = ChangeRequest.of(
        before=survey / "before", after=survey / "after", output=output, workers=workers
    )
    try:
        run_change(request, watch.tell, write_pages=write_pages if report else None)
    finally:
        watch.close()
    wall, cpu = time.perf_counter() - wall, total_cpu() - cpu
    notes = json.loads((output / "run.json").read_text())
    if workers > 1:  # the workers are children of the server that they were forked from
        cpu += sum(cost["cpu_s"] for cost in notes["stages"].values())
    points = sum(notes["points"].values())
    tiles = notes["stages"]["labels"]["tasks"]
    return {
        "survey": survey.name, "workers": workers, "points": points, "tiles": tiles, "wall_s": wall,
        "cpu_s": cpu, "peak_mib": max(watch.peak.values()), "stages": notes["stages"],
        "table_hash": notes["table_hash"], "stage_peak_mib": watch.peak, "stage_wall_s": watch.wall,
    }  # fmt: skip


def run_interrupted(survey: Path, workers: int, kills: Sequence[float]) -> dict[str, Any]:
    """Run the command, kill it and all its workers so long [s] after each start, and let the last run end."""
    output = survey / "change_interrupted"
    shutil.rmtree(output, ignore_errors=True)
    command = [
        sys.executable, "-m", "subiaco_bringup.cli.main", "change", str(survey / "before"),
        str(survey / "after"), "-o", str(output), "--workers", str(workers),
    ]  # fmt: skip
    begun, peak, walls, cpu = time.perf_counter(), 0.0, [], []
    for limit in (*kills, math.inf):
        start = time.perf_counter()
        run = psutil.Popen(command, start_new_session=True)
        used: dict[int, float] = {}
        while run.poll() is None and time.perf_counter() - start < limit:
            time.sleep(0.5)
            peak = max(peak, _look_at(run, used))
        if run.poll() is None:
            os.killpg(run.pid, signal.SIGKILL)
        code = run.wait()
        walls.append(time.perf_counter() - start)
        cpu.append(sum(used.values()))
        print(f"ended with {code} after {walls[-1]:.0f} s, {cpu[-1]:.0f} CPU s", flush=True)
    notes = json.loads((output / "run.json").read_text())
    return {
        "survey": survey.name, "workers": workers, "points": sum(notes["points"].values()),
        "tiles": notes["stages"]["labels"]["tasks"], "wall_s": time.perf_counter() - begun,
        "runs_wall_s": walls, "cpu_s": sum(cpu), "runs_cpu_s": cpu, "peak_mib": peak,
        "table_hash": notes["table_hash"],
    }  # fmt: skip


def _look_at(run: psutil.Popen, used: dict[int, float]) -> float:
    """Note the processor seconds of a process and its children; return the memory of all of them [MiB]."""
    total = 0.0
    try:
        for process in (run, *run.children(recursive=True)):
            times = process.cpu_times()
            used[process.pid] = times.user + times.system
            total += process.memory_full_info().pss / 2**20
    except psutil.Error:
        return 0.0
    return total


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
    print("\n| stage | tasks | CPU s of the tasks | wall s | all processes MiB |\n|---|---|---|---|---|")
    for stage, wall in largest["stage_wall_s"].items():
        cost = largest["stages"].get(stage, {"tasks": 0, "cpu_s": 0.0})  # cut, writing: this process alone
        peak = largest["stage_peak_mib"].get(stage, float("nan"))
        print(f"| {stage} | {cost['tasks']} | {cost['cpu_s']:.1f} | {wall:.1f} | {peak:.0f} |")
    if len({r["tiles"] for r in rows}) > 2:
        x, y = (np.log([r[name] for r in rows]) for name in ("tiles", "cpu_s"))
        print(f"\nCPU seconds grow as tiles to the power {np.polyfit(x, y, 1)[0]:.3f}")
    per_tile = largest["cpu_s"] / largest["tiles"]
    for cores in (2, 64):
        hours = 1400 * per_tile / cores / 3600
        print(f"1,400 tiles x {per_tile:.2f} CPU s / {cores} cores = {hours:.2f} h, where cores scale")


def time_m3c2(survey: Path, radius: float = 1.0) -> tuple[float, float]:
    """Wall and CPU seconds of py4dgeo's M3C2 with every point of *before* a core point.

    The cylinders have a radius of so many metres; normals take twice the radius.
    """
    import py4dgeo

    clouds = [load_epoch(survey / epoch).cloud for epoch in EPOCHS]
    origin = clouds[0].origin
    epochs = [py4dgeo.Epoch(np.ascontiguousarray(c.rebased(origin).xyz)) for c in clouds]
    wall, cpu = time.perf_counter(), time.process_time()
    method = py4dgeo.M3C2(
        epochs=tuple(epochs),
        corepoints=epochs[0].cloud,
        cyl_radii=(radius,),
        normal_radii=(2.0 * radius,),
        max_distance=2.0,
    )
    distances, _ = method.run()
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    print(f"M3C2, cylinders of {radius} m: {len(distances)} core points, {wall:.1f} s wall, {cpu:.1f} CPU s")
    return wall, cpu


def main() -> None:
    """Read the command line and run."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("mosaic", "run", "interrupt", "m3c2"))
    parser.add_argument("surveys", nargs="+", type=Path)
    parser.add_argument("--count", type=int, default=4)
    parser.add_argument("--copies", type=int, default=1, help="points of a mosaic for each of a survey")
    parser.add_argument("--workers", type=int, nargs="+", default=[2])
    parser.add_argument("--kill", type=float, nargs="*", default=[], help="after each start [s]")
    parser.add_argument("--report", action="store_true", help="build the report too")
    parser.add_argument("-o", "--output", type=Path)
    given = parser.parse_args()
    if given.what == "mosaic":
        make_mosaic(given.surveys, given.count, given.copies, given.output)
        return
    if given.what == "m3c2":
        wall, cpu = time_m3c2(given.surveys[0])
        run = run_once(given.surveys[0], given.workers[0], report=given.report)
        print(f"change run: {run['wall_s']:.1f} s wall, {run['cpu_s']:.1f} CPU s")
        print(f"ratio: {run['wall_s'] / wall:.2f} of wall time, {run['cpu_s'] / cpu:.2f} of CPU time")
        return
    rows = []
    if given.what == "interrupt":
        rows = [run_interrupted(given.surveys[0], given.workers[0], given.kill)]
        print(json.dumps(rows[0]))
    for workers in given.workers if given.what == "run" else ():
        for survey in given.surveys:
            rows.append(run_once(survey, workers, report=given.report))
            last = rows[-1]
            print(f"{survey.name}, {workers} workers: {last['wall_s']:.0f} s, table {last['table_hash']}")
    if given.what == "run":
        show_runs(rows)
    if given.output is not None:
        given.output.write_text(json.dumps(rows, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
