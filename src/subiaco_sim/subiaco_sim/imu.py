"""Specific force and angular rate in imu_link, with bias and noise."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from subiaco_geo.frames import Floats, Ints
from subiaco_sim.config import ImuConfig
from subiaco_sim.motion import Motion
from subiaco_sim.vehicle import IMU

GRAVITY = 9.7940  # Perth [m/s2]
STANDARD_GRAVITY = 9.80665


@dataclass(frozen=True)
class ImuSeries:
    """Samples: times (N,) int64 ns, gyro (N, 3) rad/s and accel (N, 3) m/s2 in imu_link."""

    times_ns: Ints
    gyro: Floats
    accel: Floats
    gyro_bias: Floats
    accel_bias: Floats


def simulate_imu(
    motion: Motion, config: ImuConfig, rng: np.random.Generator, T_base_imu: Floats = IMU.T_base_sensor
) -> ImuSeries:
    """Sample the motion; sampling begins before the first column and ends after the last."""
    step_ns = round(1e9 / config.rate)
    # an IMU keeps its own clock phase: samples fall beside the column times
    count = int((motion.duration + 0.2) * config.rate)
    times_ns = motion.start_ns - 100_000_000 + 1_234_567 + np.arange(count, dtype=np.int64) * step_ns
    seconds = motion.seconds(times_ns)
    force = motion.acceleration(seconds, T_base_imu[:3, 3]) + np.array([0.0, 0.0, GRAVITY])
    accel = motion.rotation(seconds).inv().apply(force) @ T_base_imu[:3, :3]
    gyro = motion.body_rate(seconds) @ T_base_imu[:3, :3]
    gyro_bias = config.gyro_bias * rng.standard_normal(3)
    accel_bias = config.accel_bias * rng.standard_normal(3)
    root = np.sqrt(config.rate)
    gyro = gyro + gyro_bias + config.gyro_noise * root * rng.standard_normal(gyro.shape)
    accel = accel + accel_bias + config.accel_noise * root * rng.standard_normal(accel.shape)
    return ImuSeries(times_ns, gyro, accel, gyro_bias, accel_bias)


def ouster_packets(series: ImuSeries, stamps: Ints) -> Iterator[bytes]:
    """Yield the sensor's own inertial packets with stamps (N,) [ns]: g and degrees a second."""
    accel, gyro = series.accel / STANDARD_GRAVITY, np.degrees(series.gyro)
    for stamp, a, w in zip(stamps.tolist(), accel, gyro, strict=True):
        yield struct.pack("<3Q6f", stamp, stamp, stamp, *a, *w)
