"""The real drive of an HDL-64 with an INS, as a bag: times and lasers of its points, fixes withheld."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from subiaco_geo.bags import BagReader
from subiaco_geo.topics import FIX, POINTS, TF_STATIC
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.preprocessing.conversions import scan_from_points


@pytest.fixture(scope="module")
def kitti_drive() -> ModuleType:
    folder = str(Path(__file__).parents[1] / "benchmarks")
    if folder not in sys.path:
        sys.path.insert(0, folder)
    import kitti_drive

    return kitti_drive


def test_points_are_measured_from_the_rear_over_the_left_the_front_and_the_right(
    kitti_drive: ModuleType,
) -> None:
    xyz = np.array([[-5, 0.001, 0], [0, 5, 0], [5, 0, 0], [0, -5, 0]], dtype=np.float64)
    times = kitti_drive.point_times(xyz, 10**9, 100e6)
    np.testing.assert_allclose(times - 10**9, [-50e6, -25e6, 0, 25e6], atol=5e3)


def test_lasers_are_counted_by_the_turns_of_the_azimuth(kitti_drive: ModuleType) -> None:
    azimuth = np.radians(np.tile(np.arange(1.0, 360.0, 3.0), 5))
    xyz = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros_like(azimuth)], axis=1)
    np.testing.assert_array_equal(kitti_drive.rings(xyz), np.repeat(np.arange(5), 120))


def test_the_real_drive_becomes_a_bag_with_the_sweeps_lasers_and_fixes_asked_for(
    kitti_drive: ModuleType, shared_data: Path, tmp_path: Path
) -> None:
    if not (shared_data / "kitti_drive_0027").is_dir():
        pytest.skip("no kitti_drive_0027 among the real recordings")
    drive = kitti_drive.read_drive(shared_data)
    kitti_drive.write_drive(
        drive, tmp_path / "bag", lambda k, n: k in (40, 41), every_ring=2, fixes="alternate"
    )
    with BagReader(tmp_path / "bag") as reader:
        assert {name: info.count for name, info in reader.topics.items()} == {
            POINTS: 2,
            FIX: 97,
            TF_STATIC: 1,
        }
        scans = [scan_from_points(reader.deserialize(m), MappingConfig()) for m in reader.messages({POINTS})]
    for scan, k in zip(scans, (40, 41), strict=True):
        assert len(scan.first) == pytest.approx((drive.offsets[k + 1] - drive.offsets[k]) / 2, rel=0.1)
        assert (scan.end_ns - scan.start_ns) * 1e-9 == pytest.approx(0.10356, abs=1e-4)
        assert set(np.unique(scan.first.ring)) == set(range(0, 64, 2))
    assert (scans[1].end_ns - scans[0].end_ns) * 1e-9 == pytest.approx(0.10356, abs=2e-4)
