"""What the sensors measured, as frozen records. Time is UTC nanoseconds."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.frames import Floats, Ints, invert_pose

_MOST_GYRO = 100.0  # a gyro measures 4000 deg/s at most [rad/s]
_MOST_ACCEL = 2000.0  # an accelerometer 200 g [m/s2]
_LOWEST, _HIGHEST = -500.0, 10_000.0  # heights of roads above the ellipsoid [m]
_ROUNDING = 1e-6  # of a covariance that was written as float32


@dataclass(frozen=True)
class ImuSample:
    """One IMU sample in ``imu_link``: gyro (3,) [rad/s], accel (3,) specific force [m/s2]."""

    time_ns: int
    gyro: Floats
    accel: Floats

    def is_plausible(self) -> bool:
        """Tell whether the values are finite and within what any vehicle's IMU measures."""
        return bool(np.abs(self.gyro).max() < _MOST_GYRO and np.abs(self.accel).max() < _MOST_ACCEL)


@dataclass(frozen=True)
class GnssFix:
    """One fix of the antenna.

    Parameters
    ----------
    time_ns : int
    latitude, longitude : float
        [deg], in the declared frame.
    altitude : float
        Ellipsoidal height [m].
    covariance : (3, 3) float64
        East, north, up [m2].
    status : int
        2 RTK fixed, 1 float, 0 single, negative none.
    """

    time_ns: int
    latitude: float
    longitude: float
    altitude: float
    covariance: Floats
    status: int

    def is_usable(self) -> bool:
        """Tell whether the place is on the earth, the covariance one, and the status claims a solution."""
        numbers = np.array([self.latitude, self.longitude, self.altitude, *self.covariance.ravel()])
        if self.status < 0 or not np.isfinite(numbers).all():
            return False
        on_earth = abs(self.latitude) <= 90 and abs(self.longitude) <= 360
        on_earth = on_earth and _LOWEST < self.altitude < _HIGHEST
        least = float(np.linalg.eigvalsh(0.5 * (self.covariance + self.covariance.T))[0])
        return on_earth and least >= -_ROUNDING * float(np.abs(self.covariance).max())


@dataclass(frozen=True)
class HeadingSample:
    """Yaw of the antenna baseline from east, counter-clockwise [rad], and its sigma [rad]."""

    time_ns: int
    yaw: float
    sigma: float

    def is_usable(self) -> bool:
        """Tell whether both numbers are finite and the sigma claims a heading."""
        return bool(np.isfinite([self.yaw, self.sigma]).all() and 0 <= self.sigma < 0.5)


@dataclass(frozen=True)
class Returns:
    """One return of every beam that came back.

    Parameters
    ----------
    xyz : (N, 3) float64
        In ``lidar_link`` at each point's own time [m].
    times_ns : (N,) int64
    intensity : (N,) float32
    ring : (N,) uint16
    column : (N,) int64, optional
        Firing of each point where beams fire together; with ``column_ns`` (W,), their times, it
        spares the search for equal times.
    """

    xyz: Floats
    times_ns: Ints
    intensity: NDArray[np.float32]
    ring: NDArray[np.uint16]
    column: Ints | None = None
    column_ns: Ints | None = None

    def __len__(self) -> int:
        return len(self.xyz)

    def by_time(self) -> tuple[Ints, Ints]:
        """Return times (W,) and each point's index among them (N,)."""
        if self.column is not None and self.column_ns is not None:
            return self.column_ns, self.column
        times_ns, index = np.unique(self.times_ns, return_inverse=True)
        return times_ns, index


@dataclass(frozen=True)
class Scan:
    """One turn of the LiDAR; ``end_ns`` is the time of its last column.

    ``sky`` holds where beams that met nothing would be at ``decode.sky_range``;
    ``columns`` are those that the sensor sends a turn, 0 where it sends none.
    """

    start_ns: int
    end_ns: int
    first: Returns
    last: Returns | None = None
    sky: Returns | None = None
    columns: int = 0
    lost_columns: int = 0
    frame_id: int = 0
    dropped_points: int = 0
    deskewed: bool = False


