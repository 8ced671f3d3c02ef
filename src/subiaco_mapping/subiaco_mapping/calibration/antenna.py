"""Lever arm, clock and heading offset of the antenna, from RTK fixed fixes against odometry.

Odometry drifts, so that it is held rigid to the fixes over short stretches only, each placed on
its own; lever arm, clock and the scale of odometry are shared by all. Turns hold the horizontal
lever, changes of speed the clock. On flat roads the height of the antenna is not observable beside
that of the stretch, and the given height is kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from subiaco_geo.frames import Floats, Ints, interpolate_poses, invert_pose
from subiaco_mapping.calibration.config import CalibrationConfig
from subiaco_mapping.calibration.estimate import solve, spread
from subiaco_mapping.calibration.imu import OdometryTrack
from subiaco_mapping.measurements import GnssFix, HeadingSample
from subiaco_mapping.pose_graph import gnss
from subiaco_mapping.pose_graph.config import GnssConfig

ODOMETRY_SIGMA = 0.01  # of a pose within its stretch [m]
SLOPE = 0.05  # of a stretch against the vertical that is known [rad]
FIXES_A_STRETCH = 12
PRIOR_SCALE = 0.01  # of odometry: what range offsets of a sensor do to it
SHARED = 5  # values before those of the stretches


@dataclass(frozen=True)
class AntennaFit:
    """The antenna in ``base_link`` and the receiver's clock.

    Parameters
    ----------
    t_base_gnss, lever_sigma : (3,) float64
        [m].
    lever_observed : (3,) bool
    offset_s, offset_sigma : float
        To be added to the fixes' stamps [s].
    offset_observed : bool
    heading_offset, heading_sigma : float or None
        Of the antenna baseline less ``base_link``, counter-clockwise [rad]; None without headings.
    scale, scale_sigma : float
        By which share the way is longer than odometry's.
    residual : float
        Spread of the fixes [m].
    fixes : int
    """

    t_base_gnss: Floats
    lever_sigma: Floats
    lever_observed: NDArray[np.bool_]
    offset_s: float
    offset_sigma: float
    offset_observed: bool
    heading_offset: float | None
    heading_sigma: float | None
    scale: float
    scale_sigma: float
    residual: float
    fixes: int


@dataclass(frozen=True)
class _Stretches:
    """Fixes (N,) by stretch: times [ns], ENU, sigma (N, 3), stretch (N,), first placements (W, 4, 4)."""

    times_ns: Ints
    enu: Floats
    sigma: Floats
    stretch: Ints
    T_enu_odom: Floats


class AntennaProblem:
    """Residuals of fixes against odometry. Values: lever (3) [m], offset [s], scale, then six a stretch."""

    def __init__(self, odometry: OdometryTrack, T_base_lidar: Floats, stretches: _Stretches) -> None:
        self._odometry = odometry
        self._T_lidar_base = invert_pose(T_base_lidar)
        self.data = stretches

    def placements(self, x: Floats) -> Floats:
        """Return ``T_enu_odom`` (W, 4, 4)."""
        change = x[SHARED:].reshape(-1, 6)
        placed = self.data.T_enu_odom.copy()
        placed[:, :3, :3] = Rotation.from_rotvec(change[:, :3]).as_matrix() @ placed[:, :3, :3]
        placed[:, :3, 3] += change[:, 3:]
        return placed

    def at(self, times_ns: Ints, offset_s: float, scale: float = 0.0) -> Floats:
        """Return ``T_odom_base`` (N, 4, 4) at stamps of the receiver, the way longer by a share."""
        stamps_ns = self._odometry.stamps_ns
        query = np.clip(times_ns + round(offset_s * 1e9), stamps_ns[0], stamps_ns[-1])
        poses = interpolate_poses(stamps_ns, self._odometry.T_odom_lidar, query)
        poses[:, :3, 3] *= 1.0 + scale
        return poses @ self._T_lidar_base

    def residual(self, x: Floats) -> Floats:
        """Return the antenna by odometry less the fixes (N, 3) [m]."""
        poses = self.placements(x)[self.data.stretch] @ self.at(self.data.times_ns, x[3], x[4])
        return np.asarray(poses[:, :3, :3] @ x[:3] + poses[:, :3, 3] - self.data.enu)


def _stretches(
    odometry: OdometryTrack,
    fixes: Sequence[GnssFix],
    antenna: tuple[Floats, Floats, float, Floats],
    gnss_config: GnssConfig,
    config: CalibrationConfig,
) -> _Stretches | None:
    T_base_lidar, t_base_gnss, offset_s, up_odom = antenna
    fixed = [fix for fix in fixes if fix.is_usable() and fix.status >= 2]
    frame = gnss.local_frame(fixed, gnss_config)
    if frame is None:
        return None
    enu = gnss.to_enu(fixed, frame, gnss_config.model_copy(update={"time_offset_ns": 0}))
    margin_ns = round(2e9 * config.prior_offset)
    stamps_ns = odometry.stamps_ns
    shifted = enu.times_ns + round(offset_s * 1e9)
    enu = enu.select((shifted > stamps_ns[0] + margin_ns) & (shifted < stamps_ns[-1] - margin_ns))
    if len(enu) < config.min_fixes:
        return None
    shifted = enu.times_ns + round(offset_s * 1e9)
    near = np.clip(np.searchsorted(stamps_ns, shifted), 1, len(stamps_ns) - 1)
    whole = stamps_ns[near] - stamps_ns[near - 1] <= gnss_config.max_pose_gap_ns
    whole &= odometry.segment[near] == odometry.segment[near - 1]
    span = max((enu.times_ns[-1] - enu.times_ns[0]) * 1e-9, 1e-9)
    length = span / max(round(span / config.stretch), 1)
    number = np.minimum(((enu.times_ns - enu.times_ns[0]) * 1e-9 / length).astype(np.int64), 10**6)
    number = number * 1000 + odometry.segment[near]
    _, index, counts = np.unique(number[whole], return_inverse=True, return_counts=True)
    enu = enu.select(whole)
    keep = counts[index] >= FIXES_A_STRETCH
    if keep.sum() < config.min_fixes:
        return None
    enu = enu.select(keep)
    _, index = np.unique(index[keep], return_inverse=True)
    sigma = np.sqrt(np.diagonal(enu.covariance, axis1=1, axis2=2) + ODOMETRY_SIGMA**2)
    poses = interpolate_poses(stamps_ns, odometry.T_odom_lidar, enu.times_ns + round(offset_s * 1e9))
    poses = poses @ invert_pose(T_base_lidar)
    track = poses[:, :3, :3] @ t_base_gnss + poses[:, :3, 3]
    placed = [
        gnss.place(track[index == k], enu.enu[index == k], sigma[index == k, 0], up_odom)
        for k in range(index.max() + 1)
    ]
    return _Stretches(enu.times_ns, enu.enu, sigma, index, np.array(placed))


def fit_antenna(
    odometry: OdometryTrack,
    fixes: Sequence[GnssFix],
    headings: Sequence[HeadingSample],
    T_base_lidar: Floats,
    t_base_gnss: Floats,
    up_odom: Floats,
    gnss_config: GnssConfig,
    config: CalibrationConfig,
) -> AntennaFit | None:
    """Refine the antenna's place and the receiver's clock; None where too few fixes are RTK fixed.

    Parameters
    ----------
    odometry : OdometryTrack
    fixes : sequence of GnssFix
        Stamps as recorded.
    headings : sequence of HeadingSample
    T_base_lidar : (4, 4) float64
    t_base_gnss : (3,) float64
        As given [m].
    up_odom : (3,) float64
        The vertical in the odometry frame.
    gnss_config : GnssConfig
        Its ``time_offset_ns`` is the one given.
    config : CalibrationConfig
    """
    offset_s = gnss_config.time_offset_ns * 1e-9
    antenna = (T_base_lidar, t_base_gnss, offset_s, up_odom)
    data = _stretches(odometry, fixes, antenna, gnss_config, config)
    if data is None:
        return None
    problem = AntennaProblem(odometry, T_base_lidar, data)
    count = len(data.T_enu_odom)
    given = np.concatenate([t_base_gnss, [offset_s, 0.0], np.zeros(6 * count)])
    slopes = np.tile([SLOPE, SLOPE, 1.0, 10.0, 10.0, 10.0], count)
    prior = np.concatenate([np.full(3, config.prior_lever), [config.prior_offset, PRIOR_SCALE], slopes])
    limits = np.full(len(given), np.inf)
    limits[:3], limits[3] = config.max_lever, config.max_gnss_offset
    scale = 1.0
    for limit in (np.full_like(limits, np.inf), limits):
        whole = data.sigma * scale * np.sqrt(config.shared)

        def residual(x: Floats, whole: Floats = whole) -> Floats:
            return np.asarray((problem.residual(x) / whole).ravel())

        found = solve(residual, given, prior, limit)
        scale = max(spread(problem.residual(found.values) / data.sigma), 0.3)
    x = found.values
    heading = _heading(problem, x, found.sigma, headings)
    return AntennaFit(
        t_base_gnss=x[:3],
        lever_sigma=found.sigma[:3],
        lever_observed=found.observed[:3],
        offset_s=float(x[3]),
        offset_sigma=float(found.sigma[3]),
        offset_observed=bool(found.observed[3]),
        heading_offset=heading[0],
        heading_sigma=heading[1],
        scale=float(x[4]),
        scale_sigma=float(found.sigma[4]),
        residual=spread(problem.residual(x)),
        fixes=len(data.times_ns),
    )


def _heading(
    problem: AntennaProblem, x: Floats, sigma: Floats, headings: Sequence[HeadingSample]
) -> tuple[float | None, float | None]:
    """Return the median offset [rad] of headings against the placed odometry, and its sigma."""
    usable = [h for h in headings if h.is_usable()]
    first, last = problem.data.times_ns[[0, -1]]
    usable = [h for h in usable if first <= h.time_ns <= last]
    if len(usable) < FIXES_A_STRETCH:
        return None, None
    times_ns = np.array([h.time_ns for h in usable], dtype=np.int64)
    stretch = problem.data.stretch[np.searchsorted(problem.data.times_ns, times_ns)]
    forward = (problem.placements(x)[stretch] @ problem.at(times_ns, float(x[3])))[:, :3, 0]
    yaw = np.arctan2(forward[:, 1], forward[:, 0])
    off = np.array([h.yaw for h in usable]) - yaw
    centre = np.angle(np.exp(1j * off).mean())
    off = centre + np.angle(np.exp(1j * (off - centre)))
    placed = sigma[SHARED:].reshape(-1, 6)[:, 2]
    share = 1.0 / np.sqrt((1.0 / placed**2).sum())
    return float(np.median(off)), float(np.hypot(share, spread(off - np.median(off)) / np.sqrt(len(off) / 5)))
