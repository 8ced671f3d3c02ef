# ruff: noqa: T201
"""Accuracy of the trajectory on simulated surveys of more than a kilometre, two sequences, truth exact.

    OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 python tests/benchmarks/bench_trajectory.py out/trajectory --seed 1

The survey is that of :mod:`looped_survey`. Bags and odometry are kept in the folder and reused; the fixes
are then replayed under one fault after the other. Positions are compared as they are, without any
alignment; with ``none`` (no fix at all) the joint map is brought to the first true pose. ``--map`` fuses
the map of the first case as well and measures its points against the true surfaces.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path

import numpy as np
from looped_survey import NAMES, fixes_of, looped_surveys, record_surveys
from odometry_cache import CachedOdometry, cached_odometry

from subiaco_geo.frames import Floats, invert_pose
from subiaco_mapping.backend import MappingBackend
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.measurements import Extrinsics, GnssFix, HeadingSample
from subiaco_mapping.survey_graph.solution import GraphSolution
from subiaco_sim.drives import MAP_CRS, WORLD, Survey
from subiaco_sim.gnss import NONE

KINDS = ("rtk", "outage", "multipath", "float", "none")
LIMITS = {"rtk": 0.05, "outage": 0.10, "multipath": 0.08, "float": 0.15}
HEADING_SIGMA = np.radians(0.15)


def feed_fixes(backend: MappingBackend, survey: Survey, kind: str, heading: bool) -> None:
    """Give the back end the fixes of a drive, and headings where both antennas see enough."""
    series = fixes_of(survey, kind)
    for k, time_ns in enumerate(series.times_ns.tolist()):
        status = int(series.status[k])
        if status == NONE:
            continue
        latitude, longitude, height = WORLD.to_geodetic(series.enu[k : k + 1])[0]
        covariance = np.diag(series.sigma[k] ** 2)
        backend.on_fix(GnssFix(time_ns, latitude, longitude, height, covariance, status))
        if heading and status > 0:
            backend.on_heading(HeadingSample(time_ns, float(series.yaw[k]), HEADING_SIGMA))


def fed_backend(odometry: dict[str, CachedOdometry], spool: Path, config: MappingConfig) -> MappingBackend:
    """Give a back end the odometry of all sequences."""
    backend = MappingBackend(config, Extrinsics(), spool)
    for name, cached in odometry.items():
        backend.start_sequence(name, cached.extrinsics)
        for k, pose in enumerate(cached.poses):
            backend.on_odometry(pose, cached.scan(k))
    return backend


def swap_fixes(backend: MappingBackend, surveys: dict[str, Survey], kind: str, heading: bool) -> None:
    """Give every sequence the fixes of a fault in place of those it had; scans and submaps stay."""
    records = list(backend._sequences)
    for record in records:
        record.fixes.clear()
        record.headings.clear()
        backend._sequences = [record]  # fixes go to the last
        feed_fixes(backend, surveys[record.name], kind, heading)
    backend._sequences, backend._solution = records, None


def errors(surveys: dict[str, Survey], solution: GraphSolution) -> dict[str, Floats]:
    """Return position errors (S, 3) by sequence, scene's frame; a local map is brought to one true pose."""
    truth = {s.name: surveys[s.name].drives["before"].lidar_poses(s.stamps_ns) for s in solution.sequences}
    found = {}
    first = solution.sequences[0]
    T_world_local = truth[first.name][0] @ invert_pose(first.T_local_lidar[0])
    for solved in solution.sequences:
        local = solved.T_local_lidar
        if solution.frame is not None:
            positions = WORLD.from_geodetic(*solution.frame.to_geodetic(local[:, :3, 3]).T)
        else:
            positions = (T_world_local @ local)[:, :3, 3]
        found[solved.name] = positions - truth[solved.name][:, :3, 3]
    return found


def rmse(error: Floats) -> float:
    """Return the root mean square length of errors (S, 3)."""
    return float(np.sqrt((error**2).sum(axis=1).mean()))


