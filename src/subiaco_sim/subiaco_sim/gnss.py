"""Fixes of the antenna: RTK states, slow and fast errors, covariances, heading."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from subiaco_geo.frames import Floats, Ints
from subiaco_sim.config import GnssConfig
from subiaco_sim.motion import Motion
from subiaco_sim.vehicle import GNSS

FIXED, FLOAT, SINGLE, NONE = 2, 1, 0, -1
HEADING_SIGMA = np.radians(0.15)


@dataclass(frozen=True)
class GnssSeries:
    """Fixes: times (N,), antenna in ENU (N, 3) [m] with NaN where none, status (N,), sigma (N, 3)."""

    times_ns: Ints
    enu: Floats
    status: Ints
    sigma: Floats
    yaw: Floats  # of base_link from east, counter-clockwise [rad]


def simulate_gnss(motion: Motion, config: GnssConfig, rng: np.random.Generator) -> GnssSeries:
    """Sample the antenna's path with errors that belong to each fix's state."""
    step_ns = round(1e9 / config.rate)
    count = int(motion.duration * config.rate)
    times_ns = motion.start_ns + 20_000_000 + np.arange(count, dtype=np.int64) * step_ns
    poses = motion.poses(times_ns)
    antenna = poses[:, :3, :3] @ GNSS.T_base_sensor[:3, 3] + poses[:, :3, 3]
    status = states(count, config)
    levels = {FIXED: config.sigma_fixed, FLOAT: config.sigma_float, SINGLE: config.sigma_single}
    horizontal = np.array([levels.get(int(s), np.nan) for s in status])
    sigma = horizontal[:, None] * np.array([1.0, 1.0, config.vertical_factor])
    slow = gauss_markov(count, 1.0 / config.rate, config.correlation_time, rng)
    error = sigma * (np.sqrt(0.6) * slow + np.sqrt(0.4) * rng.standard_normal((count, 3)))
    yaw = motion.angles(motion.seconds(times_ns))[:, 0] + HEADING_SIGMA * rng.standard_normal(count)
    return GnssSeries(times_ns, antenna + error, status, sigma, yaw)


def states(count: int, config: GnssConfig) -> Ints:
    """Return the state of every fix: one stretch of float, single and none past the middle."""
    status = np.full(count, FIXED, dtype=np.int64)
    begin = 0.55 * count
    stretches = ((FLOAT, config.float_share), (SINGLE, config.single_share), (NONE, config.none_share))
    for state, share in stretches:
        end = begin + share * count
        status[round(begin) : round(end)] = state
        begin = end
    return status


def gauss_markov(count: int, step: float, correlation_time: float, rng: np.random.Generator) -> Floats:
    """Return a unit-variance first-order Gauss-Markov series (count, 3)."""
    keep = np.exp(-step / correlation_time)
    drive = rng.standard_normal((count, 3))
    series = np.empty((count, 3))
    state = drive[0]
    for k in range(count):
        state = state if k == 0 else keep * state + np.sqrt(1 - keep**2) * drive[k]
        series[k] = state
    return series