@dataclass(frozen=True)
class DeskewedScan:
    """A scan as if taken at once.

    Parameters
    ----------
    stamp_ns : int
        Time of the scan's last column; points are in ``lidar_link`` then.
    xyz : (N, 3) float64
        Strongest return [m].
    intensity : (N,) float32
    mode : str
        ``gyro_accelerometer``, ``gyro``, ``constant_velocity`` or ``none``.
    motion : (4, 4) float64 or None
        Predicted ``T_previous_current`` since the scan before, None where unknown.
    last_xyz, last_intensity : arrays
        The second return, (0, 3) and (0,) where the sensor gives one only.
    sky_xyz : (K, 3) float64
        How far beams that met nothing prove the air empty [m]; see :mod:`subiaco_mapping.preprocessing.sky`.
    accel : (3,) float64 or None
        Mean specific force over the scan in ``lidar_link`` [m/s2].
    columns, lost_columns, dropped_points : int
        Columns that the sensor sends a turn (0 where it sends none), and those that never arrived.
    raw : tuple of Returns, optional
        Returns of ``xyz`` and, where the sensor gives one, ``last_xyz`` before deskewing, in their order:
        times and rings. None where the scan came without them, as over a topic.
    """

    stamp_ns: int
    xyz: Floats
    intensity: NDArray[np.float32]
    mode: str
    motion: Floats | None = None
    last_xyz: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    last_intensity: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, dtype=np.float32))
    sky_xyz: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    accel: Floats | None = None
    columns: int = 0
    lost_columns: int = 0
    dropped_points: int = 0
    raw: tuple[Returns, Returns | None] | None = None


@dataclass(frozen=True)
class OdometryPose:
    """Pose of one scan in its odometry frame.

    Parameters
    ----------
    stamp_ns : int
    T_odom_lidar : (4, 4) float64
    covariance : (6, 6) float64
        Of the motion since the scan before: rotation [rad], then translation [m], axes of
        ``lidar_link`` (right perturbation).
    inliers : int
        Points matched in the plane-to-plane refinement.
    residual_rmse : float
        Of the plane-to-plane refinement [m].
    degenerate : bool
        A direction is not held by the scene.
    segment : int
        Grows where the chain broke.
    predicted : bool
        Registration failed; the pose is the prediction.
    """

    stamp_ns: int
    T_odom_lidar: Floats
    covariance: Floats
    inliers: int
    residual_rmse: float
    degenerate: bool
    segment: int
    predicted: bool = False


@dataclass(frozen=True)
class Extrinsics:
    """Where the sensors sit on the vehicle; None where the recording has no such sensor."""

    T_base_lidar: Floats = field(default_factory=lambda: np.eye(4))
    T_base_imu: Floats | None = None
    t_base_gnss: Floats | None = None

    @property
    def R_lidar_imu(self) -> Floats:
        """Rotation (3, 3) from IMU to LiDAR axes."""
        if self.T_base_imu is None:
            raise ValueError("the IMU extrinsic is not known")
        return np.asarray(self.T_base_lidar[:3, :3].T @ self.T_base_imu[:3, :3])

    @property
    def t_lidar_imu(self) -> Floats:
        """IMU (3,) in ``lidar_link`` [m]."""
        if self.T_base_imu is None:
            raise ValueError("the IMU extrinsic is not known")
        return np.asarray(self.T_base_lidar[:3, :3].T @ (self.T_base_imu[:3, 3] - self.T_base_lidar[:3, 3]))

    @property
    def t_lidar_gnss(self) -> Floats:
        """Antenna (3,) in ``lidar_link`` [m]."""
        if self.t_base_gnss is None:
            raise ValueError("the antenna lever arm is not known")
        T_lidar_base = invert_pose(self.T_base_lidar)
        return np.asarray(T_lidar_base[:3, :3] @ self.t_base_gnss + T_lidar_base[:3, 3])
