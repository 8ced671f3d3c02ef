"""The QGIS project names every layer that is there, by relative path, in the right CRS and colours."""

import json
import shutil
import sqlite3
import subprocess
import xml.etree.ElementTree as ET
from pathlib import Path

import geopandas as gpd
import pytest
from pyproj import CRS
from result_scene import SceneConfig
from shapely.geometry import box

from subiaco_change.outputs.directory import ChangeInputs, write_change_directory
from subiaco_change.records import CHANGE_COLOURS
from subiaco_geo.codes import Change
from subiaco_report.pages import write_pages
from subiaco_report.qgis_project import write_project


def parsed(directory):
    return ET.fromstring((directory / "changes.qgs").read_text().split("\n", 1)[1])


@pytest.fixture(scope="module")
def project(change_directory):
    return parsed(change_directory)


def test_it_names_the_layers_by_relative_paths_to_files_that_are_there(project, change_directory):
    sources = [layer.findtext("datasource") for layer in project.iter("maplayer")]
    names = {source.split("layername=")[-1] for source in sources}
    assert names == {
        "ground", "objects", "objects|subset=\"review\" = 'accepted'", "coverage",
        "./ground_change.tif", "./lod95.tif", "./coverage.tif",
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
    (objects,) = (m for m in project.iter("maplayer") if m.findtext("layername") == "Objects")
    symbols = {s.get("name"): s.find(".//Option[@name='color']").get("value") for s in objects.iter("symbol")}
    for category in objects.iter("category"):
        if category.get("value") == "rejected":  # an outline alone
            assert symbols[category.get("symbol")].endswith(",0")
            continue
        rgb = CHANGE_COLOURS[next(c for c in Change if c.label == category.get("value"))]
        assert symbols[category.get("symbol")].startswith(",".join(map(str, rgb)))


def test_it_opens_on_the_place_surveyed(project, result):
    extent = {e.tag: float(e.text) for e in project.find("mapcanvas/extent")}
    low, high = result.after.world()[:, :2].min(axis=0), result.after.world()[:, :2].max(axis=0)
    assert extent["xmin"] <= low[0] <= high[0] <= extent["xmax"]
    assert extent["ymin"] <= low[1] <= high[1] <= extent["ymax"]
    assert extent["xmax"] - extent["xmin"] < high[0] - low[0] + 10.0


def test_lots_are_a_layer_where_they_were_given(result, tmp_path):
    x, y = result.records[0].x, result.records[0].y
    shapes = [box(x - 9, y - 9, x + 9, y + 9)]
    lots = gpd.GeoDataFrame({"lot": ["7"]}, geometry=shapes, crs=result.after.crs)
    write_change_directory(
        tmp_path / "out", result, SceneConfig(), ChangeInputs(lots=lots), write_pages=write_pages
    )
    (layer,) = (
        m for m in parsed(tmp_path / "out").iter("maplayer") if m.findtext("layername") == "Changes by lot"
    )
    assert layer.find("renderer-v2").get("attr") == "net_m3"


def test_local_coordinates_name_no_system(change_directory, tmp_path):
    (tmp_path / "changes.gpkg").write_bytes((change_directory / "changes.gpkg").read_bytes())
    write_project(tmp_path, None, (0.0, 0.0, 10.0, 10.0))
    project = parsed(tmp_path)
    assert list(project.iter("spatialrefsys")) == []
    assert len(list(project.iter("maplayer"))) == 4
    assert project.findtext("properties/SpatialRefSys/ProjectionsEnabled") == "0"


def test_the_project_has_a_crs_and_its_layers_stand_in_groups_with_names_for_people(project):
    assert project.findtext("properties/SpatialRefSys/ProjectionsEnabled") == "1"
    groups = {
        group.get("name"): [layer.get("name") for layer in group.findall("layer-tree-layer")]
        for group in project.findall("layer-tree-group/layer-tree-group")
    }
    assert groups == {
        "Changes": ["Changed ground", "Objects", "Accepted changes"],
        "Coverage and accuracy": [
            "What each survey saw", "Level of detection [m]", "What each survey saw, cells",
            "Change of ground height [m]",
        ],
        "Point clouds": ["Points of the later survey", "Points of the earlier survey"],
    }  # fmt: skip


def test_the_form_offers_accepted_and_rejected_and_lets_nothing_else_be_edited(project, change_directory):
    (objects,) = (m for m in project.iter("maplayer") if m.findtext("layername") == "Objects")
    fields = objects.findall("fieldConfiguration/field")
    (review,) = (field for field in fields if field.get("name") == "review")
    assert review.find("editWidget").get("type") == "ValueMap"
    offered = review.find(".//Option[@type='List']").findall("Option/Option")
    assert {option.get("value") for option in offered} == {"", "accepted", "rejected"}
    editable = {f.get("name") for f in objects.find("editable") if f.get("editable") == "1"}
    assert editable == {"review", "reviewer", "note"}
    assert objects.get("labelsEnabled") == "1"
    assert "object_id" in objects.find("labeling/settings/text-style").get("fieldName")
    with sqlite3.connect(change_directory / "changes.gpkg") as connection:
        (style,) = connection.execute(
            "select styleQML from layer_styles where f_table_name = 'objects'"
        ).fetchone()
    assert ET.fromstring(style.split("\n", 1)[1]).find(".//editWidget[@type='ValueMap']") is not None


#: What the system's Python does with a project, where it has QGIS.
QGIS = """
import json, sys
from qgis.core import QgsApplication, QgsProject
application = QgsApplication([], False)
application.initQgis()
project = QgsProject.instance()
said = {"read": project.read(sys.argv[1]), "crs": project.crs().authid()}
layers = project.mapLayers().values()
said["valid"] = {layer.name(): layer.isValid() for layer in layers}
said["systems"] = sorted({layer.crs().authid() for layer in layers if layer.isValid()})
said["groups"] = [group.name() for group in project.layerTreeRoot().children()]
(objects,) = project.mapLayersByName("Objects")
said["features"] = objects.featureCount()
said["widget"] = objects.editorWidgetSetup(objects.fields().indexOf("review")).type()
said["labels"] = objects.labelsEnabled()
said["renderer"] = objects.renderer().type()
print(json.dumps(said), flush=True)
"""
PLAIN = {"PATH": "/usr/bin:/bin", "QT_QPA_PLATFORM": "offscreen", "HOME": "/tmp", "LC_ALL": "C.UTF-8"}


def system_python(*words):
    """Run the system's Python without the packages and variables of ours."""
    command = ["/usr/bin/python3", "-c", *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False, env=PLAIN)


def test_a_real_qgis_opens_the_project_with_valid_layers(change_directory, result, tmp_path):
    if not Path("/usr/bin/python3").exists() or system_python("import qgis.core").returncode:
        pytest.skip("the system's Python has no QGIS")
    copied = tmp_path / "changes"
    shutil.copytree(change_directory, copied)
    said = json.loads(system_python(QGIS, str(copied / "changes.qgs")).stdout.splitlines()[-1])
    assert said["read"]
    assert said["crs"] == "EPSG:7850"
    assert said["systems"] == ["EPSG:7850"]
    clouds = {"Points of the later survey", "Points of the earlier survey"}  # a QGIS may lack PDAL
    assert {name for name, valid in said["valid"].items() if not valid} <= clouds
    assert said["groups"] == ["Changes", "Coverage and accuracy", "Point clouds"]
    assert said["features"] == sum(r.semantic.label != "ground" for r in result.records)
    assert said["widget"] == "ValueMap"
    assert said["labels"]
    assert said["renderer"] == "categorizedSymbol"
