"""Stamped poses and the two text forms in which other tools read them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from subiaco_geo.errors import InputError
from subiaco_geo.frames import (
    Floats,
    Ints,
    interpolate_poses,
    pose_from_quaternion,
    quaternion_from_pose,
)


@dataclass(frozen=True)
class Trajectory:
    """Poses of one frame in another over time.

    Parameters
    ----------
    times_ns : (N,) int64
        Strictly increasing UTC times.
    poses : (N, 4, 4) float64
        E.g. ``T_map_lidar``; translations are world coordinates [m].
    """

    times_ns: Ints
    poses: Floats

    def __len__(self) -> int:
        return len(self.times_ns)

    @property
    def positions(self) -> Floats:
        """Positions (N, 3) [m]."""
        return self.poses[:, :3, 3]

    def at(self, query_ns: Ints) -> Floats:
        """Interpolate to times (M,), giving (M, 4, 4)."""
        return interpolate_poses(self.times_ns, self.poses, query_ns)


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write ``seconds x y z qx qy qz qw`` rows, ns and 0.1 mm kept."""
    quaternions = quaternion_from_pose(trajectory.poses)
    rows = (
        f"{t // 10**9}.{t % 10**9:09d} "
        + " ".join(f"{v:.4f}" for v in p)
        + " "
        + " ".join(f"{v:.9f}" for v in q)
        for t, p, q in zip(
            trajectory.times_ns.tolist(), trajectory.positions, quaternions, strict=True
        )
    )
    path.write_text("\n".join(rows) + "\n")


def _seconds_to_ns(text: str) -> int:
    whole, _, fraction = text.partition(".")
    return int(whole) * 10**9 + int(fraction[:9].ljust(9, "0") or 0)


def read_tum(path: Path) -> Trajectory:
    """Read a TUM trajectory; comment lines start with ``#``."""
    times, rows = [], []
    for number, line in enumerate(path.read_text().splitlines(), 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            times.append(_seconds_to_ns(words[0]))
            rows.append([float(w) for w in words[1:8]])
        except ValueError as error:
            raise InputError(f"{path}:{number}: not a TUM row ({error})") from error
        if len(rows[-1]) != 7:
            raise InputError(f"{path}:{number}: a TUM row has 8 columns, found {len(words)}")
    if not rows:
        raise InputError(f"{path}: no poses; expected TUM rows 'seconds x y z qx qy qz qw'")
    values = np.array(rows)
    return Trajectory(np.array(times, dtype=np.int64), pose_from_quaternion(values[:, :3], values[:, 3:]))


def write_kitti(path: Path, trajectory: Trajectory) -> None:
    """Write 3x4 row-major poses, and the times beside them as ``<stem>.times.txt``."""
    np.savetxt(path, trajectory.poses[:, :3, :].reshape(-1, 12), fmt="%.9g")
    seconds = [f"{t // 10**9}.{t % 10**9:09d}" for t in trajectory.times_ns.tolist()]
    path.with_suffix(".times.txt").write_text("\n".join(seconds) + "\n")
