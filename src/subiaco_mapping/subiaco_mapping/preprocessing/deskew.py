"""Deskewing: every point of a scan moved to the time of the scan's last column.

Rotation comes from the gyro, translation from the accelerometer and the velocity that a filter holds
(:mod:`subiaco_mapping.preprocessing.velocity_filter`). Until the filter is sure the odometry's last velocity
is held, in body axes; without the IMU the whole last twist. Constant velocity after a gap must use the true
time step.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from functools import cached_property

import numba
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from subiaco_geo.frames import Floats, Ints, make_pose
from subiaco_mapping.measurements import DeskewedScan, Extrinsics, ImuSample, Returns, Scan
from subiaco_mapping.method_numbers import NUMBERS
from subiaco_mapping.preprocessing.config import DeskewConfig
from subiaco_mapping.preprocessing.velocity_filter import VelocityFilter, imu_stretch, rotations_of, summed

STANDING_SAMPLES = NUMBERS.preprocessing.standing_samples


@dataclass(frozen=True)
class Motion:
    """Poses of the LiDAR over a stretch of time, relative to its first knot.

    Parameters
    ----------
    knots_ns : (K,) int64
        Increasing, K >= 2.
    rotations : (K, 3, 3) float64
    positions : (K, 3) float64
        [m].
    mode : str
    """

    knots_ns: Ints
    rotations: Floats
    positions: Floats
    mode: str

    def at(self, times_ns: Ints) -> tuple[Floats, Floats]:
        """Return rotations (M, 3, 3) and positions (M, 3) at times inside the stretch."""
        origin = self.knots_ns[0]
        knots = (self.knots_ns - origin).astype(np.float64)
        query = np.clip((times_ns - origin).astype(np.float64), 0.0, knots[-1])
        rotation = self._slerp(query).as_matrix()
        position = np.stack([np.interp(query, knots, self.positions[:, i]) for i in range(3)], axis=1)
        return rotation, position

    @cached_property
    def _slerp(self) -> Slerp:
        """Rotations between the knots, over nanoseconds since the first."""
        return Slerp(
            (self.knots_ns - self.knots_ns[0]).astype(np.float64), Rotation.from_matrix(self.rotations)
        )

    def toward(self, end_ns: int, times_ns: Ints) -> tuple[Floats, Floats]:
        """Return rotations (M, 3, 3) and shifts (M, 3) [m] from the LiDAR at times to the LiDAR at an end."""
        return self.toward_and_since(end_ns, times_ns, end_ns)[0]

    def between(self, start_ns: int, end_ns: int) -> Floats:
        """Return ``T_start_end`` (4, 4)."""
        return self.toward_and_since(end_ns, np.zeros(0, dtype=np.int64), start_ns)[1]

    def toward_and_since(
        self, end_ns: int, times_ns: Ints, start_ns: int
    ) -> tuple[tuple[Floats, Floats], Floats]:
        """Return :meth:`toward` and :meth:`between`; one interpolation costs half as much as two."""
        rotation, position = self.at(np.concatenate([times_ns, [start_ns, end_ns]]))
        back, start = rotation[-1].T, rotation[-2].T
        moved = make_pose(start @ rotation[-1], start @ (position[-1] - position[-2]))
        return (back @ rotation[:-2], (position[:-2] - position[-1]) @ rotation[-1]), moved


@numba.njit(cache=True)
def _moved(xyz: Floats, index: Ints, rotation: Floats, shift: Floats) -> Floats:
    """Return ``rotation[index] @ xyz + shift[index]`` of points (N, 3)."""
    moved = np.empty_like(xyz)
    for i in range(len(xyz)):
        turn, step = rotation[index[i]], shift[index[i]]
        for row in range(3):
            moved[i, row] = (
                turn[row, 0] * xyz[i, 0] + turn[row, 1] * xyz[i, 1] + turn[row, 2] * xyz[i, 2] + step[row]
            )
    return moved


def integrate(knots_ns: Ints, rates: Floats, velocity: Floats, mode: str) -> Motion:
    """Integrate body rates (K, 3) [rad/s] and a constant body velocity (3,) [m/s] over knots."""
    rotations = rotations_of(knots_ns, rates)
    return Motion(knots_ns, rotations, summed(rotations @ velocity, knots_ns), mode)


def body_twist(T_previous_current: Floats, duration_s: float) -> Floats:
    """Return the constant body twist (6,), rotation first [rad/s, m/s], that makes a motion.

    The translation is divided by the mean rotation on the way, so that integrating the twist
    gives the motion back.
    """
    rotvec = Rotation.from_matrix(T_previous_current[:3, :3]).as_rotvec()
    share = (np.arange(8) + 0.5) / 8
    mean_rotation = Rotation.from_rotvec(share[:, None] * rotvec).as_matrix().mean(axis=0)
    velocity = np.linalg.solve(mean_rotation, T_previous_current[:3, 3]) / duration_s
    return np.concatenate([rotvec / duration_s, velocity])


def constant_motion(start_ns: int, end_ns: int, twist: Floats) -> Motion:
    """Return the motion of a constant body twist (6,), rotation first [rad/s, m/s]."""
    steps = np.linspace(0, end_ns - start_ns, 11).round().astype(np.int64)
    knots_ns = np.unique(start_ns + steps)
    return integrate(knots_ns, np.tile(twist[:3], (len(knots_ns), 1)), twist[3:], "constant_velocity")


def straighten_by_twist(scan: Scan, twist: Floats, previous_ns: int | None = None) -> DeskewedScan:
    """Straighten the first returns of a scan by a constant body twist (6,) alone.

    Parameters
    ----------
    scan : Scan
    twist : (6,) float64
        Rotation first [rad/s, m/s].
    previous_ns : int, optional
        Stamp of the scan before, from where the motion is predicted.
    """
    start_ns = min(scan.start_ns, scan.end_ns - 1)
    start_ns = start_ns if previous_ns is None else min(start_ns, previous_ns)
    motion = constant_motion(start_ns, scan.end_ns, twist)
    return DeskewedScan(
        stamp_ns=scan.end_ns,
        xyz=_straightened(scan.first, motion, scan.end_ns, motion.mode),
        intensity=scan.first.intensity,
        mode=motion.mode,
        motion=None if previous_ns is None else motion.between(previous_ns, scan.end_ns),
    )


def _straightened(
    returns: Returns, motion: Motion, end_ns: int, mode: str, known: tuple[Floats, Floats] | None = None
) -> Floats:
    """Return the points (N, 3) where the LiDAR at ``end_ns`` sees them; ``known`` is the way by column."""
    if mode == "none" or len(returns) == 0:
        return returns.xyz
    times_ns, index = returns.by_time()
    rotation, shift = motion.toward(end_ns, times_ns) if known is None else known
    return _moved(returns.xyz, index, rotation, shift)


def _at(knots_ns: Ints, times_ns: Ints, values: Floats) -> Floats:
    """Return values (M, 3) at times, linear in between, at knots (K, 3)."""
    query, known = (knots_ns - knots_ns[0]).astype(float), (times_ns - knots_ns[0]).astype(float)
    return np.stack([np.interp(query, known, values[:, i]) for i in range(3)], axis=1)


class Deskewer:
    """Keep the IMU samples that scans still need, and straighten scans with them.

    Parameters
    ----------
    config : DeskewConfig
    extrinsics : Extrinsics
        Without ``T_base_imu`` the IMU is not used.
    """

    def __init__(self, config: DeskewConfig, extrinsics: Extrinsics) -> None:
        self._config = config
        self._R_lidar_imu = extrinsics.R_lidar_imu if extrinsics.T_base_imu is not None else None
        self._t_lidar_imu = np.zeros(3) if extrinsics.T_base_imu is None else extrinsics.t_lidar_imu
        self._filter = VelocityFilter(config)
        self._twist: Floats | None = None
        self._samples: deque[ImuSample] = deque()
        self._bias = np.asarray(config.gyro_bias, dtype=np.float64)
        self._recent: deque[ImuSample] = deque(maxlen=STANDING_SAMPLES)
        self.out_of_order = 0

    @property
    def gyro_bias(self) -> Floats:
        """Bias (3,) in use, in IMU axes [rad/s]."""
        return self._bias.copy()

    @property
    def latest_imu_ns(self) -> int | None:
        """Time of the newest sample."""
        return self._samples[-1].time_ns if self._samples else None

    def push_imu(self, sample: ImuSample) -> None:
        """Take one sample; one that is not newer than the last is counted and dropped."""
        if self._R_lidar_imu is None:
            return
        shifted = ImuSample(sample.time_ns + self._config.imu_time_offset_ns, sample.gyro, sample.accel)
        finite = np.isfinite(sample.gyro).all() and np.isfinite(sample.accel).all()
        if not finite or (self._samples and shifted.time_ns <= self._samples[-1].time_ns):
            self.out_of_order += 1
            return
        self._samples.append(shifted)

    def ready(self, scan: Scan, latest_lidar_ns: int) -> bool:
        """Tell whether the IMU covers a scan, or will not be waited for any longer."""
        if scan.deskewed or self._R_lidar_imu is None:
            return True
        latest = self.latest_imu_ns
        covered = latest is not None and latest >= scan.end_ns
        return covered or latest_lidar_ns - scan.end_ns >= self._config.imu_wait_ns

    def deskew(self, scan: Scan, twist: Floats | None, previous_ns: int | None = None) -> DeskewedScan:
        """Straighten a scan.

        Parameters
        ----------
        scan : Scan
        twist : (6,) float64 or None
            Last body twist of the LiDAR, rotation first [rad/s, m/s]; None where unknown.
        previous_ns : int, optional
            Stamp of the scan before, from where the motion is predicted.

        Returns
        -------
        DeskewedScan
        """
        known = twist if twist is not None else np.zeros(6)
        start_ns = min(scan.start_ns, scan.end_ns - 1)
        if previous_ns is not None and previous_ns < scan.end_ns:
            start_ns = min(start_ns, previous_ns)
        used = self._between(start_ns, scan.end_ns)
        self._learn_bias(used, twist)
        self._follow(twist)
        motion = self._motion(start_ns, scan.end_ns, known, used)
        unknown = twist is None and motion.mode == "constant_velocity"
        mode = "none" if scan.deskewed or unknown else motion.mode
        parts = [part for part in (scan.first, scan.last, scan.sky) if part is not None and len(part)]
        times = parts[0].column_ns if parts else None
        shared = times is not None and all(part.column_ns is times for part in parts)  # of one decoded frame
        columns = times if times is not None and shared else np.zeros(0, dtype=np.int64)
        since_ns = scan.end_ns if previous_ns is None else previous_ns
        found, moved = motion.toward_and_since(scan.end_ns, columns, since_ns)
        predicted = None if previous_ns is None or unknown else moved
        way = found if len(columns) else None
        first = _straightened(scan.first, motion, scan.end_ns, mode, way)
        last = _straightened(scan.last, motion, scan.end_ns, mode, way) if scan.last is not None else None
        sky = _straightened(scan.sky, motion, scan.end_ns, mode, way) if scan.sky is not None else None
        self._forget(scan.end_ns)
        return DeskewedScan(
            stamp_ns=scan.end_ns,
            xyz=first,
            intensity=scan.first.intensity,
            mode=mode,
            motion=predicted,
            last_xyz=last if last is not None else np.zeros((0, 3)),
            last_intensity=scan.last.intensity if scan.last is not None else np.zeros(0, dtype=np.float32),
            sky_xyz=sky if sky is not None else np.zeros((0, 3)),
            accel=self._mean_accel(used),
            columns=scan.columns,
            lost_columns=scan.lost_columns,
            dropped_points=scan.dropped_points,
            raw=(scan.first, scan.last),
        )

    def _between(self, start_ns: int, end_ns: int) -> list[ImuSample]:
        """Return the samples inside, with one neighbour on either side."""
        samples = list(self._samples)
        times = np.array([s.time_ns for s in samples], dtype=np.int64)
        low = max(int(np.searchsorted(times, start_ns, side="right")) - 1, 0)
        high = int(np.searchsorted(times, end_ns, side="left")) + 1
        return samples[low:high]

    def _motion(self, start_ns: int, end_ns: int, twist: Floats, used: list[ImuSample]) -> Motion:
        knots_ns = np.array([start_ns, end_ns], dtype=np.int64)
        times_ns = np.array([s.time_ns for s in used], dtype=np.int64)
        if self._R_lidar_imu is None or not self._covers(times_ns, start_ns, end_ns):
            return constant_motion(start_ns, end_ns, twist)
        inside = times_ns[(times_ns > start_ns) & (times_ns < end_ns)]
        knots_ns = np.concatenate([knots_ns[:1], inside, knots_ns[1:]])
        rates = _at(knots_ns, times_ns, (np.array([s.gyro for s in used]) - self._bias) @ self._R_lidar_imu.T)
        forces = _at(knots_ns, times_ns, np.array([s.accel for s in used]) @ self._R_lidar_imu.T)
        stretch = imu_stretch(knots_ns, rates, forces, self._t_lidar_imu)
        self._filter.hold(stretch)
        held = self._filter.state
        if held is None:
            return integrate(knots_ns, rates, twist[3:], "gyro")
        return Motion(knots_ns, stretch.rotations, stretch.path(*held), "gyro_accelerometer")

    def _follow(self, twist: Floats | None) -> None:
        """Bring the filter to the stamp of the scan before; a twist that did not change says nothing new."""
        if twist is None:
            self._filter.forget()
        else:
            new = self._twist is None or not np.array_equal(twist, self._twist)
            self._filter.advance(twist[3:] if new else None)
        self._twist = twist

    def _covers(self, times_ns: Ints, start_ns: int, end_ns: int) -> bool:
        if len(times_ns) < 2:
            return False
        limit = self._config.max_imu_gap_ns
        starts = times_ns[0] <= start_ns + limit // 4
        return bool(starts and times_ns[-1] >= end_ns and np.diff(times_ns).max() <= limit)

    def _mean_accel(self, used: list[ImuSample]) -> Floats | None:
        if not used or self._R_lidar_imu is None:
            return None
        return np.asarray(self._R_lidar_imu @ np.mean([s.accel for s in used], axis=0))

    def _learn_bias(self, used: list[ImuSample], twist: Floats | None) -> None:
        """Take the mean gyro as bias while odometry, gyro and accelerometer all stand still."""
        if twist is None or np.linalg.norm(twist[3:]) > self._config.standing_speed:
            self._recent.clear()
            return
        newest = self._recent[-1].time_ns if self._recent else 0
        self._recent.extend(s for s in used if s.time_ns > newest)
        if not self._config.estimate_bias or len(self._recent) < STANDING_SAMPLES:
            return
        gyro = np.array([s.gyro for s in self._recent])
        accel = np.array([s.accel for s in self._recent])
        calm = gyro.std(axis=0).max() < self._config.standing_gyro
        still = np.linalg.norm(accel.std(axis=0)) < self._config.standing_accel
        small = np.abs(gyro.mean(axis=0)).max() < 3 * self._config.standing_gyro
        if calm and still and small:
            self._bias = 0.5 * self._bias + 0.5 * gyro.mean(axis=0)

    def _forget(self, end_ns: int) -> None:
        """Drop samples that no later scan needs; the newest before ``end_ns`` stays."""
        while len(self._samples) > 2 and self._samples[1].time_ns <= end_ns:
            self._samples.popleft()
