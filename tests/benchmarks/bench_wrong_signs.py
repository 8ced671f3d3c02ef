# ruff: noqa: T201
"""Extensions and storeys of randomly drawn houses: how many are found, and whether one has the wrong sign.

    python tests/benchmarks/bench_wrong_signs.py --houses 500 --log signs.jsonl

``--log`` keeps one line of JSON a house and kind of evidence; started again with the same file, the run goes
on after the last line. Every house is surveyed twice by drives of their own, with 10 to 60 % of its volume
built (even seeds) or taken away (odd seeds) in between, and compared with every kind of evidence. *Seen* are
changes of which the survey without the extension saw through half, and the survey with it met 70 % of length
and width. The second table counts those that are found of those seen, by event and share of the volume.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "change"))

from random_houses import (
    BUILT,
    KINDS,
    OPPOSITE,
    Case,
    compare,
    draw_case,
    label_of,
    labels,
    seen_from_street,
    volume,
)

from subiaco_geo.codes import Change

LEAST = 0.10
EVENTS = {"storey": "storey", "roof": "roof", "side": "wing", "front": "wing", "corner": "wing"}
ENDS = {"storey": ("taken away", "built"), "roof": ("lowered", "raised"), "wing": ("taken away", "built")}
SIZES = ((0.10, 0.15), (0.15, 0.25), (0.25, 0.61))


def judge(found: list[Change], house: Change, truth: Change) -> str:
    """Name the outcome: wrong, right or quiet."""
    if set(found) & set(OPPOSITE[truth]):
        return "wrong"
    return "right" if house is truth else "quiet"


def outcomes(houses: int, first: int, kinds: Sequence[str], log: Path | None) -> list[dict[str, Any]]:
    """Return one record a house and kind of evidence, those of an earlier run from its log."""
    known = read_log(log)
    for seed in range(first, first + houses):
        missing = [kind for kind in kinds if (seed, kind) not in known]
        if not missing:
            continue
        case = draw_case(seed, kinds=(*BUILT, "roof"), least=LEAST)
        for kind in missing:
            known[seed, kind] = _outcome(case, seed, kind)
            if log is not None:
                with log.open("a", encoding="utf-8") as out:
                    out.write(json.dumps(known[seed, kind]) + "\n")
    return [known[seed, kind] for seed in range(first, first + houses) for kind in kinds]


def read_log(log: Path | None) -> dict[tuple[int, str], dict[str, Any]]:
    """Return what a log holds, by seed and kind of evidence; a line that was cut off is left out."""
    if log is None or not log.is_file():
        return {}
    found = {}
    for line in log.read_text(encoding="utf-8").splitlines():
        with contextlib.suppress(json.JSONDecodeError):
            record = json.loads(line)
            found[record["seed"], record["evidence"]] = record
    return found


def _outcome(case: Case, seed: int, kind: str) -> dict[str, Any]:
    """Compare the surveys of one house under one kind of evidence."""
    small, large = case.surveys
    grown = seed % 2 == 0
    truth = Change.INCREASED if grown else Change.DECREASED
    rows = compare(small, large, kind) if grown else compare(large, small, kind)
    return {
        "seed": seed,
        "evidence": kind,
        "what": case.what,
        "built": grown,
        "share": round(volume(case.large.house) / volume(case.small.house) - 1, 3),
        "seen": bool(seen_from_street(case)),
        "outcome": judge(labels(rows), label_of(rows), truth),
        "labels": [change.label for change in labels(rows)],
    }


def table(records: Sequence[dict[str, Any]], kinds: Sequence[str]) -> str:
    """Return the table of found and wrong signs by kind of evidence."""
    lines = ["| evidence | houses | seen | found of seen | claimed of hidden | wrong sign |"]
    lines.append("|---|---|---|---|---|---|")
    for kind in kinds:
        own = [record for record in records if record["evidence"] == kind]
        count = Counter((record["seen"], record["outcome"]) for record in own)
        seen = sum(record["seen"] for record in own)
        wrong = count[True, "wrong"] + count[False, "wrong"]
        row = (kind, len(own), seen, count[True, "right"], count[False, "right"], wrong)
        lines.append("| " + " | ".join(map(str, row)) + " |")
    return "\n".join(lines)


def table_of_events(records: Sequence[dict[str, Any]], kinds: Sequence[str]) -> str:
    """Return the table of changes found of those seen, by event and share of the volume."""
    lines = ["| event | share of the volume | " + " | ".join(kinds) + " |", "|---|---|" + "---|" * len(kinds)]
    seen = [record for record in records if record["seen"]]
    for event in dict.fromkeys(EVENTS.values()):
        for built in (True, False):
            for low, high in SIZES:
                cells = []
                for kind in kinds:
                    own = [
                        record["outcome"]
                        for record in seen
                        if EVENTS[record["what"]] == event
                        and record["built"] == built
                        and low <= record["share"] < high
                        and record["evidence"] == kind
                    ]
                    cells.append(f"{own.count('right')} of {len(own)}")
                name = f"{event} {ENDS[event][built]}"
                lines.append(f"| {name} | {low:.0%} to {high:.0%} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--houses", type=int, default=500)
    parser.add_argument("--first", type=int, default=1000, help="first seed")
    parser.add_argument("--kinds", nargs="+", default=list(KINDS))
    parser.add_argument("--log", type=Path)
    parser.add_argument("--table", action="store_true", help="print the table of the log, run nothing")
    options = parser.parse_args()
    if options.table:
        records = list(read_log(options.log).values())
    else:
        records = outcomes(options.houses, options.first, options.kinds, options.log)
    print(table(records, options.kinds))
    print(table_of_events(records, options.kinds))
    for record in records:
        if record["outcome"] == "wrong":
            print(f"seed {record['seed']}, {record['evidence']}: {record['what']}, {record['labels']}")


if __name__ == "__main__":
    main()
