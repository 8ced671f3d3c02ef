"""Every return as classified LAZ tiles: read by laspy, with times, return numbers, sources and classes."""

from pathlib import Path

import geopandas as gpd
import laspy
import numpy as np
import pandas as pd
import pytest
import shapely
from mapping_scenes import SECOND, START_NS, room_scan, turning_pose, write_clouds
from traffic_scene import REGIONS, drive

from subiaco_change.segmentation.classes import map_classes
from subiaco_geo.crs import EnuFrame
from subiaco_geo.maps import read_map
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.fusion.config import FusionConfig
from subiaco_mapping.fusion.finishing import MapFusion
from subiaco_mapping.fusion.full_density import FullDensity, VoxelClasses
from subiaco_mapping.fusion.projection import Projection
from subiaco_mapping.job import run_mapping
from subiaco_mapping.measurements import DeskewedScan, Returns
from subiaco_mapping.odometry.config import OdometryConfig
from subiaco_mapping.preprocessing.scan_spool import PULSE, Spool, SpooledScan, pulses_of
from subiaco_mapping.request import MappingRequest

FRAME = EnuFrame(-31.95, 115.82, 20.0)
#: 2025-11-22T00:00:00Z, and what LAS calls adjusted standard GPS time of it.
STAMP_NS, ADJUSTED_S = 1_763_769_600_000_000_000, 1_763_769_600 - 315_964_800 + 18 - 1_000_000_000


def returns(xyz, times_ns, ring):
    return Returns(
        np.asarray(xyz, float), np.asarray(times_ns), np.ones(len(xyz), np.float32), np.array(ring, np.uint16)
    )


def test_returns_of_one_beam_are_numbered_from_the_sensor_outwards():
    first = returns([[9, 0, 0], [0, 5, 0], [4, 0, 0]], [100, 100, 200], [1, 2, 1])
    last = returns([[6, 0, 0], [0, 0, 8]], [100, 200], [1, 1])
    one, two = pulses_of(250, first, last)
    assert one["number"].tolist() == [2, 1, 1]
    assert one["of"].tolist() == [2, 1, 2]
    assert two["number"].tolist() == [1, 2]
    assert two["of"].tolist() == [2, 2]
    assert one["before_ns"].tolist() == [150, 150, 50]
    alone, none = pulses_of(250, first, None)
    assert alone["of"].tolist() == [1, 1, 1]
    assert len(none) == 0


@pytest.mark.parametrize("raw", [True, False])
def test_the_spool_keeps_the_pulses_of_the_points_that_it_keeps(tmp_path, raw):
    xyz = np.array([[1.0, 0, 0], [99.0, 0, 0], [3.0, 0, 0]])
    first = returns(xyz, [STAMP_NS - 7, STAMP_NS - 5, STAMP_NS], [0, 1, 2])
    scan = DeskewedScan(STAMP_NS, xyz, first.intensity, "gyro", raw=(first, None) if raw else None)
    spool = Spool(tmp_path / "s", 70.0, keep_pulses=True)
    spool.append(scan)
    back = spool.read(0)
    assert len(back.xyz) == len(back.pulses) == 2
    assert back.pulses["before_ns"].tolist() == ([7, 0] if raw else [0, 0])
    assert back.pulses["of"].tolist() == [1, 1]
    assert len(back.last_pulses) == 0


def test_a_point_in_no_voxel_takes_the_class_of_one_nearby():
    from subiaco_geo.clouds import voxel_keys

    keys = voxel_keys(np.array([[0, 0, 0], [0, 0, 9]]))
    classes = VoxelClasses(keys, np.array([2, 6], np.uint8), 0.25)
    xyz = np.array([[0.1, 0.1, 0.1], [0.1, 0.1, 2.3], [0.3, 0.3, 0.3], [5.0, 5.0, 5.0]])
    assert classes.of(xyz).tolist() == [2, 6, 2, 1]