def drift(survey: Survey, cached: CachedOdometry) -> dict[str, float]:
    """Return the odometry's drift over windows of 100 m, and of the whole way [%]."""
    stamps = np.array([pose.stamp_ns for pose in cached.poses], dtype=np.int64)
    truth = survey.drives["before"].lidar_poses(stamps)
    poses = np.array([pose.T_odom_lidar for pose in cached.poses])
    way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1)))
    ends = np.searchsorted(way, way + 100.0)
    starts = np.flatnonzero(ends < len(way))[::5]
    moved = [invert_pose(poses[a]) @ poses[b] for a, b in zip(starts, ends[starts], strict=True)]
    true = [invert_pose(truth[a]) @ truth[b] for a, b in zip(starts, ends[starts], strict=True)]
    off = np.linalg.norm(np.array(moved)[:, :3, 3] - np.array(true)[:, :3, 3], axis=1)
    whole = (invert_pose(truth[0]) @ truth[-1])[:3, 3] - (invert_pose(poses[0]) @ poses[-1])[:3, 3]
    return {
        "way_m": float(way[-1]),
        "per_100_m_percent": float(off.mean()),
        "whole_way_percent": float(100 * np.linalg.norm(whole) / way[-1]),
    }


def map_error(backend: MappingBackend, survey: Survey) -> dict[str, float]:
    """Return how far map points lie off the true surfaces [m]."""
    built = backend.build_map()
    seen = np.flatnonzero(np.asarray(built.cloud.fields["n"]) >= 3)
    chosen = np.random.default_rng(0).choice(seen, min(len(seen), 100_000), replace=False)
    xyz = WORLD.points_from_map(built.cloud.world()[chosen], MAP_CRS)
    distance = survey.drives["before"].compiled.distance_to_surface(xyz)
    return {"points": len(built.cloud), "median_m": float(np.median(distance))}


def measured(
    backend: MappingBackend, surveys: dict[str, Survey], kind: str, heading: bool
) -> dict[str, object]:
    """Solve with the fixes of a fault, and measure."""
    swap_fixes(backend, surveys, kind, heading)
    begin = time.process_time()
    solution = backend.optimize()
    seconds = time.process_time() - begin
    error = errors(surveys, solution)
    both = np.concatenate(list(error.values()))
    sigma = np.concatenate(
        [np.sqrt(np.diagonal(s.covariance, axis1=1, axis2=2)[:, 3:]) for s in solution.sequences]
    )
    figures = {
        "ate_m": rmse(both),
        **{f"ate_{name}_m": rmse(own) for name, own in error.items()},
        "vertical_m": float(np.sqrt((both[:, 2] ** 2).mean())),
        "max_m": float(np.linalg.norm(both, axis=1).max()),
        "error_over_sigma": float(np.sqrt((both**2 / sigma**2).mean())),
        "solve_cpu_s": seconds,
    }
    rounded = {name: round(value, 4) for name, value in figures.items()}
    return {"limit_m": LIMITS.get(kind), **rounded, "loops": solution.loops.described()}


def main() -> None:
    """Print the table and keep it as JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--odometry", default="clean", choices=["clean", "loss", "imu"])
    parser.add_argument("--kinds", nargs="+", default=KINDS, choices=KINDS)
    parser.add_argument("--heading", action="store_true", help="also the antenna baseline's heading")
    parser.add_argument("--no-loops", action="store_true")
    parser.add_argument("--map", action="store_true")
    given = parser.parse_args()
    config = MappingConfig()
    if given.no_loops:
        config = config.model_copy(update={"loops": config.loops.model_copy(update={"enabled": False})})
    folder = given.folder / f"seed{given.seed}"
    surveys = looped_surveys(given.seed)
    bags = record_surveys(folder, surveys)
    odometry = {
        name: cached_odometry(folder / f"odo_{name}_{given.odometry}", bags[name], given.odometry, config)
        for name in NAMES
    }
    variant = f"{given.odometry}{'_heading' * given.heading}{'_no_loops' * given.no_loops}"
    result: dict[str, object] = {"seed": given.seed, "odometry": given.odometry, "heading": given.heading}
    for name in NAMES:
        result[f"drift {name}"] = drift(surveys[name], odometry[name])
        print(f"odometry {name}: {result[f'drift {name}']}")
    with tempfile.TemporaryDirectory() as spool:
        backend = fed_backend(odometry, Path(spool), config)
        for kind in given.kinds:
            result[kind] = measured(backend, surveys, kind, given.heading)
            print(kind, json.dumps(result[kind]), flush=True)
            (folder / f"result_{variant}.json").write_text(json.dumps(result, indent=1))
        if given.map:
            swap_fixes(backend, surveys, given.kinds[0], given.heading)
            result["map"] = map_error(backend, surveys["there"])
            print("map", given.kinds[0], result["map"])
    (folder / f"result_{variant}.json").write_text(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
