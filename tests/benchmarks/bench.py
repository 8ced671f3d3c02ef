# ruff: noqa: T201
"""Every benchmark of speed and memory in one run: ``benchmarks.json`` and ``docs/results/benchmarks.md``.

    make bench                                       # everything, on a quiet machine: a quarter of an hour
    make bench BENCH_ARGS="--only mapping node-graph"     # some, into out/bench alone
    make bench-check                                 # into out/bench; fails where a ratio is a third worse

Inputs are simulated by the project itself and kept in ``out/bench``; peers that our lock lacks are put into
``out/bench/peers``. One that cannot be had is named as absent. Each benchmark is a program of its own in this
folder, which leaves its rows as JSON; here they are put together with what the machine was.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import psutil
from ratios import worsened
from tabulated import page

ROOT = Path(__file__).resolve().parents[2]
HERE = Path(__file__).resolve().parent
WORK = ROOT / "out" / "bench"
SEED = 101  # for tuning; speed is no score
ONE_THREAD = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
PACKAGES = ("kiss-icp", "small-gicp", "open3d-cpu", "gtsam", "numpy", "numba", "rko-lio", "py4dgeo")


@dataclass(frozen=True)
class Survey:
    """A simulated input: its folder in ``out/bench`` and the options of ``subiaco simulate``."""

    name: str
    options: tuple[str, ...]

    @property
    def path(self) -> Path:
        return WORK / self.name


def simulated(name: str, *options: str) -> Survey:
    """Return a survey of preset *default*."""
    return Survey(name, ("--preset", "default", "--seed", str(SEED), *options))


MAPS = simulated("maps", "--maps-only", "--mode", "1024x10", "--set", "map_every=2")
DRIVE = simulated("drive", "--epoch", "before", "--mode", "1024x10", "--duration", "20")
WIDE = simulated("wide", "--epoch", "before", "--mode", "2048x10", "--duration", "8")


@dataclass(frozen=True)
class Benchmark:
    """A program of this folder, run once for every line of arguments; ``{name}`` is a survey's folder."""

    name: str
    title: str
    program: str
    lines: tuple[str, ...]
    surveys: tuple[Survey, ...] = ()
    threads: bool = False  # all of the machine's, else one


BENCHMARKS = (
    Benchmark("simulator", "Simulating a drive into a bag", "bench_simulator.py",
              ("--preset default --duration 3", "--preset hard --duration 3"), threads=True),
    Benchmark("mapping", "Mapping in process, packets to map, in turns with others on the same scans",
              "bench_mapping.py", ("{drive}/before --truth {drive}/before/truth/trajectory.tum --rko",),
              (DRIVE,)),
    Benchmark("node-graph", "The node graph at 2048x10: replay, odometry and pose graph as processes",
              "bench_node_graph.py", ("{wide}/before",), (WIDE,)),
    Benchmark("pose-graph", "The pose graph as it grows", "bench_graph.py",
              ("--scans 1000 5000 20000 --live-up-to 5000",)),
    Benchmark("fusion-memory", "Fusing and writing five minutes of a street that never repeats",
              "bench_fusion_memory.py", ("--minutes 5 --points 4000",)),
    Benchmark("registration", "Registering a million points to a million", "bench_registration.py",
              ("speed {maps}",), (MAPS,)),
    Benchmark("semantics", "Classes and objects, streets side by side", "bench_semantics.py",
              ("speed --surveys {maps} --millions 0.25 0.5 1",), (MAPS,)),
    Benchmark("change", "The change run beside M3C2 and surface models", "bench_methods.py",
              (f"{{maps}} --workers {os.cpu_count()}",), (MAPS,), threads=True),
)  # fmt: skip


def machine() -> dict[str, Any]:
    """Return what the figures were measured on."""
    told = Path("/proc/cpuinfo").read_text().splitlines()
    models = [line.split(":")[1].strip() for line in told if line.startswith("model name")]
    return {
        "cpu": models[0] if models else platform.processor(),
        "cores": os.cpu_count(),
        "memory_gb": round(psutil.virtual_memory().total / 2**30, 1),
        "os": platform.freedesktop_os_release().get("PRETTY_NAME", platform.platform()),
        "python": platform.python_version(),
        "packages": {name: version(name) for name in PACKAGES},
        "revision": revision(),
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "load_before": round(os.getloadavg()[0], 2),
    }