def fused(folder: Path, scans: int = 45):
    """A street with a car that drives through, at MGA coordinates, mapped with every return."""
    taken = drive(scans, 21)
    projection = Projection.of_place(FRAME, "EPSG:7850")
    matrices, offsets = projection.affine(np.array([pose[:3, 3] for _, pose in taken]))
    density = FullDensity(folder / "full", map_classes)
    fusion = MapFusion(folder / "f", FusionConfig(tile=40.0), projection, taken[0][1][:3, 3], density)
    local = []
    for k, (scan, pose) in enumerate(taken):
        pulses = np.zeros(len(scan.xyz), PULSE)
        pulses["before_ns"], pulses["number"], pulses["of"] = 1_000_000, 1, 1
        held = SpooledScan(scan.xyz, scan.intensity, scan.last_xyz, scan.last_intensity, scan.sky_xyz, pulses)
        fusion.add(held, pose, matrices[k], offsets[k], STAMP_NS + k * SECOND // 10, 1 + k % 2)
        local.append(scan.xyz @ pose[:3, :3].T + pose[:3, 3])
    finished = fusion.finish(1, lambda _: None, {1: "north", 2: "south"})
    return finished, np.concatenate(local), projection, density.folder


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    finished, local, projection, folder = fused(tmp_path_factory.mktemp("density"))
    tiles = [laspy.read(path) for path in sorted(folder.glob("*.laz"))]
    return finished, local, projection, folder, tiles


def test_voxels_of_a_map_lie_on_multiples_of_the_leaf_in_its_crs(street):
    cloud = street[0].cloud
    assert cloud.crs == "EPSG:7850"
    voxels = np.floor(cloud.world() / 0.25)
    assert len(np.unique(voxels, axis=0)) == len(cloud) > 1_000


def column(tiles, name):
    return np.concatenate([np.asarray(tile[name]) for tile in tiles])


def test_every_return_is_in_the_tiles_where_it_was_measured(street):
    _, local, projection, _, tiles = street
    world = projection.points(local)
    found = np.concatenate([tile.xyz for tile in tiles])
    assert len(tiles) > 2
    assert len(found) == len(world)
    for axis in range(3):
        assert np.abs(np.sort(found[:, axis]) - np.sort(world[:, axis])).max() < 0.002


def test_the_files_are_las_1_4_with_gps_times_sources_and_intensities(street):
    tiles = street[-1]
    for tile in tiles:
        assert str(tile.header.version) == "1.4"
        assert tile.header.point_format.id == 6
        assert tile.header.global_encoding.gps_time_type == laspy.header.GpsTimeType.STANDARD
        assert "GDA2020" in tile.header.parse_crs().name
    times = column(tiles, "gps_time")
    assert times.min() == pytest.approx(ADJUSTED_S - 0.001, abs=1e-6)
    assert times.max() == pytest.approx(ADJUSTED_S + 4.4 - 0.001, abs=1e-6)
    assert set(column(tiles, "point_source_id").tolist()) == {1, 2}
    assert set(column(tiles, "intensity").tolist()) == {9}
    assert set(column(tiles, "number_of_returns").tolist()) == {1}


def test_ground_is_class_2_and_the_car_that_drove_through_class_64(street):
    finished, _, _, _, tiles = street
    codes, xyz = column(tiles, "classification"), np.concatenate([tile.xyz for tile in tiles])
    assert set(codes.tolist()) <= {1, 2, 5, 6, 7, 64}
    road = np.isclose(xyz[:, 2], np.median(xyz[codes == 2, 2]), atol=0.03)
    assert (codes[road] == 2).mean() > 0.95
    assert (codes == 64).sum() > 1000
    assert finished.moving is not None
    assert 0 < (codes == 7).sum() < 0.05 * len(codes)
    low = FRAME.points_to_map(np.zeros((1, 3)), "EPSG:7850")[0]
    car = REGIONS["car"](xyz - low)
    assert (codes[car] == 64).mean() > 0.5


def test_the_index_has_the_square_and_the_facts_of_every_tile(street):
    folder, tiles = street[3], street[4]
    index = gpd.read_file(folder / "tiles.gpkg")
    assert index.crs.to_epsg() == 7850
    assert sorted(index["location"]) == sorted(path.name for path in folder.glob("*.laz"))
    for row in index.itertuples():
        tile = laspy.read(folder / row.location)
        assert row.points == len(tile.points)
        assert row.class_2 == int((np.asarray(tile.classification) == 2).sum())
        assert row.geometry.area == pytest.approx(40.0**2, rel=0.01)
        shapely.prepare(grown := row.geometry.buffer(0.01))
        assert shapely.contains_xy(grown, np.asarray(tile.x), np.asarray(tile.y)).all()
    assert index["points"].sum() == sum(len(tile.points) for tile in tiles)
    recordings = pd.read_csv(folder / "recordings.csv")
    assert recordings["recording"].tolist() == ["north", "south"]


def test_a_mapping_run_leaves_the_tiles_in_the_map_directory(tmp_path):
    poses = turning_pose(START_NS + np.arange(6) * SECOND // 10, speed=2.0, rate=0.3)
    write_clouds(tmp_path / "room", [room_scan(pose, 8000, k, 0.01) for k, pose in enumerate(poses)])
    room = MappingConfig(deskewed=True, odometry=OdometryConfig(voxel=0.5))
    dense = room.model_copy(update={"fusion": FusionConfig(full_density=True)})
    (tmp_path / ".dense.checkpoint" / "full_density").mkdir(parents=True)  # of a run that was stopped
    for name, config in (("plain", room), ("dense", dense)):
        run_mapping(
            MappingRequest.of(bags=(tmp_path / "room",), output=tmp_path / name, config=config),
            classify=map_classes,
        )
    assert not (tmp_path / "plain" / "full_density").exists()
    tiles = [laspy.read(path) for path in (tmp_path / "dense" / "full_density").glob("*.laz")]
    assert sum(len(tile.points) for tile in tiles) > 40_000
    first, second = (read_map(tmp_path / name).cloud.xyz for name in ("plain", "dense"))
    assert np.array_equal(first, second)
    assert not (tmp_path / ".dense.checkpoint").exists()
