"""Maps and change directories in other forms, read back with other programs' libraries."""

from __future__ import annotations

import json
import shutil
import struct

import geopandas as gpd
import laspy
import numpy as np
import pandas as pd
import pyogrio
import pytest
from geopandas.testing import assert_geodataframe_equal
from scipy.spatial import cKDTree

from subiaco_change.outputs.clouds import POINT_FIELDS
from subiaco_change.outputs.exports import export_changes
from subiaco_change.outputs.reviews import read_reviewed
from subiaco_change.outputs.table import ALL_COLUMNS, TEXT_COLUMNS
from subiaco_geo.cloud_io import read_cloud
from subiaco_geo.clouds import from_world
from subiaco_geo.codes import ASPRS_CODES, Semantic
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


def cells(frame):
    """Rows by object id, every cell as a text or a rounded number, missing ones as an empty text."""
    plain = pd.DataFrame(frame.drop(columns="geometry", errors="ignore"))
    for name in plain.columns:
        if name in TEXT_COLUMNS:
            values = plain[name].astype(object)
            plain[name] = values.where(values.notna(), "").map(lambda v: str(v).split(" 00:00")[0])
    return plain.set_index("object_id").sort_index()


READERS = {
    "gpkg": lambda p: pd.concat([gpd.read_file(p / "changes.gpkg", layer=n) for n in ("objects", "ground")]),
    "parquet": lambda p: gpd.read_parquet(p / "changes.parquet"),
    "geojson": lambda p: gpd.read_file(p / "changes.geojson"),
    "kml": lambda p: gpd.read_file(p / "changes.kml").astype({"object_id": int}),
    "csv": lambda p: pd.read_csv(p / "changes.csv", dtype=dict.fromkeys(TEXT_COLUMNS, str)),
    "shp": lambda p: gpd.read_file(p / "changes.shp").rename(
        columns=pd.read_csv(p / "columns.csv").set_index("shapefile")["column"].to_dict()
    ),
}


@pytest.mark.parametrize("kind", READERS)
def test_every_cell_of_the_table_survives_its_export(change_directory, tmp_path, kind):
    export_changes(change_directory, tmp_path / "out", kind)
    read = READERS[kind](tmp_path / "out")
    stored = read_reviewed(change_directory)
    given = cells(stored)
    found = cells(read)
    assert set(given.columns) <= set(found.columns)
    for name in given.columns:
        if name in TEXT_COLUMNS:
            assert found[name].tolist() == given[name].tolist(), name
        else:
            numbers = pd.to_numeric(found[name]).to_numpy(dtype=np.float64)
            np.testing.assert_allclose(numbers, given[name].to_numpy(np.float64), atol=1e-4, err_msg=name)
    if kind not in ("csv", "kml"):
        back = read.set_index("object_id").to_crs("EPSG:7850").geometry.area.sort_index()
        np.testing.assert_allclose(back, stored.set_index("object_id").geometry.area.sort_index(), rtol=1e-3)


def test_a_geopackage_keeps_every_layer_with_its_style(change_directory, tmp_path):
    (file,) = export_changes(change_directory, tmp_path / "out", "gpkg")
    names = pyogrio.list_layers(change_directory / "changes.gpkg")[:, 0]
    assert sorted(pyogrio.list_layers(file)[:, 0]) == sorted(names)
    coverage = [gpd.read_file(path, layer="coverage") for path in (change_directory / "changes.gpkg", file)]
    assert_geodataframe_equal(*coverage)


def test_a_drawing_has_a_layer_a_label_and_the_row_at_every_outline(change_directory, result, tmp_path):
    (file,) = export_changes(change_directory, tmp_path / "out", "dxf")
    drawn = pyogrio.read_dataframe(file)
    outlines = drawn[drawn["Text"].fillna("") == ""]
    assert len(outlines) == len(result.records)
    assert set(outlines["Layer"]) == {r.change.label.upper() for r in result.records}
    lines = file.read_text(encoding="ascii").splitlines()
    groups = list(zip(map(int, lines[::2]), lines[1::2], strict=True))
    starts = [k for k, group in enumerate(groups) if group == (0, "POLYLINE")]
    records = sorted(result.records, key=lambda r: r.object_id)
    for record, row, start in zip(records, outlines.itertuples(), starts, strict=True):
        end = groups.index((0, "VERTEX"), start)
        assert (1001, "SUBIACO") in groups[start:end]
        data = dict(text.split("=", 1) for code, text in groups[start:end] if code == 1000)
        assert set(data) == set(ALL_COLUMNS)
        assert (data["object_id"], data["class"]) == (str(record.object_id), record.semantic.label)
        west, south, east, north = row.geometry.bounds
        assert (east - west) * (north - south) == pytest.approx(record.footprint.area, rel=1e-3)
    assert set(drawn["Text"].dropna()) >= {str(r.object_id) for r in result.records}


