# ruff: noqa: T201
"""Memory of the fusion as a drive goes on, and what of it two hours would need.

    OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 python tests/benchmarks/bench_fusion_memory.py --minutes 5

Synthetic: the vehicle drives 10 m/s through a street canyon 30 m wide (facades 12 m high, ground, poles)
that never repeats, one scan a metre; every point is new ground, so this is the worst that a drive can do.
Anonymous memory (what cannot be written back to a file) is sampled while fusing; the slope over the
second half, times two hours, is added to the level at its end. Map files on disk are counted apart.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

from subiaco_geo.frames import Floats, make_pose
from subiaco_mapping.config import FusionConfig
from subiaco_mapping.finishing import MapFusion
from subiaco_mapping.projection import Projection
from subiaco_mapping.spool import SpooledScan

SPEED = 10.0
TWO_HOURS = 7200.0


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


def main() -> None:
    """Print level, slope and extrapolation."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--points", type=int, default=30_000, help="a scan")
    given = parser.parse_args()
    rng, empty = np.random.default_rng(3), np.zeros((0, 3))
    scans = round(given.minutes * 60 * SPEED)
    samples = []
    with tempfile.TemporaryDirectory() as folder:
        fusion = MapFusion(Path(folder) / "f", FusionConfig(), Projection(None, None), np.zeros(3))
        began = time.process_time()
        for k in range(scans):
            xyz = canyon(float(k), rng, given.points)
            scan = SpooledScan(xyz, np.ones(len(xyz), np.float32), empty, np.zeros(0, np.float32), empty)
            fusion.add(scan, make_pose(np.eye(3), [float(k), 0.0, 1.8]), np.eye(3), np.zeros(3))
            if k % 25 == 0:
                samples.append((k / SPEED, anonymous_mb()))
        fused = time.process_time() - began
        found = []
        finished = fusion.finish(1, lambda f: found.append((f, anonymous_mb())))
        print(
            f"{scans} scans of {given.points} points, {scans / 1000:.1f} km, "
            f"{len(finished.cloud):,} map points"
        )
        finishing = time.process_time() - began - fused
        print(f"CPU: fusing {1e3 * fused / scans:.1f} ms a scan, finishing {finishing:.1f} s")
        for name, row in (("fusing", np.array(samples)), ("finishing", np.array(found))):
            half = row[len(row) // 2 :]
            # of the upper envelope: the tables fill and empty in between
            blocks = [part[part[:, 1].argmax()] for part in np.array_split(half, 4)]
            slope = float(np.polyfit(*np.array(blocks).T, 1)[0])
            if name == "finishing":
                slope /= given.minutes * 60  # of the share done, to seconds of the drive
            top = float(row[:, 1].max())
            print(f"{name}: at most {top:.0f} MB, slope {60 * slope:+.2f} MB a minute of the drive", end="; ")
            print(f"two hours: {top + max(slope, 0.0) * (TWO_HOURS - given.minutes * 60):.0f} MB")


if __name__ == "__main__":
    main()
