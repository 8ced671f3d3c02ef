"""Recorded motion and fixes of other people's vehicles through our deskewing and GNSS parts."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from subiaco_geo.frames import invert_pose, make_pose
from subiaco_mapping.measurements import Extrinsics, GnssFix, ImuSample, Returns, Scan
from subiaco_mapping.pose_graph import gnss
from subiaco_mapping.pose_graph.config import GnssConfig
from subiaco_mapping.preprocessing.config import DeskewConfig
from subiaco_mapping.preprocessing.deskew import Deskewer, body_twist

SECOND = 10**9
START_NS = 1_700_000_000 * SECOND


def newer_college(folder: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Raw points (N, 3), their times (N,) [s] and the same points deskewed to the first by others."""
    if not folder.is_dir():
        pytest.skip(f"no deskew sample: {folder} is no folder")
    raw, reference = (
        np.fromfile(folder / name, "<f4").reshape(-1, 3).astype(float)
        for name in ("raw_00.bin", "deskewed_00.bin")
    )
    return raw, np.fromfile(folder / "times_00.bin", "<f4").astype(float), reference


def rigid(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """The pose (4, 4) that brings source (N, 3) to target."""
    rotation, _ = Rotation.align_vectors(target - target.mean(axis=0), source - source.mean(axis=0))
    turn = rotation.as_matrix()
    return make_pose(turn, target.mean(axis=0) - turn @ source.mean(axis=0))


def reference_motion(
    raw: np.ndarray, times: np.ndarray, reference: np.ndarray, knots: int = 12
) -> tuple[np.ndarray, np.ndarray]:
    """The reference's own motion: middle times (K,) and T_start_t (K, 4, 4), from points of equal time."""
    edges = np.linspace(times.min(), times.max() + 1e-9, knots + 1)
    parts = [np.flatnonzero((times >= a) & (times < b)) for a, b in pairwise(edges)]
    poses = np.array([rigid(raw[p], reference[p]) for p in parts])
    return np.array([times[p].mean() for p in parts]), poses


def deskewed(raw: np.ndarray, times: np.ndarray, twist: np.ndarray | None, imu: list[ImuSample]) -> tuple:
    times_ns = START_NS + np.round(times * SECOND).astype(np.int64)
    returns = Returns(raw, times_ns, np.zeros(len(raw), np.float32), np.zeros(len(raw), np.uint16))
    deskewer = Deskewer(DeskewConfig(), Extrinsics(np.eye(4), np.eye(4), None))
    for sample in imu:
        deskewer.push_imu(sample)
    scan = deskewer.deskew(Scan(int(times_ns.min()), int(times_ns.max()), returns), twist)
    return scan.xyz, scan.mode


def test_a_real_scan_is_deskewed_as_by_the_reference(shared_data: Path) -> None:
    """Rates come from the reference's own motion: what is tested is how they are applied.

    Error against the reference moved to the last column, 95th percentile: 2.1 m undone, 0.22 m at
    a constant twist, 0.06 m with the gyro (whose rates are the reference's over 8 ms).
    """
    raw, times, reference = newer_college(shared_data / "newer_college_deskew")
    at, poses = reference_motion(raw, times, reference)
    expected = (reference - poses[-1, :3, 3]) @ poses[-1, :3, :3]
    twist = body_twist(invert_pose(poses[0]) @ poses[-1], float(at[-1] - at[0]))
    steps = invert_pose(poses[:-1]) @ poses[1:]
    rates = Rotation.from_matrix(steps[:, :3, :3]).as_rotvec() / np.diff(at)[:, None]
    middle = np.concatenate([[-0.02], 0.5 * (at[1:] + at[:-1]), [times.max() + 0.02]])
    rates = rates[np.r_[0, np.arange(len(rates)), -1]]
    imu = [
        ImuSample(START_NS + round(float(t) * SECOND), rate, np.array([0.0, 0.0, 9.8]))
        for t, rate in zip(middle, rates, strict=True)
    ]

    def error(xyz: np.ndarray) -> float:
        return float(np.percentile(np.linalg.norm(xyz - expected, axis=1), 95))

    still, steady, turning = (
        deskewed(raw, times, twist if used else np.zeros(6), imu if gyro else [])
        for used, gyro in ((False, False), (True, False), (True, True))
    )
    assert (steady[1], turning[1]) == ("constant_velocity", "gyro")
    assert error(still[0]) > 1.5
    assert error(steady[0]) < 0.25
    assert error(turning[0]) < 0.08


def rtk_drive(folder: Path) -> list[GnssFix]:
    """The fixes of the recorded drive; Q 1 is fixed, 2 float."""
    if not folder.is_dir():
        pytest.skip(f"no recorded drive: {folder} is no folder")
    rows = [line.split() for line in (folder / "gnss_1934_sf.pos").read_text().splitlines()]
    fixes = []
    for row in rows:
        if row[0].startswith("%"):
            continue
        stamp = np.datetime64(row[0].replace("/", "-") + "T" + row[1], "ns").astype(np.int64)
        latitude, longitude, height, quality, _, sdn, sde, sdu = (float(v) for v in row[2:10])
        status = {1: 2, 2: 1}.get(int(quality), 0)
        covariance = np.diag([sde, sdn, sdu]) ** 2
        fixes.append(GnssFix(int(stamp), latitude, longitude, height, covariance, status))
    return fixes


def predicted_between(xyz: np.ndarray) -> np.ndarray:
    """Every fix from its four neighbours (cubic through -2 -1 +1 +2), (N-4, 3)."""
    return (-xyz[:-4] + 4 * xyz[1:-3] + 4 * xyz[3:-1] - xyz[4:]) / 6


def test_the_recorded_drive_is_read_whole_and_placed_in_metres(shared_data: Path) -> None:
    fixes = rtk_drive(shared_data / "rtk_imu_drive")
    frame = gnss.local_frame(fixes, GnssConfig())
    assert frame is not None
    enu = gnss.to_enu(fixes, frame, GnssConfig())
    assert len(enu) == len(fixes) == 2197
    way = np.linalg.norm(np.diff(enu.enu, axis=0), axis=1).sum()
    assert way == pytest.approx(4040, rel=0.01)
    assert gnss.enough_to_place(enu.enu, GnssConfig()) is None
    assert (enu.status == 2).mean() == pytest.approx(0.996, abs=0.002)


def test_innovations_of_the_recorded_drive_show_that_fixes_share_their_errors(shared_data: Path) -> None:
    """Each fix against the cubic through its neighbours, 0.25 and 0.5 s away.

    Root mean square over the stated sigma: 0.27 east, 0.30 north, 0.32 up; the 99th percentile of
    the absolute value is at most 1.05. Independent errors of the stated size would give 1: at least
    nine tenths of the stated variance are common to neighbours, which is why
    ``gnss.correlated_share`` inflates. None of the fixes that claim to be fixed jumps.
    """
    fixes = rtk_drive(shared_data / "rtk_imu_drive")
    frame = gnss.local_frame(fixes, GnssConfig())
    assert frame is not None
    enu = gnss.to_enu(fixes, frame, GnssConfig())
    fixed = enu.status[2:-2] == 2
    innovation = (enu.enu[2:-2] - predicted_between(enu.enu))[fixed]
    sigma = np.sqrt(np.diagonal(enu.covariance, axis1=1, axis2=2))[2:-2][fixed]
    ratio = innovation / (sigma * np.sqrt(1 + 34 / 36))
    np.testing.assert_allclose(np.sqrt((ratio**2).mean(axis=0)), [0.27, 0.30, 0.32], atol=0.02)
    assert np.percentile(np.abs(ratio), 99, axis=0).max() < 1.1
    assert np.abs(ratio).max() < 5.0
