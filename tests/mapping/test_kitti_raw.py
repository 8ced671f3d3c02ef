"""Raw folders of KITTI become bags: times by azimuth, fixes of the INS, extrinsics by its calibration."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from subiaco_geo.bags import BagReader
from subiaco_geo.errors import InputError
from subiaco_geo.topics import FIX, IMU, POINTS, TF_STATIC
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.importers.csv_logs import parse_time_ns
from subiaco_mapping.importers.kitti_raw import raised
from subiaco_mapping.importers.packets import import_recording
from subiaco_mapping.pose_graph.config import GnssConfig
from subiaco_mapping.preprocessing.conversions import extrinsics_from_tf, fix_from_msg, scan_from_points

CALIBRATION = "calib_time: 25-May-2012 16:47:16\nR: 0 -1 0 1 0 0 0 0 1\nT: -0.8 0.3 -0.7\n"
STAMP = "2011-09-26 13:21:35.{:09d}"


def raw_drive(folder: Path, *, ins_hz: int = 10) -> Path:
    """Two sweeps of four points at the rear, left, front and right; an INS over 0.3 s."""
    drive = folder / "2011_09_26" / "2011_09_26_drive_0001_sync"
    points, ins = drive / "velodyne_points", drive / "oxts"
    (points / "data").mkdir(parents=True)
    (ins / "data").mkdir(parents=True)
    xyz = np.array([[-5, 0.001, 0, 0.1], [0, 5, 0, 0.2], [5, 0, 0, 0.3], [0, -5, 0, 1.0]], "<f4")
    for k in range(2):
        (points / "data" / f"{k:010d}.bin").write_bytes(xyz.tobytes())
    for name, ms in (("start", -50), ("", 0), ("end", 50)):
        lines = [STAMP.format((100 + 100 * k + ms) * 10**6) for k in range(2)]
        (points / f"timestamps{'_' + name if name else ''}.txt").write_text("\n".join(lines) + "\n")
    row = [49.0, 8.44, 113.0, 0.01, 0.02, 2.4, *[0.0] * 5, 0.1, 0.2, 9.8, *[0.0] * 3, 0.01, 0.02, 0.3]
    row += [0.0] * 3 + [0.08, 0.1, 4, 9, 5, 6, 6]
    for k in range(3 * ins_hz // 10):
        (ins / "data" / f"{k:010d}.txt").write_text(" ".join(map(str, row)))
    stamps = [STAMP.format(100_000_000 + k * 10**9 // ins_hz) for k in range(3 * ins_hz // 10)]
    (ins / "timestamps.txt").write_text("\n".join(stamps) + "\n")
    (drive.parent / "calib_imu_to_velo.txt").write_text(CALIBRATION)
    return drive


def test_a_drive_becomes_clouds_with_point_times_fixes_and_extrinsics(tmp_path: Path) -> None:
    counts = import_recording(raw_drive(tmp_path), tmp_path / "bag")
    assert counts == {POINTS: 2, FIX: 3, TF_STATIC: 1}
    with BagReader(tmp_path / "bag") as reader:
        found = {topic: [reader.deserialize(m) for m in reader.messages({topic})] for topic in counts}
    scan = scan_from_points(found[POINTS][0], MappingConfig())
    start_ns = parse_time_ns(STAMP.format(50_000_000))
    np.testing.assert_allclose((scan.first.times_ns - start_ns) * 1e-6, [0, 25, 50, 75], atol=0.01)
    np.testing.assert_allclose(scan.first.intensity, [25.5, 51, 76.5, 255], rtol=1e-6)
    fix = fix_from_msg(found[FIX][0], GnssConfig())
    assert (fix.latitude, fix.longitude, fix.altitude, fix.status) == (49.0, 8.44, 113.0, 1)
    np.testing.assert_allclose(np.sqrt(np.diag(fix.covariance)), [0.08, 0.08, 0.16])
    rig = extrinsics_from_tf(found[TF_STATIC][0].transforms, MappingConfig().sensors, {"gnss"})
    velo = rig.T_base_lidar @ [-0.8, 0.3, -0.7, 1.0]  # where the calibration sees the INS
    np.testing.assert_allclose(velo[:3], 0.0, atol=1e-9)


def test_elevation_angles_are_put_right_and_ranges_stay() -> None:
    rng = np.random.default_rng(3)
    xyz = rng.normal(size=(100, 3)) * [20, 20, 2]
    found = raised(xyz)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), np.linalg.norm(xyz, axis=1))
    np.testing.assert_allclose(np.arctan2(found[:, 1], found[:, 0]), np.arctan2(xyz[:, 1], xyz[:, 0]))
    rise = [np.degrees(np.arctan2(p[:, 2], np.hypot(p[:, 0], p[:, 1]))) for p in (xyz, found)]
    np.testing.assert_allclose(rise[1] - rise[0], 0.205, atol=1e-9)


def test_a_dense_ins_is_an_imu_too(tmp_path: Path) -> None:
    counts = import_recording(raw_drive(tmp_path, ins_hz=100), tmp_path / "bag")
    assert counts[IMU] == counts[FIX] == 30
    with BagReader(tmp_path / "bag") as reader:
        sample = reader.deserialize(next(reader.messages({IMU})))
    assert (sample.angular_velocity.z, sample.linear_acceleration.z) == (0.3, 9.8)


def test_without_starts_and_ends_the_stamps_are_the_middles_of_the_turns(tmp_path: Path) -> None:
    drive = raw_drive(tmp_path)
    for name in ("start", "end"):
        (drive / "velodyne_points" / f"timestamps_{name}.txt").unlink()
    import_recording(drive, tmp_path / "bag")
    with BagReader(tmp_path / "bag") as reader:
        scan = scan_from_points(reader.deserialize(next(reader.messages({POINTS}))), MappingConfig())
    assert scan.start_ns == pytest.approx(parse_time_ns(STAMP.format(50_000_000)), abs=10_000)


def spoil(drive: Path, what: str) -> None:
    stamps = drive / "velodyne_points" / "timestamps_start.txt"
    if what == "half a point":
        (drive / "velodyne_points" / "data" / "0000000001.bin").write_bytes(b"\0" * 24)
    elif what == "no calibration":
        (drive.parent / "calib_imu_to_velo.txt").unlink()
    elif what == "too few stamps":
        stamps.write_text(stamps.read_text().splitlines()[0] + "\n")
    elif what == "no stamp":
        stamps.write_text("now\nlater\n")
    elif what == "a short row":
        (drive / "oxts" / "data" / "0000000000.txt").write_text("49.0 8.44 113.0")


@pytest.mark.parametrize(
    ("what", "said"),
    [
        ("half a point", r"0000000001\.bin: 24 bytes"),
        ("no calibration", "calib_imu_to_velo.txt"),
        ("too few stamps", r"timestamps_start\.txt: 1 stamps"),
        ("no stamp", r"timestamps_start\.txt: line 1"),
        ("a short row", r"0000000000\.txt: 3 values"),
    ],
)
def test_what_is_damaged_is_named_and_no_bag_is_left(tmp_path: Path, what: str, said: str) -> None:
    drive = raw_drive(tmp_path)
    spoil(drive, what)
    with pytest.raises(InputError, match=said) as refused:
        import_recording(drive, tmp_path / "bag")
    assert "\n" not in str(refused.value)
    assert not (tmp_path / "bag").exists()


def test_a_folder_that_is_no_drive_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"velodyne_points/data/\*\.bin"):
        import_recording(tmp_path, tmp_path / "out" / "bag")
