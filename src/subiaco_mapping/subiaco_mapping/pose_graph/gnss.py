"""GNSS fixes: which may be used, the scans they attach to, and how they place the odometry."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from subiaco_geo.crs import EnuFrame, fixes_to_datum
from subiaco_geo.crs_area import AUTO, crs_at, require_inside
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, Ints, interpolate_poses, invert_pose, make_pose
from subiaco_geo.geoid import ellipsoidal_heights
from subiaco_mapping.measurements import GnssFix
from subiaco_mapping.method_numbers import NUMBERS
from subiaco_mapping.pose_graph.config import GnssConfig

_ASTRAY = np.array(NUMBERS.pose_graph.astray)


@dataclass(frozen=True)
class EnuFixes:
    """Usable fixes in local ENU.

    Parameters
    ----------
    times_ns : (N,) int64
    enu : (N, 3) float64
        Antenna positions [m].
    covariance : (N, 3, 3) float64
        With the floor of their status [m2].
    status : (N,) int64
    """

    times_ns: Ints
    enu: Floats
    covariance: Floats
    status: Ints

    def select(self, index: NDArray[np.generic]) -> EnuFixes:
        """Return the fixes of a mask or index."""
        return EnuFixes(self.times_ns[index], self.enu[index], self.covariance[index], self.status[index])

    def __len__(self) -> int:
        return len(self.times_ns)


@dataclass(frozen=True)
class Attachment:
    """Where a fix acts: the nearest scan and the antenna seen from it at the fix's time.

    Parameters
    ----------
    index : (N,) int64
        Scan.
    levers : (N, 3) float64
        Antenna in that scan's ``lidar_link`` [m], the odometry's motion from the scan to the
        fix included.
    kept : (M,) bool
        Which of the fixes given could be attached.
    """

    index: Ints
    levers: Floats
    kept: NDArray[np.bool_]


def local_frame(fixes: Sequence[GnssFix], config: GnssConfig, crs: str = AUTO) -> EnuFrame | None:
    """Return the ENU frame at the first of the best fixes, None where no fix is usable.

    A fix that is :func:`near` no other, as receivers give when they start, is not taken. The frame is in the
    datum of the map's CRS ``crs``.
    """
    usable = [fix for fix in fixes if fix.is_usable()]
    if not usable:
        return None
    best = max(fix.status for fix in usable)
    placed = [fix for fix in usable if fix.status == best]
    first = placed[int(np.argmax(near(placed)))]
    origin = _to_datum([first], config, crs_at(first.latitude, first.longitude, crs))[0]
    return EnuFrame(float(origin[0]), float(origin[1]), float(origin[2]))


def near(fixes: Sequence[GnssFix]) -> NDArray[np.bool_]:
    """Mark fixes (N,) that are within a degree and 2 km of height of the median of all."""
    rows = np.array([[fix.latitude, fix.longitude, fix.altitude] for fix in fixes]).reshape(-1, 3)
    if len(rows) == 0:
        return np.zeros(0, dtype=np.bool_)
    return np.asarray((np.abs(rows - np.median(rows, axis=0)) < _ASTRAY).all(axis=1))


class PlaceCheck:
    """Refuse the CRS of a map as soon as enough fixes tell where the drive is.

    Parameters
    ----------
    crs : str
        Of the map.
    """

    _ENOUGH = 20

    def __init__(self, crs: str) -> None:
        self._crs = crs
        self._seen: list[tuple[float, float]] = []

    def take(self, fix: GnssFix) -> None:
        """Take one fix.

        Raises
        ------
        InputError
            The median of the first usable fixes is where the CRS must not be used.
        """
        if len(self._seen) < self._ENOUGH and fix.is_usable():
            self._seen.append((fix.latitude, fix.longitude))
            if len(self._seen) == self._ENOUGH:
                latitude, longitude = np.median(np.array(self._seen), axis=0).tolist()
                require_inside(latitude, longitude, crs_at(latitude, longitude, self._crs))


def _to_datum(fixes: Sequence[GnssFix], config: GnssConfig, crs: str) -> Floats:
    rows = np.array([[f.latitude, f.longitude, f.altitude] for f in fixes]).reshape(-1, 3)
    if config.heights == "geoid":
        if not config.geoid_grid:
            raise InputError(
                "gnss.heights: heights above the geoid need gnss.geoid_grid, the grid of undulations as .gtx "
                "or .tif (AUSGeoid2020 for AHD); or let the receiver send ellipsoidal heights"
            )
        rows = ellipsoidal_heights(rows, Path(config.geoid_grid))
    return fixes_to_datum(rows, config.declared_frame, crs, config.epoch)


def sigma_floor(status: int, config: GnssConfig) -> float:
    """Return the smallest horizontal sigma [m] that a status is believed."""
    return {2: config.sigma_fixed, 1: config.sigma_float}.get(min(status, 2), config.sigma_single)


def _floored(fix: GnssFix, config: GnssConfig) -> Floats:
    """Return the covariance (3, 3) with its floor added in quadrature."""
    sigma = sigma_floor(fix.status, config)
    floor = np.array([sigma, sigma, sigma * config.vertical_factor]) ** 2
    return np.asarray(0.5 * (fix.covariance + fix.covariance.T) + np.diag(floor))


def to_enu(fixes: Sequence[GnssFix], frame: EnuFrame, config: GnssConfig, crs: str = AUTO) -> EnuFixes:
    """Bring usable fixes to ENU, in time order; those astray and later ones of equal time are dropped.

    ``frame`` is in the datum of the map's CRS ``crs``, and so are the positions.
    """
    usable = [fix for fix in fixes if fix.is_usable()]
    usable = [fix for fix, kept in zip(usable, near(usable), strict=True) if kept]
    usable.sort(key=lambda fix: fix.time_ns)
    geodetic = _to_datum(usable, config, crs_at(frame.latitude_deg, frame.longitude_deg, crs))
    enu = frame.from_geodetic(*geodetic.T) if usable else np.zeros((0, 3))
    times_ns = np.array([fix.time_ns + config.time_offset_ns for fix in usable], dtype=np.int64)
    covariance = np.array([_floored(fix, config) for fix in usable]).reshape(-1, 3, 3)
    status = np.array([fix.status for fix in usable], dtype=np.int64)
    _, first = np.unique(times_ns, return_index=True)
    return EnuFixes(times_ns, enu, covariance, status).select(first)


def attach(
    times_ns: Ints, stamps_ns: Ints, T_odom_lidar: Floats, t_lidar_gnss: Floats, max_gap_ns: int
) -> Attachment:
    """Attach fixes to scans.

    Parameters
    ----------
    times_ns : (M,) int64
        Of the fixes.
    stamps_ns : (S,) int64
        Of the scans.
    T_odom_lidar : (S, 4, 4) float64
    t_lidar_gnss : (3,) float64
        Lever arm [m].
    max_gap_ns : int
        A fix between scans farther apart is not attached [ns].

    Returns
    -------
    Attachment
    """
    after = np.clip(np.searchsorted(stamps_ns, times_ns, side="left"), 1, max(len(stamps_ns) - 1, 1))
    if len(stamps_ns) < 2:
        kept = np.zeros(len(times_ns), dtype=np.bool_)
    else:
        inside = (times_ns >= stamps_ns[0]) & (times_ns <= stamps_ns[-1])
        kept = inside & (stamps_ns[after] - stamps_ns[after - 1] <= max_gap_ns)
    after, query = after[kept], times_ns[kept]
    later = len(query) > 0 and stamps_ns[after] - query < query - stamps_ns[after - 1]
    index = np.where(later, after, after - 1).astype(np.int64)
    if len(query) == 0:
        return Attachment(index, np.zeros((0, 3)), kept)
    at_fix = interpolate_poses(stamps_ns, T_odom_lidar, query)
    relative = invert_pose(T_odom_lidar[index]) @ at_fix
    return Attachment(index, relative[:, :3, :3] @ t_lidar_gnss + relative[:, :3, 3], kept)


def level_rotation(up: Floats) -> Floats:
    """Return the shortest rotation (3, 3) that turns a direction (3,) to +z."""
    axis = np.cross(up / np.linalg.norm(up), [0.0, 0.0, 1.0])
    angle = np.arctan2(np.linalg.norm(axis), up[2] / np.linalg.norm(up))
    length = np.linalg.norm(axis)
    if length < 1e-12:
        return np.eye(3) if up[2] > 0 else np.diag([1.0, -1.0, -1.0])
    return np.asarray(Rotation.from_rotvec(axis / length * angle).as_matrix())


def _planar_fit(source: Floats, target: Floats, weight: Floats) -> tuple[float, Floats]:
    """Return yaw [rad] and shift (3,) that bring source (N, 3) to target, rotation about z."""
    share = weight / weight.sum()
    mean_source, mean_target = share @ source, share @ target
    a, b = source[:, :2] - mean_source[:2], target[:, :2] - mean_target[:2]
    sine = share @ (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    cosine = share @ (a * b).sum(axis=1)
    yaw = float(np.arctan2(sine, cosine))
    rotation = Rotation.from_rotvec([0.0, 0.0, yaw]).as_matrix()
    return yaw, mean_target - rotation @ mean_source


def place(antenna_odom: Floats, enu: Floats, sigma: Floats, up_odom: Floats) -> Floats:
    """Place an odometry in ENU by its antenna track, robustly.

    Parameters
    ----------
    antenna_odom, enu : (N, 3) float64
        The antenna in odometry and in ENU at the same times [m].
    sigma : (N,) float64
        Of the fixes [m].
    up_odom : (3,) float64
        The vertical in the odometry frame.

    Returns
    -------
    (4, 4) float64
        ``T_enu_odom``.
    """
    level = level_rotation(up_odom)
    source = antenna_odom @ level.T
    base = 1.0 / np.maximum(sigma, 0.01) ** 2
    weight = base
    for _ in range(20):
        yaw, shift = _planar_fit(source, enu, weight)
        turn = Rotation.from_rotvec([0.0, 0.0, yaw]).as_matrix()
        residual = np.linalg.norm(source @ turn.T + shift - enu, axis=1)
        scale = max(float(np.median(residual)), 0.02)
        weight = base / (1.0 + (residual / (2.0 * scale)) ** 2)
    return make_pose(turn @ level, shift)


def enough_to_place(enu: Floats, config: GnssConfig) -> str | None:
    """Return None where fixes (N, 3) suffice to place a sequence, else the reason why not."""
    if len(enu) < config.min_fixes:
        return f"{len(enu)} usable GNSS fixes, {config.min_fixes} are needed"
    span = float(np.linalg.norm((enu - enu[0])[:, :2], axis=1).max())
    if span < config.min_length:
        return f"the GNSS fixes span {span:.1f} m, {config.min_length:g} m are needed"
    return None
