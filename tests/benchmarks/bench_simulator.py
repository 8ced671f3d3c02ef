# ruff: noqa: T201
"""Time and memory of the simulator: scene, drive and truth apart, per second that is driven.

    python tests/benchmarks/bench_simulator.py --preset default --duration 10 --mode 1024x10

Each preset runs in a process of its own, so that peak memory is its own. "real time" is seconds driven
over seconds taken by the drive alone (rays, noise, packets, bag), once by the clock on the wall and once by
CPU time spread over two cores; on a machine that does other work only the second says anything.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from results import keep, rounded

from subiaco_sim.config import SimulationConfig
from subiaco_sim.survey import simulate

CORES = 2


@dataclass
class TaskCost:
    """Seconds by the wall clock and of the CPU in one stage."""

    wall: float = 0.0
    cpu: float = 0.0


class StageClock:
    """Adds up what every stage takes, as the progress is told."""

    def __init__(self) -> None:
        self.spent: dict[str, TaskCost] = {}
        self._stage, self._wall, self._cpu = "imports", time.perf_counter(), time.process_time()

    def __call__(self, stage: str, _share: float) -> None:
        """Charge the time since the last call to the stage that was under way then."""
        wall, cpu = time.perf_counter(), time.process_time()
        entry = self.spent.setdefault(self._stage, TaskCost())
        entry.wall += wall - self._wall
        entry.cpu += cpu - self._cpu
        self._stage, self._wall, self._cpu = stage, wall, cpu


def measure(config: SimulationConfig) -> dict[str, object]:
    """Simulate one epoch and print what it took."""
    with tempfile.TemporaryDirectory() as folder:
        stages = StageClock()
        simulate(Path(folder) / "survey", config, stages)
        stages("end", 1.0)
        size = sum(f.stat().st_size for f in Path(folder).rglob("*") if f.is_file()) / 1e6
    driven = float(config.duration or 0.0)
    drive = stages.spent[config.epoch.value]
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    for name, spent in stages.spent.items():
        print(f"  {name:14} {spent.wall:7.1f} s wall  {spent.cpu:7.1f} s CPU")
    print(f"  drive: real time factor {driven / drive.wall:.2f} wall, {CORES * driven / drive.cpu:.2f} CPU")
    print(f"  peak memory {peak:.0f} MB, {size:.0f} MB written, {driven:g} s driven, {config.mode.value}")
    return {
        "preset": config.preset,
        "scene, CPU s": rounded(sum(s.cpu for name, s in stages.spent.items() if name == "scene")),
        "drive, CPU s a second": rounded(drive.cpu / driven),
        "times real time, wall": rounded(driven / drive.wall),
        f"times real time, CPU over {CORES} cores": rounded(CORES * driven / drive.cpu),
        "peak MB": round(peak),
    }


def main() -> None:
    """Measure the presets that are asked for, each in its own process."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--preset", nargs="+", default=["easy", "default", "hard"])
    parser.add_argument("--duration", type=float, default=10.0, help="of the drive [s]")
    parser.add_argument("--mode", default="1024x10")
    parser.add_argument("--maps-only", action="store_true")
    parser.add_argument("--json", type=Path, help="leave the rows there, for bench.py")
    options = parser.parse_args()
    if len(options.preset) > 1:
        for preset in options.preset:
            rest = ["--duration", str(options.duration), "--mode", options.mode]
            rest += ["--maps-only"] if options.maps_only else []
            subprocess.run([sys.executable, __file__, "--preset", preset, *rest], check=True)
        return
    config = SimulationConfig(
        preset=options.preset[0],
        seed=101,
        epoch="after",
        duration=options.duration,
        mode=options.mode,
        maps_only=options.maps_only,
    )
    print(f"{config.preset}{' (maps only)' if config.maps_only else ''}", flush=True)
    keep(options.json, [measure(config)], {}, [f"{config.duration:g} s of {config.mode.value}, epoch after"])


if __name__ == "__main__":
    main()
