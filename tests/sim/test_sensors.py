"""Motion, IMU and GNSS agree with one another, and the LiDAR measures the objects of the scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ouster.sdk.core import FrameBatcher, LidarFrame, LidarPacket, PacketFormat
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from subiaco_geo.frames import make_pose
from subiaco_sim.ahead import ahead
from subiaco_sim.config import FaultConfig, GnssConfig, ImuConfig, LidarConfig, LidarMode
from subiaco_sim.gnss import FIXED, NONE, gauss_markov, simulate_gnss
from subiaco_sim.ground import Road, Terrain
from subiaco_sim.imu import GRAVITY, simulate_imu
from subiaco_sim.lidar import Lidar, column_times, points_of
from subiaco_sim.motion import Motion, drive
from subiaco_sim.packets import PacketMaker, TimedPacket, sensor_info, with_faults
from subiaco_sim.plants import Tree
from subiaco_sim.primitives import Material, box
from subiaco_sim.scene import CompiledScene, compile_meshes
from subiaco_sim.suburb import dense_route
from subiaco_sim.vehicle import GNSS, IMU

START_NS = 1_700_000_000_000_000_000
PERFECT_IMU = ImuConfig(gyro_noise=0, accel_noise=0, gyro_bias=0, accel_bias=0)


@pytest.fixture(scope="module")
def motion() -> Motion:
    x = np.linspace(-120, 120, 13)
    route = dense_route(np.column_stack([x, 15 * np.sin(x / 35)]))
    terrain = Terrain(Road(route), (-200, -100, 200, 100), (0.02, -0.01), 1.0)
    return drive(route, terrain, START_NS, 15.0, 7.0, reverse=False, seed=5)


def test_the_drive_starts_at_rest_and_then_keeps_to_suburban_speed(motion: Motion) -> None:
    t = np.linspace(0, 15, 1501)
    speed = np.linalg.norm(motion.position(t, 1), axis=1)
    assert speed[t < 0.8].max() < 0.01
    assert speed[t > 8].min() > 5.0
    assert speed.max() < 8.5


def test_an_imu_at_rest_measures_gravity_upwards_in_its_own_frame(motion: Motion) -> None:
    series = simulate_imu(motion, PERFECT_IMU, np.random.default_rng(1))
    rest = series.times_ns < START_NS + 500_000_000
    T_enu_imu = motion.poses(series.times_ns)[rest] @ IMU.T_base_sensor
    up = np.einsum("nij,nj->ni", T_enu_imu[:, :3, :3], series.accel[rest])
    np.testing.assert_allclose(up, np.tile([0, 0, GRAVITY], (rest.sum(), 1)), atol=0.02)
    np.testing.assert_allclose(series.gyro[rest], 0.0, atol=1e-3)


def test_integrating_the_gyro_gives_the_attitude(motion: Motion) -> None:
    series = simulate_imu(motion, replace_rate(PERFECT_IMU, 500.0), np.random.default_rng(1))
    truth = (motion.poses(series.times_ns) @ IMU.T_base_sensor)[:, :3, :3]
    middle = 0.5 * (series.gyro[1:] + series.gyro[:-1]) * np.diff(series.times_ns)[:, None] * 1e-9
    attitude = Rotation.from_matrix(truth[0])
    for step in Rotation.from_rotvec(middle):
        attitude = attitude * step
    error = (attitude.inv() * Rotation.from_matrix(truth[-1])).magnitude()
    assert error < np.radians(0.02)


def replace_rate(config: ImuConfig, rate: float) -> ImuConfig:
    return config.model_copy(update={"rate": rate})


def test_specific_force_is_the_second_derivative_of_the_imus_own_path(motion: Motion) -> None:
    series = simulate_imu(motion, replace_rate(PERFECT_IMU, 400.0), np.random.default_rng(1))
    T_enu_imu = motion.poses(series.times_ns) @ IMU.T_base_sensor
    seconds = motion.seconds(series.times_ns)
    expected = CubicSpline(seconds, T_enu_imu[:, :3, 3])(seconds, 2) + np.array([0, 0, GRAVITY])
    found = np.einsum("nij,nj->ni", T_enu_imu[:, :3, :3], series.accel)
    inner = slice(20, -20)
    np.testing.assert_allclose(found[inner], expected[inner], atol=0.02)


def test_imu_bias_and_noise_are_as_configured(motion: Motion) -> None:
    config = ImuConfig()
    noisy = simulate_imu(motion, config, np.random.default_rng(8))
    clean = simulate_imu(motion, PERFECT_IMU, np.random.default_rng(8))
    rest = noisy.gyro - clean.gyro - noisy.gyro_bias
    assert rest.std() == pytest.approx(config.gyro_noise * 10, rel=0.05)
    assert np.abs(noisy.gyro_bias).max() > 0


def test_an_imu_of_73_hz_keeps_its_rate_and_covers_the_whole_drive(motion: Motion) -> None:
    series = simulate_imu(motion, replace_rate(ImuConfig(), 73.0), np.random.default_rng(8))
    assert set(np.diff(series.times_ns).tolist()) == {round(1e9 / 73)}
    assert series.times_ns[0] < motion.start_ns
    assert series.times_ns[-1] > motion.start_ns + 15 * 10**9


def test_the_slow_part_of_a_fixs_error_is_correlated_as_long_as_asked() -> None:
    series = gauss_markov(200_000, 0.2, 20.0, np.random.default_rng(3))
    assert series.std(axis=0) == pytest.approx([1.0] * 3, abs=0.1)
    for lag_s, expected in ((10.0, np.exp(-0.5)), (20.0, np.exp(-1.0)), (100.0, np.exp(-5.0))):
        lag = round(lag_s / 0.2)
        found = np.mean(series[lag:] * series[:-lag]) / np.mean(series**2)
        assert found == pytest.approx(expected, abs=0.08)


def test_one_antenna_gives_no_heading(motion: Motion) -> None:
    config = GnssConfig(heading_sigma_deg=None)
    assert np.isnan(simulate_gnss(motion, config, np.random.default_rng(2)).yaw).all()
    two = simulate_gnss(motion, GnssConfig(), np.random.default_rng(2))
    np.testing.assert_array_equal(np.isfinite(two.yaw), two.status > 0)


def test_a_fix_is_the_pose_applied_to_the_lever_arm_with_the_stated_error(motion: Motion) -> None:
    config = GnssConfig(rate=20.0)
    series = simulate_gnss(motion, config, np.random.default_rng(2))
    poses = motion.poses(series.times_ns)
    antenna = poses[:, :3, :3] @ GNSS.T_base_sensor[:3, 3] + poses[:, :3, 3]
    fixed = series.status == FIXED
    error = (series.enu - antenna)[fixed]
    assert np.abs(error / series.sigma[fixed]).max() < 5
    assert np.linalg.norm(error, axis=1).max() < 0.12
    assert set(series.status.tolist()) == {2, 1, 0, -1}
    assert np.isnan(series.enu[series.status == NONE]).all()
    assert np.isfinite(series.enu[series.status != NONE]).all()


def ground_plane() -> CompiledScene:
    return compile_meshes([(0, box(300, 300, 1.0, Material.CONCRETE).placed(0, 0, -1.0))])


def test_a_scan_from_a_moving_tilted_sensor_falls_on_the_plane_below(motion: Motion) -> None:
    info = sensor_info(LidarMode.COLUMNS_512, dual=False)
    lidar = Lidar(info, LidarConfig(range_sigma=0.0, range_sigma_slope=0.0), False)
    times_ns = column_times(START_NS + 10 * 10**9, 0, 512)
    T_enu_lidar = motion.poses(times_ns)
    T_enu_lidar[:, 2, 3] += 2.0 - T_enu_lidar[:, 2, 3].mean()
    scan = lidar.scan(ground_plane(), 0, times_ns, T_enu_lidar, np.random.default_rng(3))
    found = scan.first.range_mm > 0
    points = points_of(lidar.beams, scan, scan.first.range_mm * 1e-3)[found]
    assert found.sum() > 5000
    np.testing.assert_allclose(points[:, 2], 0.0, atol=0.001)  # ranges are whole millimetres


def test_a_second_return_lies_behind_the_first_and_only_where_foliage_let_the_beam_through() -> None:
    tree = Tree(9.0, 3.0, 6.0, 0.2, form=1, leaves=2).mesh().placed(8.0, 0.0, 0.0)
    scene = compile_meshes([(0, box(300, 300, 1.0, Material.CONCRETE).placed(0, 0, -1.0)), (1, tree)])
    lidar = Lidar(sensor_info(LidarMode.COLUMNS_512, dual=True), LidarConfig(), True)
    pose = np.tile(make_pose(np.eye(3), [0.0, 0.0, 2.0]), (512, 1, 1))
    scan = lidar.scan(scene, 0, column_times(START_NS, 0, 512), pose, np.random.default_rng(4))
    assert scan.second is not None
    both = (scan.first.range_mm > 0) & (scan.second.range_mm > 0)
    assert both.sum() > 60
    assert (scan.first.object_id[both] == 1).all()
    assert (scan.second.range_mm[both] > scan.first.range_mm[both] + 150).all()
    assert (scan.second.range_mm[~both] == 0).all()


@pytest.mark.parametrize("dual", [False, True])
@pytest.mark.parametrize("beams", [64, 128])
@pytest.mark.parametrize("mode", list(LidarMode))
def test_every_sensor_there_is_comes_back_through_the_sensor_makers_decoder(
    mode: LidarMode, beams: int, dual: bool
) -> None:
    info = sensor_info(mode, dual, beams)
    lidar = Lidar(info, LidarConfig(divergence=1e-3), dual)
    tree = Tree(9.0, 3.0, 6.0, 0.2, form=1, leaves=2).mesh().placed(8.0, 0.0, 0.0)
    scene = compile_meshes([(0, box(300, 300, 1.0, Material.CONCRETE).placed(0, 0, -1.0)), (1, tree)])
    pose = np.tile(make_pose(np.eye(3), [0.0, 0.0, 2.0]), (mode.columns, 1, 1))
    times_ns = column_times(START_NS, 0, mode.columns)
    scan = lidar.scan(scene, 0, times_ns, pose, np.random.default_rng(4))
    layout, batcher, frame = PacketFormat(info), FrameBatcher(info), LidarFrame(info)
    for packet in PacketMaker(info).packets(scan):
        raw = LidarPacket(layout)
        raw.buf[:] = np.frombuffer(packet.buf, np.uint8)
        batcher.batch(raw, frame)
    assert frame.complete()
    assert scan.first.range_mm.shape == (beams, mode.columns)
    np.testing.assert_array_equal(frame.timestamp.astype(np.int64), times_ns)
    np.testing.assert_array_equal(frame.field("RANGE"), scan.first.range_mm)
    assert ("RANGE2" in frame.fields) == dual
    if scan.second is not None:
        assert (scan.second.range_mm > 0).sum() > 20
        np.testing.assert_array_equal(frame.field("RANGE2"), scan.second.range_mm)


def test_work_made_ahead_comes_in_order_and_its_failure_too() -> None:
    def make(k: int) -> int:
        if k == 30:
            raise ValueError("thirty")
        return k * k

    assert list(ahead(make, range(30))) == [k * k for k in range(30)]
    stream = ahead(make, range(40))
    assert [next(stream) for _ in range(30)] == [k * k for k in range(30)]
    with pytest.raises(ValueError, match="thirty"):
        next(stream)


def test_what_is_made_ahead_stays_within_one_a_worker() -> None:
    begun: list[int] = []
    stream = ahead(lambda k: begun.append(k) or k, range(100), workers=2)
    for used in range(1, 20):
        next(stream)
        assert len(begun) <= used + 2
    stream.close()
    assert len(begun) < 25


def numbered(count: int) -> list[TimedPacket]:
    return [TimedPacket(k, bytes([k % 256, k // 256])) for k in range(count)]


def test_each_fault_does_what_its_name_says_and_nothing_else() -> None:
    packets, rng = numbered(4000), np.random.default_rng
    same = list(with_faults(iter(packets), FaultConfig(), rng(1)))
    lost = list(with_faults(iter(packets), FaultConfig(packet_loss=0.1), rng(1)))
    doubled = list(with_faults(iter(packets), FaultConfig(duplicates=0.1), rng(1)))
    swapped = list(with_faults(iter(packets), FaultConfig(reordered=0.1), rng(1)))
    assert same == packets
    assert 0.08 < 1 - len(lost) / 4000 < 0.12
    assert 0.08 < len(doubled) / 4000 - 1 < 0.12
    assert sorted(swapped, key=lambda p: p.last_column_ns) == packets
    moved = np.abs(np.array([p.last_column_ns for p in swapped]) - np.arange(4000))
    assert moved.max() == 1
    assert moved.sum() > 400


def test_without_noise_the_antenna_is_exactly_on_its_lever_arm(motion: Motion) -> None:
    config = GnssConfig(sigma_fixed=1e-9, float_share=0, single_share=0, none_share=0)
    series = simulate_gnss(motion, config, np.random.default_rng(2))
    back = np.linalg.inv(motion.poses(series.times_ns))
    in_base = np.einsum("nij,nj->ni", back[:, :3, :3], series.enu) + back[:, :3, 3]
    np.testing.assert_allclose(in_base, np.tile([GNSS.x, GNSS.y, GNSS.z], (len(in_base), 1)), atol=1e-6)
    assert replace(series).status.min() == FIXED
