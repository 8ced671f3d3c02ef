"""Moving objects leave the map, thin objects stay; a map in tiles is the map in one piece."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from plain_fusion import add_scan, fused_cloud
from scipy.spatial import cKDTree
from traffic_scene import REGIONS, drive

from subiaco_geo.clouds import PointCloud, unpack_voxel_keys, voxel_keys
from subiaco_geo.frames import Floats
from subiaco_mapping.fusion.config import FusionConfig, MovingConfig
from subiaco_mapping.fusion.dynamic_objects import fragment_shares, height_above_floor, moved_probability
from subiaco_mapping.fusion.finishing import FinishedMap, MapFusion
from subiaco_mapping.fusion.outliers import beam_spacing
from subiaco_mapping.fusion.projection import Projection
from subiaco_mapping.fusion.voxel_fusion import VoxelAccumulator
from subiaco_mapping.fusion.voxel_tiles import TileRuns, tile_corner, tile_numbers, tiles_around
from subiaco_mapping.method_numbers import NUMBERS

SEED = 21


def nothing_stood(places: Floats) -> NDArray[np.bool_]:
    return np.zeros(len(places), dtype=np.bool_)


def fuse(
    folder: Path, config: FusionConfig, scans: int = 45, shift: tuple[float, float] = (0.0, 0.0)
) -> FinishedMap:
    taken = drive(scans, SEED, shift)
    fusion = MapFusion(folder, config, Projection(None, None), taken[0][1][:3, 3])
    for scan, pose in taken:
        fusion.add(scan, pose, np.eye(3), np.zeros(3))
    return fusion.finish(1, lambda _: None)


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> dict[bool, FinishedMap]:
    found = {}
    for enabled in (True, False):
        config = FusionConfig(moving=MovingConfig(enabled=enabled))
        found[enabled] = fuse(tmp_path_factory.mktemp("street"), config)
    return found


def counted(cloud: PointCloud | None, thing: str) -> int:
    return 0 if cloud is None else int(REGIONS[thing](cloud.world()).sum())


def test_a_car_that_drives_through_leaves_the_map_for_the_side_cloud(street: dict[bool, FinishedMap]) -> None:
    before, after = counted(street[False].cloud, "car"), counted(street[True].cloud, "car")
    assert before > 300
    assert after < 0.25 * before
    assert counted(street[True].moving, "car") >= before - after
    assert street[False].moving is None


def test_beams_that_returned_from_too_far_for_the_map_show_free_space_up_to_its_range(tmp_path: Path) -> None:
    taken = drive(30, SEED)
    reach = np.concatenate([np.linalg.norm(scan.xyz, axis=1) for scan, _ in taken])
    limit = float(np.median(reach))
    maps = []
    for name, kept in (("all", None), ("near", limit)):
        fusion = MapFusion(
            tmp_path / name, FusionConfig(max_range=limit), Projection(None, None), taken[0][1][:3, 3]
        )
        for scan, pose in taken:
            near = np.linalg.norm(scan.xyz, axis=1) <= limit
            cut = replace(scan, xyz=scan.xyz[near], intensity=scan.intensity[near])
            fusion.add(scan if kept is None else cut, pose, np.eye(3), np.zeros(3))
        maps.append(fusion.finish(1, lambda _: None))
    passes = [int(m.visibility.passes.sum()) for m in maps]
    assert passes[0] > 1.5 * passes[1]
    assert len(maps[0].cloud) == pytest.approx(len(maps[1].cloud), rel=0.02), "the points stay the same"
    layer = maps[0].visibility
    middles = (unpack_voxel_keys(layer.keys) + 0.5) * layer.voxel + layer.origin
    eyes = np.array([pose[:3, 3] for _, pose in taken])
    assert cKDTree(eyes).query(middles)[0].max() <= limit + layer.voxel


@pytest.mark.parametrize(("thing", "least"), [("pole", 10), ("fence", 300), ("hedge", 1000), ("wire", 20)])
def test_thin_things_stay(street: dict[bool, FinishedMap], thing: str, least: int) -> None:
    before, after = counted(street[False].cloud, thing), counted(street[True].cloud, thing)
    assert before >= least
    assert after >= 0.98 * before


def test_the_rest_of_the_street_stays(street: dict[bool, FinishedMap]) -> None:
    moving = street[True].moving
    assert moving is not None
    elsewhere = len(moving) - counted(moving, "car")
    assert elsewhere < 0.003 * len(street[False].cloud)


def test_what_stays_says_how_probably_it_moved(street: dict[bool, FinishedMap]) -> None:
    cloud = street[True].cloud
    moving = np.asarray(cloud.fields["moving"])
    assert np.nanmax(moving) < MovingConfig().sure
    for thing in ("pole", "fence", "hedge", "wire"):
        assert np.nanmean(moving[REGIONS[thing](cloud.world())]) < 0.4, thing
    all_stay = street[False].cloud
    car = REGIONS["car"](all_stay.world())
    assert np.nanmedian(np.asarray(all_stay.fields["moving"])[car]) >= MovingConfig().sure


def test_the_lower_edge_of_a_vehicle_takes_the_verdict_on_the_voxel_above() -> None:
    xyz = np.array([[0.0, 0.0, 0.1], [0.0, 0.0, 0.4], [0.0, 0.0, 0.9], [5.0, 0.0, 0.4]])

    def moved(places: np.ndarray) -> np.ndarray:
        return np.where((places[:, 2] > 0.5) & (places[:, 0] < 1), 0.99, 0.0).astype(np.float32)

    found = moved_probability(xyz, xyz[:, 2], moved, 0.5)
    np.testing.assert_allclose(found, [0.99, 0.99, 0.99, 0.0], atol=1e-6)


def test_the_floor_is_the_lowest_of_its_surroundings_on_a_slope_too() -> None:
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(-4, 4, 0.25), np.arange(-4, 4, 0.25)))
    road = np.column_stack([x, y, 0.05 * x])
    car = road[(np.abs(x) < 2) & (np.abs(y) < 0.9)] + [0.0, 0.0, 0.3]
    found = height_above_floor(np.vstack([road, car])) < 0.15
    np.testing.assert_array_equal(found, np.arange(len(found)) < len(road))
    assert height_above_floor(np.zeros((0, 3))).shape == (0,)


@given(st.integers(-(10**5), 10**5), st.integers(-(10**5), 10**5), st.integers(1, 400))
def test_every_voxel_lies_in_its_tile_alone(x: int, y: int, edge: int) -> None:
    (tile,) = tile_numbers(np.array([[x, y, 0]]), edge).tolist()
    low = tile_corner(tile, edge)
    assert (low <= [x, y]).all()
    assert (np.array([x, y]) < low + edge).all()
    assert tiles_around(tile).count(tile) == 1
    assert len(set(tiles_around(tile))) == 9


@given(st.integers(0, 2**32 - 1), st.integers(1, 9), st.integers(1, 60))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=30)
def test_runs_on_disk_add_up_to_what_came_in(
    tmp_path_factory: pytest.TempPathFactory, seed: int, runs: int, edge: int
) -> None:
    rng = np.random.default_rng(seed)
    store, total = TileRuns(tmp_path_factory.mktemp("runs") / "r", edge), {}
    for _ in range(runs):
        keys = np.unique(voxel_keys(rng.integers(-40, 40, (50, 3))))
        counts = rng.integers(1, 9, len(keys)).astype(np.uint32)
        store.append(keys, [counts])
        for key, count in zip(keys.tolist(), counts.tolist(), strict=True):
            total[key] = total.get(key, 0) + count
    found: dict[int, int] = {}
    for tile in store.tiles():
        keys, (counts,) = store.read([tile])
        assert (np.diff(keys) > 0).all()
        found |= dict(zip(keys.tolist(), counts.tolist(), strict=True))
    assert found == total


def ordered(cloud: PointCloud) -> PointCloud:
    return cloud.select(np.lexsort(np.round(cloud.xyz, 6).T))


def assert_same_cloud(found: PointCloud, expected: PointCloud) -> None:
    found, expected = ordered(found), ordered(expected)
    assert len(found) == len(expected)
    np.testing.assert_allclose(found.world(), expected.world(), atol=1e-9)
    assert set(found.fields) == set(expected.fields)
    for name, values in expected.fields.items():
        np.testing.assert_allclose(found.fields[name], values, atol=2e-6, err_msg=name)


@cache
def in_one_piece(folder: Path, x: float, y: float) -> FinishedMap:
    config = FusionConfig(tile=1000.0, active_voxels=10**9)
    return fuse(folder, config, scans=6, shift=(x, y))


@given(
    st.floats(10.0, 60.0),
    st.integers(2000, 200_000),
    st.sampled_from([(-20.0, -500.0), (3.3, 480.0), (0.0, 0.0)]),
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=4)
def test_a_map_in_tiles_is_the_map_in_one_piece_wherever_their_borders_are(
    tmp_path_factory: pytest.TempPathFactory, tile: float, active: int, shift: tuple[float, float]
) -> None:
    whole = in_one_piece(tmp_path_factory.getbasetemp() / f"whole{shift}", *shift)
    config = FusionConfig(tile=tile, active_voxels=active)
    parts = fuse(tmp_path_factory.mktemp("parts"), config, scans=6, shift=shift)
    assert_same_cloud(parts.cloud, whole.cloud)
    assert (parts.moving is None) == (whole.moving is None)
    if parts.moving is not None and whole.moving is not None:
        assert_same_cloud(parts.moving, whole.moving)
    for name in ("origin", "voxel", "keys", "hits", "passes", "moving"):
        np.testing.assert_array_equal(getattr(parts.visibility, name), getattr(whole.visibility, name))
    assert parts.visibility.times is not None
    assert whole.visibility.times is not None
    for found, expected in zip(
        parts.visibility.times.looks.columns(), whole.visibility.times.looks.columns(), strict=True
    ):
        np.testing.assert_array_equal(found, expected)


def test_without_movement_the_finished_map_is_the_fused_cloud(tmp_path: Path) -> None:
    config = FusionConfig(moving=MovingConfig(enabled=False))
    accumulator = VoxelAccumulator(config.leaf)
    for scan, pose in drive(6, SEED):
        add_scan(accumulator, scan.xyz, scan.intensity, pose)
    spacing = beam_spacing(drive(1, SEED)[0][0].xyz, config.outlier_neighbours)
    expected = fused_cloud(accumulator, config, 1, lambda p: p, lambda _p, v: v, None, spacing)
    found = fuse(tmp_path / "f", config, scans=6).cloud
    kept = {name: values for name, values in found.fields.items() if name != "moving"}
    assert_same_cloud(PointCloud(found.xyz, found.origin, found.crs, kept), expected)


def box(low: tuple[float, float, float], size: tuple[float, float, float]) -> np.ndarray:
    """Points 0.25 m apart that fill a box."""
    axes = [a + np.arange(0.0, s, 0.25) for a, s in zip(low, size, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


@given(st.integers(0, 2**32 - 1))
@settings(deadline=None, max_examples=20)
def test_the_rest_of_a_moving_vehicle_is_a_fragment_and_a_car_or_hedge_beside_it_is_not(seed: int) -> None:
    rng = np.random.default_rng(seed)
    ground = box((0, 0, 0), (30, 12, 0.25))
    vehicle = box((10, 4, 0.25), (4.5, 1.75, 1.5))
    parked, hedge = box((10, 7.5, 0.25), (4.5, 1.75, 1.5)), box((0, 10, 0.25), (30, 1, 1.5))
    xyz = np.concatenate([ground, vehicle, parked, hedge])
    number = np.repeat(np.arange(4), [len(ground), len(vehicle), len(parked), len(hedge)])
    corner = vehicle[rng.integers(len(vehicle))]
    left = (number == 1) & (np.abs(xyz - corner).max(axis=1) < rng.uniform(0.3, 0.7))
    shares = fragment_shares(xyz, xyz[:, 2], (number == 1) & ~left, nothing_stood, 0.5)
    high = xyz[:, 2] >= 0.3
    assert shares[left & high].min(initial=1.0) >= 0.8
    assert shares[number != 1].max() < 0.8
    assert not shares[~high].any()
    nothing_moved = np.zeros(len(xyz), dtype=np.bool_)
    assert not fragment_shares(xyz, xyz[:, 2], nothing_moved, nothing_stood, 0.5).any()


@pytest.mark.parametrize(("share", "is_fragment"), [(0.2, True), (0.8, False)])
def test_a_parked_car_of_which_edges_look_as_if_they_moved_is_no_fragment(
    share: float, is_fragment: bool
) -> None:
    rng = np.random.default_rng(SEED)
    ground, car = box((0, 0, 0), (30, 12, 0.25)), box((10, 4, 0.25), (4.5, 1.75, 1.5))
    xyz = np.concatenate([ground, car])
    moved = (np.arange(len(xyz)) >= len(ground)) & (rng.random(len(xyz)) < 0.3)
    rest = np.flatnonzero((np.arange(len(xyz)) >= len(ground)) & ~moved & (xyz[:, 2] >= 0.3))
    still = xyz[rest[rng.random(len(rest)) < share]]

    def stood(places: Floats) -> NDArray[np.bool_]:
        return np.asarray(cKDTree(still).query(places)[0] < 1e-9)

    shares = fragment_shares(xyz, xyz[:, 2], moved, stood, 0.5)[rest]
    assert (shares >= NUMBERS.fusion.fragment_share).all() == is_fragment
    assert is_fragment or not shares.any()
