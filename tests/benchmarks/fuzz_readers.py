# ruff: noqa: T201
"""Fuzz every reader: damaged inputs may be refused, in one line that names the file, and nothing else.

    python tests/benchmarks/fuzz_readers.py --cases 20000 --seconds 60 --seed 1 [--only ply,las]

Each reader runs in a process of its own, so that a crash of native code is seen, under a limit of processor
time and memory a case (see tests/fuzz/fuzz_cases.py). Prints cases, accepted ones and faults; the exit status
is 1 where there was a fault. Counts and what failed are kept in the folder given, over several runs;
``--page docs/results/damaged-files.md`` writes the table of these, after every file that failed was read
once more.
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
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "fuzz"))

from fuzz_cases import CPU_SECONDS, MEMORY, Edit, Fault, Target, run
from fuzz_targets import TARGETS

_HANG = 120.0  # wall clock without a sign of life [s]
_SIGN = 5.0  # wall clock between two signs of life [s]


@dataclass(frozen=True)
class Tally:
    """What became of one reader in one run."""

    name: str
    seed: int
    cases: int
    accepted: int
    longest: float
    faults: int


def edits_of(rng: np.random.Generator) -> list[Edit]:
    """Draw one to five edits."""
    drawn = rng.integers(0, 2**31, (int(rng.integers(1, 6)), 3))
    return [(int(kind), int(where), int(what)) for kind, where, what in drawn]


def fresh(folder: Path) -> Path:
    """Return an empty folder to work in."""
    work = folder / "work"
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    return work


def whole_inputs(target: Target, folder: Path) -> list[bytes]:
    """Make and read the whole inputs of a target, which loads the libraries outside the bounds."""
    seeds = target.seeds(folder)
    for data in seeds:
        (folder / f"case{target.suffix}").write_bytes(data)
        target.read(folder / f"case{target.suffix}")
        if not run(target, data, folder):
            raise SystemExit(f"{target.name}: a whole input is refused")
    return seeds


def fuzz(target: Target, cases: int, seconds: float, seed: int, folder: Path) -> None:
    """Run cases of one reader; a line of JSON every few seconds, faults as they come."""
    work = fresh(folder)
    seeds = whole_inputs(target, work)
    rng = np.random.default_rng([seed, *target.name.encode()])
    accepted, longest = 0, 0.0
    end = time.monotonic() + seconds
    said = time.monotonic()
    for case in range(1, cases + 1):
        data = target.damage(seeds[case % len(seeds)], edits_of(rng))
        started = time.process_time()
        try:
            accepted += run(target, data, work)
        except Fault as fault:
            (folder / f"fault-{seed}-{case}{target.suffix}").write_bytes(data)
            print(json.dumps({"fault": str(fault), "case": case}), flush=True)
        longest = max(longest, time.process_time() - started)
        now = time.monotonic()
        if case == cases or now > end or now > said + _SIGN:
            said = now
            print(json.dumps({"cases": case, "accepted": accepted, "longest": longest}), flush=True)
        if now > end:
            return


def read_again(target: Target, folder: Path) -> None:
    """Read the cases that failed once more; a line of JSON each."""
    work = fresh(folder)
    whole_inputs(target, work)
    for path in sorted(folder.glob(f"fault-*{target.suffix}")):
        try:
            said = "accepted" if run(target, path.read_bytes(), work) else "refused"
        except Fault as fault:
            said = str(fault)
        print(json.dumps({"file": path.name, "said": said}), flush=True)


def watched(target: Target, options: argparse.Namespace, folder: Path) -> tuple[Tally, Counter[str]]:
    """Run :func:`fuzz` in a process; return the counts, and what faults were said how often."""
    command = [sys.executable, __file__, "--child", target.name, "--seconds", str(options.seconds)]
    command += ["--cases", str(options.cases), "--seed", str(options.seed), "--keep", str(folder)]
    died: list[str] = []
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=options.seconds + _HANG, check=False
        )
        out = done.stdout
        if done.returncode != 0:
            died = [f"the process ended with {done.returncode}: {done.stderr[-300:]}"]
    except subprocess.TimeoutExpired as error:
        out = (error.stdout or b"").decode(errors="replace")
        died = ["it hung in native code"]
    case = folder / "work" / f"case{target.suffix}"
    if died and case.is_file():
        shutil.copy(case, folder / f"fault-{options.seed}-died{target.suffix}")
    lines = [json.loads(line) for line in out.splitlines() if line.startswith("{")]
    faults = Counter([line["fault"] for line in lines if "fault" in line] + died)
    counted = [line for line in lines if "cases" in line]
    last = counted[-1] if counted else {"cases": 0, "accepted": 0, "longest": 0.0}
    counts = last["cases"], last["accepted"], last["longest"], faults.total()
    return Tally(target.name, options.seed, *counts), faults


_PAGE = """# Damaged files

Every reader of files that people exchange is given damaged ones: flipped bits, pieces that are cut or
doubled, numbers that no file holds, types that were swapped, columns that are missing. A reader may read
the file, or refuse it in one line that names it. Any other exception, more than {seconds:g} s of
processor time, or more than {memory} GiB of memory is a fault.

