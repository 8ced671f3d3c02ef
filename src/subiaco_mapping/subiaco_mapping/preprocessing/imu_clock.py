"""Offset of the IMU's clock from the LiDAR's, estimated in constant memory.

Between two scans the odometry turns by what the gyro integrates to, unless the stamps are off: an
offset shows as the change of rate between start and end. Linearised at the offset in use, so that
normal equations can be summed as scans come; a large offset comes out too small by a third or so,
since scans deskewed with a wrong clock hide a part of it. ``subiaco calibrate-rig`` iterates.
"""

from __future__ import annotations

import logging
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.integrate import trapezoid
from scipy.spatial.transform import Rotation

from subiaco_geo.frames import Floats
from subiaco_mapping.measurements import ImuSample, OdometryPose
from subiaco_mapping.method_numbers import NUMBERS

logger = logging.getLogger(__name__)

WARN_MS = NUMBERS.preprocessing.clock_warning_ms
SECOND = 1e9
MAX_STEP = NUMBERS.preprocessing.clock_step
MAX_HOLE = NUMBERS.preprocessing.clock_hole
MIN_INTERVALS = NUMBERS.preprocessing.clock_intervals
KERNEL = NUMBERS.preprocessing.clock_kernel
FIRST_SIGMA = NUMBERS.preprocessing.clock_first_sigma
MEMORY = NUMBERS.preprocessing.clock_memory
PRIORS = np.array(NUMBERS.preprocessing.clock_priors)


@dataclass(frozen=True)
class ClockEstimate:
    """Offset to be added to IMU stamps, beside the one in use, and its sigma [ms]; intervals used."""

    offset_ms: float
    sigma_ms: float
    intervals: int

    @property
    def off(self) -> bool:
        """Whether the clock is off by more than 2 ms and that is no chance."""
        return abs(self.offset_ms) > max(WARN_MS, 3 * self.sigma_ms)


class ImuClock:
    """Compare the gyro with the odometry, scan by scan.

    Parameters
    ----------
    R_lidar_imu : (3, 3) float64 or None
        None: no IMU, no estimate.
    imu_time_offset_ns : int
        In use, added to every stamp.
    """

    def __init__(self, R_lidar_imu: Floats | None, imu_time_offset_ns: int = 0) -> None:
        self._R = R_lidar_imu
        self._shift_ns = imu_time_offset_ns
        self._samples: deque[ImuSample] = deque()
        self._last: OdometryPose | None = None
        self._information = np.diag(1.0 / PRIORS**2)
        self._pull = np.zeros(7)
        self._sigma = FIRST_SIGMA
        self._intervals = 0
        self._warned = False

    def push_imu(self, sample: ImuSample) -> None:
        """Take one sample; one that is not newer than the last is left out."""
        finite = np.isfinite(sample.gyro).all()
        if self._R is None or not finite:
            return
        if not self._samples or sample.time_ns > self._samples[-1].time_ns:
            self._samples.append(sample)

    def push_pose(self, pose: OdometryPose) -> None:
        """Take one registered scan, after the IMU samples that reach over its end."""
        last, self._last = self._last, pose
        if last is not None and last.segment == pose.segment and not (pose.predicted or last.predicted):
            self._compare(last, pose)
        limit = pose.stamp_ns - self._shift_ns
        while len(self._samples) > 2 and self._samples[1].time_ns <= limit:
            self._samples.popleft()

    def _compare(self, last: OdometryPose, pose: OdometryPose) -> None:
        step_s = (pose.stamp_ns - last.stamp_ns) / SECOND
        t = np.array([s.time_ns + self._shift_ns - last.stamp_ns for s in self._samples]) / SECOND
        if step_s > MAX_STEP or len(t) < 3 or t[0] > 0 or t[-1] < step_s or np.diff(t).max() > MAX_HOLE:
            return
        rates = np.array([s.gyro for s in self._samples]) @ np.asarray(self._R).T
        inside = (t > 0) & (t < step_s)
        knots = np.concatenate([[0.0], t[inside], [step_s]])
        at = np.stack([np.interp(knots, t, rates[:, i]) for i in range(3)], axis=1)
        turned = np.asarray(trapezoid(at, knots, axis=0))
        between = last.T_odom_lidar[:3, :3].T @ pose.T_odom_lidar[:3, :3]
        self._add(Rotation.from_matrix(between).as_rotvec() - turned, turned, at[0] - at[-1], step_s)

    def _add(self, residual: Floats, turned: Floats, change: Floats, step_s: float) -> None:
        x, y, z = turned
        cross = np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])  # theta x turned
        slope = np.column_stack([cross, -step_s * np.eye(3), change])
        left = float(np.linalg.norm(residual - slope @ self._solution()[0])) / np.sqrt(3)
        weight = min(1.0, KERNEL * self._sigma / max(left, 1e-12)) / self._sigma**2
        self._information += weight * slope.T @ slope
        self._pull += weight * slope.T @ residual
        self._intervals += 1
        share = 1.0 / min(self._intervals + 5, MEMORY)
        clipped = min(left, KERNEL * self._sigma)
        self._sigma = float(np.sqrt((1 - share) * self._sigma**2 + share * clipped**2))

    def _solution(self) -> tuple[Floats, Floats]:
        covariance = np.asarray(np.linalg.inv(self._information), dtype=np.float64)
        return covariance @ self._pull, covariance

    def estimate(self) -> ClockEstimate | None:
        """Return what is known so far, None before enough scans."""
        if self._intervals < MIN_INTERVALS:
            return None
        values, covariance = self._solution()
        return ClockEstimate(float(values[6]) * 1e3, float(np.sqrt(covariance[6, 6])) * 1e3, self._intervals)

    def facts(self) -> dict[str, Any]:
        """Return what the manifest notes; empty before enough scans."""
        found = self.estimate()
        if found is None:
            return {}
        if found.off and not self._warned:
            self._warned = True
            logger.warning(
                "the IMU's clock is %.1f +- %.1f ms off the LiDAR's; run subiaco calibrate-rig or set "
                "deskew.imu_time_offset_ns",
                found.offset_ms,
                found.sigma_ms,
            )
        numbers = {"offset_ms": round(found.offset_ms, 3), "sigma_ms": round(found.sigma_ms, 3)}
        return {"imu_clock": {**numbers, "off": found.off, "intervals": found.intervals}}
