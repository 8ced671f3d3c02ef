"""Beams that met nothing prove empty air only where they surely went into the sky."""

from pathlib import Path

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from mapping_scenes import pcap_bufs, sdk_frames
from ouster.sdk import core
from scipy.ndimage import binary_erosion

from subiaco_geo.frames import make_pose
from subiaco_geo.voxel_traversal import VisibilityAccumulator
from subiaco_mapping.fusion.config import FusionConfig
from subiaco_mapping.fusion.voxel_fusion import visibility_beams
from subiaco_mapping.preprocessing.config import DecodeConfig
from subiaco_mapping.preprocessing.decode import PacketDecoder
from subiaco_mapping.preprocessing.scan_spool import SpooledScan
from subiaco_mapping.preprocessing.sky import COLUMNS_PER_TURN, MAX_CLUTTER, RING_STEP, sky_mask, thinned


def street(rings: int = 64, columns: int = 128) -> np.ndarray:
    """What returned in a street: the lower half, and a house up to a quarter of the rings."""
    returned = np.zeros((rings, columns), bool)
    returned[rings // 2 :] = True
    returned[rings // 4 :, 40:80] = True
    return returned


def test_the_open_sky_is_taken_but_for_the_rim_of_what_stands_before_it() -> None:
    returned = street()
    sky = sky_mask(returned, np.ones_like(returned))
    assert sky[:15].all()
    assert sky[:31, :38].all()
    assert not sky[:, 38:82][15:].any()
    assert not sky[31:].any()


def test_an_isolated_drop_out_on_a_wall_is_not_sky() -> None:
    returned = np.ones((64, 128), bool)
    returned[20, 50] = returned[21, 51] = False
    assert not sky_mask(returned, np.ones_like(returned)).any()


def test_a_window_under_its_roof_is_not_sky() -> None:
    returned = street()
    returned[24:30, 50:70] = False  # glass in the house, eight rings of wall above it
    assert not sky_mask(returned, np.ones_like(returned))[16:, 40:80].any()


def test_a_wire_does_not_hide_the_sky_below_it() -> None:
    returned = street()
    returned[4, :] = True
    sky = sky_mask(returned, np.ones_like(returned))
    assert not sky[3:6].any()
    assert sky[int(1 / MAX_CLUTTER) : 31, :38].all()


def test_a_column_that_something_nearer_than_the_sensor_measures_hides_is_not_sky() -> None:
    returned = street()
    returned[:, 60:100] = False  # a bus beside the car: neither the house behind it nor the road returns
    sky = sky_mask(returned, np.ones_like(returned))
    assert not sky[:31, 58:102].any()
    assert sky[:15, 102:].all()


def test_a_lost_column_proves_nothing_and_neither_do_its_neighbours() -> None:
    received = np.ones((64, 128), bool)
    received[:, 100] = False
    sky = sky_mask(street(), received)
    assert not sky[:, 98:103].any()
    assert sky[:15, 103:].all()


@given(st.integers(0, 2**32 - 1), st.floats(0.0, 0.3))
@settings(max_examples=30, deadline=None)
def test_every_sky_beam_has_an_empty_neighbourhood_whatever_returned(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    returned, received = rng.random((16, 32)) < share, rng.random((16, 32)) > 0.02
    nothing = np.pad(received & ~returned, ((1, 1), (0, 0)), constant_values=True)
    nothing = np.pad(nothing, ((0, 0), (2, 2)), mode="wrap")
    twin = binary_erosion(nothing, np.ones((3, 5)))[1:-1, 2:-2]
    assert not (sky_mask(returned, received) & ~twin).any()


def test_sky_above_a_wet_road_is_taken_where_some_of_the_road_returned() -> None:
    returned = street()
    returned[32:, :40] = False
    returned[60:, :40] = True  # the road near the car
    sky = sky_mask(returned, np.ones_like(returned))
    assert sky[:15].all()
    assert sky[:31, :38].all()


def test_turn_by_turn_the_lattice_comes_round_to_every_beam() -> None:
    everything = np.ones((4, 1024), bool)
    seen = np.zeros_like(everything)
    step = 1024 // COLUMNS_PER_TURN
    for turn in range(step * RING_STEP):
        ring, column = thinned(everything, turn)
        assert len(ring) == 4 * 1024 // (step * RING_STEP)
        seen[ring, column] = True
    assert seen.all()


def test_sky_of_a_real_scan_lies_where_the_sdk_has_no_range(shared_data: Path) -> None:
    name = "OS-1-128_v2.3.0_1024x10"
    metadata = (shared_data / "ouster" / f"{name}.json").read_text()
    bufs = pcap_bufs(shared_data / "ouster" / f"{name}_lb_n3.pcap", metadata)
    decoder = PacketDecoder(metadata, DecodeConfig())
    scan = next(scan for buf in bufs for scan in decoder.push(buf))
    info = core.SensorInfo(metadata)
    empty = core.destagger(info, sdk_frames(bufs, metadata)[0].field("RANGE")) == 0
    direction = core.destagger(
        info, np.asarray(core.XYZLut(info, use_extrinsics=False).direction).reshape(128, 1024, 3)
    )
    direction = direction / np.linalg.norm(direction, axis=2, keepdims=True)
    assert scan.sky is not None
    assert len(scan.sky) > 0
    unit = scan.sky.xyz / np.linalg.norm(scan.sky.xyz, axis=1, keepdims=True)
    assert np.abs(np.linalg.norm(scan.sky.xyz, axis=1) - 40.0).max() < 0.05
    for ring, beam in zip(scan.sky.ring[::7].tolist(), unit[::7], strict=True):
        column = int(np.argmax(direction[ring] @ beam))
        assert empty[max(ring - 1, 0) : ring + 2, [(column + k) % 1024 for k in range(-2, 3)]].all()


def test_sky_beams_pass_every_voxel_and_hit_none_and_stay_above_the_horizon() -> None:
    sky = np.array([[30.0, 0.0, 15.0], [30.0, 0.0, -15.0], [30.0, 0.0, 0.5]])
    none = np.zeros(0, np.float32)
    scan = SpooledScan(np.array([[10.0, 0.0, 0.0]]), np.ones(1, np.float32), np.zeros((0, 3)), none, sky)
    level = make_pose(np.eye(3), np.zeros(3))
    ends, returned = visibility_beams(scan, level, FusionConfig(visibility_stride=1))
    np.testing.assert_array_equal(ends, [[10.0, 0.0, 0.0], [30.0, 0.0, 15.0]])
    np.testing.assert_array_equal(returned, [True, False])
    walk = VisibilityAccumulator(np.zeros(3), 0.5)
    walk.add(np.zeros_like(ends), ends, returned)
    grid = walk.grid()
    assert grid.hits.sum() == 1
    assert grid.observed(np.array([[20.0, 0.0, 10.0], [29.9, 0.0, 14.95]])).all()


def test_a_beam_shows_free_space_no_farther_than_points_enter_the_map() -> None:
    """A survey that leaves far leaves out of its map must not call the gaps between them free."""
    none = np.zeros(0, np.float32)
    far, sky = np.array([[0.0, 71.0, 0.0], [0.0, 69.0, 0.0]]), np.array([[0.0, 30.0, 30.0]])
    scan = SpooledScan(far, np.ones(2, np.float32), np.zeros((0, 3)), none, sky)
    level = make_pose(np.eye(3), np.zeros(3))
    ends, returned = visibility_beams(scan, level, FusionConfig(visibility_stride=1, max_range=70.0))
    np.testing.assert_allclose(ends, [[0.0, 70.0, 0.0], [0.0, 69.0, 0.0], [0.0, 30.0, 30.0]])
    np.testing.assert_array_equal(returned, [False, True, False])


def test_a_tilted_sensor_takes_the_horizon_of_the_world_not_its_own() -> None:
    none = np.zeros(0, np.float32)
    sky = np.array([[30.0, 0.0, 3.0], [-30.0, 0.0, 3.0]])
    scan = SpooledScan(np.zeros((0, 3)), none, np.zeros((0, 3)), none, sky)
    tilt = np.radians(10.0)
    rotation = np.array(
        [[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]]
    )  # nose down: ahead sinks
    ends, _ = visibility_beams(scan, make_pose(rotation, np.zeros(3)), FusionConfig())
    np.testing.assert_array_equal(ends, sky[1:])
