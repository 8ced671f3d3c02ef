# ruff: noqa: T201
"""Fuzz every reader for a stated time: damaged inputs may be refused, in one line, and nothing else.

    python tests/benchmarks/fuzz_readers.py --seconds 20 --seed 1 [--only ply,las] [--keep FOLDER]

Each reader runs in a process of its own, so that a crash of native code is seen, under a limit of processor
time and memory a case (see tests/fuzz/fuzz_targets.py). Prints cases, accepted ones and faults; the exit
status is 1 where there was a fault. What failed is kept in the folder given.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "fuzz"))

from fuzz_targets import TARGETS, Fault, Target, damaged, run

_HANG = 120.0  # wall clock without a sign of life [s]


def edits_of(rng: np.random.Generator) -> list[tuple[int, int, int]]:
    """Draw one to five edits."""
    drawn = rng.integers(0, 2**31, (int(rng.integers(1, 6)), 3))
    return [(int(kind), int(where), int(what)) for kind, where, what in drawn]


def fuzz(target: Target, seconds: float, seed: int, folder: Path) -> None:
    """Run cases of one reader; a line of JSON at the end, faults as they come."""
    seeds = target.seeds(folder)
    for data in seeds:
        (folder / f"case{target.suffix}").write_bytes(data)
        target.read(folder / f"case{target.suffix}")  # libraries are loaded outside the bounds
        if not run(target, data, folder):
            raise SystemExit(f"{target.name}: a whole input is refused")
    rng = np.random.default_rng([seed, *target.name.encode()])
    cases = accepted = 0
    longest = 0.0
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        data = damaged(seeds[cases % len(seeds)], edits_of(rng))
        cases += 1
        started = time.process_time()
        try:
            accepted += run(target, data, folder)
        except Fault as fault:
            (folder / f"fault-{cases}{target.suffix}").write_bytes(data)
            print(json.dumps({"fault": str(fault), "case": cases}), flush=True)
        longest = max(longest, time.process_time() - started)
    print(json.dumps({"cases": cases, "accepted": accepted, "longest": round(longest, 2)}), flush=True)


def watched(target: Target, seconds: float, seed: int, folder: Path) -> tuple[dict[str, float], Counter[str]]:
    """Run :func:`fuzz` in a process; return its figures and the faults with their number."""
    command = [sys.executable, __file__, "--child", target.name, "--seconds", str(seconds)]
    command += ["--seed", str(seed), "--keep", str(folder)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=seconds + _HANG, check=False)
        lines = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
        died = (
            []
            if done.returncode == 0
            else [f"the process ended with {done.returncode}: {done.stderr[-300:]}"]
        )
    except subprocess.TimeoutExpired:
        lines, died = [], ["it hung in native code"]
    faults = Counter([line["fault"] for line in lines if "fault" in line] + died)
    figures = next((line for line in lines if "cases" in line), {"cases": 0, "accepted": 0, "longest": 0.0})
    return figures, faults


def main() -> None:
    """Fuzz the readers asked for, one after another."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seconds", type=float, default=20.0, help="a reader")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="readers, separated by commas")
    parser.add_argument("--keep", type=Path, help="folder for what failed")
    parser.add_argument("--child", default="", help=argparse.SUPPRESS)
    options = parser.parse_args()
    named = {target.name: target for target in TARGETS}
    if options.child:
        fuzz(named[options.child], options.seconds, options.seed, options.keep)
        return
    wanted = [name for name in options.only.split(",") if name] or list(named)
    root = options.keep or Path(tempfile.mkdtemp(prefix="fuzz-"))
    total, failed, started = 0, 0, time.monotonic()
    for name in wanted:
        folder = root / name.replace(" ", "-")
        folder.mkdir(parents=True, exist_ok=True)
        figures, faults = watched(named[name], options.seconds, options.seed, folder)
        total, failed = total + int(figures["cases"]), failed + sum(faults.values())
        said = f"{figures['cases']:7d} cases {figures['accepted']:7d} accepted"
        print(f"{name:16s} {said}  longest {figures['longest']:5.2f} s CPU  {sum(faults.values())} faults")
        for fault, times in faults.most_common(8):
            print(f"    {times:5d} x {fault}", flush=True)
    print(f"{total} cases, {failed} faults, {time.monotonic() - started:.0f} s, seed {options.seed}")
    if options.keep is None:
        shutil.rmtree(root, ignore_errors=True)
    sys.exit(failed > 0)


if __name__ == "__main__":
    main()
