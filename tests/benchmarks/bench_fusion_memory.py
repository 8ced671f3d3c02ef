# ruff: noqa: T201
"""Memory from scan to written map as a drive goes on, and what of it two hours would need.

    OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 python tests/benchmarks/bench_fusion_memory.py --minutes 20

Synthetic: the vehicle drives 10 m/s through a street canyon 30 m wide (facades 12 m high, ground, poles)
that never repeats, one scan a metre; every point is new ground, so this is the worst that a drive can do.
Anonymous memory (what cannot be written back to a file) is sampled while fusing, finishing, measuring the
map as the quality page does, and writing the map directory. Where a stage follows the drive, the slope over
its second half, times two hours, is added to its level; the last two are scaled by length, all above the
level they began from.
"""

from __future__ import annotations

import argparse
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from results import keep, rounded

from subiaco_geo.frames import Floats, make_pose
from subiaco_geo.maps import write_map
from subiaco_geo.survey_map import SurveyMap
from subiaco_mapping.fusion.config import FusionConfig
from subiaco_mapping.fusion.finishing import FinishedMap, MapFusion
from subiaco_mapping.fusion.ground_heights import height_table
from subiaco_mapping.fusion.projection import Projection
from subiaco_mapping.map_quality.wall_thickness import coverage, wall_thickness
from subiaco_mapping.preprocessing.scan_spool import SpooledScan

SPEED = 10.0
TWO_HOURS = 7200.0

ROWS: list[dict[str, Any]] = []  # what is kept for bench.py


def anonymous_mb() -> float:
    """Return anonymous resident memory of this process [MB]."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return sum(int(line.split()[1]) for line in lines if line.startswith("RssAnon")) / 1024


def canyon(x: float, rng: np.random.Generator, points: int) -> Floats:
    """Points (N, 3) in the sensor's frame of a street at x [m]."""
    along = rng.uniform(-50, 50, points)
    kind = rng.random(points)
    side = np.sign(rng.random(points) - 0.5)
    xyz = np.column_stack([along, rng.uniform(-15, 15, points), np.full(points, -1.8)])
    wall = kind < 0.5
    setback = 15.0 + 2.0 * (np.floor((x + along) / 12.0) % 3)  # houses step back
    xyz[wall] = np.column_stack([along, side * setback, rng.uniform(-1.8, 10.0, points)])[wall]
    return xyz


@contextmanager
def peak(name: str, minutes: float) -> Iterator[None]:
    """Print the most anonymous memory that a step takes, sampled all along."""
    began, most, over = anonymous_mb(), [anonymous_mb()], threading.Event()

    def watch() -> None:
        while not over.wait(0.02):
            most.append(anonymous_mb())

    thread = threading.Thread(target=watch)
    thread.start()
    cpu = time.process_time()
    try:
        yield
    finally:
        over.set()
        thread.join()
    top = max(most)
    scaled = began + (top - began) * TWO_HOURS / (60 * minutes)
    spent = time.process_time() - cpu
    print(f"{name}: at most {top:.0f} MB (from {began:.0f}), {spent:.1f} s; two hours: {scaled:.0f} MB")
    ROWS.append({"stage": name, "at most, MB": round(top), "CPU s": rounded(spent)})


def followed(name: str, rows: Floats, minutes: float) -> None:
    """Print level and slope of samples (K, 2): seconds driven or share done, and MB."""
    half = rows[len(rows) // 2 :]
    # of the upper envelope: the tables fill and empty in between
    blocks = [part[part[:, 1].argmax()] for part in np.array_split(half, 4)]
    slope = float(np.polyfit(*np.array(blocks).T, 1)[0])
    if name == "finishing":
        slope /= minutes * 60  # of the share done, to seconds of the drive
    top = float(rows[:, 1].max())
    later = top + max(slope, 0.0) * (TWO_HOURS - minutes * 60)
    print(f"{name}: at most {top:.0f} MB, slope {60 * slope:+.2f} MB a minute; two hours: {later:.0f} MB")
    ROWS.append({"stage": name, "at most, MB": round(top), "slope, MB a minute": rounded(60 * slope, 2)})


def drive(fusion: MapFusion, minutes: float, points: int) -> Floats:
    """Fuse a drive; return seconds and MB (K, 2)."""
    rng, empty = np.random.default_rng(3), np.zeros((0, 3))
    samples = []
    for k in range(round(minutes * 60 * SPEED)):
        xyz = canyon(float(k), rng, points)
        scan = SpooledScan(xyz, np.ones(len(xyz), np.float32), empty, np.zeros(0, np.float32), empty)
        fusion.add(scan, make_pose(np.eye(3), [float(k), 0.0, 1.8]), np.eye(3), np.zeros(3))
        if k % 25 == 0:
            samples.append((k / SPEED, anonymous_mb()))
    return np.array(samples)


def measured_and_written(finished: FinishedMap, folder: Path, minutes: float) -> None:
    """Do with the finished map what the quality page and the map directory need."""
    with peak("heights, walls, coverage", minutes):
        heights = height_table(finished.cloud, 20.0)
        walls, cells = wall_thickness(finished.cloud), coverage(finished.cloud)
        del walls, cells
    with peak("writing", minutes):
        survey = SurveyMap(
            finished.cloud, visibility=finished.visibility, moving=finished.moving, heights=heights
        )
        write_map(folder / "map", survey)
    for path in sorted((folder / "map").iterdir()):
        if path.stat().st_size > 1e6:
            print(f"  {path.name} {path.stat().st_size / 1e6:.0f} MB")


def main() -> None:
    """Print level, slope and extrapolation."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=20.0)
    parser.add_argument("--points", type=int, default=10_000, help="a scan")
    parser.add_argument("--json", type=Path, help="leave the rows there, for bench.py")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        fusion = MapFusion(Path(folder) / "f", FusionConfig(), Projection(None, None), np.zeros(3))
        began = time.process_time()
        samples = drive(fusion, given.minutes, given.points)
        fused = time.process_time() - began
        found: list[tuple[float, float]] = []
        finished = fusion.finish(1, lambda f: found.append((f, anonymous_mb())))
        del fusion
        metres, count = given.minutes * 60 * SPEED, len(finished.cloud)
        print(f"{metres / 1000:.1f} km, {given.points} points a scan, {count:,} map points")
        finishing = time.process_time() - began - fused
        print(f"CPU: fusing {1e3 * fused / metres:.1f} ms a scan, finishing {finishing:.1f} s")
        followed("fusing", samples, given.minutes)
        followed("finishing", np.array(found), given.minutes)
        measured_and_written(finished, Path(folder), given.minutes)
    keep(given.json, ROWS, {}, [f"{metres / 1000:.1f} km, {count:,} map points, anonymous memory"])


if __name__ == "__main__":
    main()
