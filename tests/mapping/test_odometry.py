"""Odometry recovers known motions, and says how well it does."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from kitti import kitti_clouds, kitti_reference
from mapping_scenes import SECOND, START_NS, cast, relative, room_scan, turning_pose

from subiaco_geo.frames import invert_pose, make_pose
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.measurements import DeskewedScan, Extrinsics, Returns, Scan
from subiaco_mapping.odometry.config import OdometryConfig
from subiaco_mapping.odometry.frontend import OdometryFrontend
from subiaco_mapping.odometry.scan_matching import KissOdometry

STEP = SECOND // 10
SMALL = OdometryConfig(voxel=0.5)


def deskewed(xyz: np.ndarray, stamp_ns: int, motion: np.ndarray | None = None) -> DeskewedScan:
    return DeskewedScan(stamp_ns, xyz, np.zeros(len(xyz), np.float32), "none", motion)


def run_room(stamps: np.ndarray, predict: bool, config: OdometryConfig = SMALL):
    truth = turning_pose(stamps, speed=2.0, rate=0.3)
    odometry = KissOdometry(config)
    found = []
    for k, (stamp, pose) in enumerate(zip(stamps, truth, strict=True)):
        motion = invert_pose(truth[k - 1]) @ pose if predict and k else None
        found.append(odometry.register(deskewed(room_scan(pose, 8000, k, 0.01), int(stamp), motion)))
    return found, relative(truth)


def test_motion_in_a_room_is_recovered_within_centimetres() -> None:
    found, truth = run_room(START_NS + np.arange(15) * STEP, predict=False)
    error = [
        np.linalg.norm((invert_pose(t) @ f.T_odom_lidar)[:3, 3]) for f, t in zip(found, truth, strict=True)
    ]
    assert max(error) < 0.05
    assert {f.segment for f in found} == {0}
    assert not any(f.degenerate or f.predicted for f in found)


def test_the_covariance_is_of_the_size_of_the_errors() -> None:
    found, truth = run_room(START_NS + np.arange(15) * STEP, predict=True)
    poses = np.array([f.T_odom_lidar for f in found])
    motion = invert_pose(poses[:-1]) @ poses[1:]
    true_motion = invert_pose(truth[:-1]) @ truth[1:]
    error = (invert_pose(true_motion) @ motion)[:, :3, 3]
    sigma = np.sqrt(np.array([np.diag(f.covariance)[3:] for f in found[1:]]))
    ratio = np.sqrt((error**2 / sigma**2).mean())
    assert 0.05 < ratio < 2.0


def test_a_corridor_is_reported_degenerate() -> None:
    rng = np.random.default_rng(5)
    odometry, found = KissOdometry(OdometryConfig(voxel=0.5)), None
    for k in range(3):
        x, side = rng.uniform(-30, 30, 6000), rng.choice([-1.0, 1.0], 6000)
        walls = np.column_stack([x, 2.0 * side, rng.uniform(-1.5, 2, 6000)])
        floor = np.column_stack([rng.uniform(-30, 30, 3000), rng.uniform(-2, 2, 3000), np.full(3000, -1.5)])
        found = odometry.register(deskewed(np.vstack([walls, floor]), START_NS + k * STEP))
    assert found is not None
    along, across = np.sqrt(np.diag(found.covariance))[3:5]
    assert along > 3 * across


def test_a_gap_within_the_limit_keeps_the_segment_and_inflates_the_covariance() -> None:
    stamps = START_NS + np.array([0, 1, 2, 3, 9]) * STEP
    found, truth = run_room(stamps, predict=True)
    assert found[-1].segment == 0
    assert np.linalg.norm((invert_pose(truth[-1]) @ found[-1].T_odom_lidar)[:3, 3]) < 0.05
    assert found[-1].covariance[3, 3] > 5 * found[-2].covariance[3, 3]


def test_a_gap_beyond_the_limit_starts_a_segment_and_goes_on() -> None:
    stamps = START_NS + np.array([0, 1, 2, 60, 61, 62]) * STEP
    found, _ = run_room(stamps, predict=False)
    assert [f.segment for f in found] == [0, 0, 0, 1, 1, 1]
    assert found[-1].inliers > 100


def test_scans_that_match_nothing_are_predicted_and_never_end_the_run() -> None:
    odometry = KissOdometry(OdometryConfig(voxel=0.5, max_failures=2))
    odometry.register(deskewed(room_scan(np.eye(4), 6000, 0), START_NS))
    far = np.add(room_scan(np.eye(4), 6000, 1), [50.0, 50.0, 0.0])
    found = [odometry.register(deskewed(far, START_NS + k * STEP)) for k in range(1, 6)]
    assert found[0].predicted
    assert found[-1].segment == 1
    assert not found[-1].predicted


def test_an_older_stamp_is_refused() -> None:
    odometry = KissOdometry(OdometryConfig())
    odometry.register(deskewed(room_scan(np.eye(4), 2000, 0), START_NS))
    with pytest.raises(ValueError, match="not newer"):
        odometry.register(deskewed(room_scan(np.eye(4), 2000, 0), START_NS))


def lag_behind(config: OdometryConfig) -> np.ndarray:
    """How far (30,) odometry is ahead of a sensor of 32 rings that pulls away with 1 m/s2 [m]."""
    azimuth, rise = np.meshgrid(
        np.linspace(0, 2 * np.pi, 360, endpoint=False), np.radians(np.linspace(-22, 22, 32))
    )
    beams = np.stack([np.cos(rise) * np.cos(azimuth), np.cos(rise) * np.sin(azimuth), np.sin(rise)], axis=-1)
    beams, rng, odometry, found = beams.reshape(-1, 3), np.random.default_rng(2), KissOdometry(config), []
    for k in range(30):
        x = 0.5 * max(0.1 * k - 0.5, 0.0) ** 2
        pose = make_pose(np.eye(3), [x - 2.0, 0.3, 0.0])
        xyz = cast(np.tile(pose, (len(beams), 1, 1)), beams) + beams * rng.normal(0, 0.01, (len(beams), 1))
        found.append(odometry.register(deskewed(xyz, START_NS + k * STEP)).T_odom_lidar[0, 3] - x)
    return np.array(found)


def test_the_second_look_does_not_stick_to_the_rings_while_pulling_away() -> None:
    assert np.abs(lag_behind(OdometryConfig())).max() < 0.03
    assert lag_behind(OdometryConfig(refine=False, convergence=5e-4)).min() < -1.0  # point to point does


@pytest.fixture
def matched(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Stamps at which kiss-icp matched: one entry a call."""
    calls: list[int] = []
    match = KissOdometry._matched

    def counted(self: KissOdometry, dense: np.ndarray, guess: np.ndarray) -> np.ndarray:
        calls.append(self.last_stamp_ns or 0)
        return match(self, dense, guess)

    monkeypatch.setattr(KissOdometry, "_matched", counted)
    return calls


