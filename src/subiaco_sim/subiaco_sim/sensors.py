"""Spinning sensors of 32, 64 and 128 beams with the beam angles of real units.

Angles are elevations from the sensor's horizontal plane, highest beam first, and offsets of the azimuth
[deg]. Those of OS1-128 and OS0-32 are the calibration of one unit each (sample metadata of the maker's SDK,
BSD-3), those of OS1-64 the SDK's default for its first generation; HDL-32E is evenly spaced.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from subiaco_geo.frames import Floats


class SensorName(StrEnum):
    """Sensors of the second edition's presets."""

    OS1_128 = "os1-128"
    OS1_64 = "os1-64"
    OS0_32 = "os0-32"
    HDL_32E = "hdl-32e"


# fmt: off
_OS1_128 = (
    20.95, 20.67, 20.36, 20.03, 19.73, 19.41, 19.11, 18.76, 18.47, 18.14, 17.82, 17.5, 17.19, 16.86,
    16.53, 16.2, 15.89, 15.56, 15.23, 14.9, 14.57, 14.23, 13.9, 13.57, 13.25, 12.91, 12.57, 12.22, 11.9,
    11.55, 11.2, 10.87, 10.54, 10.18, 9.84, 9.51, 9.15, 8.81, 8.47, 8.11, 7.78, 7.43, 7.08, 6.74, 6.39,
    6.04, 5.7, 5.34, 4.98, 4.64, 4.29, 3.93, 3.58, 3.24, 2.88, 2.53, 2.17, 1.82, 1.47, 1.12, 0.78, 0.41,
    0.07, -0.28, -0.64, -0.99, -1.35, -1.7, -2.07, -2.4, -2.75, -3.11, -3.46, -3.81, -4.15, -4.5, -4.86,
    -5.22, -5.57, -5.9, -6.27, -6.61, -6.97, -7.3, -7.67, -8.01, -8.35, -8.69, -9.05, -9.38, -9.71,
    -10.07, -10.42, -10.76, -11.09, -11.43, -11.78, -12.12, -12.46, -12.78, -13.15, -13.46, -13.8, -14.12,
    -14.48, -14.79, -15.11, -15.46, -15.79, -16.12, -16.45, -16.76, -17.11, -17.44, -17.74, -18.06,
    -18.39, -18.72, -19.02, -19.32, -19.67, -19.99, -20.27, -20.57, -20.92, -21.22, -21.54, -21.82,
)
_OS0_32 = (
    43.88, 40.9, 37.94, 34.98, 32.06, 29.16, 26.25, 23.37, 20.51, 17.66, 14.81, 11.99, 9.17, 6.35, 3.55,
    0.72, -2.09, -4.9, -7.72, -10.55, -13.38, -16.22, -19.06, -21.92, -24.79, -27.68, -30.58, -33.49,
    -36.43, -39.39, -42.38, -45.4,
)
_OS0_32_AZIMUTH = (
    -2.9, -2.83, -2.78, -2.73, -2.7, -2.67, -2.65, -2.64, -2.65, -2.65, -2.65, -2.67, -2.69, -2.71, -2.74,
    -2.78, -2.81, -2.85, -2.89, -2.95, -3.01, -3.08, -3.17, -3.25, -3.35, -3.46, -3.58, -3.72, -3.87,
    -4.05, -4.25, -4.48,
)
# fmt: on


@dataclass(frozen=True)
class Sensor:
    """A sensor by its line name and the elevation and azimuth offset of every beam (B,) [deg]."""

    line: str
    elevation_deg: Floats
    azimuth_deg: Floats

    @property
    def beams(self) -> int:
        """Return the number of beams."""
        return len(self.elevation_deg)


SENSORS: dict[SensorName, Sensor] = {
    SensorName.OS1_128: Sensor("OS-1-128", np.array(_OS1_128), np.tile([4.21, 1.41, -1.40, -4.21], 32)),
    SensorName.OS1_64: Sensor(
        "OS-1-64", np.round(np.linspace(16.611, -16.611, 64), 3), np.tile([3.164, 1.055, -1.055, -3.164], 16)
    ),
    SensorName.OS0_32: Sensor("OS-0-32", np.array(_OS0_32), np.array(_OS0_32_AZIMUTH)),
    SensorName.HDL_32E: Sensor("HDL-32E", np.round(10.67 - 4.0 / 3.0 * np.arange(32), 2), np.zeros(32)),
}


def row_shift(sensor: Sensor, columns: int) -> list[int]:
    """Return by how many columns each row is shifted so that a column looks one way, 0 for the last one."""
    shift = np.round(sensor.azimuth_deg * columns / 360.0).astype(np.int64)
    return [int(value) for value in shift - shift.min()]
