# ruff: noqa: T201
"""Traffic in view of the sensor: ghost trails that are claimed as changes, and objects that pass for trails.

    source ros2_ws/env.sh
    python tests/benchmarks/bench_traffic.py -o out/traffic --minutes 10

Every survey is a street of the preset ``easy`` in which no object changes, driven twice for 20 s of traffic,
written as bags and mapped by ``subiaco map``, because only mapping keeps the times of beams. Three kinds of
traffic: cars and vans that flow, a queue that crawls (0 to 3 m/s, stop and go), and a queue that stands while
the survey vehicle passes and then leaves. A claim is a trail if most of its points are those of traffic. A
standing object of 50 points or more is left out if most of its points are in no object and count as moving.
One line of JSON a survey is kept in OUTPUT/traffic.jsonl; started again, the run goes on after the last line.
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

import subiaco_sim.drives
from subiaco_bringup.cli.main import run
from subiaco_evaluation.scoring import in_after_frame, read_prediction, read_truth
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.frames import Floats
from subiaco_sim.config import LidarMode, SimulationConfig
from subiaco_sim.furniture import Truck
from subiaco_sim.presets import build_scene
from subiaco_sim.scene import EPOCHS, Scene, Shape
from subiaco_sim.suburb import random_car
from subiaco_sim.survey import simulate

KINDS = ("flow", "crawl", "stand")
SECONDS = 20.0  # of each drive
REPORTED = (Change.ADDED, Change.REMOVED, Change.INCREASED, Change.DECREASED)
_NEAR = 0.3  # distance within which a point of the map is one of the truth [m]
_LEAST = 50  # points of an object that must not pass for a trail


@dataclass(frozen=True)
class Vehicle:
    """A vehicle on the route: ``stations`` (K,) [m] at ``times`` (K,) [s], ``offset`` to the left [m]."""

    object_id: int
    shape: Shape
    epoch: str
    times: Floats
    stations: Floats
    offset: float
    radius: float = 4.5

    def at(self, route: Floats, seconds: float) -> tuple[float, float, float]:
        """Return x, y [m] and heading [rad]; it goes round when it comes to the end."""
        spacing = float(np.linalg.norm(route[1] - route[0]))
        station = float(np.interp(seconds, self.times, self.stations))
        k = int(station / spacing) % (len(route) - 2)
        step = route[k + 1] - route[k]
        heading = float(np.arctan2(step[1], step[0]))
        x, y = route[k] + self.offset * np.array([-np.sin(heading), np.cos(heading)])
        return float(x), float(y), heading if self.stations[-1] >= self.stations[0] else heading + np.pi


def traffic(kind: str, scene: Scene, first: int, rng: np.random.Generator) -> tuple[Vehicle, ...]:
    """Draw the traffic of both epochs, a vehicle each 25 m, or bumper to bumper in a queue."""
    length = 0.25 * len(scene.route)
    made: list[Vehicle] = []
    times = np.arange(0.0, SECONDS + 1.0, 0.5)
    for epoch in EPOCHS:
        way = -1.0 if epoch == "before" else 1.0  # against the survey vehicle, which turns round
        queue = 0.2 * length + np.cumsum(rng.uniform(7.0, 11.0, 12))
        starts = rng.uniform(0, length, round(length / 25)) if kind == "flow" else queue
        for start in starts:
            shape = Truck() if rng.random() < 0.25 else random_car(rng)
            stations = start + way * np.concatenate([[0.0], np.cumsum(_steps(kind, len(times) - 1, rng))])
            side = way * 1.75 if kind != "flow" or rng.random() < 0.75 else -way * 1.75
            course = stations if side == way * 1.75 else 2 * start - stations
            made.append(Vehicle(first + len(made), shape, epoch, times, course + length, side))
    return tuple(made)


def _steps(kind: str, count: int, rng: np.random.Generator) -> Floats:
    """Return how far (count,) a vehicle goes in each half second [m]."""
    if kind == "flow":
        return np.full(count, 0.5 * rng.uniform(5.0, 11.0))
    if kind == "crawl":
        phase = rng.uniform(0, 2 * np.pi)
        speed = 3.0 * np.clip(np.sin(2 * np.pi * np.arange(count) * 0.5 / 8.0 + phase), 0.0, 1.0)
        return np.asarray(0.5 * speed)
    leaves = rng.uniform(0.6, 0.8) * count
    return np.where(np.arange(count) < leaves, 0.0, 0.5 * 5.0)


def simulate_traffic(folder: Path, kind: str, seed: int) -> list[int]:
    """Write both drives of one survey as bags; return the object ids of its traffic."""
    numbers: list[int] = []

    def built(*words: Any) -> Scene:
        scene = build_scene(*words)
        items = tuple(
            replace(item, before=item.before or item.after, after=item.before or item.after, event="")
            for item in scene.items
        )
        first = 1 + max(item.object_id for item in items)
        movers = traffic(kind, scene, first, np.random.default_rng([seed, KINDS.index(kind)]))
        numbers[:] = [mover.object_id for mover in movers]
        return replace(scene, items=items, ground_items=(), moving=movers)

    sensor = {"mode": LidarMode.COLUMNS_512, "beams_before": 64, "beams_after": 64}
    config = SimulationConfig.model_validate({"preset": "easy", "seed": seed, "duration": SECONDS, **sensor})
    with mock.patch.object(subiaco_sim.drives, "build_scene", built):
        simulate(folder, config)
    return numbers


def score(folder: Path, result: Path, movers: Sequence[int]) -> dict[str, Any]:
    """List claims of trails and of other objects, and standing objects that pass for trails."""
    truth = read_truth(folder)
    real, found = in_after_frame(truth), read_prediction(result, truth)
    if found.table is None:
        raise SystemExit(f"{result}: no change table")
    claimed = found.table[found.table["label"].isin([change.label for change in REPORTED])]
    of_traffic: dict[int, list[NDArray[np.bool_]]] = {}
    left_out, standing = [], 0
    for epoch in EPOCHS:
        cloud, points = getattr(found, epoch), real[epoch]
        own = cloud.world()
        distance, slot = cKDTree(points.world()).query(own, distance_upper_bound=_NEAR)
        known = np.isfinite(distance)
        number = np.full(len(own), -1)
        number[known] = np.asarray(points.fields["object"])[slot[known]]
        moving = np.isin(number, movers)
        instance = np.asarray(cloud.fields["instance"])
        for row in np.unique(instance[instance >= 0]):
            of_traffic.setdefault(int(row), []).append(moving[instance == row])
        loose = (np.asarray(cloud.fields["semantic"]) == Semantic.MOBILE) & (instance < 0)
        ids, counts = np.unique(number[(number > 0) & ~moving], return_counts=True)
        for thing in ids[counts >= _LEAST]:
            standing += 1
            if loose[number == thing].mean() > 0.5:
                left_out.append([epoch, int(thing), int(np.count_nonzero(number == thing))])
    trails, others = [], []
    for row in claimed.to_dict("records"):
        share = float(np.concatenate(of_traffic.get(int(row["object_id"]), [np.zeros(1)])).mean())
        claim = [row["label"], row["class"], round(float(row["confidence"]), 3), row["reason"]]
        (trails if share > 0.5 else others).append(claim)
    return {"trails": trails, "others": others, "standing": standing, "left_out": left_out}


def one_survey(work: Path, kind: str, seed: int) -> dict[str, Any]:
    """Simulate, map, compare and score one survey; the bags and maps are not kept."""
    folder = work / f"{kind}_{seed}"
    shutil.rmtree(folder, ignore_errors=True)
    movers = simulate_traffic(folder, kind, seed)
    for epoch in EPOCHS:
        _do(["map", str(folder / epoch), "-o", str(folder / f"map_{epoch}"), "-q"])
    maps = [str(folder / f"map_{epoch}") for epoch in EPOCHS]
    _do(["change", *maps, "-o", str(folder / "change"), "-q"])
    found = score(folder, folder / "change", movers)
    shutil.rmtree(folder)
    return {"kind": kind, "seed": seed, "seconds": 2 * SECONDS, **found}


def _do(words: list[str]) -> None:
    if run(words) != 0:
        raise SystemExit(f"subiaco {' '.join(words)} failed")


def table(records: Sequence[dict[str, Any]]) -> str:
    """Return the table of claims by kind of traffic."""
    lines = [
        "| traffic | surveys | minutes | trails claimed | > 0.5 | other claims | > 0.5 | standing | left |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for kind in KINDS:
        own = [record for record in records if record["kind"] == kind]
        cells: list[object] = [kind, len(own), round(sum(r["seconds"] for r in own) / 60, 1)]
        for name in ("trails", "others"):
            claims = [claim for record in own for claim in record[name]]
            cells += [len(claims), sum(claim[2] > 0.5 for claim in claims)]
        cells += [sum(r["standing"] for r in own), sum(len(r["left_out"]) for r in own)]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


def main() -> None:
    """Run the surveys that are missing and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--minutes", type=float, default=10.0, help="traffic in all, of both epochs")
    parser.add_argument("--first", type=int, default=301, help="first seed")
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    log = options.output / "traffic.jsonl"
    lines = log.read_text(encoding="utf-8").splitlines() if log.is_file() else []
    records = [json.loads(line) for line in lines]
    known = {(record["kind"], record["seed"]) for record in records}
    for number in range(round(options.minutes * 60 / (2 * SECONDS))):
        kind, seed = KINDS[number % len(KINDS)], options.first + number // len(KINDS)
        if (kind, seed) in known:
            continue
        records.append(one_survey(options.output, kind, seed))
        with log.open("a", encoding="utf-8") as out:
            out.write(json.dumps(records[-1]) + "\n")
        print(records[-1], flush=True)
    print(table(records))


if __name__ == "__main__":
    main()
