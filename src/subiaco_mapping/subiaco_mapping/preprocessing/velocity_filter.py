"""Velocity filter: odometry and IMU in one filter, with the accelerometer's bias."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from subiaco_geo.frames import Floats, Ints
from subiaco_mapping.method_numbers import NUMBERS
from subiaco_mapping.preprocessing.config import DeskewConfig

SECOND = 1e9
_GRAVITY = NUMBERS.odometry.gravity_bounds
_FIRST_SPEED, _FIRST_REST = NUMBERS.odometry.first_speed_sigma, NUMBERS.odometry.first_acceleration_sigma


@dataclass(frozen=True)
class ImuStretch:
    """What the IMU alone says of a stretch of time, in the axes of ``lidar_link`` at its start.

    Parameters
    ----------
    knots_ns : (K,) int64
        Increasing, K >= 2.
    rotations : (K, 3, 3) float64
        Since the start.
    gained, moved : (K, 3) float64
        The specific force integrated once [m/s] and twice [m], gravity included.
    """

    knots_ns: Ints
    rotations: Floats
    gained: Floats
    moved: Floats

    @property
    def seconds(self) -> Floats:
        """Time (K,) since the start [s]."""
        return np.asarray((self.knots_ns - self.knots_ns[0]) / SECOND)

    def path(self, velocity: Floats, rest: Floats) -> Floats:
        """Return positions (K, 3) [m] for a start velocity and the force read at rest, both at the start."""
        seconds = self.seconds[:, None]
        return np.asarray(velocity * seconds + self.moved - 0.5 * rest * seconds**2)


def rotations_of(knots_ns: Ints, rates: Floats) -> Floats:
    """Integrate body rates (K, 3) [rad/s] to rotations (K, 3, 3) since the first knot."""
    step_s = np.diff(knots_ns)[:, None] / SECOND
    increments = Rotation.from_rotvec(0.5 * (rates[1:] + rates[:-1]) * step_s).as_matrix()
    rotations = np.empty((len(knots_ns), 3, 3))
    rotations[0] = np.eye(3)
    for k, increment in enumerate(increments):
        rotations[k + 1] = rotations[k] @ increment
    return rotations


def summed(values: Floats, knots_ns: Ints) -> Floats:
    """Integrate values (K, 3) over time by trapezoids."""
    step_s = np.diff(knots_ns)[:, None] / SECOND
    return np.vstack([np.zeros(3), np.cumsum(0.5 * (values[1:] + values[:-1]) * step_s, axis=0)])


def imu_stretch(knots_ns: Ints, rates: Floats, forces: Floats, t_lidar_imu: Floats) -> ImuStretch:
    """Integrate rates [rad/s] and forces [m/s2] (K, 3), axes of ``lidar_link``, of an IMU at a place.

    The force is brought to the LiDAR's own origin: what turning adds at the IMU is taken off.
    """
    seconds = (knots_ns - knots_ns[0]) / SECOND
    spin = np.gradient(rates, seconds, axis=0)
    at_imu = np.cross(spin, t_lidar_imu) + np.cross(rates, np.cross(rates, t_lidar_imu))
    rotations = rotations_of(knots_ns, rates)
    gained = summed(np.einsum("nij,nj->ni", rotations, forces - at_imu), knots_ns)
    return ImuStretch(knots_ns, rotations, gained, summed(gained, knots_ns))


class VelocityFilter:
    """A Kalman filter of place, velocity and rest force; noise knows no direction: 3 x 3 covariances do.

    Registration errors are taken as each scan's own, as they are against a local map.

    Parameters
    ----------
    config : DeskewConfig
    """

    def __init__(self, config: DeskewConfig) -> None:
        self._config = config
        self._state: Floats | None = None  # rows: place less odometry's, velocity, rest force
        self._covariance = np.zeros((3, 3))
        self._pending: ImuStretch | None = None

    @property
    def state(self) -> tuple[Floats, Floats] | None:
        """Velocity [m/s] and rest force [m/s2] in ``lidar_link`` at the last stamp; None while not sure."""
        low, high = _GRAVITY
        sure = self._covariance[2, 2] < self._config.rest_sigma**2
        if self._state is None or not sure or not low < np.linalg.norm(self._state[2]) < high:
            return None
        return self._state[1], self._state[2]

    def forget(self) -> None:
        """Restart with the next segment."""
        self._state, self._pending = None, None

    def hold(self, stretch: ImuStretch) -> None:
        """Note the stretch into the present scan; :meth:`advance` takes it once odometry has seen it."""
        self._pending = stretch

    def advance(self, velocity: Floats | None) -> None:
        """Go to the end of the stretch noted last.

        Parameters
        ----------
        velocity : (3,) float64 or None
            What odometry found of it: mean velocity, in body axes [m/s]; None where it found nothing.
        """
        stretch, self._pending = self._pending, None
        if stretch is None:
            self.forget()
            return
        seconds = float(stretch.seconds[-1])
        state = self._begin(stretch, seconds) if self._state is None else self._state
        step = np.array([[1.0, seconds, -0.5 * seconds**2], [0.0, 1.0, -seconds], [0.0, 0.0, 1.0]])
        state = step @ state + np.stack([stretch.moved[-1], stretch.gained[-1], np.zeros(3)])
        drift = np.square([0.0, self._config.force_noise, self._config.rest_drift]) * seconds
        self._covariance = step @ self._covariance @ step.T + np.diag(drift)
        if velocity is not None:
            moved = stretch.rotations.mean(axis=0) @ velocity * seconds
            state = self._corrected(state, moved)
            state[0] -= moved
        else:
            state[0] = 0.0  # odometry goes where it was told
        self._state = state @ stretch.rotations[-1]

    def _begin(self, stretch: ImuStretch, seconds: float) -> Floats:
        sigmas = [self._config.registration_sigma, _FIRST_SPEED, _FIRST_REST]
        self._covariance = np.diag(np.square(sigmas))
        return np.stack([np.zeros(3), np.zeros(3), stretch.gained[-1] / seconds])  # as if not accelerating

    def _corrected(self, state: Floats, moved: Floats) -> Floats:
        gain = self._covariance[:, 0] / (self._covariance[0, 0] + self._config.registration_sigma**2)
        self._covariance = self._covariance - np.outer(gain, self._covariance[0])
        return np.asarray(state + np.outer(gain, moved - state[0]))
