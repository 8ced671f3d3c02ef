"""Fixes place a drive: lever arm, yaw, outliers, NaN, covariances."""

from pathlib import Path

import numpy as np
import pytest
from mapping_scenes import SECOND, START_NS, relative, turning_pose
from scipy.spatial.transform import Rotation

from subiaco_geo.crs import EnuFrame
from subiaco_geo.errors import InputError
from subiaco_geo.frames import exp_se3, make_pose
from subiaco_mapping import gnss
from subiaco_mapping.backend import MappingBackend
from subiaco_mapping.config import GnssConfig, GraphConfig, MappingConfig
from subiaco_mapping.graph import gravity_priors
from subiaco_mapping.manifest import describe_fixes
from subiaco_mapping.map_builder import describe
from subiaco_mapping.measurements import DeskewedScan, Extrinsics, GnssFix, OdometryPose

FRAME = EnuFrame(-31.948, 115.825, 12.0)
LEVER = np.array([-0.4, 0.3, 0.9])
T_BASE_LIDAR = make_pose(Rotation.from_euler("xyz", [2, 5, 30], degrees=True).as_matrix(), [0.3, 0.0, 1.9])
EXTRINSICS = Extrinsics(T_BASE_LIDAR, None, T_BASE_LIDAR[:3, :3] @ LEVER + T_BASE_LIDAR[:3, 3])
STEP = SECOND // 10
# errors here are white, of fixes and of odometry steps
CONFIG = MappingConfig(gnss=GnssConfig(correlated_share=0.0), graph=GraphConfig(drift_share=1.0))


def truth_poses(count: int) -> np.ndarray:
    """The true T_enu_lidar: base level on a circle of 15 m radius, heading 70 deg at the start."""
    stamps = START_NS + np.arange(count) * STEP
    level = make_pose(Rotation.from_euler("z", 70, degrees=True).as_matrix(), [5.0, -3.0, 1.0])
    return level @ turning_pose(stamps, speed=6.0, rate=0.4) @ T_BASE_LIDAR


def fix_at(enu: np.ndarray, time_ns: int, status: int = 2, sigma: float = 0.01) -> GnssFix:
    latitude, longitude, height = FRAME.to_geodetic(enu[None])[0]
    return GnssFix(time_ns, latitude, longitude, height, np.eye(3) * sigma**2, status)


def drive(
    tmp_path: Path, count: int = 100, drift: float = 0.0, config: MappingConfig = CONFIG, seed: int = 3
):
    """A back end fed with a drive of `count` scans; returns it with the true poses."""
    rng = np.random.default_rng(seed)
    truth = truth_poses(count)
    odometry = relative(truth)
    for k in range(1, count):
        error = exp_se3(np.concatenate([rng.normal(0, drift * 0.1, 3), rng.normal(0, drift, 3)]))
        odometry[k] = odometry[k - 1] @ np.linalg.inv(truth[k - 1]) @ truth[k] @ error
    backend = MappingBackend(config, EXTRINSICS, tmp_path)
    backend.start_sequence("drive")
    covariance = np.diag(np.repeat([4e-4**2, 0.008**2], 3))
    xyz = rng.uniform(-10, 10, (50, 3))
    for k, pose in enumerate(odometry):
        stamp = START_NS + k * STEP
        backend.on_odometry(
            OdometryPose(stamp, pose, covariance, 100, 0.02, False, 0),
            DeskewedScan(stamp, xyz, np.zeros(50, np.float32), "gyro"),
        )
    return backend, truth


