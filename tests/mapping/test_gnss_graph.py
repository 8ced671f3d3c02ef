"""Fixes place a drive: lever arm, yaw, outliers, NaN, covariances."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mapping_scenes import SECOND, START_NS, relative, turning_pose
from pyproj import Proj
from scipy.spatial.transform import Rotation

from subiaco_geo.crs import EnuFrame
from subiaco_geo.errors import InputError
from subiaco_geo.frames import exp_se3, make_pose
from subiaco_mapping.backend import MappingBackend
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.fusion.map_builder import describe
from subiaco_mapping.manifest import describe_fixes
from subiaco_mapping.measurements import DeskewedScan, Extrinsics, GnssFix, HeadingSample, OdometryPose
from subiaco_mapping.pose_graph import gnss
from subiaco_mapping.pose_graph.config import GnssConfig, GraphConfig
from subiaco_mapping.pose_graph.correlated_gnss_errors import link_precision, own_precision, slow_errors
from subiaco_mapping.pose_graph.gravity import gravity_priors
from subiaco_mapping.pose_graph.records import Chain, ChainSolution, GnssPriors, GravityPriors, HeadingPriors
from subiaco_mapping.pose_graph.solver import solve

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
    backend: MappingBackend,
    truth: np.ndarray,
    seed: int = 4,
    sigma: float = 0.01,
    jump=None,
    status: int = 2,
) -> None:
    rng = np.random.default_rng(seed)
    stamps = START_NS + np.arange(len(truth)) * STEP
    from subiaco_geo.frames import interpolate_poses

    times = np.arange(stamps[0] + STEP // 3, stamps[-1], SECOND // 5)
    at = interpolate_poses(stamps, truth, times)
    antenna = at[:, :3, :3] @ LEVER + at[:, :3, 3] + rng.normal(0, sigma, (len(times), 3))
    for k, (time, enu) in enumerate(zip(times, antenna, strict=True)):
        shift = jump if jump is not None and k % 10 == 5 else 0.0
        backend.on_fix(fix_at(enu + shift, int(time), status, sigma))


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


def priors_at(times_ns: np.ndarray, sigma: float = 0.02, status: np.ndarray | None = None) -> GnssPriors:
    """Fixes at the origin on the scans 0, 1, 2, ..."""
    count = len(times_ns)
    state = np.full(count, 2) if status is None else status
    flat = np.zeros((count, 3))
    covariance = np.tile(np.eye(3) * sigma**2, (count, 1, 1))
    return GnssPriors(np.arange(count), times_ns, flat, flat, covariance, state)


@given(steps=st.lists(st.floats(0.05, 3.0), min_size=1, max_size=8))
def test_the_priors_of_the_knots_make_up_the_gauss_markov_process(steps: list[float]) -> None:
    times = np.concatenate([[0.0], np.cumsum(steps)])
    expected = np.linalg.inv(np.exp(-np.abs(times[:, None] - times)))
    found = np.zeros_like(expected)
    around = [0.0, *steps, 0.0]
    for k in range(len(times)):
        found[k, k] += own_precision(around[k], around[k + 1])
    for k, step in enumerate(steps):
        found[k : k + 2, k : k + 2] += link_precision(step) * np.array([[1, -1], [-1, 1]])
    np.testing.assert_allclose(found, expected, atol=1e-9 * expected.max())


def test_slow_errors_start_anew_with_every_state_and_after_a_gap() -> None:
    config = GnssConfig(correlation_time=20.0, correlated_share=0.6)
    times = START_NS + np.array([0, 1, 2, 4, 30, 31, 32, 40]) * SECOND
    slow = slow_errors(priors_at(times, status=np.array([2, 2, 2, 2, 2, 2, 1, 1])), config)
    assert slow is not None
    np.testing.assert_array_equal(slow.epoch, [0, 0, 0, 1, 2, 3])
    np.testing.assert_allclose(slow.step, [0, 0.1, 0.1, 0, 0, 0])
    np.testing.assert_allclose(slow.sigma, np.sqrt(0.6) * 0.02)
    np.testing.assert_array_equal(slow.knot, [0, 0, 1, 2, 3, 3, 4, 5])


@pytest.mark.parametrize("config", [GnssConfig(correlation_time=0.0), GnssConfig(correlated_share=0.0)])
def test_white_errors_need_no_states(config: GnssConfig) -> None:
    assert slow_errors(priors_at(START_NS + np.arange(50) * SECOND), config) is None


def test_a_hundred_fixes_that_share_one_error_do_not_claim_a_millimetre() -> None:
    """Standing for 20 s: the marginal sigma is that of the mean of correlated fixes."""
    times = START_NS + np.arange(100) * SECOND // 5
    config = GnssConfig(correlation_time=20.0, correlated_share=0.6)
    covariance = np.tile(np.diag([1e-10] * 6), (100, 1, 1))
    chain = Chain(
        stamps_ns=times,
        T_odom_lidar=np.tile(np.eye(4), (100, 1, 1)),
        covariance=covariance,
        held=np.ones(100, bool),
        segment=np.zeros(100, np.int64),
        T_world_odom=np.eye(4),
        gravity=GravityPriors(np.arange(100), np.tile([0.0, 0.0, 1.0], (100, 1))),
        gnss=priors_at(times),
        heading=HeadingPriors(
            np.arange(100), np.zeros(100), np.full(100, 0.01), np.tile(np.eye(3), (100, 1, 1))
        ),
    )
    found = solve({0: chain}, GraphConfig(drift_share=1.0), config).chains[0]
    lag = np.abs(times[:, None] - times) * 1e-9 / 20.0
    slow, white = 0.6 * 0.02**2 * np.exp(-lag), 0.4 * 0.02**2 * np.eye(100)
    expected = 1.0 / np.linalg.inv(slow + white).sum()
    assert found.covariance[50, 3, 3] == pytest.approx(expected, rel=0.1)
    assert np.sqrt(expected) > 0.009


@pytest.mark.parametrize("offset_deg", [0.0, 90.0])
def test_headings_turn_a_drive_that_fixes_leave_open(tmp_path: Path, offset_deg: float) -> None:
    """Fixes of 2 m leave the yaw open by degrees; the antenna baseline knows it."""
    white = {"correlated_share": 0.0, "heading_offset_deg": offset_deg}
    backend, truth = drive(tmp_path, config=MappingConfig(gnss=GnssConfig(**white), graph=CONFIG.graph))
    add_fixes(backend, truth, sigma=2.0, status=0)
    turned = truth[:, :3, :3] @ T_BASE_LIDAR[:3, :3].T
    yaw = np.arctan2(turned[:, 1, 0], turned[:, 0, 0]) + np.radians(offset_deg)
    loose = backend.optimize().sequences[0].covariance[50, 2, 2]
    for k in range(0, 100, 5):
        backend.on_heading(HeadingSample(START_NS + k * STEP, float(yaw[k]), np.radians(0.1)))
    backend.on_heading(HeadingSample(START_NS, float("nan"), 0.01))
    solved = backend.optimize().sequences[0]
    found = solved.T_local_lidar[:, :3, :3] @ T_BASE_LIDAR[:3, :3].T
    off = np.arctan2(found[:, 1, 0], found[:, 0, 0]) - yaw + np.radians(offset_deg)
    assert np.degrees(np.abs((off + np.pi) % (2 * np.pi) - np.pi)).max() < 0.2
    assert solved.covariance[50, 2, 2] < 0.2 * loose
    assert solved.headings_used == 20
    gnss = describe(backend._sequences, backend.optimize(), CONFIG.manifest)["sequences"]["drive"]["gnss"]
    assert (gnss["headings_used"], gnss["headings_refused"]) == (20, 1)


def test_the_manifest_tells_the_residuals_of_every_rtk_state(tmp_path: Path) -> None:
    status = np.array([2, 2, 1, 0])
    residuals = np.array([[0.03, 0.04, 0.0], [0.03, 0.04, 0.0], [0.0, 0.3, 0.4], [1.0, 0.0, 2.0]])
    weights, slow = np.array([1.0, 0.1, 1.0, 1.0]), np.tile([0.0, 0.03, 0.04], (4, 1))
    none = np.zeros((0, 4, 4))
    solution = ChainSolution(none, np.zeros((0, 6, 6)), residuals, slow, weights)
    found = describe_fixes(status, [2, 2, 2, 1, 0], solution)
    assert found["fixed"] == {
        "received": 3,
        "used": 2,
        "downweighted": 1,
        "rmse_horizontal_m": 0.05,
        "rmse_vertical_m": 0.0,
        "slow_rms_m": 0.05,
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
    assert {"packet_loss", "without_rtk_fixed", "slow_rms_m"} <= set(legend)


def test_the_live_graph_grows_to_what_the_batch_finds(tmp_path: Path) -> None:
    backend, truth = drive(tmp_path / "whole", count=200, drift=0.01)
    add_fixes(backend, truth)
    whole = backend.optimize().sequences[0].T_local_lidar
    record = backend._sequences[0]
    record.submaps = None
    poses, fixes = list(record.poses), list(record.fixes)
    record.poses.clear()
    record.fixes.clear()
    accel = list(record.accel)
    record.accel.clear()
    for k, pose in enumerate(poses):
        record.poses.append(pose)
        record.accel.append(accel[k])
        record.fixes.extend(f for f in fixes if k and poses[k - 1].stamp_ns < f.time_ns <= pose.stamp_ns)
        if k >= 60 and k % 20 == 19:
            preview = backend.preview()
            assert len(preview.sequences[0].T_local_lidar) == k + 1
    live = preview.sequences[0]
    assert preview.frame is not None
    assert live.fixes_used == len(fixes)
    assert np.linalg.norm((live.T_local_lidar - whole)[:, :3, 3], axis=1).max() < 0.03
    carried = live.T_local_odom @ poses[-1].T_odom_lidar
    np.testing.assert_allclose(carried, live.T_local_lidar[-1], atol=1e-9)


def test_a_preview_that_cannot_be_georeferenced_yet_is_local_and_starts_anew_when_it_can(
    tmp_path: Path,
) -> None:
    backend, truth = drive(tmp_path, count=100)
    assert backend.preview().frame is None
    add_fixes(backend, truth)
    preview = backend.preview()
    assert preview.frame is not None
    expected = preview.frame.from_geodetic(*FRAME.to_geodetic(truth[:, :3, 3]).T)
    assert np.linalg.norm(preview.sequences[0].T_local_lidar[:, :3, 3] - expected, axis=1).max() < 0.05


def test_fixes_in_ahd_are_refused_without_a_grid() -> None:
    fixes = [fix_at(np.zeros(3), START_NS)]
    with pytest.raises(InputError, match=r"gnss\.heights: .* need gnss\.geoid_grid"):
        gnss.to_enu(fixes, FRAME, GnssConfig(heights="AHD"))


def test_fixes_where_the_crs_is_not_made_for_are_refused_before_a_map_is_made(tmp_path: Path) -> None:
    backend, truth = drive(tmp_path, config=CONFIG.model_copy(update={"crs": "EPSG:7856"}))
    add_fixes(backend, truth)
    with pytest.raises(InputError, match=r"EPSG:7856 \(GDA2020 / MGA zone 56\).*--set crs=EPSG:7850"):
        backend.optimize()


@pytest.mark.parametrize(
    ("place", "crs", "code", "source"),
    [
        ((-31.948, 115.825), "auto", 7850, "auto"),
        ((49.04, 8.44), "auto", 25832, "auto"),
        ((48.86, 2.35), "EPSG:2154", 2154, "given"),
    ],
    ids=["Perth", "Karlsruhe", "Paris with the national grid"],
)
def test_a_map_is_made_in_the_crs_of_its_place_or_in_the_given_one(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    place: tuple[float, float],
    crs: str,
    code: int,
    source: str,
) -> None:
    monkeypatch.setitem(globals(), "FRAME", EnuFrame(*place, 50.0))
    backend, truth = drive(tmp_path, config=CONFIG.model_copy(update={"crs": crs}))
    add_fixes(backend, truth)
    survey = backend.build_map()
    assert survey.cloud.crs == f"EPSG:{code}"
    assert survey.info["crs_source"] == source
    projection = Proj(code)
    assert survey.trajectory is not None
    first = survey.trajectory.poses[0, :2, 3]
    latitude, longitude, _ = FRAME.to_geodetic(truth[:1, :3, 3])[0]
    assert np.abs(first - projection(longitude, latitude)).max() < 0.05


def test_twenty_fixes_elsewhere_end_the_reading_and_one_astray_does_not() -> None:
    check = gnss.PlaceCheck("EPSG:7850")
    check.take(GnssFix(0, 0.0, 0.0, 0.0, np.eye(3), 2))
    for k in range(40):
        check.take(fix_at(np.zeros(3), k))
    check = gnss.PlaceCheck("EPSG:25832")
    for k in range(19):
        check.take(fix_at(np.zeros(3), k))
    with pytest.raises(InputError, match="area of use"):
        check.take(fix_at(np.zeros(3), 19))


def test_the_local_frame_is_not_laid_at_a_fix_far_off_all_others() -> None:
    astray = GnssFix(0, 0.0, 0.0, 0.0, np.eye(3), 2)
    frame = gnss.local_frame([astray, *(fix_at(np.zeros(3), k) for k in range(5))], GnssConfig())
    assert frame is not None
    assert frame.latitude_deg == pytest.approx(FRAME.latitude_deg, abs=1e-9)


def test_a_map_that_most_of_its_fixes_contradict_is_flagged_and_a_sound_one_is_not(tmp_path: Path) -> None:
    found = {}
    for name, error in (("sound", 0.0), ("contradicted", 4.0)):
        backend, truth = drive(tmp_path / name)
        rng, stamps = np.random.default_rng(8), START_NS + np.arange(len(truth)) * STEP
        for pose, stamp in zip(truth, stamps.tolist(), strict=True):
            antenna = pose[:3, :3] @ LEVER + pose[:3, 3]
            backend.on_fix(fix_at(antenna + rng.normal(0, error, 3), stamp))
        found[name] = describe(backend._sequences, backend.optimize(), CONFIG.manifest)
    assert found["sound"]["gnss_contradicts"] is False
    assert found["sound"]["sequences"]["drive"]["gnss"]["contradicting"] == 0
    assert found["contradicted"]["gnss_contradicts"] is True
    (stretch,) = found["contradicted"]["sequences"]["drive"]["flagged"]["gnss_contradicts"]
    assert stretch["scans"] == 100


def test_a_fix_five_kilometres_above_the_others_does_not_move_the_map(tmp_path: Path) -> None:
    backend, truth = drive(tmp_path)
    add_fixes(backend, truth)
    latitude, longitude, _ = FRAME.to_geodetic(np.zeros((1, 3)))[0]
    backend.on_fix(GnssFix(START_NS + STEP // 2, latitude, longitude, 5e3, np.eye(3) * 1e-4, 2))
    assert backend.optimize().sequences[0].fixes_unattached == 1
    assert errors(backend, truth).max() < 0.1