**{cases:,} cases (seeds {seeds}) found {faults} faults; of these files, {left} still fail.** The table adds
up the runs of `python tests/benchmarks/fuzz_readers.py --seconds S --seed N --keep DIR`, and
`--page docs/results/damaged-files.md --keep DIR` writes this page and `data/damaged-files.json` after it has
read every file that failed once more.
The tests run a short share of such cases, the same ones every time (`tests/fuzz`).

| reader | cases | read | refused | longest case [s CPU] | faults found | left |
| --- | ---: | ---: | ---: | ---: | ---: | ---: |
"""


def tallied(tallies: list[Tally], left: dict[str, int]) -> dict[str, Any]:
    """Return the data of the page: seeds, limits, and the sums of each reader over the runs.

    ``left`` counts the files of a reader that still fail.
    """
    rows = []
    for name in dict.fromkeys(target.name for target in TARGETS):
        own = [t for t in tallies if t.name == name]
        cases, accepted, faults = (sum(getattr(t, n) for t in own) for n in ("cases", "accepted", "faults"))
        longest = round(max((t.longest for t in own), default=0.0), 2)
        rows.append([name, cases, accepted, cases - accepted - faults, longest, faults, left.get(name, 0)])
    limits = {"seconds": CPU_SECONDS, "memory": MEMORY >> 30}
    return {**limits, "seeds": sorted({t.seed for t in tallies}), "readers": rows}


def page(found: dict[str, Any]) -> str:
    """Return the page of damaged files."""
    rows = found["readers"]
    cases, faults, left = (sum(row[i] for row in rows) for i in (1, 5, 6))
    seeds = ", ".join(map(str, found["seeds"]))
    head = _PAGE.format(
        seconds=found["seconds"], memory=found["memory"], cases=cases, faults=faults, left=left, seeds=seeds
    )
    return head + "".join(
        f"| {name} | {cases:,} | {read:,} | {refused:,} | {longest:.2f} | {faults} | {left} |\n"
        for name, cases, read, refused, longest, faults, left in rows
    )


def still_failing(target: Target, folder: Path) -> int:
    """Return how many of the kept cases of a reader still fail, each read in a process of its own."""
    if not any(folder.glob("fault-*")):
        return 0
    command = [sys.executable, __file__, "--child", target.name, "--again", "--keep", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    said = [json.loads(line)["said"] for line in done.stdout.splitlines() if line.startswith("{")]
    kept = len(list(folder.glob("fault-*")))
    return kept - sum(one in ("accepted", "refused") for one in said)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--cases", type=int, default=10**9, help="most cases a reader")
    parser.add_argument("--seconds", type=float, default=20.0, help="most seconds a reader")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="readers, separated by commas")
    parser.add_argument("--keep", type=Path, help="folder for counts and for what failed, over several runs")
    parser.add_argument("--page", type=Path, help="write the table of the runs kept, and run none")
    parser.add_argument("--again", action="store_true", help="read what failed once more, and run none")
    parser.add_argument("--child", default="", help=argparse.SUPPRESS)
    return parser.parse_args()


def main() -> None:
    """Fuzz the readers asked for, one after another; or write the table of the runs so far."""
    options = _options()
    named = {target.name: target for target in TARGETS}
    if options.child and options.again:
        read_again(named[options.child], options.keep)
        return
    if options.child:
        fuzz(named[options.child], options.cases, options.seconds, options.seed, options.keep)
        return
    root = options.keep or Path(tempfile.mkdtemp(prefix="fuzz-"))
    folders = {name: root / name.replace(" ", "-").replace("/", "-") for name in named}
    counts = root / "counts.jsonl"
    if options.page is not None or options.again:
        left = {name: still_failing(target, folders[name]) for name, target in named.items()}
        print({name: number for name, number in left.items() if number} or "nothing that failed fails still")
        if options.page is not None:
            tallies = [Tally(**json.loads(line)) for line in counts.read_text().splitlines()]
            found = tallied(tallies, left)
            data = options.page.parent / "data" / f"{options.page.stem}.json"
            data.write_text(json.dumps(found, indent=1), encoding="utf-8")
            options.page.write_text(page(found), encoding="utf-8")
        sys.exit(any(left.values()))
    cases = faults = 0
    for name in [name for name in options.only.split(",") if name] or list(named):
        folders[name].mkdir(parents=True, exist_ok=True)
        tally, said = watched(named[name], options, folders[name])
        with counts.open("a") as stream:
            stream.write(json.dumps(asdict(tally)) + "\n")
        cases, faults = cases + tally.cases, faults + tally.faults
        figures = f"{tally.cases:7d} cases {tally.accepted:7d} accepted  longest {tally.longest:5.2f} s CPU"
        print(f"{name:28s} {figures}  {tally.faults} faults", flush=True)
        for fault, times in said.most_common(8):
            print(f"    {times:5d} x {fault}", flush=True)
    print(f"{cases} cases, {faults} faults, seed {options.seed}")
    if options.keep is None:
        shutil.rmtree(root, ignore_errors=True)
    sys.exit(faults > 0)


if __name__ == "__main__":
    main()