def add_fixes(
    backend: MappingBackend, truth: np.ndarray, seed: int = 4, sigma: float = 0.01, jump=None
) -> None:
    rng = np.random.default_rng(seed)
    stamps = START_NS + np.arange(len(truth)) * STEP
    from subiaco_geo.frames import interpolate_poses

    times = np.arange(stamps[0] + STEP // 3, stamps[-1], SECOND // 5)
    at = interpolate_poses(stamps, truth, times)
    antenna = at[:, :3, :3] @ LEVER + at[:, :3, 3] + rng.normal(0, sigma, (len(times), 3))
    for k, (time, enu) in enumerate(zip(times, antenna, strict=True)):
        shift = jump if jump is not None and k % 10 == 5 else 0.0
        backend.on_fix(fix_at(enu + shift, int(time)))


def errors(backend: MappingBackend, truth: np.ndarray) -> np.ndarray:
    solution = backend.optimize()
    assert solution.frame is not None
    geodetic = FRAME.to_geodetic(truth[:, :3, 3])
    expected = solution.frame.from_geodetic(*geodetic.T)
    return np.linalg.norm(solution.sequences[0].T_local_lidar[:, :3, 3] - expected, axis=1)


def test_yaw_and_lever_arm_are_recovered_within_centimetres(tmp_path: Path) -> None:
    backend, truth = drive(tmp_path)
    add_fixes(backend, truth)
    assert np.sqrt((errors(backend, truth) ** 2).mean()) < 0.02
    rotation = np.swapaxes(truth[:, :3, :3], 1, 2) @ backend.optimize().sequences[0].T_local_lidar[:, :3, :3]
    assert np.degrees(Rotation.from_matrix(rotation).magnitude()).max() < 0.5


def test_fixes_take_the_drift_out_of_the_odometry(tmp_path: Path) -> None:
    backend, truth = drive(tmp_path, count=200, drift=0.01)
    add_fixes(backend, truth)
    raw = np.linalg.norm(backend._sequences[0].T_odom_lidar[:, :3, 3] - relative(truth)[:, :3, 3], axis=1)
    assert raw.max() > 0.15
    assert np.sqrt((errors(backend, truth) ** 2).mean()) < 0.03


def test_multipathed_fixes_that_claim_fixed_do_not_bend_the_map(tmp_path: Path) -> None:
    backend, truth = drive(tmp_path, count=200, drift=0.002)
    add_fixes(backend, truth, jump=np.array([3.0, -2.0, 1.0]))
    assert np.sqrt((errors(backend, truth) ** 2).mean()) < 0.03
    assert backend.optimize().sequences[0].fixes_downweighted >= 8


def test_nan_and_missing_fixes_are_refused_and_counted(tmp_path: Path) -> None:
    backend, truth = drive(tmp_path)
    add_fixes(backend, truth)
    good = fix_at(np.zeros(3), START_NS)
    for bad in (
        GnssFix(START_NS, float("nan"), 115.8, 12.0, np.eye(3), 2),
        GnssFix(START_NS, -31.9, 115.8, 12.0, np.full((3, 3), np.nan), 2),
        GnssFix(good.time_ns, good.latitude, good.longitude, good.altitude, good.covariance, -1),
    ):
        backend.on_fix(bad)
    assert errors(backend, truth).max() < 0.05
    assert backend.optimize().sequences[0].fixes_refused == 3


def test_pose_covariances_are_of_the_size_of_the_errors(tmp_path: Path) -> None:
    ratios = []
    for seed in range(4):
        backend, truth = drive(tmp_path / str(seed), drift=0.005, seed=seed)
        add_fixes(backend, truth, seed=seed + 50, sigma=0.018)
        sigma = np.sqrt(np.trace(backend.optimize().sequences[0].covariance[:, 3:, 3:], axis1=1, axis2=2))
        ratios.append(np.sqrt((errors(backend, truth) ** 2 / sigma**2).mean()))
    assert 0.3 < np.mean(ratios) < 2.0


@pytest.mark.parametrize("count", [6, 12])
def test_too_few_or_too_close_fixes_leave_the_map_local_and_say_why(tmp_path: Path, count: int) -> None:
    backend, truth = drive(tmp_path, count=count)
    add_fixes(backend, truth)
    solution = backend.optimize()
    assert solution.frame is None
    assert "GNSS fixes" in str(solution.reason)


def test_gnss_that_is_required_and_absent_is_an_input_error(tmp_path: Path) -> None:
    backend, _ = drive(tmp_path, config=MappingConfig(gnss=GnssConfig(required=True)))
    with pytest.raises(InputError, match="cannot be georeferenced"):
        backend.optimize()


def test_an_unknown_crs_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="EPSG:99999"):
        MappingBackend(MappingConfig(crs="EPSG:99999"), EXTRINSICS, tmp_path)


