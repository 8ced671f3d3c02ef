# ruff: noqa: T201
"""A real building site seen twice (``real_pair_site``), scored against what was drawn by eye.

    python tests/benchmarks/bench_real_site.py DATA

``tests/data/real_pair_site_truth.json`` holds our polygons: an object, its heights, the labels that are right
and why. An object is right when at least half of its points carry one of these labels, in the epoch that
shows it. A claim that touches no polygon of a change is listed as a false one.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely

from subiaco_change.config import ChangeConfig
from subiaco_change.pipeline import detect_changes
from subiaco_change.records import ChangeRecord, ChangeResult
from subiaco_geo.cloud_io import read_cloud
from subiaco_geo.codes import Change
from subiaco_geo.frames import Floats
from subiaco_geo.survey_map import SurveyMap

TRUTH = Path(__file__).parents[1] / "data" / "real_pair_site_truth.json"
CLAIMS = (Change.ADDED, Change.REMOVED, Change.INCREASED, Change.DECREASED)


@dataclass(frozen=True)
class Drawn:
    """An object drawn by eye: where, between which heights [m], in which epoch, and what is right."""

    name: str
    outline: shapely.Polygon
    heights: tuple[float, float]
    epoch: str
    labels: tuple[str, ...]
    reason: str

    def labels_of(self, result: ChangeResult) -> Floats:
        """Return the codes of change of its points."""
        cloud = result.before if self.epoch == "before" else result.after
        world = cloud.world()
        inside = shapely.contains_xy(self.outline, world[:, 0], world[:, 1])
        inside &= (world[:, 2] >= self.heights[0]) & (world[:, 2] <= self.heights[1])
        return np.asarray(cloud.fields["change"][inside])


def read_truth(path: Path = TRUTH) -> list[Drawn]:
    """Read what was drawn."""
    return [
        Drawn(
            item["name"],
            shapely.MultiLineString(item["lines"]).buffer(item["width"] / 2)
            if "lines" in item
            else shapely.Polygon(item["polygon"]),
            tuple(item["heights"]),
            item["epoch"],
            tuple(item["labels"]),
            item["reason"],
        )
        for item in json.loads(path.read_text(encoding="utf-8"))["objects"]
    ]


def read_site(data: Path, epoch: int) -> SurveyMap:
    """Read an epoch of the site, a bare cloud."""
    name = f"bike_parking_construction_{epoch}.ply"
    return SurveyMap(read_cloud(data / "real_pair_site" / name))


def score(
    result: ChangeResult, truth: list[Drawn]
) -> tuple[list[tuple[Drawn, str, float]], list[ChangeRecord]]:
    """Return every object with its commonest label and the share that is right, and the false claims."""
    found = []
    for item in truth:
        codes = item.labels_of(result)
        right = np.isin(codes, [change for change in Change if change.label in item.labels])
        common = Change(int(np.bincount(codes).argmax())).label if len(codes) else "no points"
        found.append((item, common, float(right.mean()) if len(codes) else 0.0))
    changed = {change.label for change in CLAIMS}
    known = shapely.union_all([t.outline.buffer(0.3) for t in truth if changed & set(t.labels)])
    return found, [r for r in result.records if r.change in CLAIMS and not r.footprint.intersects(known)]


def main() -> None:
    """Compare the two epochs as they are and print the score."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("data", type=Path)
    parser.add_argument("--identity", action="store_true", help="take the epochs as registered")
    words = parser.parse_args()
    transform = np.eye(4) if words.identity else None
    epochs = read_site(words.data, 0), read_site(words.data, 1)
    result = detect_changes(*epochs, ChangeConfig(), transform=transform)
    found, wrong = score(result, read_truth())
    print("| object | drawn as | common label | share | |\n|---|---|---|---|---|")
    for item, common, share in found:
        mark = "right" if share >= 0.5 else "wrong"
        print(f"| {item.name} | {' or '.join(item.labels)} | {common} | {share:.2f} | {mark} |")
    print(f"| all | {len(found)} | | | {sum(s >= 0.5 for *_, s in found)} right, {len(wrong)} false claims |")
    for r in wrong:
        print(
            f"false {r.semantic.label} {r.change.label} {r.confidence:.2f} at {r.x:.1f} {r.y:.1f}: {r.reason}"
        )


if __name__ == "__main__":
    main()
