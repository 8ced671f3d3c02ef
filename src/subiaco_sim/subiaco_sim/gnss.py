"""Fixes of the antenna: RTK states, slow and fast errors, covariances, heading."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from subiaco_geo.frames import Floats, Ints
from subiaco_sim.config import FaultConfig, GnssConfig
from subiaco_sim.motion import Motion
from subiaco_sim.scene import Castable
from subiaco_sim.vehicle import GNSS

FIXED, FLOAT, SINGLE, NONE = 2, 1, 0, -1


@dataclass(frozen=True)
class GnssSeries:
    """Fixes: times (N,), antenna in ENU (N, 3) [m] with NaN where none, status (N,), sigma (N, 3).

    ``yaw`` (N,) of base_link from east, counter-clockwise, NaN where the two
    antennas give none; ``yaw_sigma`` [rad].
    """

    times_ns: Ints
    enu: Floats
    status: Ints
    sigma: Floats
    yaw: Floats
    yaw_sigma: float


def simulate_gnss(
    motion: Motion,
    config: GnssConfig,
    rng: np.random.Generator,
    faults: FaultConfig | None = None,
    scene: Castable | None = None,
) -> GnssSeries:
    """Sample the antenna's path with errors that belong to each fix's state.

    With ``faults`` and the ``scene`` around the antenna, the sky that is
    hidden and multipath take their part.
    """
    step_ns = round(1e9 / config.rate)
    count = int(motion.duration * config.rate)
    times_ns = motion.start_ns + 20_000_000 + np.arange(count, dtype=np.int64) * step_ns
    poses = motion.poses(times_ns)
    antenna = poses[:, :3, :3] @ GNSS.T_base_sensor[:3, 3] + poses[:, :3, 3]
    status = states(count, config)
    if faults is not None and faults.canyons and scene is not None:
        status = np.minimum(status, state_under(hidden_sky(scene, antenna)))
    levels = {FIXED: config.sigma_fixed, FLOAT: config.sigma_float, SINGLE: config.sigma_single}
    horizontal = np.array([levels.get(int(s), np.nan) for s in status])
    sigma = horizontal[:, None] * np.array([1.0, 1.0, config.vertical_factor])
    slow = gauss_markov(count, 1.0 / config.rate, config.correlation_time, rng)
    error = sigma * (np.sqrt(0.6) * slow + np.sqrt(0.4) * rng.standard_normal((count, 3)))
    if faults is not None and faults.multipath:
        times = np.arange(count) / config.rate
        false = multipath(times, faults, rng)
        error += np.where((status == FIXED)[:, None], false, 0.0)
    yaw_sigma = np.radians(config.heading_sigma_deg or np.nan)
    yaw = motion.angles(motion.seconds(times_ns))[:, 0] + yaw_sigma * rng.standard_normal(count)
    yaw[status < FLOAT] = np.nan  # the baseline needs the carrier phase of both
    return GnssSeries(times_ns, antenna + error, status, sigma, yaw, float(yaw_sigma))


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


def hidden_sky(scene: Castable, antenna: Floats) -> Floats:
    """Return the share of the sky above 15 degrees that is hidden at places (N, 3)."""
    elevation = np.repeat(np.radians([20.0, 35.0, 50.0, 70.0]), 12)
    azimuth = np.tile(np.arange(12) * (2 * np.pi / 12), 4)
    flat = np.cos(elevation)
    rays = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=1)
    origins = np.repeat(antenna, len(rays), axis=0)
    hits = scene.cast(origins, np.tile(rays, (len(antenna), 1)))
    return np.isfinite(hits.distance).reshape(len(antenna), -1).mean(axis=1)


def state_under(hidden: Floats) -> Ints:
    """Return the best state that a receiver keeps under a hidden share of the sky (N,)."""
    return np.select([hidden < 0.35, hidden < 0.5, hidden < 0.7], [FIXED, FLOAT, SINGLE], NONE).astype(
        np.int64
    )


def multipath(seconds: Floats, faults: FaultConfig, rng: np.random.Generator) -> Floats:
    """Return errors (N, 3) that come and go within 4 s, each of its own direction [m]."""
    error = np.zeros((len(seconds), 3))
    for _ in range(faults.multipath):
        begin, turn = rng.uniform(0.15, 0.9) * seconds[-1], rng.uniform(0, 2 * np.pi)
        shape = np.clip(np.minimum(seconds - begin, begin + 4.0 - seconds) / 0.5, 0.0, 1.0)
        error += shape[:, None] * faults.multipath_size * np.array([np.cos(turn), np.sin(turn), 0.8])
    return error
