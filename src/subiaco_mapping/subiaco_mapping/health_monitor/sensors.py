"""Health of IMU, GNSS receiver and disk, each from its own messages."""

from __future__ import annotations

from collections import deque

import numpy as np

from subiaco_geo.frames import Floats
from subiaco_mapping.health_monitor.config import DiskLimits, GnssLimits, ImuLimits
from subiaco_mapping.measurements import GnssFix, ImuSample

GRAVITY = 9.81
STATES = {2: "rtk fixed", 1: "float", 0: "single"}
_SECOND_NS = 1_000_000_000


def state_name(status: int) -> str:
    """Return a fix's state in words."""
    return STATES.get(min(status, 2), "none")


class ImuWatch:
    """Values that an IMU in a car can have.

    Parameters
    ----------
    limits : ImuLimits
    """

    def __init__(self, limits: ImuLimits) -> None:
        self._limits = limits
        self._last: ImuSample | None = None
        self._changed_ns = 0
        self._start_ns: int | None = None
        self._sum = np.zeros(3)
        self._count = 0
        self._mean: Floats | None = None
        self._fault = ""
        self._fault_ns = 0
        self.out_of_order = 0

    def take(self, sample: ImuSample, now_ns: int) -> None:
        """Note one sample."""
        self._judge(sample, now_ns)
        last = self._last
        if last is not None and sample.time_ns <= last.time_ns:
            self.out_of_order += 1
        same = last is not None and bool(
            (last.gyro == sample.gyro).all() and (last.accel == sample.accel).all()
        )
        if not same:
            self._changed_ns = now_ns
        self._last = sample
        self._average(sample, now_ns)

    def _judge(self, sample: ImuSample, now_ns: int) -> None:
        if not (np.isfinite(sample.gyro).all() and np.isfinite(sample.accel).all()):
            self._fault, self._fault_ns = "values are not finite", now_ns
        elif float(np.abs(sample.gyro).max()) > self._limits.max_gyro:
            self._fault = f"turns at {np.abs(sample.gyro).max():.1f} rad/s: saturated, or in deg/s"
            self._fault_ns = now_ns

    def _average(self, sample: ImuSample, now_ns: int) -> None:
        if self._start_ns is None or now_ns - self._start_ns >= _SECOND_NS:
            if self._count >= 5:
                self._mean = self._sum / self._count
            self._start_ns, self._sum, self._count = now_ns, np.zeros(3), 0
        if np.isfinite(sample.accel).all():
            self._sum = self._sum + sample.accel
            self._count += 1

    def fault(self, now_ns: int) -> str:
        """Say what is wrong, empty where nothing is."""
        if self._fault and now_ns - self._fault_ns < _SECOND_NS:
            return self._fault
        if self._last is not None and now_ns - self._changed_ns > self._limits.stuck_ns:
            return "the same values over and over: stuck"
        return "" if self._mean is None else self._gravity_fault(float(np.linalg.norm(self._mean)))

    def _gravity_fault(self, force: float) -> str:
        if abs(force - GRAVITY) <= self._limits.gravity_tolerance:
            return ""
        if abs(force - 1.0) < 0.2:
            return "specific force in g; sensor_msgs/Imu wants m/s2"
        if force < 1.0:
            return "gravity is missing: the driver removes it; switch that off"
        return f"mean specific force {force:.1f} m/s2 is not gravity"


class GnssWatch:
    """RTK state, stated accuracy, dilution of precision.

    Parameters
    ----------
    limits : GnssLimits
    """

    def __init__(self, limits: GnssLimits) -> None:
        self._limits = limits
        self.states: dict[str, int] = {}
        self.last: GnssFix | None = None
        self._fixed_ns: int | None = None
        self._first_ns: int | None = None
        self._dop: tuple[int, float, float] | None = None

    def take(self, fix: GnssFix, now_ns: int) -> None:
        """Note one fix, its status already that of the driver profile."""
        self._first_ns = now_ns if self._first_ns is None else self._first_ns
        self.last = fix
        state = state_name(fix.status) if fix.is_usable() else "none"
        self.states[state] = self.states.get(state, 0) + 1
        if state == "rtk fixed":
            self._fixed_ns = now_ns

    def take_dop(self, hdop: float, pdop: float, now_ns: int) -> None:
        """Note dilutions of precision; NaN where the driver does not say."""
        self._dop = (now_ns, hdop, pdop)

    @property
    def state(self) -> str:
        """The state of the newest fix."""
        return "none" if self.last is None or not self.last.is_usable() else state_name(self.last.status)

    def sigma(self) -> float:
        """Return the horizontal standard deviation that the driver states [m], NaN where it does not."""
        if self.last is None or not self.last.is_usable():
            return float("nan")
        variance = float(max(self.last.covariance[0, 0], self.last.covariance[1, 1]))
        return float(np.sqrt(variance)) if variance > 0 else float("nan")

    def without_fixed(self, now_ns: int) -> bool:
        """Whether there was no RTK fixed solution for longer than the limit."""
        reference = self._fixed_ns if self._fixed_ns is not None else self._first_ns
        return reference is not None and now_ns - reference > self._limits.rtk_gap_ns

    def dop(self, now_ns: int) -> tuple[float, float]:
        """Return HDOP and PDOP, NaN where they are unknown or old."""
        if self._dop is None or now_ns - self._dop[0] > 5 * _SECOND_NS:
            return float("nan"), float("nan")
        return self._dop[1], self._dop[2]

    def poor(self, now_ns: int) -> str:
        """Say what is poor about the geometry, empty where nothing is."""
        hdop, pdop = self.dop(now_ns)
        if hdop > self._limits.max_hdop:
            return f"HDOP {hdop:.1f}"
        if pdop > self._limits.max_pdop:
            return f"PDOP {pdop:.1f}"
        sigma = self.sigma()
        return f"horizontal sigma {sigma:.2f} m" if sigma > self._limits.max_sigma else ""


class DiskWatch:
    """Room for the recording and how fast it goes.

    Parameters
    ----------
    limits : DiskLimits
    """

    def __init__(self, limits: DiskLimits) -> None:
        self._limits = limits
        self._samples: deque[tuple[int, float]] = deque()

    def take(self, free: float, now_ns: int) -> None:
        """Note the free space [bytes]."""
        self._samples.append((now_ns, free))
        while self._samples[0][0] < now_ns - 60 * _SECOND_NS:
            self._samples.popleft()

    @property
    def free(self) -> float:
        """Free space [bytes], NaN where it is not watched."""
        return self._samples[-1][1] if self._samples else float("nan")

    @property
    def minutes(self) -> float:
        """Minutes left at the rate of the last minute; infinite where it does not shrink."""
        if len(self._samples) < 2 or self._samples[-1][0] - self._samples[0][0] < 5 * _SECOND_NS:
            return float("inf")
        (start_ns, before), (end_ns, after) = self._samples[0], self._samples[-1]
        rate = (before - after) / ((end_ns - start_ns) * 1e-9)
        return after / rate / 60.0 if rate > 0 else float("inf")

    def full(self) -> bool:
        """Whether recording must end now."""
        return self.free < self._limits.full

    def low(self) -> bool:
        """Whether the end is near."""
        return self.free < self._limits.low or self.minutes < self._limits.low_minutes
