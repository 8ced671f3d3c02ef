"""Stamped poses and the two text forms in which other tools read them."""

from __future__ import annotations

from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path

import numpy as np

from subiaco_geo.atomic import whole_file
from subiaco_geo.errors import InputError
from subiaco_geo.frames import (
    Floats,
    Ints,
    interpolate_poses,
    make_pose,
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

    def __post_init__(self) -> None:
        if self.poses.shape != (len(self.times_ns), 4, 4):
            raise InputError(f"poses must have shape ({len(self.times_ns)}, 4, 4), got {self.poses.shape}")
        if self.times_ns.dtype.kind != "i":
            raise InputError(f"times_ns must be integer nanoseconds, got {self.times_ns.dtype}")
        if np.any(np.diff(self.times_ns) <= 0):
            raise InputError("times_ns must be strictly increasing")

    def __len__(self) -> int:
        return len(self.times_ns)

    @property
    def positions(self) -> Floats:
        """Positions (N, 3) [m]."""
        return self.poses[:, :3, 3]

    def at(self, query_ns: Ints) -> Floats:
        """Interpolate to times (M,), giving (M, 4, 4)."""
        return interpolate_poses(self.times_ns, self.poses, query_ns)


def format_seconds(time_ns: int) -> str:
    """Write nanoseconds as seconds with nine decimals, exactly."""
    sign = "-" if time_ns < 0 else ""
    whole, fraction = divmod(abs(time_ns), 10**9)
    return f"{sign}{whole}.{fraction:09d}"


def parse_seconds(text: str) -> int:
    """Read seconds, with or without an exponent, as nanoseconds, exactly."""
    try:
        time_ns = int((Decimal(text) * 10**9).to_integral_value())
    except (ArithmeticError, ValueError) as error:
        raise ValueError(f"{text!r} is not a time in seconds") from error
    if not -(2**63) <= time_ns < 2**63:
        raise ValueError(f"{text!r} is not a time in seconds that 64 bits of nanoseconds hold")
    return time_ns


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write ``seconds x y z qx qy qz qw`` rows, ns and 0.1 mm kept."""
    quaternions = quaternion_from_pose(trajectory.poses)
    rows = (
        f"{format_seconds(t)} " + " ".join(f"{v:.4f}" for v in p) + " " + " ".join(f"{v:.9f}" for v in q)
        for t, p, q in zip(trajectory.times_ns.tolist(), trajectory.positions, quaternions, strict=True)
    )
    with whole_file(path) as temporary:
        temporary.write_text("\n".join(rows) + "\n")


def _read_lines(path: Path) -> list[tuple[int, list[str]]]:
    """Return the numbered rows of a text file, comments and blank lines left out."""
    try:
        lines = path.read_text().splitlines()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); give a text file of poses") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not a text file; give a text file of poses") from error
    rows = [(number, line.split()) for number, line in enumerate(lines, 1)]
    return [(number, words) for number, words in rows if words and not words[0].startswith("#")]


def _refuse_bad_rows(path: Path, numbers: list[int], values: Floats, times_ns: Ints) -> None:
    bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if len(bad):
        raise InputError(f"{path}:{numbers[bad[0]]}: NaN or infinite values; remove such rows")
    back = np.flatnonzero(np.diff(times_ns) <= 0)
    if len(back):
        raise InputError(f"{path}:{numbers[back[0] + 1]}: time does not increase; sort the rows by time")


def read_tum(path: Path) -> Trajectory:
    """Read a TUM trajectory; comment lines start with ``#``.

    Raises
    ------
    InputError
        Missing, no poses, a row that is not TUM, NaN, or times that do not increase.
    """
    times, rows, numbers = [], [], []
    for number, words in _read_lines(path):
        if len(words) < 8:
            raise InputError(f"{path}:{number}: a TUM row has 8 columns, found {len(words)}; export as TUM")
        try:
            times.append(parse_seconds(words[0]))
            rows.append([float(w) for w in words[1:8]])
        except ValueError as error:
            raise InputError(f"{path}:{number}: not a TUM row ({error}); export as TUM") from error
        numbers.append(number)
    if not rows:
        raise InputError(f"{path}: no poses; expected TUM rows 'seconds x y z qx qy qz qw'")
    values, times_ns = np.array(rows), np.array(times, dtype=np.int64)
    _refuse_bad_rows(path, numbers, values, times_ns)
    zero = np.flatnonzero(np.linalg.norm(values[:, 3:], axis=1) < 1e-6)
    if len(zero):
        raise InputError(f"{path}:{numbers[zero[0]]}: the quaternion is zero; export the trajectory again")
    return Trajectory(times_ns, pose_from_quaternion(values[:, :3], values[:, 3:]))


def write_kitti(path: Path, trajectory: Trajectory) -> None:
    """Write 3x4 row-major poses, and the times beside them as ``<stem>.times.txt``."""
    seconds = [format_seconds(t) for t in trajectory.times_ns.tolist()]
    with whole_file(path.with_suffix(".times.txt")) as temporary:
        temporary.write_text("\n".join(seconds) + "\n")
    with whole_file(path) as temporary:
        np.savetxt(temporary, trajectory.poses[:, :3, :].reshape(-1, 12), fmt="%.12g")


def read_kitti(path: Path, times: Path | None = None) -> Trajectory:
    """Read 3x4 row-major poses and their times.

    Parameters
    ----------
    path : Path
    times : Path, optional
        Seconds a row; default ``<stem>.times.txt`` beside the poses.

    Raises
    ------
    InputError
        Missing, no poses, rows that are not 12 numbers, NaN, or times that do
        not fit the poses.
    """
    times = path.with_suffix(".times.txt") if times is None else times
    lines = _read_lines(path)
    try:
        times_ns = np.array([parse_seconds(words[0]) for _, words in _read_lines(times)], dtype=np.int64)
        values = np.array([[float(w) for w in words] for _, words in lines])
    except ValueError as error:
        raise InputError(f"{path}: not a KITTI pose file with times ({error}); export it again") from error
    if values.ndim != 2 or values.shape[1] != 12:
        raise InputError(f"{path}: a KITTI row has 12 numbers; export the poses as 3x4 rows")
    if len(values) != len(times_ns):
        raise InputError(
            f"{path}: {len(values)} poses but {len(times_ns)} times in {times.name}; export both again"
        )
    _refuse_bad_rows(path, [number for number, _ in lines], values, times_ns)
    rows = values.reshape(-1, 3, 4)
    return Trajectory(times_ns, make_pose(rows[:, :, :3], rows[:, :, 3]))
