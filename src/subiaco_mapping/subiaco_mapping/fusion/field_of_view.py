"""Field of view and range of the sensors of a survey, for the entry ``sensor`` of ``map.yaml``."""

from __future__ import annotations

import numpy as np

from subiaco_geo.frames import Floats
from subiaco_geo.free_space.sensor_view import SensorView
from subiaco_mapping.method_numbers import NUMBERS

_ANGLE = np.radians(NUMBERS.fusion.elevation_cell_deg)
_RANGE = NUMBERS.fusion.range_cell
_STRAY = NUMBERS.fusion.stray_beams
_REACHED = NUMBERS.fusion.useful_range


class FieldOfView:
    """Collects elevations and ranges of scans, in the sensor's own axes.

    Beams that met nothing count for the elevations too: the upper ones often meet the sky alone.

    Parameters
    ----------
    proven : float
        Range up to which a beam that met nothing proves empty air [m]; the useful range is no less.
    longest : float
        Farther returns count as this range [m].
    """

    def __init__(self, proven: float, longest: float) -> None:
        self._proven = proven
        self._elevations = np.zeros(round(np.pi / _ANGLE), dtype=np.int64)
        self._ranges = np.zeros(max(int(np.ceil(longest / _RANGE)), 1), dtype=np.int64)

    def add(self, xyz: Floats, sky_xyz: Floats) -> None:
        """Take returns (N, 3) of a scan and ends (K, 3) of beams that met nothing [m, its own axes]."""
        for beams in (xyz, sky_xyz):
            distance = np.linalg.norm(beams, axis=1)
            sine = np.clip(beams[:, 2] / np.maximum(distance, 1e-9), -1.0, 1.0)
            cell = ((np.arcsin(sine) + 0.5 * np.pi) / _ANGLE).astype(np.int64)
            last = len(self._elevations) - 1
            self._elevations += np.bincount(np.minimum(cell, last), minlength=last + 1)
        self._ranges += _counted(np.linalg.norm(xyz, axis=1), len(self._ranges))

    def view(self) -> SensorView | None:
        """Return what was looked at; None without any beam."""
        total = np.cumsum(self._elevations)
        if total[-1] == 0 or self._ranges.sum() == 0:
            return None
        low, high = np.searchsorted(total, np.array([_STRAY, 1.0 - _STRAY]) * total[-1])
        reached = np.searchsorted(np.cumsum(self._ranges), _REACHED * self._ranges.sum())
        return SensorView(
            float(low * _ANGLE - 0.5 * np.pi),
            float((high + 1) * _ANGLE - 0.5 * np.pi),
            max(float((reached + 1) * _RANGE), self._proven),
        )


def _counted(distance: Floats, cells: int) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    index = np.minimum((distance / _RANGE).astype(np.int64), cells - 1)
    return np.bincount(index, minlength=cells).astype(np.int64)
