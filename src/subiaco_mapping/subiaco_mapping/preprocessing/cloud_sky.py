"""Beams without a return in clouds that hold returns alone: what is missing from a turning scanner's rings.

Each ring of a turning scanner has one elevation, and each of its columns an azimuth. The cells of this
lattice in which no point lies returned nothing; :mod:`.sky` says which of them surely met the sky. Without
them, nothing is known of the space above a roof until something stands there.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.frames import Floats, Ints
from subiaco_mapping.measurements import Returns
from subiaco_mapping.method_numbers import NUMBERS
from subiaco_mapping.preprocessing.sky import sky_mask, thinned

_FEWEST_RINGS, _MOST_RINGS = NUMBERS.preprocessing.cloud_rings
_SPREAD = np.radians(NUMBERS.preprocessing.ring_spread_deg)
_NEAR = NUMBERS.preprocessing.ring_nearest
_FEW = NUMBERS.preprocessing.timed_points
_COLUMNS = NUMBERS.preprocessing.cloud_columns
_TURN_NS = 100_000_000  # numbers clouds, so that each takes another lattice of beams


class SkyOfClouds:
    """Beams into the sky of the clouds of one scanner; it learns the elevations of the rings.

    A ring that met the sky alone has no point from which its elevation could be taken, but had some in
    earlier clouds.
    """

    def __init__(self) -> None:
        self._sums = np.zeros((_MOST_RINGS, 3))  # of each ring: points, elevations, their squares

    def find(self, xyz: Floats, times_ns: Ints, ring: NDArray[np.uint16], sky_range: float) -> Returns | None:
        """Return where a lattice of the beams that met nothing would be at ``sky_range``.

        Parameters
        ----------
        xyz : (N, 3) float64
            All returns of a cloud, in ``lidar_link`` at their own times, those too near or far too [m].
        times_ns : (N,) int64
        ring : (N,) uint16
        sky_range : float
            [m]; 0 for none.

        Returns
        -------
        Returns or None
            None where the rings have no elevations of their own: no turning scanner, or no rings.
        """
        if sky_range <= 0 or len(xyz) < _FEW or int(ring.max()) >= _MOST_RINGS:
            return None
        flat = np.hypot(xyz[:, 0], xyz[:, 1])
        self._learn(np.arctan2(xyz[:, 2], flat), ring, flat > _NEAR)
        count, total, squares = self._sums.T
        known = np.flatnonzero(count >= _FEW)
        mean = total[known] / count[known]
        spread = np.sqrt(np.maximum(squares[known] / count[known] - mean**2, 0.0))
        if len(known) < _FEWEST_RINGS or np.median(spread) > _SPREAD:
            return None
        highest_first = np.argsort(-mean)
        order, elevation = known[highest_first], mean[highest_first]
        row = np.full(_MOST_RINGS, -1)
        row[order] = np.arange(len(order))
        azimuth = np.arctan2(xyz[:, 1], xyz[:, 0])
        columns = _columns(azimuth[ring == np.argmax(np.bincount(ring))])
        column = np.minimum(((azimuth + np.pi) * (columns / (2 * np.pi))).astype(np.int64), columns - 1)
        returned = np.zeros((len(order), columns), dtype=np.bool_)
        inside = row[ring] >= 0
        returned[row[ring[inside]], column[inside]] = True
        when = np.zeros(columns, dtype=np.int64)
        when[column] = times_ns
        # A column without any return was not received: at the latest the road returns something.
        received = np.broadcast_to(when > 0, returned.shape)
        turn = int(times_ns.min() // _TURN_NS)
        lines, places = thinned(sky_mask(returned, received), turn)
        angle = (places + 0.5) * (2 * np.pi / columns) - np.pi
        high = elevation[lines]
        beams = np.stack([np.cos(high) * np.cos(angle), np.cos(high) * np.sin(angle), np.sin(high)], axis=1)
        nothing = np.zeros(len(beams), dtype=np.float32)
        return Returns(sky_range * beams, when[places], nothing, order[lines].astype(np.uint16))

    def _learn(self, elevation: Floats, ring: NDArray[np.uint16], far: NDArray[np.bool_]) -> None:
        own, angle = ring[far], elevation[far]
        for power in range(3):
            self._sums[:, power] += np.bincount(own, angle**power, _MOST_RINGS)


def _columns(azimuth: Floats) -> int:
    """Return the number of columns of a turn, from the azimuths (N,) of one ring."""
    step = np.diff(np.sort(azimuth))
    return int(np.clip(round(2 * np.pi / max(float(np.median(step)), 1e-6)), *_COLUMNS))
