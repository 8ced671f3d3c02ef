"""The manifest: stretches of a survey that need attention, by time and distance."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.frames import Floats, Ints
from subiaco_mapping.config import ManifestConfig
from subiaco_mapping.measurements import GnssFix, OdometryPose
from subiaco_mapping.pose_graph.records import ChainSolution

#: Flag of a sequence, and key of the manifest, where most fixes contradict the map.
CONTRADICTED = "gnss_contradicts"
STATES = {2: "fixed", 1: "float", 0: "single"}

#: What every key of the manifest means; written into it, so that its reader need not look elsewhere.
LEGEND = {
    "georeferenced": "GNSS placed the map in its CRS; false: local axes, first scan at the origin",
    "reason": "why the map is local, empty where it is georeferenced",
    "gnss_contradicts": "most fixes of a sequence are farther off the map than they state; flag: of which",
    "sequences": "one entry a recording, named after its bag",
    "scans": "registered LiDAR turns; in packets: turns decoded",
    "length_m": "way driven [m]",
    "start_s": "first scan, UTC seconds since 1970",
    "end_s": "last scan, UTC seconds since 1970",
    "lost_columns": "LiDAR columns that never arrived",
    "deskew": "scans by how motion inside them was removed: gyro_accelerometer, gyro, "
    "constant_velocity, none",
    "segments": "stretches of unbroken odometry; 1 is right",
    "flagged": "stretches that should be inspected, by reason; empty is right",
    "packet_loss": "flag: a larger share of the LiDAR columns lost than manifest.max_lost_ratio",
    "degenerate": "flag: the scene did not hold the position in some direction",
    "unregistered": "flag: registration failed, the pose is predicted",
    "segment_start": "flag: the odometry broke before this scan",
    "without_gyro": "flag: deskewed by constant velocity, the IMU was missing",
    "without_rtk_fixed": "flag: no RTK fixed solution within manifest.rtk_gap_ns",
    "gnss": "fixes and how the map agrees with them",
    "states": "fixes by RTK state: fixed, float, single",
    "received": "fixes that came with this state",
    "used": "fixes that act on the map",
    "refused": "fixes without a solution or with NaN",
    "unattached": "fixes before, after or in a gap of the scans",
    "downweighted": "fixes that the robust kernel left less than 30 % of their weight",
    "contradicting": "fixes that the map is farther off than 99.9 % of what they state",
    "rmse_horizontal_m": "antenna on the map against the fixes used, horizontal [m]",
    "rmse_vertical_m": "the same, vertical [m]",
    "slow_rms_m": "what of that the graph takes for slow errors of the receiver, shared by neighbours [m]",
    "headings_used": "headings of the antenna baseline that act on the map",
    "headings_refused": "headings without a number, or with a standard deviation of 0.5 rad or more",
    "loops": "places seen twice; in within, between: those that act on the map",
    "proposed_by_estimate": "pairs of submaps that lie near each other by the estimate",
    "proposed_by_descriptor": "further pairs that look alike",
    "refused_graph": "pairs that the present estimate with its covariance rules out",
    "refused_overlap": "pairs of which too little meets",
    "refused_residual": "pairs that meet too roughly",
    "refused_degenerate": "pairs that do not hold each other in some direction",
    "verified": "pairs that geometry bears out",
    "within": "loops inside one sequence",
    "between": "loops between two sequences",
    "seam_median_m": "how far the solved map is off the registration of both visits, median [m]",
    "seam_p95_m": "the same, 95th percentile [m]",
    "dropped_points": "points that were not finite",
    "scans_without_room": "scans whose points are not in the map because the disk was full",
    "packets": "LiDAR packets of the whole recording: received, lost, late, duplicate, reordered, malformed",
    "dropped_scans": "scans without points or out of order",
    "imu_out_of_order": "IMU samples that were not newer than the one before",
    "imu_implausible": "IMU samples with NaN or with values beyond any sensor's range; they are left out",
    "arrivals_odometry": "live, up to its last second: sensor messages at the odometry, by topic",
    "arrivals_pose_graph": "live: messages at the pose graph, by topic",
    "before_start": "published before the process listened",
    "left_out": "came before it was known where the sensors sit",
    "scans_in_part": "live: scans left out because one of their messages was lost",
    "gyro_bias": "subtracted from the gyro, x y z [rad/s]",
    "imu_clock": "gyro against odometry: offset_ms to be added to IMU stamps beside the one in use, "
    "sigma_ms; off: more than 2 ms and 3 sigma",
}


def describe_fixes(
    status: Ints, received: Sequence[int], solution: ChainSolution
) -> dict[str, dict[str, Any]]:
    """Return counts and residuals by RTK state.

    Parameters
    ----------
    status : (N,) int64
        Of the fixes used.
    received : sequence of int
        States of all usable fixes.
    solution : ChainSolution
        Residuals, slow errors and weights of the fixes used.
    """
    found: dict[str, dict[str, Any]] = {}
    for number, name in STATES.items():
        chosen = np.minimum(status, 2) == number
        count = sum(min(state, 2) == number for state in received)
        if count == 0:
            continue
        if not chosen.any():
            found[name] = {"received": count, "used": 0}
            continue
        square = (solution.residuals[chosen] ** 2).mean(axis=0)
        slow = (solution.slow[chosen] ** 2).sum(axis=1).mean()
        found[name] = {
            "received": count,
            "used": int(chosen.sum()),
            "downweighted": int((solution.weights[chosen] < 0.3).sum()),
            "rmse_horizontal_m": _rounded(np.sqrt(square[0] + square[1])),
            "rmse_vertical_m": _rounded(np.sqrt(square[2])),
            "slow_rms_m": _rounded(np.sqrt(slow)),
        }
    return found


def _rounded(value: float) -> float:
    return round(float(value), 4)


def stretches(flags: NDArray[np.bool_], stamps_ns: Ints, positions: Floats) -> list[dict[str, Any]]:
    """Return start, end [UTC s] and length [m] of every run of flagged scans (S,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))])
    runs = []
    for start, stop in edges.reshape(-1, 2):
        runs.append(
            {
                "start_s": round(int(stamps_ns[start]) * 1e-9, 3),
                "end_s": round(int(stamps_ns[stop - 1]) * 1e-9, 3),
                "scans": int(stop - start),
                "length_m": round(float(way[stop - 1] - way[max(start - 1, 0)]), 2),
            }
        )
    return runs