def test_a_predicted_motion_needs_no_matching_by_points(matched: list[int]) -> None:
    stamps = START_NS + np.arange(25) * STEP
    found, truth = run_room(stamps, predict=True)
    assert max(matched) < stamps[15]  # the size of the errors of the prediction is learned first
    offset = invert_pose(truth) @ np.array([f.T_odom_lidar for f in found])
    assert np.linalg.norm(offset[:, :3, 3], axis=1).max() < 0.05


def test_a_wrong_prediction_is_matched_by_points_and_recovered(matched: list[int]) -> None:
    stamps = START_NS + np.arange(30) * STEP
    truth = turning_pose(stamps, speed=2.0, rate=0.3)
    odometry, found = KissOdometry(SMALL), []
    for k, (stamp, pose) in enumerate(zip(stamps, truth, strict=True)):
        motion = invert_pose(truth[k - 1]) @ pose if k else None
        if k == 25:
            motion = motion @ make_pose(np.eye(3), [0.4, -0.3, 0.0])
            matched.clear()
        found.append(odometry.register(deskewed(room_scan(pose, 8000, k, 0.01), int(stamp), motion)))
    assert matched[0] == stamps[24]
    offset = invert_pose(relative(truth)) @ np.array([f.T_odom_lidar for f in found])
    assert np.linalg.norm(offset[25:, :3, 3], axis=1).max() < 0.05


def test_without_refinement_every_scan_is_matched_by_points(matched: list[int]) -> None:
    run_room(START_NS + np.arange(20) * STEP, predict=True, config=OdometryConfig(voxel=0.5, refine=False))
    assert len(matched) == 20


def as_scan(xyz: np.ndarray, stamp_ns: int) -> Scan:
    count = len(xyz)
    first = Returns(xyz, np.full(count, stamp_ns), np.zeros(count, np.float32), np.zeros(count, np.uint16))
    return Scan(stamp_ns, stamp_ns, first, deskewed=True)


@pytest.mark.parametrize(("refine", "limit"), [(False, 0.06), (True, 0.2)])
def test_77_real_scans_agree_with_the_reference_poses(shared_data: Path, refine: bool, limit: float) -> None:
    """The reference is kiss-icp's, of scans that still hold the motion inside them (real-recordings.md)."""
    config = OdometryConfig(refine=refine, convergence=1e-2 if refine else 5e-4)
    clouds, _ = kitti_clouds(shared_data / "kitti_scans")
    reference = kitti_reference(shared_data / "kitti_scans")
    frontend = OdometryFrontend(MappingConfig(deskewed=True, odometry=config), Extrinsics())
    outputs = []
    for k, xyz in enumerate(clouds):
        outputs += frontend.on_points(as_scan(xyz[np.linalg.norm(xyz, axis=1) > 1.0], START_NS + k * STEP))
    outputs += frontend.finish()
    difference = np.array([o.pose.T_odom_lidar for o in outputs])[:, :3, 3] - reference[:, :3, 3]
    largest = np.linalg.norm(difference, axis=1).max()
    assert len(outputs) == 77
    assert largest < limit, f"largest difference {largest:.3f} m over 28.9 m"


