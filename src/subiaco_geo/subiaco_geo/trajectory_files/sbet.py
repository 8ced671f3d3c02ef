"""Smoothed best estimates of trajectory (SBET) of Applanix POSPac: rows of 17 doubles, no header."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats
from subiaco_geo.trajectory_files.attitude import offset_from_travel, rotation_from_ned
from subiaco_geo.trajectory_files.formats import RecordedPath

#: Values of a row: time, latitude, longitude, height, three velocities, roll, pitch, heading, wander angle,
#: three accelerations, three rates; radians, metres, seconds.
ROW = 17
_BYTES = 8 * ROW
_HEIGHTS = (-1_000.0, 20_000.0)  # above the ellipsoid, of what carries a scanner [m]
_WANDER = np.radians(1.0)  # less makes no difference
_EARTH = 6_378_137.0


def read_sbet(path: Path) -> RecordedPath:
    """Read an SBET file.

    Heading is platform heading less wander angle; where the wander angle is not small and the direction of
    travel fits their sum instead, their sum is taken (writers differ).

    Raises
    ------
    InputError
        Not rows of 17 doubles, positions that are none, or times that go back.
    """
    rows = _rows(path)
    latitude, longitude, height = rows[:, 1], rows[:, 2], rows[:, 3]
    bad = (np.abs(latitude) > np.pi / 2) | (np.abs(longitude) > 2.0 * np.pi)
    bad |= (height < _HEIGHTS[0]) | (height > _HEIGHTS[1]) | ~np.isfinite(rows[:, :11]).all(axis=1)
    if bad.any():
        raise InputError(
            f"{path}: row {int(np.flatnonzero(bad)[0]) + 1} holds no latitude and longitude in radians and "
            "height in metres; export the SBET again with 17 doubles a row, angles in radians"
        )
    times_ns = np.round(rows[:, 0] * 1e9).astype(np.int64)
    back = np.flatnonzero(np.diff(times_ns) < 0)
    if len(back):
        raise InputError(f"{path}: row {int(back[0]) + 2}: time goes back; export one mission a file")
    kept = np.concatenate([[True], np.diff(times_ns) > 0])
    rows, times_ns = rows[kept], times_ns[kept]
    positions = np.column_stack([np.degrees(rows[:, 1:3]), rows[:, 3]])
    return RecordedPath(times_ns, "gps", positions, geographic=True, rotations=_rotations(rows))


def _rows(path: Path) -> Floats:
    try:
        size = path.stat().st_size
        if size == 0 or size % _BYTES:
            raise InputError(
                f"{path}: {size} bytes are no rows of {ROW} doubles ({_BYTES} bytes); give an SBET file, or "
                "name the format with trajectories.before.kind or trajectories.after.kind"
            )
        rows = np.fromfile(path, dtype="<f8").reshape(-1, ROW)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); give an SBET file") from error
    if not (np.isfinite(rows[:, 0]).all() and np.all(np.abs(rows[:, 0]) < 1e10)):
        raise InputError(f"{path}: the first value of a row is no time in seconds; give an SBET file")
    return np.asarray(rows, dtype=np.float64)


def _rotations(rows: Floats) -> Floats:
    roll, pitch, platform, wander = (rows[:, column] for column in (7, 8, 9, 10))
    usual = rotation_from_ned(roll, pitch, platform - wander)
    if np.median(np.abs(wander)) < _WANDER:
        return usual
    other = rotation_from_ned(roll, pitch, platform + wander)
    flat = _EARTH * np.column_stack([rows[:, 2] * np.cos(rows[:, 1]), rows[:, 1], np.zeros(len(rows))])
    flat -= flat[0]
    off = [offset_from_travel(flat, turns) for turns in (usual, other)]
    if off[0] is None or off[1] is None:
        return usual
    return usual if abs(off[0]) <= abs(off[1]) else other
