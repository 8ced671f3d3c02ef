"""Position of the vehicle: good fixes, and odometry between them."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from subiaco_geo.crs import EnuFrame
from subiaco_geo.frames import Floats
from subiaco_mapping.measurements import GnssFix

_PAIRS = 100
_FRESH_NS = 1_000_000_000
_MIN_WAY = 20.0


@dataclass(frozen=True)
class TimedPosition:
    """One position: time [ns], east and north [m] about the first fix."""

    time_ns: int
    east: float
    north: float


class Positions:
    """Follow the vehicle through places without satellites.

    The odometry is laid over the last fixes by a turn about the vertical and a shift, so it carries
    on where they end.
    """

    def __init__(self) -> None:
        self.frame: EnuFrame | None = None
        self._fix: tuple[int, Floats] | None = None
        self._odometry: tuple[int, Floats] | None = None
        self._pairs: deque[tuple[Floats, Floats]] = deque(maxlen=_PAIRS)

    def on_fix(self, fix: GnssFix, now_ns: int) -> TimedPosition | None:
        """Take a fix; return where the vehicle is."""
        if not fix.is_usable():
            return None
        if self.frame is None:
            self.frame = EnuFrame(fix.latitude, fix.longitude, fix.altitude)
        columns = (np.array([value]) for value in (fix.latitude, fix.longitude, fix.altitude))
        enu = self.frame.from_geodetic(*columns)[0]
        self._fix = (now_ns, enu)
        if self._odometry is not None and now_ns - self._odometry[0] < _FRESH_NS:
            self._pairs.append((self._odometry[1], enu))
        return TimedPosition(now_ns, float(enu[0]), float(enu[1]))

    def on_odometry(self, xyz: Floats, now_ns: int) -> TimedPosition | None:
        """Take an odometry position (3,) [m]; return where that is, once fixes have stayed away."""
        self._odometry = (now_ns, xyz)
        if self._fix is None or now_ns - self._fix[0] < _FRESH_NS:
            return None
        carried = self._carried(xyz)
        return None if carried is None else TimedPosition(now_ns, float(carried[0]), float(carried[1]))

    def broken(self) -> None:
        """Forget the odometry: it began again elsewhere."""
        self._pairs.clear()

    def _carried(self, xyz: Floats) -> Floats | None:
        if len(self._pairs) < 3:
            return None
        source, target = (np.array(side) for side in zip(*self._pairs, strict=True))
        if np.linalg.norm(source[-1] - source[0]) < _MIN_WAY:
            return None
        turn = planar_turn(source[:, :2], target[:, :2])
        return np.asarray((xyz[:2] - source[-1, :2]) @ turn.T + target[-1, :2])


def planar_turn(source: Floats, target: Floats) -> Floats:
    """Return the rotation (2, 2) that turns points (N, 2) onto others best, shift apart."""
    a, b = ((side - side.mean(axis=0)) @ np.array([1.0, 1.0j]) for side in (source, target))
    yaw = float(np.angle(np.vdot(a, b)))
    return np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
