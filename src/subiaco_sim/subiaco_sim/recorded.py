"""Speed and swing of a real drive: RTK fixes (RTKLIB .pos) and the IMU beside them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats

_STEP = 0.05  # of the profile [s]
_REST = 0.3  # below this the vehicle stands [m/s]
_SWING = 2.0  # slower turns than this belong to the road [s]


@dataclass(frozen=True)
class RecordedDrive:
    """A recorded drive on an even grid: speed [m/s], and pitch and roll of the body on its springs [rad]."""

    speed: Floats  # (N,)
    pitch: Floats  # (N,)
    roll: Floats  # (N,)

    def stretch(self, duration: float, rng: np.random.Generator) -> RecordedDrive:
        """Return a part that begins at rest and lasts ``duration`` and 4 s more, drawn among all such.

        Raises
        ------
        InputError
            The recording has none.
        """
        count = int((duration + 4.0) / _STEP) + 2
        still = np.convolve(self.speed < _REST, np.ones(60), mode="full")[: len(self.speed)] >= 60
        leaves = np.flatnonzero(still[:-1] & ~still[1:]) - 59
        leaves = leaves[(leaves >= 0) & (leaves + count <= len(self.speed))]
        if len(leaves) == 0:
            raise InputError(f"recorded_drive: no stretch of {duration:g} s begins at rest; ask for less")
        part = slice(int(k := rng.choice(leaves)), int(k) + count)
        return RecordedDrive(self.speed[part], self.pitch[part], self.roll[part])

    def travelled(self, seconds: Floats) -> Floats:
        """Return the distance driven; the grid begins 2 s before zero [m]."""
        grid = np.arange(len(self.speed)) * _STEP - 2.0
        moving = np.where(grid > 0, np.where(self.speed < _REST, 0.0, self.speed), 0.0)
        return np.asarray(np.interp(seconds, grid, np.cumsum(moving) * _STEP))

    def swing(self, seconds: Floats) -> tuple[Floats, Floats]:
        """Return pitch and roll on the springs [rad]."""
        grid = np.arange(len(self.speed)) * _STEP - 2.0
        return np.interp(seconds, grid, self.pitch), np.interp(seconds, grid, self.roll)


def read_recorded_drive(folder: Path) -> RecordedDrive:
    """Read ``gnss*.pos`` (velocities) and ``imu*.csv.gz`` (rates) of one drive.

    Raises
    ------
    InputError
        The folder lacks them.
    """
    fixes, inertial = sorted(folder.glob("gnss*.pos")), sorted(folder.glob("imu*.csv.gz"))
    if not fixes or not inertial:
        raise InputError(f"recorded_drive {folder}: needs gnss*.pos and imu*.csv.gz; leave the setting out")
    times, speed = _read_speed(fixes[0])
    imu = pd.read_csv(inertial[0], comment="#", header=None).to_numpy(dtype=np.float64)
    grid = np.arange(max(times[0], imu[0, 0]), min(times[-1], imu[-1, 0]), _STEP)
    level = _smooth(np.interp(grid, times, speed), 0.6)
    roll, pitch = (_swing(np.interp(grid, imu[:, 0], imu[:, k])) for k in (4, 5))
    return RecordedDrive(level, pitch, roll)


def _read_speed(path: Path) -> tuple[Floats, Floats]:
    """Return times [s, GPST as Unix] and horizontal speed [m/s]."""
    table = pd.read_csv(path, sep=r"\s+", comment="%", header=None)
    stamps = pd.to_datetime(table[0] + " " + table[1], format="%Y/%m/%d %H:%M:%S.%f")
    seconds = stamps.astype("datetime64[ns]").astype(np.int64).to_numpy() * 1e-9
    return seconds, np.hypot(table[15], table[16]).to_numpy(dtype=np.float64)


def _swing(rate: Floats) -> Floats:
    """Integrate a rate and keep what swings faster than the road turns."""
    angle = np.cumsum(rate - _smooth(rate, 10.0)) * _STEP
    return _smooth(angle - _smooth(angle, _SWING), 0.2)


def _smooth(values: Floats, seconds: float) -> Floats:
    """Average over a window twice, ends held."""
    width = 2 * int(seconds / _STEP / 2) + 1
    for _ in range(2):
        values = np.convolve(np.pad(values, width // 2, mode="edge"), np.ones(width) / width, mode="valid")
    return np.asarray(values)
