"""What of a survey deserves a second look, by stretch and metre."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.frames import Floats, Ints
from subiaco_mapping.config import ManifestConfig
from subiaco_mapping.measurements import GnssFix, OdometryPose


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
    lost_columns: Sequence[int],
    modes: Sequence[str],
    fixes: Sequence[GnssFix],
    positions: Floats,
    config: ManifestConfig,
) -> dict[str, Any]:
    """Return the flagged stretches of one sequence."""
    stamps_ns = np.array([pose.stamp_ns for pose in poses], dtype=np.int64)
    lost = np.asarray(lost_columns, dtype=np.float64)
    columns = max(float(lost.max(initial=0.0)), 512.0)
    segments = np.array([pose.segment for pose in poses])
    broken = np.concatenate([[False], np.diff(segments) > 0])
    flags = {
        "packet_loss": lost > config.max_lost_ratio * columns,
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
        "gnss_states": {str(k): v for k, v in sorted(Counter(fix.status for fix in fixes).items())},
        "flagged": found,
    }
