"""What no sensor can measure is left out at the door, and counted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from subiaco_mapping.config import MappingConfig
from subiaco_mapping.measurements import Extrinsics, GnssFix, ImuSample
from subiaco_mapping.odometry.frontend import OdometryFrontend

FIX = GnssFix(0, -31.95, 115.83, 20.0, np.diag([1e-4, 1e-4, 4e-4]), 2)


def test_a_sound_fix_is_usable_and_so_is_one_whose_covariance_was_rounded() -> None:
    assert FIX.is_usable()
    turned = np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    turned[0, 1] = np.float32(1.0 + 1e-7)
    assert replace(FIX, covariance=turned).is_usable()


@pytest.mark.parametrize(
    "covariance",
    [
        np.diag([1e-4, -1e-4, 1e-4]),
        np.diag([1e-4, np.nan, 1e-4]),
        np.array([[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),  # correlated by more than 1
    ],
)
def test_a_fix_whose_covariance_is_none_is_not_used(covariance: np.ndarray) -> None:
    assert not replace(FIX, covariance=covariance).is_usable()


@pytest.mark.parametrize("altitude", [1e7, -9999.0, np.inf])
def test_a_fix_that_no_road_can_have_is_not_used(altitude: float) -> None:
    assert not replace(FIX, altitude=altitude).is_usable()


@pytest.mark.parametrize("spike", [1e30, np.nan, np.inf, -1e4])
def test_a_spike_of_the_imu_is_left_out_and_counted(spike: float) -> None:
    frontend = OdometryFrontend(MappingConfig(), Extrinsics())
    good = np.array([0.0, 0.0, 9.81])
    samples = [(np.zeros(3), good), (np.array([spike, 0, 0]), good), (np.zeros(3), np.array([0, spike, 0]))]
    for number, (gyro, accel) in enumerate(samples):
        frontend.on_imu(ImuSample(number * 10_000_000, gyro, accel))
    assert frontend.facts()["imu_implausible"] == 2