def without_fixed(stamps_ns: Ints, fixes: Sequence[GnssFix], gap_ns: int) -> NDArray[np.bool_]:
    """Mark scans (S,) farther than half of ``gap_ns`` from every RTK fixed solution."""
    fixed = np.sort([f.time_ns for f in fixes if f.is_usable() and f.status >= 2]).astype(np.int64)
    if len(fixed) == 0:
        return np.ones(len(stamps_ns), dtype=np.bool_)
    after = np.clip(np.searchsorted(fixed, stamps_ns), 1, max(len(fixed) - 1, 1))
    near = np.minimum(
        np.abs(stamps_ns - fixed[np.minimum(after, len(fixed) - 1)]), np.abs(stamps_ns - fixed[after - 1])
    )
    return np.asarray(near > gap_ns // 2)


def describe_sequence(
    poses: Sequence[OdometryPose],
    columns: Sequence[tuple[int, int]],
    modes: Sequence[str],
    fixes: Sequence[GnssFix],
    positions: Floats,
    config: ManifestConfig,
) -> dict[str, Any]:
    """Return the flagged stretches of one sequence."""
    stamps_ns = np.array([pose.stamp_ns for pose in poses], dtype=np.int64)
    lost, sent = np.array(columns, dtype=np.int64).reshape(-1, 2).T
    segments = np.array([pose.segment for pose in poses])
    broken = np.concatenate([[False], np.diff(segments) > 0])
    flags = {
        "packet_loss": lost > config.max_lost_ratio * sent,
        "degenerate": np.array([pose.degenerate for pose in poses]),
        "unregistered": np.array([pose.predicted for pose in poses]),
        "segment_start": broken,
        "without_gyro": np.array([mode == "constant_velocity" for mode in modes]),
    }
    if fixes:
        flags["without_rtk_fixed"] = without_fixed(stamps_ns, fixes, config.rtk_gap_ns)
    found = {name: stretches(flag, stamps_ns, positions) for name, flag in flags.items() if flag.any()}
    length = float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())
    return {
        "scans": len(poses),
        "length_m": round(length, 2),
        "start_s": round(int(stamps_ns[0]) * 1e-9, 3),
        "end_s": round(int(stamps_ns[-1]) * 1e-9, 3),
        "lost_columns": int(lost.sum()),
        "deskew": dict(Counter(modes)),
        "segments": int(segments[-1] - segments[0] + 1),
        "flagged": found,
    }
