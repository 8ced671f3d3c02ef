"""Point times of every maker of LiDARs, in whatever unit they come."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mapping_scenes import START_NS, point_cloud_message

from subiaco_geo.errors import InputError
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.preprocessing.conversions import scan_from_points

COUNT = 400
SHARE = np.linspace(0.0, 1.0, COUNT)  # of a sweep of 0.1 s
XYZ = np.stack([5 * np.cos(SHARE * 6), 5 * np.sin(SHARE * 6), SHARE], axis=1)
SECONDS = 0.1 * SHARE

DRIVERS = [
    pytest.param("time", SECONDS.astype("<f4"), 0, 10, id="Velodyne, since the start"),
    pytest.param("time", (SECONDS - 0.1).astype("<f4"), -100_000_000, 10, id="Velodyne, before the end"),
    pytest.param("t", (SECONDS * 1e9).astype("<u4"), 0, 1, id="Ouster"),
    pytest.param("timestamp", START_NS * 1e-9 + SECONDS, 0, 300, id="Hesai, RoboSense"),
    pytest.param("timestamp", START_NS + SECONDS * 1e9, 0, 300, id="Livox, nanoseconds as float64"),
    pytest.param("offset_time", (SECONDS * 1e9).astype("<u4"), 0, 1, id="Livox, since the start"),
    pytest.param("time", (SECONDS * 1e3).astype("<f4"), 0, 10, id="milliseconds"),
    pytest.param("time", (SECONDS * 1e6).astype("<f4"), 0, 10, id="microseconds as float32"),
    pytest.param("t", (SECONDS * 1e6).astype("<u4"), 0, 1000, id="microseconds as uint32"),
    pytest.param("t", (SECONDS * 1e9).astype("<f4"), 0, 10, id="nanoseconds as float32"),
    pytest.param("timestamp", START_NS * 1e-3 + SECONDS * 1e6, 0, 500, id="microseconds since 1970"),
]


@pytest.mark.parametrize(("name", "values", "first", "near"), DRIVERS)
def test_the_unit_is_told_by_how_long_a_sweep_lasts(
    name: str, values: np.ndarray, first: int, near: int
) -> None:
    scan = scan_from_points(point_cloud_message(XYZ, START_NS, **{name: values}), MappingConfig())
    np.testing.assert_allclose(scan.first.times_ns - START_NS - first, SECONDS * 1e9, atol=near)


@given(st.sampled_from([0.01, 0.05, 0.1, 0.2]), st.sampled_from([1, 10**3, 10**6, 10**9]), st.booleans())
def test_any_unit_and_sweep_gives_the_same_times(lasts: float, per_second: int, absolute: bool) -> None:
    values = SHARE * lasts * per_second + (START_NS * 1e-9 * per_second if absolute else 0.0)
    scan = scan_from_points(point_cloud_message(XYZ, START_NS, timestamp=values), MappingConfig())
    np.testing.assert_allclose(scan.first.times_ns - START_NS, SHARE * lasts * 1e9, atol=600)


def test_points_without_coordinates_do_not_tell_the_unit() -> None:
    xyz, values = XYZ.copy(), START_NS * 1e-9 + SECONDS
    xyz[::3], values[::3] = np.nan, 0.0
    xyz[1::9], values[1::9] = 0.0, 0.0
    scan = scan_from_points(point_cloud_message(xyz, START_NS, timestamp=values), MappingConfig())
    assert 0 <= scan.start_ns - START_NS < 1_000_000
    assert (scan.end_ns - scan.start_ns) * 1e-9 == pytest.approx(0.1, abs=0.001)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        (np.zeros(COUNT, "<u4"), "same for all points"),
        ((START_NS * 1e-9 + SECONDS).astype("<f4"), "same for all points"),  # float32 steps by 128 s
        (SHARE * 1e-4, "spans"),
    ],
)
def test_what_is_no_time_of_a_sweep_is_refused_in_one_line(values: np.ndarray, said: str) -> None:
    with pytest.raises(InputError, match=said) as refused:
        scan_from_points(point_cloud_message(XYZ, START_NS, t=values), MappingConfig())
    assert "\n" not in str(refused.value)
    assert "/lidar/points" in str(refused.value)
