"""Trajectories: exact times, round trips, and rows that are refused with their number."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from subiaco_geo.errors import InputError
from subiaco_geo.frames import exp_se3
from subiaco_geo.trajectories import (
    Trajectory,
    format_seconds,
    parse_seconds,
    read_kitti,
    read_tum,
    write_kitti,
    write_tum,
)

ROW = "1763000000.000000001 1 2 3 0 0 0 1\n"


def drive(n: int = 20) -> Trajectory:
    rng = np.random.default_rng(4)
    poses = exp_se3(rng.normal(size=(n, 6)))
    poses[:, :3, 3] += [389_000.0, 6_463_000.0, 10.0]
    return Trajectory(1_763_000_000_000_000_001 + np.arange(n) * 99_999_999, poses)


@given(st.integers(-(2**62), 2**62))
def test_nanoseconds_survive_the_text(time_ns: int) -> None:
    assert parse_seconds(format_seconds(time_ns)) == time_ns


@pytest.mark.parametrize(
    ("text", "expected"),
    [("1.763e9", 1_763_000_000 * 10**9), ("-0.5", -500_000_000), ("7", 7 * 10**9), (".25", 250_000_000)],
)
def test_seconds_are_read_as_people_write_them(text: str, expected: int) -> None:
    assert parse_seconds(text) == expected


@pytest.mark.parametrize("text", ["noon", "nan", "inf", ""])
def test_what_is_not_a_time_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="not a time"):
        parse_seconds(text)


def test_tum_keeps_times_exactly_and_poses_to_a_tenth_of_a_millimetre(tmp_path: Path) -> None:
    write_tum(tmp_path / "t.tum", drive())
    back = read_tum(tmp_path / "t.tum")
    np.testing.assert_array_equal(back.times_ns, drive().times_ns)
    np.testing.assert_allclose(back.poses, drive().poses, atol=5.1e-5)
    np.testing.assert_allclose(back.poses[:, :3, :3], drive().poses[:, :3, :3], atol=1e-8)


def test_kitti_keeps_times_exactly_and_poses_to_a_micrometre(tmp_path: Path) -> None:
    write_kitti(tmp_path / "01.txt", drive())
    assert sorted(p.name for p in tmp_path.iterdir()) == ["01.times.txt", "01.txt"]
    back = read_kitti(tmp_path / "01.txt")
    np.testing.assert_array_equal(back.times_ns, drive().times_ns)
    np.testing.assert_allclose(back.poses, drive().poses, atol=6e-6)


def test_comments_and_blank_lines_are_skipped(tmp_path: Path) -> None:
    (tmp_path / "t.tum").write_text("# time x y z\n\n" + ROW)
    assert read_tum(tmp_path / "t.tum").times_ns.tolist() == [1_763_000_000_000_000_001]


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("# nothing\n", "no poses"),
        (ROW + "1 2 3\n", ":2: a TUM row has 8 columns, found 3"),
        (ROW + "noon 1 2 3 0 0 0 1\n", ":2: not a TUM row"),
        (ROW + ROW, ":2: time does not increase"),
        ("# c\n1 nan 2 3 0 0 0 1\n", ":2: NaN"),
        ("1 1 2 3 0 0 0 0\n", ":1: the quaternion is zero"),
    ],
)
def test_bad_tum_rows_are_named(tmp_path: Path, text: str, match: str) -> None:
    (tmp_path / "t.tum").write_text(text)
    with pytest.raises(InputError, match=match):
        read_tum(tmp_path / "t.tum")


def test_missing_and_binary_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_tum(tmp_path / "none.tum")
    (tmp_path / "b.tum").write_bytes(bytes(range(256)))
    with pytest.raises(InputError, match="not a text file"):
        read_tum(tmp_path / "b.tum")


@pytest.mark.parametrize(
    ("poses", "times", "match"),
    [
        ("1 0 0 0 0 1 0 0 0 0 1 0\n", "1\n2\n", "1 poses but 2 times"),
        ("1 0 0 0\n", "1\n", "12 numbers"),
        ("one\n", "1\n", "not a KITTI"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0\n", "1\n2\n", "not a KITTI"),
        ("", "", "12 numbers"),
    ],
)
def test_bad_kitti_files_are_refused(tmp_path: Path, poses: str, times: str, match: str) -> None:
    (tmp_path / "p.txt").write_text(poses)
    (tmp_path / "p.times.txt").write_text(times)
    with pytest.raises(InputError, match=match):
        read_kitti(tmp_path / "p.txt")


def test_real_reference_poses_are_read_and_stay_rigid(shared_data: Path, tmp_path: Path) -> None:
    path = shared_data / "kitti_scans" / "kiss_icp_reference_poses.txt"
    count = len(path.read_text().splitlines())
    times = tmp_path / "times.txt"
    times.write_text("".join(f"{i / 10}\n" for i in range(count)))
    rotation = read_kitti(path, times).poses[:, :3, :3]
    np.testing.assert_allclose(
        rotation @ np.swapaxes(rotation, 1, 2), np.tile(np.eye(3), (count, 1, 1)), atol=1e-5
    )


def test_a_trajectory_checks_its_own_shape_and_order() -> None:
    with pytest.raises(InputError, match="shape"):
        Trajectory(np.array([1, 2]), np.eye(4)[None])
    with pytest.raises(InputError, match="increasing"):
        Trajectory(np.array([2, 2]), np.tile(np.eye(4), (2, 1, 1)))
    with pytest.raises(InputError, match="integer"):
        Trajectory(np.array([0.5]), np.eye(4)[None])  # type: ignore[arg-type]


def test_interpolation_passes_through_the_poses() -> None:
    trajectory = drive()
    np.testing.assert_allclose(trajectory.at(trajectory.times_ns), trajectory.poses, atol=1e-9)
    middle = trajectory.at((trajectory.times_ns[:1] + trajectory.times_ns[1:2]) // 2)
    np.testing.assert_allclose(middle[0, :3, 3], trajectory.positions[:2].mean(axis=0), atol=1e-6)
