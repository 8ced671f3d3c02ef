# ruff: noqa: T201
"""The change run beside what people use today, on one pair of maps: py4dgeo's M3C2, and surface models.

    python tests/benchmarks/bench_methods.py SURVEY --workers 2

A SURVEY is what ``subiaco simulate --maps-only`` writes. M3C2 takes every point of *before* as a core point
and all cores it finds, gives distances alone, with cylinders of 1 m (normals of 2 m) and of 0.5 m (normals
of 1 m), searched to 2 m along the normal. Differencing of surface models (``subiaco baseline dsm``)
registers first, as we do, and takes one core. The change run stands there three times: in process without
its pages; as a user starts it, with start-up and pages, in one process; and so on a machine that has no
compiled kernels yet. py4dgeo is not among our dependencies: see ``requirements.txt`` beside this file.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import resource
import shutil
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from bench_city import run_once, time_m3c2
from results import keep, rounded

from subiaco_change.request import ComparisonRequest
from subiaco_evaluation.baseline_run import run_baseline
from subiaco_evaluation.config import BaselineConfig

RADII = (1.0, 0.5)  # of the cylinders of M3C2 [m]


def time_surfaces(survey: Path) -> tuple[float, float]:
    """Wall and CPU seconds of differencing surface models, files and table included."""
    output = survey / "surfaces"
    shutil.rmtree(output, ignore_errors=True)
    wall, cpu = time.perf_counter(), time.process_time()
    request = ComparisonRequest(before=survey / "before", after=survey / "after", output=output)
    run_baseline(request, "dsm", BaselineConfig())
    return time.perf_counter() - wall, time.process_time() - cpu


def time_command(survey: Path, **environment: str) -> tuple[float, float]:
    """Wall and CPU seconds of ``subiaco change`` as a process of its own, start-up and pages included."""
    output = survey / "change_command"
    shutil.rmtree(output, ignore_errors=True)
    epochs = [str(survey / "before"), str(survey / "after")]
    command = [sys.executable, "-m", "subiaco_bringup.cli.main", "change", *epochs, "-o", str(output)]
    wall, used = time.perf_counter(), children_cpu()
    subprocess.run([*command, "--workers", "1", "--quiet"], check=True, env=os.environ | environment)
    return time.perf_counter() - wall, children_cpu() - used


def children_cpu() -> float:
    """Processor seconds of the processes that this one started and that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main() -> None:
    """Print and keep the rows."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("survey", type=Path)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--json", type=Path, help="leave the rows there, for bench.py")
    given = parser.parse_args()
    times: dict[str, tuple[float, float]] = {}
    absent: dict[str, str] = {}
    bases: dict[str, tuple[float, float]] = {}
    if importlib.util.find_spec("py4dgeo") is None:
        absent["py4dgeo M3C2"] = "py4dgeo cannot be imported"
    else:
        for radius in RADII:
            bases[f"M3C2 {radius:g} m"] = time_m3c2(given.survey, radius)
        times |= {f"py4dgeo {name}, distances alone": value for name, value in bases.items()}
    times["DSM differencing, from maps to table"] = time_surfaces(given.survey)
    with TemporaryDirectory() as empty:
        times["subiaco change as a command, first run"] = time_command(given.survey, NUMBA_CACHE_DIR=empty)
    times["subiaco change as a command, with pages, 1 process"] = time_command(given.survey)
    ours = run_once(given.survey, given.workers, report=False)
    times[f"subiaco change, from maps to table, {given.workers} workers"] = ours["wall_s"], ours["cpu_s"]
    rows: list[dict[str, Any]] = []
    for name, (wall, cpu) in times.items():
        rows.append({"method": name, "wall s": rounded(wall), "CPU s": rounded(cpu)})
        for base, (base_wall, base_cpu) in bases.items():
            rows[-1] |= {f"of {base}, wall": rounded(wall / base_wall, 2)}
            rows[-1] |= {f"of {base}, CPU": rounded(cpu / base_cpu, 2)}
        print(rows[-1])
    rows[-1]["peak MB, all processes"] = round(ours["peak_mib"])
    remarks = [f"{ours['points']} points of both epochs at the working leaf"]
    if bases:
        remarks.append(
            "M3C2 R m: every point of before is a core point, cylinders of radius R, normals from 2 R, "
            "searched to 2 m along the normal, all cores; distances alone"
        )
    keep(given.json, rows, absent, remarks)


if __name__ == "__main__":
    main()