def version(name: str) -> str:
    """Return the version of a package or peer, *absent* where there is none."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "absent"


def revision() -> str:
    """Return the commit, with a plus where files differ from it."""

    def git(*words: str) -> str:
        return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=False).stdout

    changed = git("status", "--porcelain", "--untracked-files=no").strip()
    return git("rev-parse", "--short=12", "HEAD").strip() + ("+" if changed else "")


def fetch_peers() -> None:
    """Put the peers that our lock lacks beside; without a network they stay absent."""
    wanted, stamp = HERE / "requirements.txt", WORK / "peers" / "requirements.txt"
    if stamp.is_file() and stamp.read_text() == wanted.read_text():
        return
    print("[bench] peers", flush=True)
    pip = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "-q",
        "--no-deps",
        "--target",
        str(stamp.parent),
        "--upgrade",
    ]
    if subprocess.run([*pip, "-r", str(wanted)], check=False).returncode == 0:
        stamp.write_text(wanted.read_text())


def make_survey(survey: Survey) -> None:
    """Simulate a survey that is not there yet."""
    if not survey.path.is_dir():
        print(f"[bench] simulating {survey.name}", flush=True)
        command = [sys.executable, "-m", "subiaco_bringup.cli.main", "simulate", str(survey.path)]
        subprocess.run([*command, *survey.options, "-q"], check=True)


def run(benchmark: Benchmark) -> dict[str, Any]:
    """Run one benchmark; a line that fails is named, and the others go on."""
    found: dict[str, Any] = {
        "title": benchmark.title,
        "commands": [],
        "rows": [],
        "absent": {},
        "remarks": [],
    }
    folders = {survey.name: str(survey.path.relative_to(ROOT)) for survey in benchmark.surveys}
    environment = os.environ | ({} if benchmark.threads else ONE_THREAD)
    result = WORK / "result.json"
    for line in benchmark.lines:
        words = line.format(**folders).split()
        program = HERE / benchmark.program
        found["commands"].append(" ".join(["python", str(program.relative_to(ROOT)), *words]))
        print(f"[bench] {found['commands'][-1]}", flush=True)
        result.unlink(missing_ok=True)
        command = [sys.executable, str(program), *words, "--json", str(result)]
        code = subprocess.run(command, cwd=ROOT, env=environment, check=False).returncode
        if code or not result.is_file():
            found["remarks"].append(f"failed with exit code {code}")
            found["failed"] = True
            continue
        told = json.loads(result.read_text())
        found["rows"] += told["rows"]
        found["absent"] |= told["absent"]
        found["remarks"] += [remark for remark in told["remarks"] if remark not in found["remarks"]]
    return found


def main() -> int:
    """Run, and write what was found."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    names = [benchmark.name for benchmark in BENCHMARKS]
    parser.add_argument("--only", nargs="+", choices=names, metavar="NAME", help=", ".join(names))
    parser.add_argument(
        "--check", action="store_true", help="compare the ratios with benchmarks.json instead of replacing it"
    )
    given = parser.parse_args()
    chosen = [b for b in BENCHMARKS if given.only is None or b.name in given.only]
    WORK.mkdir(parents=True, exist_ok=True)
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # else every start compiles 1,700 modules: 5 s
    fetch_peers()
    paths = [str(WORK / "peers"), str(HERE)]
    sys.path[1:1] = paths
    os.environ["PYTHONPATH"] = os.pathsep.join([os.environ.get("PYTHONPATH", ""), *paths]).strip(os.pathsep)
    for survey in dict.fromkeys(s for b in chosen for s in b.surveys):
        make_survey(survey)
    facts, began = machine(), time.monotonic()
    results = {benchmark.name: run(benchmark) for benchmark in chosen}
    facts |= {
        "load_after": round(os.getloadavg()[0], 2),
        "minutes": round((time.monotonic() - began) / 60, 1),
    }
    whole = given.only is None and not given.check
    found = {"machine": facts, "seed": SEED, "surveys": surveys(chosen), "benchmarks": results}
    (ROOT if whole else WORK).joinpath("benchmarks.json").write_text(json.dumps(found, indent=1) + "\n")
    table = ROOT / "docs" / "results" / "benchmarks.md" if whole else WORK / "benchmarks.md"
    table.write_text(page(found))
    print(f"[bench] {table.relative_to(ROOT)}")
    failed = any("failed" in result for result in results.values())
    return int((given.check and not holds(found)) or failed)


def holds(found: dict[str, Any]) -> bool:
    """Say which ratios are worse than the recorded ones."""
    lines, compared = worsened(json.loads((ROOT / "benchmarks.json").read_text()), found)
    for line in lines:
        print(f"[bench] worse: {line}")
    print(f"[bench] {compared} ratios compared with benchmarks.json, {len(lines)} of them worse by a third")
    return compared > 0 and not lines


def surveys(chosen: list[Benchmark]) -> dict[str, str]:
    """Return how every input was made."""
    made = dict.fromkeys(s for b in chosen for s in b.surveys)
    return {s.name: " ".join(["subiaco simulate", f"out/bench/{s.name}", *s.options]) for s in made}


if __name__ == "__main__":
    sys.exit(main())
