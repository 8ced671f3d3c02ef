"""Rotation of the LiDAR in the body of an INS: it turns with the body, and it drives where the body drives.

Turns of the body seen by both show the two rotations about axes across the axis of the turn; the direction
of travel shows the two about axes across it. A car turns about its vertical and drives forwards, so that
turns show roll and pitch of the LiDAR, and the way shows pitch and yaw. What the motion leaves open comes out
with a large sigma and stays as given. Windows are short, so that drift of odometry does not enter; an
attitude that is off by a constant is part of the result.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, Ints
from subiaco_mapping.calibration.config import CalibrationConfig
from subiaco_mapping.calibration.estimate import solve, spread
from subiaco_mapping.calibration.imu import MIN_SCANS, OdometryTrack

PRIOR_SCALE = 0.01  # of odometry
MOVED = 2.0  # windows with a shorter way say nothing of its direction [m]
TURN_SIGMA, WAY_SIGMA = 2e-3, 0.1  # guessed at first [rad, m]


@dataclass(frozen=True)
class BodyTrack:
    """Poses of the body of an INS: times (N,) int64 [ns], increasing; ``T_enu_body`` (N, 4, 4)."""

    times_ns: Ints
    T_enu_body: Floats


@dataclass(frozen=True)
class BodyRotationFit:
    """The LiDAR's rotation in the body, and the clock of the body.

    Parameters
    ----------
    R_body_lidar : (3, 3) float64
    sigma : (3,) float64
        About the axes of the body [rad].
    observed : (3,) bool
    offset_s, offset_sigma : float
        To be added to the body's stamps [s].
    turn_residual, way_residual : float
        Spread per window [rad], [m].
    windows : int
    """

    R_body_lidar: Floats
    sigma: Floats
    observed: NDArray[np.bool_]
    offset_s: float
    offset_sigma: float
    turn_residual: float
    way_residual: float
    windows: int


class BodyProblem:
    """Residuals of odometry against the body. Values: rotation (3) [rad, body axes], offset [s], scale."""

    def __init__(
        self, odometry: OdometryTrack, body: BodyTrack, T_body_lidar: Floats, window_s: float, margin_s: float
    ) -> None:
        origin_ns = body.times_ns[0]
        self._R = T_body_lidar[:3, :3]
        self._lever = T_body_lidar[:3, 3]
        self._t = (odometry.stamps_ns - origin_ns) * 1e-9
        self._body_t = (body.times_ns - origin_ns) * 1e-9
        self._position = body.T_enu_body[:, :3, 3]
        self._slerp = Slerp(self._body_t, Rotation.from_matrix(body.T_enu_body[:, :3, :3]))
        self._first, self._last = self._windows(odometry, window_s, margin_s)
        start, end = (odometry.T_odom_lidar[index] for index in (self._first, self._last))
        back = np.swapaxes(start[:, :3, :3], 1, 2)
        self._turn = back @ end[:, :3, :3]
        self._way = np.einsum("nij,nj->ni", back, end[:, :3, 3] - start[:, :3, 3])

    def _windows(self, odometry: OdometryTrack, window_s: float, margin_s: float) -> tuple[Ints, Ints]:
        """First and last pose (W,) of windows of one segment that the body covers whole, with a margin."""
        inside = np.flatnonzero(
            (self._t > self._body_t[0] + margin_s) & (self._t < self._body_t[-1] - margin_s)
        )
        last = np.searchsorted(self._t, self._t[inside] + window_s)
        whole = (last < len(self._t)) & np.isin(last, inside)
        first, last = inside[whole], last[whole]
        same = odometry.segment[first] == odometry.segment[last]
        return first[same], last[same]

    def __len__(self) -> int:
        return len(self._first)

    def rotation(self, x: Floats) -> Floats:
        """Return ``R_body_lidar`` (3, 3)."""
        return np.asarray(Rotation.from_rotvec(x[:3]).as_matrix() @ self._R)

    def residuals(self, x: Floats) -> tuple[Floats, Floats]:
        """Return turns (W, 3) [rad] and ways (K, 3) [m] by odometry less those of the body, in its axes."""
        start, end = (self._t[index] - x[3] for index in (self._first, self._last))
        at_start, at_end = self._slerp(start), self._slerp(end)
        back = at_start.inv()
        R = self.rotation(x)
        turn = R @ self._turn @ R.T
        turned = (Rotation.from_matrix(turn) * (back * at_end).inv()).as_rotvec()
        # the LiDAR's way less what its lever swings is the way of the body
        way = (1.0 + x[4]) * self._way @ R.T - (turn @ self._lever - self._lever)
        driven = back.apply(self._at(end) - self._at(start))
        moved = np.linalg.norm(driven, axis=1) > MOVED
        return turned, (way - driven)[moved]

    def _at(self, seconds: Floats) -> Floats:
        """Position (N, 3) of the body [m]."""
        return np.stack([np.interp(seconds, self._body_t, self._position[:, k]) for k in range(3)], axis=1)


def sharing(residuals: Floats) -> float:
    """Return how many successive residuals (W, C) share one error: their integrated autocorrelation.

    Windows overlap, and the position of an INS wanders for many seconds. Summed up to the first lag
    without correlation, the largest of the columns.
    """
    largest = 1.0
    for column in residuals.T if len(residuals) > 1 else ():
        rest = np.clip(column, -3.0 * spread(column), 3.0 * spread(column))
        count = len(rest)
        power = np.abs(np.fft.rfft(rest, 2 * count)) ** 2
        correlation = np.fft.irfft(power)[:count] / max(float(np.sum(rest**2)), 1e-30)
        ended = np.flatnonzero(correlation <= 0)
        last = int(ended[0]) if len(ended) else count
        largest = max(largest, 1.0 + 2.0 * float(correlation[1:last].sum()))
    return largest


def fit_body_rotation(
    odometry: OdometryTrack, body: BodyTrack, T_body_lidar: Floats, config: CalibrationConfig
) -> BodyRotationFit:
    """Refine the rotation of the LiDAR in the body of an INS.

    Parameters
    ----------
    odometry : OdometryTrack
    body : BodyTrack
        Stamps as recorded.
    T_body_lidar : (4, 4) float64
        As given; its translation is not estimated [m].
    config : CalibrationConfig

    Raises
    ------
    InputError
        Fewer scans than needed with the INS over them.
    """
    window_s = config.body_window
    problem = BodyProblem(odometry, body, T_body_lidar, window_s, config.search_offset)
    if len(problem) < MIN_SCANS:
        raise InputError(
            f"attitude: covers {len(problem)} windows of {window_s:g} s, {MIN_SCANS} are needed;"
            " record longer"
        )
    turn = np.radians(config.prior_rotation_deg)
    prior = np.array([turn, turn, turn, config.prior_offset, PRIOR_SCALE])
    free = np.full(5, np.inf)
    limits = free.copy()
    limits[:3], limits[3] = np.radians(config.max_rotation_deg), config.max_gnss_offset
    overlap = max(window_s / float(np.median(np.diff(odometry.stamps_ns))) * 1e9, 1.0)
    scales, shared = (TURN_SIGMA, WAY_SIGMA), (overlap, overlap)
    for limit in (free, limits):
        whole = [scale * np.sqrt(count) for scale, count in zip(scales, shared, strict=True)]

        def residual(x: Floats, whole: list[float] = whole) -> Floats:
            parts = zip(problem.residuals(x), whole, strict=True)
            return np.concatenate([(part / sigma).ravel() for part, sigma in parts])

        found = solve(residual, np.zeros(5), prior, limit)
        turned, way = problem.residuals(found.values)
        scales = (max(spread(turned), 1e-6), max(spread(way), 1e-4) if len(way) else WAY_SIGMA)
        shared = (max(overlap, sharing(turned)), max(overlap, sharing(way)))
    return BodyRotationFit(
        R_body_lidar=problem.rotation(found.values),
        sigma=found.sigma[:3],
        observed=found.observed[:3],
        offset_s=float(found.values[3]),
        offset_sigma=float(found.sigma[3]),
        turn_residual=scales[0],
        way_residual=scales[1],
        windows=len(problem),
    )
