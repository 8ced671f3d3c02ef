"""The QGIS project names every layer that is there, by relative path, in the right CRS and colours."""

import xml.etree.ElementTree as ET

import geopandas as gpd
import pytest
from pyproj import CRS
from result_scene import SceneConfig
from shapely.geometry import box

from subiaco_change.outputs.directory import ChangeInputs, write_change_directory
from subiaco_change.outputs.qgis_project import write_project
from subiaco_change.records import CHANGE_COLOURS
from subiaco_geo.codes import Change


def parsed(directory):
    return ET.fromstring((directory / "changes.qgs").read_text().split("\n", 1)[1])


@pytest.fixture(scope="module")
def project(change_directory):
    return parsed(change_directory)


def test_it_names_the_layers_by_relative_paths_to_files_that_are_there(project, change_directory):
    sources = [layer.findtext("datasource") for layer in project.iter("maplayer")]
    names = {source.split("layername=")[-1] for source in sources}
    assert names == {
        "ground", "objects", "coverage", "./ground_change.tif", "./lod95.tif", "./coverage.tif",
        "./after_labelled.laz", "./before_labelled.laz",
    }  # fmt: skip
    for source in sources:
        assert source.startswith("./")
        assert (change_directory / source.split("|")[0]).is_file()
    assert project.findtext("properties/Paths/Absolute") == "false"
    assert str(change_directory) not in (change_directory / "changes.qgs").read_text()


def test_every_layer_of_the_tree_is_a_layer_of_the_project_with_its_provider(project):
    kinds = {layer.findtext("id"): layer for layer in project.iter("maplayer")}
    tree = list(project.iter("layer-tree-layer"))
    assert [entry.get("id") for entry in tree] == list(kinds)
    provider = {"vector": "ogr", "raster": "gdal", "point-cloud": "pdal"}
    style = {"vector": "renderer-v2", "raster": "pipe/rasterrenderer", "point-cloud": "renderer"}
    for entry in tree:
        layer = kinds[entry.get("id")]
        assert entry.get("providerKey") == layer.findtext("provider") == provider[layer.get("type")]
        assert layer.find(style[layer.get("type")]) is not None
        assert entry.get("source") == layer.findtext("datasource")


def test_the_system_is_that_of_the_maps_everywhere(project):
    systems = list(project.iter("spatialrefsys"))
    assert len(systems) == 2 + len(list(project.iter("maplayer")))
    assert {s.findtext("authid") for s in systems} == {"EPSG:7850"}
    assert CRS.from_wkt(systems[0].findtext("wkt")) == CRS.from_epsg(7850)


def test_objects_have_the_colours_of_the_paper(project):
    (objects,) = (m for m in project.iter("maplayer") if m.findtext("layername") == "objects")
    symbols = {s.get("name"): s.find(".//Option[@name='color']").get("value") for s in objects.iter("symbol")}
    for category in objects.iter("category"):
        rgb = CHANGE_COLOURS[next(c for c in Change if c.label == category.get("value"))]
        assert symbols[category.get("symbol")].startswith(",".join(map(str, rgb)))


def test_it_opens_on_the_place_surveyed(project, result):
    extent = {e.tag: float(e.text) for e in project.find("mapcanvas/extent")}
    low, high = result.after.world()[:, :2].min(axis=0), result.after.world()[:, :2].max(axis=0)
    assert extent["xmin"] <= low[0] <= high[0] <= extent["xmax"]
    assert extent["ymin"] <= low[1] <= high[1] <= extent["ymax"]
    assert extent["xmax"] - extent["xmin"] < high[0] - low[0] + 10.0


def test_lots_are_a_layer_where_they_were_given(result, tmp_path, cheap_report):
    x, y = result.records[0].x, result.records[0].y
    shapes = [box(x - 9, y - 9, x + 9, y + 9)]
    lots = gpd.GeoDataFrame({"lot": ["7"]}, geometry=shapes, crs=result.after.crs)
    write_change_directory(tmp_path / "out", result, SceneConfig(), ChangeInputs(lots=lots))
    (layer,) = (m for m in parsed(tmp_path / "out").iter("maplayer") if m.findtext("layername") == "parcels")
    assert layer.find("renderer-v2").get("attr") == "net_m3"


def test_local_coordinates_name_no_system(change_directory, tmp_path):
    (tmp_path / "changes.gpkg").write_bytes((change_directory / "changes.gpkg").read_bytes())
    write_project(tmp_path, None, (0.0, 0.0, 10.0, 10.0))
    project = parsed(tmp_path)
    assert list(project.iter("spatialrefsys")) == []
    assert len(list(project.iter("maplayer"))) == 3
