"""Field of view and range of the sensors of a survey, for the entry ``sensor`` of ``map.yaml``.

A rig that looks ahead alone, a roof or a mast leaves azimuths without beams. Azimuths count from the heading
of the vehicle. An azimuth is blind if no sequence of the survey has beams there.
"""

from __future__ import annotations

import numpy as np

from subiaco_geo.frames import Floats
from subiaco_geo.free_space.azimuth_sector import Arcs
from subiaco_geo.free_space.sensor_view import SensorView, upright_sense
from subiaco_mapping.method_numbers import NUMBERS

_ANGLE = np.radians(NUMBERS.fusion.elevation_cell_deg)
_AZIMUTHS = NUMBERS.fusion.azimuth_cells
_EMPTY = NUMBERS.fusion.azimuth_stray
_RANGE = NUMBERS.fusion.range_cell
_STRAY = NUMBERS.fusion.stray_beams
_REACHED = NUMBERS.fusion.useful_range


class FieldOfView:
    """Collects elevations, azimuths and ranges of scans, in the sensor's own axes.

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
        self._azimuths = np.zeros(_AZIMUTHS, dtype=np.int64)
        self._ranges = np.zeros(max(int(np.ceil(longest / _RANGE)), 1), dtype=np.int64)

    def add(self, xyz: Floats, sky_xyz: Floats) -> None:
        """Take returns (N, 3) of a scan and ends (K, 3) of beams that met nothing [m, its own axes]."""
        for beams in (xyz, sky_xyz):
            distance = np.linalg.norm(beams, axis=1)
            sine = np.clip(beams[:, 2] / np.maximum(distance, 1e-9), -1.0, 1.0)
            cell = ((np.arcsin(sine) + 0.5 * np.pi) / _ANGLE).astype(np.int64)
            last = len(self._elevations) - 1
            turns = np.mod(np.arctan2(beams[:, 1], beams[:, 0]) / (2.0 * np.pi), 1.0)
            sector = np.minimum((turns * _AZIMUTHS).astype(np.int64), _AZIMUTHS - 1)
            self._azimuths += np.bincount(sector, minlength=_AZIMUTHS)
            self._elevations += np.bincount(np.minimum(cell, last), minlength=last + 1)
        self._ranges += _counted(np.linalg.norm(xyz, axis=1), len(self._ranges))

    def view(self, rotations: Floats) -> SensorView | None:
        """Return what was looked at; None without any beam.

        Parameters
        ----------
        rotations : (K, 3, 3) float64
            From the axes of the sensor to the world, along the survey. A sensor whose z axis is not upright
            has no stated azimuths.
        """
        total = np.cumsum(self._elevations)
        if total[-1] == 0 or self._ranges.sum() == 0:
            return None
        low, high = np.searchsorted(total, np.array([_STRAY, 1.0 - _STRAY]) * total[-1])
        reached = np.searchsorted(np.cumsum(self._ranges), _REACHED * self._ranges.sum())
        return SensorView(
            float(low * _ANGLE - 0.5 * np.pi),
            float((high + 1) * _ANGLE - 0.5 * np.pi),
            max(float((reached + 1) * _RANGE), self._proven),
            self._blind(upright_sense(rotations)),
        )

    def _blind(self, sense: int) -> Arcs | None:
        """Return the arcs of azimuths without beams; None where azimuths do not turn about the vertical."""
        if sense == 0:
            return None
        counts = self._azimuths[::sense]
        empty = counts <= _EMPTY * np.median(counts[counts > 0])
        if empty.all() or not empty.any():
            return ()
        step = 2.0 * np.pi / _AZIMUTHS
        first = np.flatnonzero(empty & ~np.roll(empty, 1))
        last = np.flatnonzero(empty & ~np.roll(empty, -1))
        last = last if last[0] >= first[0] else np.roll(last, -1)
        extents = (last - first) % _AZIMUTHS + 1
        return tuple(zip((first * step).tolist(), (extents * step).tolist(), strict=True))


def _counted(distance: Floats, cells: int) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    index = np.minimum((distance / _RANGE).astype(np.int64), cells - 1)
    return np.bincount(index, minlength=cells).astype(np.int64)
