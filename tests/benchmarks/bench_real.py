# ruff: noqa: T201
"""Every benchmark on real recordings by one command, and their tables on one page.

    source ros2_ws/env.sh
    python tests/benchmarks/bench_real.py $SUBIACO_TEST_DATA -o out/real --page docs/results/real-tables.md
    python tests/benchmarks/bench_real.py $SUBIACO_TEST_DATA -o out/real --only airborne objects

Each part is a program of its own and runs in a process of its own; what it printed stays in the output
folder. The page names the day, the revision and the seed. A part whose recordings are absent, or that fails,
is named on the page, and the exit code is 1.
"""

from __future__ import annotations

import argparse
import datetime as dt
import itertools
import os
import resource
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

FOLDER = Path(__file__).parent


@dataclass(frozen=True)
class Part:
    """One benchmark: what it shows, its program, its recordings, and its words."""

    title: str
    program: str
    recordings: tuple[str, ...]
    words: tuple[str, ...] = ()
    seeded: bool = False


#: ``DATA`` and ``OUT`` stand for the folders of recordings and of output.
PARTS = {
    "drive": Part(
        "A drive with fixes, with fixes withheld, and without; clock and rotation of the rig",
        "bench_kitti_drive.py", ("kitti_drive_0027", "kitti_scans"), ("DATA", "--json", "OUT/drive.json"),
    ),
    "static": Part(
        "Maps of one drive in which nothing but traffic changed: every claim is false",
        "bench_static_pairs.py", ("kitti_scans",), ("DATA", "-o", "OUT/static"),
    ),
    "objects": Part(
        "Objects of DALES put into that drive beam by beam, and taken out",
        "bench_real_objects.py", ("kitti_scans", "dales_objects"), ("DATA", "-o", "OUT/static"), True,
    ),
    "site": Part(
        "A building site, seen twice, against objects drawn by eye",
        "bench_real_site.py", ("real_pair_site",), ("DATA",),
    ),
    "airborne": Part(
        "Airborne clouds against themselves: shifted, thinned, objects removed",
        "bench_airborne.py", ("autzen", "ign_lidarhd"), ("DATA",), True,
    ),
    "semantics": Part(
        "Classes on pieces of a real street that were never looked at",
        "bench_semantics.py", ("oakland_mls",), ("oakland-report",),
    ),
    "registration": Part(
        "Registration at its defaults, clouds of every density",
        "bench_real_registration.py", ("autzen", "oakland_mls", "isprs_filter"), ("pairs",),
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Outcome:
    """What a part printed, and CPU seconds; or why there is nothing."""

    part: Part
    text: str
    seconds: float
    failed: str = ""

    def section(self) -> str:
        """Return the part of the page: tables, and lines that follow a table."""
        head = f"## {self.part.title}\n\n`{self.part.program}`, {self.seconds:.0f} CPU s.\n\n"
        return head + (f"**{self.failed}**" if self.failed else tables(self.text)) + "\n"


def tables(text: str) -> str:
    """Return the tables of a text: a head, a rule, and rows; rows without a head are left out."""
    lines = [line.rstrip() for line in text.splitlines()]
    found = []
    for at, line in enumerate(lines):
        if at and line.startswith("|") and "-" in line and set(line) <= set("|-: "):
            rows = itertools.takewhile(lambda row: row.startswith("|"), lines[at + 1 :])
            found.append("\n".join([lines[at - 1], line, *rows]))
    return "\n\n".join(found)


def run_part(name: str, data: Path, output: Path, seed: int) -> Outcome:
    """Run one benchmark."""
    part = PARTS[name]
    missing = [folder for folder in part.recordings if not (data / folder).exists()]
    if missing:
        return Outcome(part, "", 0.0, f"Not run: {', '.join(missing)} is not in {data.name}.")
    places = {"DATA": str(data), "OUT": str(output)}
    words = ["/".join(places.get(piece, piece) for piece in word.split("/", 1)) for word in part.words]
    words += ["--seed", str(seed)] if part.seeded else []
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        [sys.executable, str(FOLDER / part.program), *words],
        env={**os.environ, "SUBIACO_TEST_DATA": str(data)}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    (output / f"{name}.txt").write_text(done.stdout + done.stderr, encoding="utf-8")
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    last = (done.stderr.strip().splitlines() or ["no words"])[-1]
    failed = f"Failed with {done.returncode}: {last}" if done.returncode else ""
    return Outcome(part, done.stdout, seconds, failed)


def revision() -> str:
    """Return the revision of the sources, with a plus where they differ from it."""
    words = ["git", "-C", str(FOLDER), "describe", "--always", "--dirty=+"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    return done.stdout.strip() or "unknown"


def main() -> None:
    """Run the parts and write the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("data", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--page", type=Path, help="Markdown page; OUTPUT/real.md by default")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    given.output.mkdir(parents=True, exist_ok=True)
    outcomes = []
    for name in given.only:
        outcomes.append(run_part(name, given.data.resolve(), given.output.resolve(), given.seed))
        print(outcomes[-1].section(), flush=True)
    day = dt.datetime.now(dt.UTC).date().isoformat()
    head = "# Real recordings: every table\n\n"
    head += (
        f"Made by `tests/benchmarks/bench_real.py` on {day}, revision `{revision()}`, seed {given.seed}.\n"
    )
    head += "What the recordings are and how to read the tables: [real-data.md](real-data.md).\n\n"
    page = given.page or given.output / "real.md"
    page.write_text(head + "\n".join(o.section() for o in outcomes), encoding="utf-8")
    print(f"{page}: written")
    sys.exit(any(o.failed for o in outcomes))


if __name__ == "__main__":
    main()
