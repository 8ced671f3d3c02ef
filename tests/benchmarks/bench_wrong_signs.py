# ruff: noqa: T201
"""Extensions and storeys of randomly drawn houses: how many are found, and whether one has the wrong sign.

    python tests/benchmarks/bench_wrong_signs.py --houses 500 --json signs.json

Every house is surveyed twice by drives of their own, with 15 to 60 % of its volume built or taken away in
between, and compared with every kind of evidence. *Seen* are changes of which the survey without the
extension saw through half, and the survey with it met 70 % of length and width.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "change"))

from random_houses import KINDS, OPPOSITE, compare, draw_case, label_of, labels, seen_from_street

from subiaco_geo.codes import Change


def judge(found: list[Change], house: Change, truth: Change) -> str:
    """Name the outcome: wrong, right or quiet."""
    if set(found) & set(OPPOSITE[truth]):
        return "wrong"
    return "right" if house is truth else "quiet"


def run(houses: int, first: int, kinds: tuple[str, ...]) -> dict[str, Counter[str]]:
    """Count outcomes by kind of evidence, ``seen`` or ``hidden`` before the outcome."""
    counts: dict[str, Counter[str]] = {kind: Counter() for kind in kinds}
    for seed in range(first, first + houses):
        case = draw_case(seed)
        small, large = case.surveys
        place = "seen" if seen_from_street(case) else "hidden"
        grown = seed % 2 == 0
        truth = Change.INCREASED if grown else Change.DECREASED
        for kind in kinds:
            rows = compare(small, large, kind) if grown else compare(large, small, kind)
            outcome = judge(labels(rows), label_of(rows), truth)
            counts[kind][f"{place} {outcome}"] += 1
            counts[kind][f"{case.what}: {place} {outcome}"] += 1
            if outcome == "wrong":
                print(f"seed {seed}, {kind}: {case.what}, {[c.label for c in labels(rows)]}", flush=True)
    return counts


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--houses", type=int, default=500)
    parser.add_argument("--first", type=int, default=1000, help="first seed")
    parser.add_argument("--kinds", nargs="+", default=list(KINDS))
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    counts = run(options.houses, options.first, tuple(options.kinds))
    print("| evidence | houses | seen | found of seen | wrong sign |\n|---|---|---|---|---|")
    for kind, count in counts.items():
        seen = sum(count[f"seen {outcome}"] for outcome in ("right", "quiet", "wrong"))
        wrong = count["seen wrong"] + count["hidden wrong"]
        print(f"| {kind} | {options.houses} | {seen} | {count['seen right']} | {wrong} |")
    if options.json is not None:
        options.json.write_text(json.dumps({k: dict(sorted(v.items())) for k, v in counts.items()}, indent=1))


if __name__ == "__main__":
    main()
