"""Every fault is a switch: it does what its name says, and nothing when off."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from subiaco_geo.errors import InputError
from subiaco_geo.frames import make_pose, transform_points
from subiaco_sim.clock import LidarClock
from subiaco_sim.config import (
    FaultConfig,
    GnssConfig,
    ImuConfig,
    LidarConfig,
    LidarMode,
    MapErrorConfig,
    SimulationConfig,
)
from subiaco_sim.drives import MAP_CRS, WORLD
from subiaco_sim.gnss import FIXED, NONE, hidden_sky, simulate_gnss, state_under
from subiaco_sim.ground import Road, Terrain
from subiaco_sim.imu import GRAVITY, STANDARD_GRAVITY, ouster_packets, simulate_imu
from subiaco_sim.lidar import Lidar, column_times
from subiaco_sim.map_errors import MapWarp
from subiaco_sim.motion import Motion, drive
from subiaco_sim.packets import inner_imu, sensor_info
from subiaco_sim.presets import with_preset
from subiaco_sim.primitives import Material, box
from subiaco_sim.recorded import RecordedDrive, read_recorded_drive
from subiaco_sim.scene import compile_meshes
from subiaco_sim.suburb import dense_route

START_NS = 1_700_000_000_000_000_000
TIMES = START_NS + np.arange(64, dtype=np.int64) * 100_000_000


@pytest.fixture(scope="module")
def motion() -> Motion:
    """Return a straight drive of 15 s (seed 5) on flat land."""
    route = dense_route(np.column_stack([np.linspace(-120, 120, 13), np.zeros(13)]))
    terrain = Terrain(Road(route), (-200, -100, 200, 100), (0.0, 0.0), 1.0)
    return drive(route, terrain, START_NS, 15.0, 7.0, reverse=False, seed=5)


def stamps(**faults: float) -> np.ndarray:
    clock = LidarClock(FaultConfig(**faults), START_NS, 6.4)
    return clock.stamps(TIMES, 16, np.random.default_rng(1)) - TIMES


def test_a_sound_clock_gives_true_time() -> None:
    assert not stamps().any()


def test_without_pps_the_clock_runs_away_at_its_own_rate() -> None:
    off = stamps(pps_lost=2.0, clock_drift=1e-4)
    assert not off[:21].any()
    np.testing.assert_allclose(off[21:], 1e4 * np.arange(1, 44), atol=1)  # 0.1 ms a second, each 0.1 s


def test_a_leap_moves_the_second_half() -> None:
    off = stamps(clock_leap=-1.0)
    assert not off[:33].any()
    assert (off[33:] == -1_000_000_000).all()


def test_zeroed_stamps_share_the_fate_of_their_packet() -> None:
    zero = (stamps(stamps_zeroed=0.5) == -TIMES).reshape(4, 16)
    assert zero.all(axis=1).sum() + (~zero).all(axis=1).sum() == 4
    assert 0 < zero.sum() < 64


def test_multipath_shifts_fixes_that_still_claim_rtk_fixed(motion: Motion) -> None:
    config = GnssConfig(float_share=0, single_share=0, none_share=0)
    plain = simulate_gnss(motion, config, np.random.default_rng(2))
    false = simulate_gnss(
        motion, config, np.random.default_rng(2), FaultConfig(multipath=1, multipath_size=2.0)
    )
    off = np.linalg.norm(false.enu - plain.enu, axis=1)
    assert off.max() > 2.0
    assert 10 < (off > 0).sum() <= 21  # 4 s at 5 Hz
    assert (false.status == FIXED).all()
    np.testing.assert_array_equal(false.sigma, plain.sigma)


def test_between_tall_walls_the_sky_is_hidden_and_no_fix_is_left(motion: Motion) -> None:
    walls = [box(400.0, 1.0, 60.0, Material.BRICK).placed(0, y, 0) for y in (-6.0, 9.0)]
    canyon = compile_meshes([(k, wall) for k, wall in enumerate(walls)])
    hidden = hidden_sky(canyon, np.array([[0.0, 1.5, 2.0], [0.0, 500.0, 2.0]]))
    assert hidden[0] > 0.6
    assert hidden[1] < 0.1
    config = GnssConfig(float_share=0, single_share=0, none_share=0)
    switched = [
        simulate_gnss(motion, config, np.random.default_rng(2), FaultConfig(canyons=on), canyon).status
        for on in (False, True)
    ]
    assert (switched[0] == FIXED).all()
    assert (switched[1] < FIXED).all()
    assert state_under(np.array([0.0, 0.4, 0.6, 0.9])).tolist() == [2, 1, 0, NONE]


def test_the_lidars_own_imu_feels_gravity_in_its_own_units(motion: Motion) -> None:
    perfect = ImuConfig(gyro_noise=0, accel_noise=0, gyro_bias=0, accel_bias=0)
    T_base_imu = inner_imu(sensor_info(LidarMode.COLUMNS_512, dual=False))
    series = simulate_imu(motion, perfect, np.random.default_rng(1), T_base_imu)
    buf = next(ouster_packets(series, series.times_ns - 7))
    values = struct.unpack("<3Q6f", buf)
    assert len(buf) == 48
    assert values[:3] == (series.times_ns[0] - 7,) * 3
    assert np.linalg.norm(values[3:6]) == pytest.approx(GRAVITY / STANDARD_GRAVITY, abs=2e-3)


def scan_of(config: LidarConfig, material: Material) -> tuple[np.ndarray, np.ndarray]:
    scene = compile_meshes([(0, box(300, 300, 1.0, material).placed(0, 0, -1.0))])
    lidar = Lidar(sensor_info(LidarMode.COLUMNS_512, dual=False), config, False)
    pose = np.tile(make_pose(np.eye(3), [0.0, 0.0, 2.0]), (512, 1, 1))
    scan = lidar.scan(scene, 0, column_times(START_NS, 0, 512), pose, np.random.default_rng(4))
    return scan.first.range_mm, scan.first.reflectivity


def test_a_wet_road_swallows_grazing_beams_and_leaves_concrete_alone() -> None:
    counts = {
        (material, wet): (scan_of(LidarConfig(wet_road=wet), material)[0] > 0).sum()
        for material in (Material.ASPHALT, Material.CONCRETE)
        for wet in (0.0, 1.0)
    }
    assert counts[Material.ASPHALT, 1.0] < 0.5 * counts[Material.ASPHALT, 0.0]
    assert counts[Material.CONCRETE, 1.0] == counts[Material.CONCRETE, 0.0]


def test_spread_beams_keep_their_mean_range_and_scatter_more_where_they_graze() -> None:
    still = LidarConfig(range_sigma=0.0, range_sigma_slope=0.0, dropout=0.0)
    sharp = scan_of(still, Material.CONCRETE)[0].astype(float)
    wide = scan_of(still.model_copy(update={"divergence": 1e-3}), Material.CONCRETE)[0].astype(float)
    both = (sharp > 0) & (wide > 0)
    spread = [np.std((wide - sharp)[row][both[row]]) for row in (127, 90)]
    assert spread[0] < spread[1]
    assert abs(np.mean((wide - sharp)[127][both[127]])) < 2.0


def test_intensity_follows_material() -> None:
    dark, light = (
        np.median(r[d > 0])
        for d, r in (scan_of(LidarConfig(), m) for m in (Material.ASPHALT, Material.GRASS))
    )
    assert dark < 0.5 * light


def warp(**errors: float) -> MapWarp:
    return MapWarp(MapErrorConfig(**errors), np.array([10.0, -5.0, 0.0]), 3)


def test_a_map_without_errors_is_where_it_is() -> None:
    xyz = np.random.default_rng(1).uniform(-50, 50, (100, 3))
    assert warp().is_identity
    np.testing.assert_array_equal(warp().apply(xyz), xyz)
    np.testing.assert_array_equal(warp().T_true_map(WORLD, MAP_CRS), np.eye(4))


def test_the_stated_transform_undoes_shift_and_turn_in_map_coordinates() -> None:
    xyz = np.random.default_rng(1).uniform(-50, 50, (100, 3))
    wrong = warp(shift=1.5, rotation_deg=1.0, tilt_deg=0.2)
    moved = WORLD.points_to_map(wrong.apply(xyz), MAP_CRS)
    true = WORLD.points_to_map(xyz, MAP_CRS)
    assert np.linalg.norm(moved - true, axis=1).min() > 0.3
    back = transform_points(wrong.T_true_map(WORLD, MAP_CRS), moved)
    np.testing.assert_allclose(back, true, atol=0.002)
    poses = make_pose(np.tile(Rotation.from_euler("z", 0.3).as_matrix(), (100, 1, 1)), xyz)
    np.testing.assert_allclose(wrong.pose(poses)[:, :3, 3], wrong.apply(xyz))


def test_drift_and_shear_bend_by_no_more_than_asked_and_by_what_no_rigid_motion_undoes() -> None:
    grid = np.stack(np.meshgrid(np.linspace(-100, 100, 21), np.linspace(-100, 100, 21)), -1).reshape(-1, 2)
    xyz = np.column_stack([grid, np.zeros(len(grid))])
    for name, most in (("drift", 0.1 * np.sqrt(2.25)), ("shear", 0.1)):
        bend = warp(**{name: 0.1}).apply(xyz) - xyz
        assert 0.02 < np.linalg.norm(bend, axis=1).max() <= most
        turn, _ = Rotation.align_vectors(xyz + bend - (xyz + bend).mean(0), xyz - xyz.mean(0))
        left = (xyz + bend - (xyz + bend).mean(0)) - turn.apply(xyz - xyz.mean(0))
        assert np.linalg.norm(left, axis=1).max() > 0.02


def test_what_is_asked_for_goes_before_what_the_preset_says() -> None:
    plain = with_preset(SimulationConfig(preset="hard"))
    assert plain.faults.canyons
    assert plain.faults.multipath == 2
    asked = with_preset(SimulationConfig(preset="hard", faults=FaultConfig(multipath=0), duration=9.0))
    assert asked.faults.canyons
    assert asked.faults.multipath == 0
    assert asked.duration == 9.0
    easy = with_preset(SimulationConfig(preset="easy"))
    assert easy.faults == FaultConfig()
    assert easy.maps == MapErrorConfig()


def test_a_recorded_drive_begins_at_rest_and_is_followed() -> None:
    speed = np.concatenate([np.zeros(100), np.linspace(0, 8, 80), np.full(400, 8.0)])
    recorded = RecordedDrive(speed, np.zeros(580), np.zeros(580))
    stretch = recorded.stretch(12.0, np.random.default_rng(1))
    t = np.arange(-2.0, 14.0, 0.05)
    driven = stretch.travelled(t)
    assert driven[t < 0.5].max() == 0.0
    assert np.diff(driven).max() == pytest.approx(0.4)
    with pytest.raises(InputError, match="begins at rest"):
        recorded.stretch(100.0, np.random.default_rng(1))


def test_a_real_recording_gives_speed_and_swing(shared_data: Path) -> None:
    recorded = read_recorded_drive(shared_data / "rtk_imu_drive")
    assert 10.0 < recorded.speed.max() < 20.0
    assert len(recorded.speed) * 0.05 > 500
    for angle in (recorded.pitch, recorded.roll):
        assert np.radians(0.05) < angle.std() < np.radians(1.5)


def test_a_folder_without_a_recording_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="needs gnss"):
        read_recorded_drive(tmp_path)
