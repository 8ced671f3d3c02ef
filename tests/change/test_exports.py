"""Maps and change directories in other forms, read back with other programs' libraries."""

from __future__ import annotations

import geopandas as gpd
import laspy
import numpy as np
import pytest

from subiaco_change.outputs.exports import export_changes
from subiaco_geo.cloud_io import read_cloud
from subiaco_geo.clouds import from_world
from subiaco_geo.errors import InputError
from subiaco_geo.exports import export_map
from subiaco_geo.maps import write_map
from subiaco_geo.survey_map import SurveyMap
from subiaco_geo.trajectories import Trajectory


def test_the_table_as_geojson_lies_in_longitude_and_latitude(change_directory, result, tmp_path):
    (file,) = export_changes(change_directory, tmp_path / "out", "geojson")
    rows = gpd.read_file(file)
    assert rows.crs.to_epsg() == 4326
    assert len(rows) == len(result.records)
    assert rows.geometry.bounds["miny"].between(-32.2, -31.7).all()


@pytest.mark.parametrize("kind", ["gpkg", "parquet"])
def test_the_table_keeps_its_rows(change_directory, result, tmp_path, kind):
    (file,) = export_changes(change_directory, tmp_path / "out", kind)
    rows = gpd.read_parquet(file) if kind == "parquet" else gpd.read_file(file, layer="objects")
    assert set(rows["object_id"]) <= {r.object_id for r in result.records}
    assert "review" in rows.columns


def test_clouds_as_copc_and_for_cloudcompare(change_directory, result, tmp_path):
    files = export_changes(change_directory, tmp_path / "copc", "copc")
    assert [f.name for f in files] == ["after_labelled.copc.laz", "before_labelled.copc.laz"]
    with laspy.CopcReader.open(files[0]) as reader:
        assert reader.header.point_count == len(result.after)
    files = export_changes(change_directory, tmp_path / "ply", "ply", cloudcompare=True)
    header = files[0].read_bytes()[:2000].split(b"end_header")[0].decode()
    assert "scalar_change" in header
    assert "uchar red" in header


def test_a_map_gives_kitti_poses_that_begin_with_identity_and_no_table(tmp_path):
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = 391_000.0 + np.arange(3)
    cloud = from_world(np.array([[391_000.0, 6_464_000.0, 1.0], [391_001.0, 6_464_000.0, 1.0]]), "EPSG:7850")
    times = np.arange(3, dtype=np.int64) * 10**8
    write_map(tmp_path / "map", SurveyMap(cloud, Trajectory(times, poses)))
    export_map(tmp_path / "map", tmp_path / "kitti", "kitti")
    rows = np.loadtxt(tmp_path / "kitti" / "poses.txt").reshape(-1, 3, 4)
    np.testing.assert_allclose(rows[0], np.eye(4)[:3], atol=1e-12)
    np.testing.assert_allclose(rows[:, 0, 3], [0, 1, 2], atol=1e-6)
    export_map(tmp_path / "map", tmp_path / "laz", "laz")
    assert len(read_cloud(tmp_path / "laz" / "map.laz")) == 2
    with pytest.raises(InputError, match="a map has no geojson"):
        export_map(tmp_path / "map", tmp_path / "out", "geojson")


def test_a_map_in_tiles_is_found_by_its_index_and_holds_every_point_once(tmp_path):
    rng = np.random.default_rng(3)
    world = np.round(rng.uniform([390_930.0, 6_463_990.0, 5.0], [391_070.0, 6_464_120.0, 25.0], (5000, 3)), 3)
    cloud = from_world(world, "EPSG:7850").with_fields(intensity=rng.uniform(0, 1, 5000).astype(np.float32))
    times = np.arange(2, dtype=np.int64)
    write_map(tmp_path / "map", SurveyMap(cloud, Trajectory(times, np.tile(np.eye(4), (2, 1, 1)))))
    files = export_map(tmp_path / "map", tmp_path / "out", "tiles")
    index = gpd.read_file(tmp_path / "out" / "tiles.gpkg", layer="tiles")
    assert index.crs.to_epsg() == 7850
    assert sorted(index["location"]) == sorted(f.name for f in files if f.suffix == ".laz")
    assert index["points"].sum() == 5000
    found = []
    for row in index.itertuples():
        tile = laspy.read(tmp_path / "out" / row.location)
        assert tile.header.parse_crs().to_2d().to_epsg() == 7850
        west, south, east, north = row.geometry.bounds
        assert ((tile.x >= west) & (tile.x < east) & (tile.y >= south) & (tile.y < north)).all()
        assert (float(tile.z.min()), float(tile.z.max())) == pytest.approx((row.low, row.high), abs=1e-3)
        found.append(np.column_stack([tile.x, tile.y, tile.z, tile.intensity]))
    found = np.concatenate(found)
    given = np.column_stack([world, cloud.fields["intensity"] * 65535])
    for table in (found, given):
        table[:] = table[np.lexsort(table[:, :3].T)]
    np.testing.assert_allclose(found[:, :3], given[:, :3], rtol=0, atol=1e-3)
    np.testing.assert_allclose(found[:, 3], given[:, 3], rtol=0, atol=1.0)


def test_other_folders_and_kinds_are_refused_and_leave_nothing(change_directory, tmp_path):
    with pytest.raises(InputError, match="not the output of 'subiaco change'"):
        export_changes(tmp_path, tmp_path / "out", "laz")
    with pytest.raises(InputError, match="has no kitti"):
        export_changes(change_directory, tmp_path / "out", "kitti")
    assert not (tmp_path / "out").exists()
