"""The vertical from the accelerometer, the odometry's own acceleration taken off."""

from __future__ import annotations

import numpy as np

from subiaco_geo.frames import Floats, Ints
from subiaco_mapping.method_numbers import NUMBERS
from subiaco_mapping.pose_graph.records import GravityPriors

GRAVITY_BOUNDS = NUMBERS.pose_graph.gravity_bounds


def gravity_priors(stamps_ns: Ints, T_odom_lidar: Floats, accel: Floats, window_ns: int) -> GravityPriors:
    """Find *up* in windows of accelerometer, the odometry's own acceleration taken off.

    Parameters
    ----------
    stamps_ns : (S,) int64
    T_odom_lidar : (S, 4, 4) float64
    accel : (S, 3) float64
        Mean specific force in ``lidar_link`` of every scan [m/s2], NaN where unknown.
    window_ns : int

    Returns
    -------
    GravityPriors
        One a window that holds at least five scans and a plausible gravity.
    """
    empty = GravityPriors(np.zeros(0, dtype=np.int64), np.zeros((0, 3)))
    if len(stamps_ns) < 7:
        return empty
    seconds = (stamps_ns - stamps_ns[0]) * 1e-9
    velocity = np.gradient(T_odom_lidar[:, :3, 3], seconds, axis=0)
    force = np.einsum("nij,nj->ni", T_odom_lidar[:, :3, :3], accel)
    window = ((stamps_ns - stamps_ns[0]) // window_ns).astype(np.int64)
    index, ups = [], []
    for number in np.unique(window[1:-1]):
        scans = np.flatnonzero(window == number)
        scans = scans[(scans > 0) & (scans < len(stamps_ns) - 1)]
        if len(scans) < 5 or not np.isfinite(force[scans]).all():
            continue
        first, final = scans[0], scans[-1]
        moved = (velocity[final] - velocity[first]) / (seconds[final] - seconds[first])
        up = force[scans].mean(axis=0) - moved
        if GRAVITY_BOUNDS[0] < np.linalg.norm(up) < GRAVITY_BOUNDS[1]:
            middle = scans[len(scans) // 2]
            index.append(middle)
            ups.append(T_odom_lidar[middle, :3, :3].T @ (up / np.linalg.norm(up)))
    return GravityPriors(np.array(index, dtype=np.int64), np.array(ups)) if index else empty