def test_the_front_end_drops_empty_scans_and_counts_them() -> None:
    frontend = OdometryFrontend(MappingConfig(deskewed=True), Extrinsics())
    assert frontend.on_points(as_scan(np.zeros((0, 3)), START_NS)) == []
    assert frontend.dropped_scans == 1


def test_the_front_end_tells_how_far_a_scan_lies_before_those_that_were_registered() -> None:
    frontend, xyz = (
        OdometryFrontend(MappingConfig(deskewed=True), Extrinsics()),
        room_scan(np.eye(4), 2000, 0),
    )
    for k, behind in ((0, 0), (50, 0), (10, 40), (11, 39), (51, 0)):
        outputs = frontend.on_points(as_scan(xyz, START_NS + k * STEP))
        assert (len(outputs), frontend.behind_ns) == (int(not behind), behind * STEP)
    assert frontend.dropped_scans == 2


def test_a_drive_that_begins_at_speed_is_straight_from_its_first_scan() -> None:
    """The sensor turns clockwise from the rear at 10 Hz, at 8 m/s; steps are alike from the first on."""
    frontend, outputs, stamps = OdometryFrontend(MappingConfig(), Extrinsics()), [], []
    rng = np.random.default_rng(4)
    for k in range(6):
        beams = rng.normal(size=(8000, 3)) * [1.0, 1.0, 0.5]
        beams /= np.linalg.norm(beams, axis=1, keepdims=True)
        share = 0.5 - np.arctan2(beams[:, 1], beams[:, 0]) / (2 * np.pi)
        times = START_NS + k * STEP + np.round(share * STEP).astype(np.int64)
        xyz = cast(turning_pose(times, speed=8.0, rate=0.3), beams)
        first = Returns(xyz, times, np.zeros(8000, np.float32), np.zeros(8000, np.uint16))
        outputs += frontend.on_points(Scan(int(times.min()), int(times.max()), first))
        stamps.append(int(times.max()))
    found = np.array([output.pose.T_odom_lidar for output in outputs])
    truth = relative(turning_pose(np.array(stamps), speed=8.0, rate=0.3))
    steps = np.linalg.norm(np.diff(found[:, :3, 3], axis=0), axis=1)
    assert [output.scan.mode for output in outputs] == ["constant_velocity"] * 6
    np.testing.assert_allclose(steps, 0.8, atol=0.04)
    assert np.linalg.norm(found[:, :3, 3] - truth[:, :3, 3], axis=1).max() < 0.05


def test_the_only_scan_of_a_recording_comes_when_the_stream_ends() -> None:
    frontend, xyz = OdometryFrontend(MappingConfig(), Extrinsics()), room_scan(np.eye(4), 2000, 0)
    scan = dataclasses.replace(as_scan(xyz, START_NS), deskewed=False)
    assert frontend.on_points(scan) == []
    (output,) = frontend.finish()
    assert output.scan.mode == "none"
    np.testing.assert_array_equal(output.pose.T_odom_lidar, np.eye(4))


def test_after_a_gap_the_motion_is_found_anew() -> None:
    frontend, outputs = OdometryFrontend(MappingConfig(), Extrinsics()), []
    for k in (0, 1, 60, 61, 120):
        xyz = room_scan(make_pose(np.eye(3), [0.02 * k, 0.0, 0.0]), 4000, k)
        outputs += frontend.on_points(dataclasses.replace(as_scan(xyz, START_NS + k * STEP), deskewed=False))
    outputs += frontend.finish()
    assert [output.pose.segment for output in outputs] == [0, 0, 1, 1, 2]


def test_the_result_does_not_depend_on_how_the_topics_interleave() -> None:
    from subiaco_mapping.measurements import ImuSample

    extrinsics = dataclasses.replace(Extrinsics(), T_base_imu=np.eye(4))
    samples = [
        ImuSample(START_NS + k * SECOND // 100, np.array([0, 0, 0.4]), np.array([0, 0, 9.8]))
        for k in range(80)
    ]
    scans = []
    for k in range(1, 6):
        rng = np.random.default_rng(k)
        times = np.sort(START_NS + k * STEP + rng.integers(0, STEP, 3000))
        beams = rng.normal(size=(3000, 3))
        xyz = cast(turning_pose(times), beams / np.linalg.norm(beams, axis=1, keepdims=True))
        first = Returns(xyz, times, np.zeros(3000, np.float32), np.zeros(3000, np.uint16))
        scans.append(Scan(int(times[0]), int(times[-1]), first))
    poses = []
    for imu_first in (True, False):
        frontend = OdometryFrontend(MappingConfig(), extrinsics)
        steps = [lambda f, s=s: f.on_imu(s) for s in samples], [lambda f, s=s: f.on_points(s) for s in scans]
        order = steps[0] + steps[1] if imu_first else steps[1] + steps[0]
        outputs = [output for step in order for output in step(frontend)] + frontend.finish()
        poses.append([output.pose.T_odom_lidar for output in outputs])
    np.testing.assert_array_equal(poses[0], poses[1])