@pytest.mark.parametrize("kind", ["laz", "copc", "ply"])
@pytest.mark.parametrize("epoch", ["before", "after"])
def test_every_field_of_every_point_survives_its_export(change_directory, result, tmp_path, kind, epoch):
    files = export_changes(change_directory, tmp_path / "out", kind)
    (file,) = (f for f in files if f.name.startswith(epoch))
    cloud, source = read_cloud(file), getattr(result, epoch)
    places = [np.column_stack([c.world() - source.origin, c.fields["confidence"]]) for c in (cloud, source)]
    distance, pairs = cKDTree(places[1]).query(places[0])
    assert distance.max() < 1.5e-3
    assert len(np.unique(pairs)) == len(cloud) == len(source)
    for name in (*POINT_FIELDS, "intensity"):
        values, expected = cloud.fields[name], np.asarray(source.fields[name])[pairs]
        if name == "lod95" and kind != "ply":
            expected = np.where(np.isinf(expected), np.nan, expected)  # LAS readers stumble over infinity
        if name == "intensity" and kind != "ply":
            expected = np.round(expected)
        np.testing.assert_array_equal(values, expected, err_msg=name)
    assert "7850" in cloud.crs
    if kind != "ply":
        codes = [ASPRS_CODES[Semantic(code)] for code in np.asarray(source.fields["semantic"])[pairs]]
        np.testing.assert_array_equal(cloud.fields["classification"], codes)


def test_extra_dimensions_say_what_they_are_and_hold_no_infinity(change_directory, tmp_path):
    export_changes(change_directory, tmp_path / "laz", "laz")
    for folder in (change_directory, tmp_path / "laz"):
        las = laspy.read(folder / "after_labelled.laz")
        described = {d.name: d.description for d in las.point_format.extra_dimensions}
        assert set(described) >= set(POINT_FIELDS)
        assert all(described.values())
        assert described["instance"] == "object_id of the table, -1 none"
        for name in described:
            assert not np.isinf(las[name]).any()
        assert np.isnan(las["lod95"]).sum() == 50


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


def test_a_shapefile_says_once_how_many_texts_it_cuts(change_directory, tmp_path, caplog, recwarn):
    copy = shutil.copytree(change_directory, tmp_path / "copy")
    table = pd.read_csv(copy / "changes.csv", dtype=str)
    table.loc[[0, 2], "reason"] = "The object is new. " * 20
    table.to_csv(copy / "changes.csv", index=False)
    export_changes(copy, tmp_path / "out", "shp")
    assert [record.message for record in caplog.records if "254" in record.message] == [
        "changes.shp: 2 texts, such as reasons, were cut, because Shapefile allows 254 characters"
    ]
    assert not [warning for warning in recwarn if "truncated" in str(warning.message)]


def test_other_folders_and_kinds_are_refused_and_leave_nothing(change_directory, tmp_path):
    with pytest.raises(InputError, match="not the output of 'subiaco change'"):
        export_changes(tmp_path, tmp_path / "out", "laz")
    with pytest.raises(InputError, match="has no kitti"):
        export_changes(change_directory, tmp_path / "out", "kitti")
    assert not (tmp_path / "out").exists()


def test_heights_above_a_geoid_leave_differences_alone_and_are_named(change_directory, tmp_path):
    grid = tmp_path / "geoid.gtx"
    grid.write_bytes(struct.pack(">4d2i", -33.0, 115.0, 1.0, 1.0, 3, 3) + struct.pack(">9f", *[-30.0] * 9))
    export_changes(change_directory, tmp_path / "plain", "csv")
    export_changes(change_directory, tmp_path / "ahd", "csv", geoid=grid)
    plain, ahd = (pd.read_csv(tmp_path / name / "changes.csv") for name in ("plain", "ahd"))
    np.testing.assert_allclose(ahd["z"] - plain["z"], 30.0, atol=2e-3)
    np.testing.assert_array_equal(ahd["delta_h_m"], plain["delta_h_m"])
    assert json.loads((tmp_path / "ahd/heights.json").read_text())["geoid_grid"] == "geoid.gtx"
    export_changes(change_directory, tmp_path / "laz", "laz", geoid=grid)
    own = read_cloud(change_directory / "after_labelled.ply").world()
    found = read_cloud(tmp_path / "laz/after_labelled.laz").world()
    np.testing.assert_allclose(found - own, np.broadcast_to([0.0, 0.0, 30.0], own.shape), atol=2e-3)
    with pytest.raises(InputError, match="foxglove shows a local frame"):
        export_changes(change_directory, tmp_path / "fox", "foxglove", geoid=grid)