def test_an_attached_fix_sees_the_antenna_from_the_nearest_scan() -> None:
    stamps = START_NS + np.arange(20) * STEP
    poses = truth_poses(20)
    times = np.array([stamps[3] + STEP // 4, stamps[7] + 3 * STEP // 4, stamps[0] - 1])
    found = gnss.attach(times, stamps, poses, LEVER, SECOND)
    np.testing.assert_array_equal(found.index, [3, 8])
    np.testing.assert_array_equal(found.kept, [True, True, False])
    exact = turning_pose(times[:2], speed=6.0, rate=0.4)
    level = make_pose(Rotation.from_euler("z", 70, degrees=True).as_matrix(), [5.0, -3.0, 1.0])
    for k in range(2):
        antenna = (level @ exact[k] @ T_BASE_LIDAR @ np.append(LEVER, 1.0))[:3]
        seen = poses[found.index[k]] @ np.append(found.levers[k], 1.0)
        np.testing.assert_allclose(seen[:3], antenna, atol=0.01)


def test_a_fix_inside_a_gap_of_scans_is_not_attached() -> None:
    stamps = START_NS + np.array([0, 1, 30, 31]) * STEP
    found = gnss.attach(
        np.array([stamps[1] + SECOND]), stamps, np.tile(np.eye(4), (4, 1, 1)), LEVER, SECOND // 2
    )
    assert not found.kept.any()


def test_gravity_is_found_under_acceleration() -> None:
    stamps = START_NS + np.arange(60) * STEP
    seconds = np.arange(60) * 0.1
    tilt = Rotation.from_euler("xyz", [4, -3, 20], degrees=True).as_matrix()
    poses = make_pose(np.tile(tilt, (60, 1, 1)), np.outer(0.5 * 1.5 * seconds**2, [1.0, 0.0, 0.0]))
    accel = np.tile(tilt.T @ np.array([1.5, 0.0, 9.8]), (60, 1))
    found = gravity_priors(stamps, poses, accel, SECOND)
    assert len(found.index) >= 4
    up = found.up @ tilt.T
    assert np.degrees(np.arccos(up[:, 2])).max() < 0.1


@pytest.mark.parametrize("span_s", [5, 60, 600])
def test_the_inflation_is_what_slow_errors_do_to_a_mean(span_s: int) -> None:
    config = GnssConfig(correlation_time=20.0, correlated_share=0.6)
    count, rng = 2 * span_s, np.random.default_rng(5)
    keep = np.exp(-0.5 / 20.0)
    slow = rng.standard_normal(4000)
    mean = np.zeros(4000)
    for _ in range(count):
        mean += (np.sqrt(0.6) * slow + np.sqrt(0.4) * rng.standard_normal(4000)) / count
        slow = keep * slow + np.sqrt(1 - keep**2) * rng.standard_normal(4000)
    times = START_NS + np.arange(count) * SECOND // 2
    assert mean.var() * count == pytest.approx(gnss.correlation_inflation(times, config), rel=0.1)


def test_white_errors_are_not_inflated() -> None:
    times = START_NS + np.arange(50) * SECOND // 5
    assert gnss.correlation_inflation(times, GnssConfig(correlation_time=0.0)) == 1.0
    assert gnss.correlation_inflation(times, GnssConfig(correlated_share=0.0)) == 1.0
    assert gnss.correlation_inflation(times[:1], GnssConfig()) == 1.0


def test_the_manifest_tells_the_residuals_of_every_rtk_state(tmp_path: Path) -> None:
    status = np.array([2, 2, 1, 0])
    residuals = np.array([[0.03, 0.04, 0.0], [0.03, 0.04, 0.0], [0.0, 0.3, 0.4], [1.0, 0.0, 2.0]])
    found = describe_fixes(status, [2, 2, 2, 1, 0], residuals, np.array([1.0, 0.1, 1.0, 1.0]))
    assert found["fixed"] == {
        "received": 3,
        "used": 2,
        "downweighted": 1,
        "rmse_horizontal_m": 0.05,
        "rmse_vertical_m": 0.0,
    }
    assert (found["float"]["rmse_horizontal_m"], found["float"]["rmse_vertical_m"]) == (0.3, 0.4)
    assert found["single"]["used"] == 1


def test_every_key_of_the_manifest_is_explained(tmp_path: Path) -> None:
    backend, truth = drive(tmp_path)
    add_fixes(backend, truth)
    manifest = describe(backend._sequences, backend.optimize(), CONFIG.manifest)
    names = {"sequences", "drive", "gyro", "packets", "fixed", "legend"}

    def keys(part: object) -> set[str]:
        if isinstance(part, list):
            return set().union(*(keys(item) for item in part))
        if not isinstance(part, dict):
            return set()
        return set(part).union(*(keys(item) for item in part.values()))

    legend = manifest.pop("legend")
    assert keys(manifest) - names <= set(legend)
    assert {"packet_loss", "without_rtk_fixed", "variance_inflation"} <= set(legend)
