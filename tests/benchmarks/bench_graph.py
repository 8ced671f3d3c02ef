# ruff: noqa: T201
"""Time of the pose graph as it grows: batch with marginals, and ISAM2 while driving.

    OMP_NUM_THREADS=1 python tests/benchmarks/bench_graph.py --scans 1000 5000 20000 72000

A car circles at 7 m/s (10 scans, 5 fixes a second, a loop every 25 scans after the first lap); CPU
seconds. 72000 scans are two hours.
"""

from __future__ import annotations

import argparse
import resource
import time
from pathlib import Path
from typing import Any

import numpy as np
from results import keep, rounded
from scipy.spatial.transform import Rotation

from subiaco_geo.frames import Floats, exp_se3, invert_pose, make_pose
from subiaco_mapping.pose_graph.config import GnssConfig, GraphConfig
from subiaco_mapping.pose_graph.incremental import LiveGraph
from subiaco_mapping.pose_graph.records import Chain, GnssPriors, GravityPriors, LoopEdge
from subiaco_mapping.pose_graph.solver import solve

LAP = 600  # scans


def circling(count: int) -> Floats:
    """Return true poses (S, 4, 4)."""
    angle = np.arange(count) * (2 * np.pi / LAP)
    radius = 0.7 * LAP / (2 * np.pi)
    position = np.stack([radius * np.sin(angle), -radius * np.cos(angle), np.zeros(count)], axis=1)
    return make_pose(Rotation.from_rotvec(np.outer(angle, [0, 0, 1])).as_matrix(), position)


def chain_of(truth: Floats, rng: np.random.Generator) -> Chain:
    """Return a chain with drift, fixes of 2 cm and gravity."""
    count = len(truth)
    steps = invert_pose(truth[:-1]) @ truth[1:]
    noise = exp_se3(rng.normal(0, 1, (count - 1, 6)) * np.repeat([1e-4, 2e-3], 3))
    odometry = [truth[0]]
    for step in steps @ noise:
        odometry.append(odometry[-1] @ step)
    stamps = np.arange(count, dtype=np.int64) * 10**8
    index = np.arange(0, count, 2)
    fixes = truth[index, :3, 3] + rng.normal(0, 0.02, (len(index), 3))
    levers, covariance = np.zeros((len(index), 3)), np.tile(np.eye(3) * 4e-4, (len(index), 1, 1))
    gnss = GnssPriors(index, stamps[index], fixes, levers, covariance, np.full(len(index), 2))
    gravity = GravityPriors(np.arange(0, count, 10), np.tile([0.0, 0.0, 1.0], (len(range(0, count, 10)), 1)))
    step_covariance = np.tile(np.diag(np.repeat([1e-8, 4e-6], 3)), (count, 1, 1))
    return Chain(
        stamps,
        np.array(odometry),
        step_covariance,
        np.ones(count, np.bool_),
        np.zeros(count, np.int64),
        np.eye(4),
        gravity,
        gnss,
    )


def loops_of(truth: Floats) -> list[LoopEdge]:
    """Return a loop to the lap before, every 25 scans."""
    covariance = np.diag(np.repeat([1e-3, 0.02], 3)) ** 2
    pairs = [(k - LAP, k) for k in range(LAP, len(truth), 25)]
    return [LoopEdge((0, a), (0, b), invert_pose(truth[a]) @ truth[b], covariance) for a, b in pairs]


def part(chain: Chain, count: int) -> Chain:
    """Return the first scans of a chain."""
    gnss, gravity = chain.gnss, chain.gravity
    assert gnss is not None
    near, up = gnss.index < count, gravity.index < count
    priors = [getattr(gnss, n)[near] for n in ("index", "times_ns", "enu", "levers", "covariance", "status")]
    arrays = [
        getattr(chain, n)[:count] for n in ("stamps_ns", "T_odom_lidar", "covariance", "held", "segment")
    ]
    return Chain(
        *arrays, chain.T_world_odom, GravityPriors(gravity.index[up], gravity.up[up]), GnssPriors(*priors)
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scans", type=int, nargs="+", default=[1000, 5000, 20000])
    parser.add_argument("--every", type=int, default=50, help="scans between two live updates")
    parser.add_argument("--live-up-to", type=int, default=20_000, help="scans; no live updates beyond")
    parser.add_argument("--json", type=Path, help="leave the rows there, for bench.py")
    given = parser.parse_args()
    rows: list[dict[str, Any]] = []
    for count in given.scans:
        truth = circling(count)
        chain, loops = chain_of(truth, np.random.default_rng(1)), loops_of(truth)
        begin = time.process_time()
        solved = solve({0: chain}, GraphConfig(), GnssConfig(), loops)
        batch = time.process_time() - begin
        off = np.sqrt(((solved.chains[0].T_world_lidar - truth)[:, :3, 3] ** 2).sum(axis=1).mean())
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(f"{count:7d} scans: batch {batch:7.2f} s, error {off:.4f} m, {peak:.0f} MB at most", flush=True)
        rows.append({"scans": count, "batch, CPU s": rounded(batch), "peak MB": round(peak)})
        if count > given.live_up_to:
            continue
        live, taken, seconds = LiveGraph(GraphConfig(), GnssConfig()), 0, []
        for end in range(given.every, count + 1, given.every):
            new = [loop for loop in loops if taken <= loop.second[1] < end]
            begin = time.process_time()
            poses = live.update({0: part(chain, end)}, new)[0]
            seconds.append(time.process_time() - begin)
            taken = end
        off = np.sqrt(((poses - truth[: len(poses)])[:, :3, 3] ** 2).sum(axis=1).mean())
        last = np.array(seconds[-10:])
        rows[-1][f"live, ms for {given.every} more scans"] = rounded(1e3 * float(last.mean()))
        print(
            f"         live, every {given.every} scans: first {seconds[0]:.3f} s, "
            f"last ten {last.mean():.3f} s (most {max(seconds):.2f}), error {off:.4f} m",
            flush=True,
        )
    keep(given.json, rows)


if __name__ == "__main__":
    main()
