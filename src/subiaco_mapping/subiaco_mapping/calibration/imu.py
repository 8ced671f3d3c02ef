"""Rotation and clock offset of the IMU against the odometry.

Odometry gives rotation and mean velocity between scans. The gyro integrates to the same rotation,
the accelerometer (with gravity, which is estimated too) to the same changes of velocity. What a
car's motion leaves open, e.g. the yaw of an IMU on a vehicle that only turns left and right and
holds its speed, comes out with a large sigma and stays as given.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation, Slerp

from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, Ints
from subiaco_mapping.calibration.config import CalibrationConfig
from subiaco_mapping.calibration.estimate import Estimate, solve, spread

GRAVITY = 9.80
GYRO_BIAS, ACCEL_BIAS = 0.05, 0.1  # what is believed of them beforehand [rad/s, m/s2]
MAX_GAP = 0.1  # longest hole of the IMU that is bridged [s]
MIN_SCANS = 30


@dataclass(frozen=True)
class ImuTrack:
    """IMU samples: times (N,) int64 [ns], increasing; gyro and accel (N, 3) [rad/s, m/s2]."""

    times_ns: Ints
    gyro: Floats
    accel: Floats


@dataclass(frozen=True)
class OdometryTrack:
    """Odometry: stamps (S,) int64 [ns], increasing; ``T_odom_lidar`` (S, 4, 4); segment (S,)."""

    stamps_ns: Ints
    T_odom_lidar: Floats
    segment: Ints


@dataclass(frozen=True)
class ImuFit:
    """The IMU's rotation and clock.

    Parameters
    ----------
    R_lidar_imu : (3, 3) float64
    offset_s : float
        To be added to the IMU's stamps.
    rotation_sigma : (3,) float64
        About the LiDAR's axes [rad].
    rotation_observed : (3,) bool
    offset_sigma : float
        [s].
    offset_observed : bool
    gyro_bias, accel_bias : (3,) float64
        IMU axes [rad/s], [m/s2].
    gyro_residual, velocity_residual : float
        Spread per scan [rad], per window [m/s].
    up_odom : (3,) float64
        The vertical in the odometry frame.
    """

    R_lidar_imu: Floats
    offset_s: float
    rotation_sigma: Floats
    rotation_observed: NDArray[np.bool_]
    offset_sigma: float
    offset_observed: bool
    gyro_bias: Floats
    accel_bias: Floats
    gyro_residual: float
    velocity_residual: float
    up_odom: Floats


class ImuProblem:
    """Residuals of the IMU against odometry.

    Parameters of :meth:`gyro` and :meth:`velocity` are those of one vector (13,): rotation
    about LiDAR axes (3) [rad], offset [s], gyro bias (3), accel bias (3), gravity (3) [m/s2].
    """

    def __init__(
        self, odometry: OdometryTrack, imu: ImuTrack, R_lidar_imu: Floats, t_lidar_imu: Floats, window: float
    ) -> None:
        origin = odometry.stamps_ns[0]
        self._t = (odometry.stamps_ns - origin) * 1e-9
        self._imu_t = (imu.times_ns - origin) * 1e-9
        self._accel = imu.accel
        self._R = R_lidar_imu
        self._segment = odometry.segment
        rotations = odometry.T_odom_lidar[:, :3, :3]
        self._slerp = Slerp(self._t, Rotation.from_matrix(rotations))
        self._position = odometry.T_odom_lidar[:, :3, 3] + rotations @ t_lidar_imu
        self._turned = Rotation.from_matrix(np.swapaxes(rotations[:-1], 1, 2) @ rotations[1:]).as_rotvec()
        self._angle = cumulative_trapezoid(imu.gyro, self._imu_t, axis=0, initial=0.0)
        self._covered = self._covers()
        n = max(round(window / float(np.median(np.diff(self._t)))), 1)
        self._middle = np.arange(n, len(self._t) - n)
        self.overlap, self._n = n, n
        good = np.concatenate([[0], np.cumsum(~self._covered)])
        self._middle = self._middle[good[self._middle + n] == good[self._middle - n]]

    def _covers(self) -> NDArray[np.bool_]:
        """Mark the intervals (S - 1,) of odometry that the IMU covers whole, with a margin."""
        holes = np.flatnonzero(np.diff(self._imu_t) > MAX_GAP)
        bad = np.zeros(len(self._t) - 1, dtype=np.bool_)
        for hole in holes:
            bad |= (self._t[1:] > self._imu_t[hole] - MAX_GAP) & (
                self._t[:-1] < self._imu_t[hole + 1] + MAX_GAP
            )
        inside = (self._t[:-1] > self._imu_t[0] + MAX_GAP) & (self._t[1:] < self._imu_t[-1] - MAX_GAP)
        return np.asarray(inside & ~bad & (np.diff(self._segment) == 0))

    @property
    def intervals(self) -> int:
        """How many scans can be compared."""
        return int(self._covered.sum())

    def rotation(self, x: Floats) -> Floats:
        """Return ``R_lidar_imu`` (3, 3)."""
        return np.asarray(Rotation.from_rotvec(x[:3]).as_matrix() @ self._R)

    def _integrated(self, offset: float) -> Floats:
        at = self._t - offset
        angle = np.stack([np.interp(at, self._imu_t, self._angle[:, i]) for i in range(3)], axis=1)
        return np.diff(angle, axis=0)

    def gyro(self, x: Floats) -> Floats:
        """Return rotation by odometry less that by gyro (K, 3) [rad]."""
        turned = self._integrated(x[3]) - np.diff(self._t)[:, None] * x[4:7]
        return np.asarray((self._turned - turned @ self.rotation(x).T)[self._covered])

    def velocity(self, x: Floats) -> Floats:
        """Return changes of velocity by odometry less those by accelerometer (M, 3) [m/s]."""
        at = np.clip(self._imu_t + x[3], self._t[0], self._t[-1])
        force = (self._accel - x[7:10]) @ self.rotation(x).T
        acceleration = np.einsum("nij,nj->ni", self._slerp(at).as_matrix(), force) + x[10:13]
        speed = cumulative_trapezoid(acceleration, self._imu_t, axis=0, initial=0.0)
        way = cumulative_trapezoid(speed, self._imu_t, axis=0, initial=0.0)
        # between samples the way is a parabola, not a line
        query = self._t - x[3]
        before = np.clip(np.searchsorted(self._imu_t, query) - 1, 0, len(self._imu_t) - 2)
        step = (query - self._imu_t[before])[:, None]
        way = way[before] + speed[before] * step + 0.5 * acceleration[before] * step**2
        return self._bend(self._position) - self._bend(way)

    def _bend(self, way: Floats) -> Floats:
        """Return the change (M, 3) of mean velocity from before to after each middle scan."""
        a, b, c = self._middle - self._n, self._middle, self._middle + self._n
        after = (way[c] - way[b]) / (self._t[c] - self._t[b])[:, None]
        return np.asarray(after - (way[b] - way[a]) / (self._t[b] - self._t[a])[:, None])

    def first_offset(self, search: float, given: float) -> float:
        """Return the offset at which centred rates agree best, by trying [s]."""
        tried = given + np.arange(-search, search + 1e-9, 0.005)
        costs = []
        for offset in tried:
            difference = (self._turned - self._integrated(offset) @ self._R.T)[self._covered]
            costs.append(np.abs(difference - np.median(difference, axis=0)).sum())
        return float(tried[int(np.argmin(costs))])

    def gravity(self) -> Floats:
        """Return a first gravity (3,) in the odometry frame from the mean specific force."""
        at = np.clip(self._imu_t, self._t[0], self._t[-1])
        force = np.einsum("nij,nj->ni", self._slerp(at).as_matrix(), self._accel @ self._R.T)
        inside = (self._imu_t >= self._t[0]) & (self._imu_t <= self._t[-1])
        mean = force[inside].mean(axis=0)
        return np.asarray(-GRAVITY * mean / np.linalg.norm(mean))


def fit_imu(
    odometry: OdometryTrack,
    imu: ImuTrack,
    R_lidar_imu: Floats,
    t_lidar_imu: Floats,
    offset_s: float,
    config: CalibrationConfig,
) -> ImuFit:
    """Refine the IMU's rotation and clock.

    Parameters
    ----------
    odometry : OdometryTrack
    imu : ImuTrack
        Stamps as recorded.
    R_lidar_imu : (3, 3) float64
        As given.
    t_lidar_imu : (3,) float64
        As given; it is not estimated [m].
    offset_s : float
        As given, added to the IMU's stamps.
    config : CalibrationConfig

    Raises
    ------
    InputError
        Fewer scans than needed with IMU over them.
    """
    problem = ImuProblem(odometry, imu, R_lidar_imu, t_lidar_imu, config.window)
    if problem.intervals < MIN_SCANS:
        raise InputError(
            f"/imu/data: covers {problem.intervals} intervals between scans, {MIN_SCANS} are needed; "
            "record longer, with the IMU on"
        )
    given = np.concatenate([np.zeros(3), [offset_s], np.zeros(6), problem.gravity()])
    start = given.copy()
    start[3] = problem.first_offset(config.search_offset, offset_s)
    turn = np.radians(config.prior_rotation_deg)
    # a maximum found by trying says more than what was believed of the clock
    given[3] = start[3]
    prior = np.repeat([turn, config.prior_offset, GYRO_BIAS, ACCEL_BIAS, 2.0], [3, 1, 3, 3, 3])
    limits = np.full(13, np.inf)
    limits[:3], limits[3] = np.radians(config.max_rotation_deg), config.max_imu_offset
    found, scales = _weighted(problem, given, prior, limits)
    if not found.observed[3]:
        given[3] = offset_s
        found, scales = _weighted(problem, given, prior, limits)
    x = found.values
    return ImuFit(
        R_lidar_imu=problem.rotation(x),
        offset_s=float(x[3]),
        rotation_sigma=found.sigma[:3],
        rotation_observed=found.observed[:3],
        offset_sigma=float(found.sigma[3]),
        offset_observed=bool(found.observed[3]),
        gyro_bias=x[4:7],
        accel_bias=x[7:10],
        gyro_residual=scales[0],
        velocity_residual=scales[1],
        up_odom=-x[10:13] / np.linalg.norm(x[10:13]),
    )


def _weighted(
    problem: ImuProblem, given: Floats, prior: Floats, limits: Floats
) -> tuple[Estimate, tuple[float, float]]:
    """Solve twice: with guessed noise, then with what the residuals show."""
    scales = (1e-3, 0.05)
    free = np.full_like(limits, np.inf)
    for limit in (free, limits):
        wide = scales[1] * np.sqrt(problem.overlap)  # windows overlap: so many share one error

        def residual(x: Floats, narrow: float = scales[0], wide: float = wide) -> Floats:
            size = np.array([(np.linalg.norm(x[10:13]) - GRAVITY) / 0.03])
            parts = [problem.gyro(x).ravel() / narrow, problem.velocity(x).ravel() / wide, size]
            return np.concatenate(parts)

        found = solve(residual, given, prior, limit)
        scales = (
            max(spread(problem.gyro(found.values)), 1e-6),
            max(spread(problem.velocity(found.values)), 1e-5),
        )
    return found, scales
