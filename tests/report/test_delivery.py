"""A delivery is read with other programs: rasters, volumes, metadata, checksums, accuracy statement."""

import json
import re
import shutil
import subprocess
import xml.etree.ElementTree as ET
from datetime import date

import geopandas as gpd
import laspy
import numpy as np
import pandas as pd
import pytest
import rasterio
from result_scene import ORIGIN
from shapely.geometry import box

from subiaco_bringup.cli.main import run
from subiaco_change.outputs.difference_rasters import BANDS, cut_and_fill, write_difference_rasters
from subiaco_geo.errors import InputError
from subiaco_report.accuracy import accuracy_facts, read_check
from subiaco_report.delivery import Delivery, deliver

EAST, NORTH = ORIGIN[:2]
STRIP = box(EAST + 75, NORTH + 10, EAST + 85, NORTH + 16)  # raised by 0.25 m
GMD = "{http://www.isotc211.org/2005/gmd}"
GCO = "{http://www.isotc211.org/2005/gco}"


@pytest.fixture(scope="module")
def rasters(change_directory, tmp_path_factory):
    target = tmp_path_factory.mktemp("rasters")
    return write_difference_rasters(change_directory, target)


def test_rasters_are_cloud_optimised_and_hold_both_epochs_and_their_difference(rasters):
    for path in rasters:
        with rasterio.open(path) as dataset:
            assert dataset.descriptions == BANDS
            assert dataset.crs.to_epsg() == 7850
            assert dataset.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
            difference, lod95, before, after = dataset.read()
        known = np.isfinite(before) & np.isfinite(after)
        np.testing.assert_array_equal(np.isfinite(difference), known)
        np.testing.assert_allclose(difference[known], (after - before)[known], atol=1e-5)
        assert np.nanmin(lod95) > 0.0


def test_the_ground_rose_where_it_was_raised_and_the_surface_where_a_storey_was_built(rasters):
    surface, ground = rasters
    with rasterio.open(ground) as dataset:
        inside, outside = (EAST + 80.25, NORTH + 13.25), (EAST + 70.25, NORTH + 13.25)
        assert next(dataset.sample([inside], indexes=1))[0] == pytest.approx(0.25, abs=1e-3)
        assert next(dataset.sample([outside], indexes=1))[0] == pytest.approx(0.0, abs=1e-3)
    with rasterio.open(surface) as dataset:
        band, transform = dataset.read(1), dataset.transform
    column, row = (int(v) for v in ~transform * (EAST + 16.0, NORTH + 49.5))
    assert np.nanmedian(band[row - 4 : row + 4, column - 4 : column + 4]) == pytest.approx(3.0, abs=0.5)


def test_fill_is_the_raised_volume_with_the_uncertainty_of_common_and_own_errors(rasters):
    lots = gpd.GeoDataFrame(
        {"owner": ["Ng", "Hay", "far"]},
        geometry=[STRIP.buffer(1.0, join_style="mitre"), box(EAST, NORTH + 20, EAST + 8, NORTH + 30),
                  box(EAST - 900, NORTH, EAST - 890, NORTH + 9)],
        crs="EPSG:7850",
    )  # fmt: skip
    volumes = cut_and_fill(rasters[1], lots, sigma_common=0.01).set_index("owner")
    assert volumes.loc["Ng", "fill_m3"] == pytest.approx(15.0, abs=0.01)
    assert volumes.loc["Ng", "cut_m3"] == 0.0
    assert volumes.loc["Ng", "changed_m2"] == 60.0
    assert volumes.loc["Ng", "compared_fraction"] == pytest.approx(1.0, abs=0.02)
    common = 1.96 * 0.01 * 96.0  # of all compared cells, a metre around the strip too
    assert common < volumes.loc["Ng", "net_95_m3"] < 1.2 * common
    assert volumes.loc["Hay", ["fill_m3", "cut_m3"]].tolist() == [0.0, 0.0]
    assert volumes.loc["Hay", "net_95_m3"] > 1.96 * 0.01 * 60.0  # that nothing was found is uncertain too
    assert volumes.loc["far", "compared_m2"] == 0.0
    assert np.isnan(volumes.loc["far", "net_95_m3"])
    less = cut_and_fill(rasters[1], lots, sigma_common=0.0).set_index("owner")
    assert less.loc["Ng", "net_95_m3"] < volumes.loc["Ng", "net_95_m3"]


def test_polygons_in_another_system_are_refused(rasters):
    lots = gpd.GeoDataFrame(geometry=[box(115, -32, 116, -31)], crs="EPSG:4326")
    with pytest.raises(InputError, match="another CRS"):
        cut_and_fill(rasters[1], lots, 0.01)


@pytest.fixture(scope="module")
def delivered(change_directory, tmp_path_factory):
    folder = tmp_path_factory.mktemp("delivery")
    lots = gpd.GeoDataFrame({"name": ["strip"]}, geometry=[STRIP], crs="EPSG:7850")
    lots.to_file(folder / "lots.gpkg")
    check = {"points": 31, "horizontal_points": 30, "rmse_horizontal_m": 0.03, "vertical_points": 31,
             "rmse_vertical_m": 0.02}  # fmt: skip
    (folder / "check.json").write_text(json.dumps(check))
    wanted = Delivery(
        polygons=folder / "lots.gpkg", check=folder / "check.json", cell=1.0, created=date(2025, 7, 1)
    )
    return folder / "out", deliver(change_directory, folder / "out", wanted)


def test_every_file_is_in_the_manifest_with_its_checksum(delivered):
    folder, files = delivered
    held = sorted(p.relative_to(folder) for p in folder.rglob("*") if p.is_file())
    assert sorted(files) == held
    manifest = pd.read_csv(folder / "manifest.csv")
    assert len(manifest) == len(held) - 2
    assert all((folder / row.file).stat().st_size == row.bytes for row in manifest.itertuples())
    if shutil.which("sha256sum"):
        checked = subprocess.run(["sha256sum", "-c", "SHA256SUMS", "--quiet"], cwd=folder, check=False)
        assert checked.returncode == 0


def test_its_parts_open_with_other_programs(delivered, result):
    folder, _ = delivered
    assert len(gpd.read_file(folder / "changes" / "changes.shp")) == len(result.records)
    with laspy.CopcReader.open(folder / "clouds" / "after_labelled.copc.laz") as reader:
        assert reader.header.point_count == len(result.after)
    with rasterio.open(folder / "rasters" / "surface_difference.tif") as dataset:
        assert dataset.res == (1.0, 1.0)
    volumes = gpd.read_file(folder / "volumes" / "volumes.gpkg").set_index("lot")
    assert volumes.loc["strip", "fill_m3"] == pytest.approx(15.0, abs=0.01)
    assert "report.html" in (folder / "README.txt").read_text()
    assert (folder / "report" / "report.html").is_file()


def test_the_metadata_name_system_extent_day_and_accuracy(delivered):
    root = ET.parse(delivered[0] / "metadata.xml").getroot()
    assert root.tag == f"{GMD}MD_Metadata"
    texts = [element.text for element in root.iter(f"{GCO}CharacterString")]
    assert "EPSG:7850" in texts
    assert root.findtext(f"{GMD}dateStamp/{GCO}Date") == "2025-07-01"
    west, east, south, north = (float(e.text) for e in root.iter(f"{GCO}Decimal"))
    assert 115.0 < west < east < 116.0
    assert -32.5 < south < north < -31.5
    assert float(next(root.iter(f"{GCO}Record")).text) == pytest.approx(0.035, abs=0.01)


#: Children of the types that we write, in the order and number of the schema of ISO 19139 (gmd, 2007):
#: ``?`` at most one, ``*`` any number, ``+`` one or more, else exactly one.
SEQUENCES = {
    "MD_Metadata": "fileIdentifier? language? characterSet? parentIdentifier? "
    "hierarchyLevel* hierarchyLevelName* contact+ dateStamp "
    "metadataStandardName? metadataStandardVersion? dataSetURI? "
    "locale* spatialRepresentationInfo* referenceSystemInfo* "
    "metadataExtensionInfo* identificationInfo+ contentInfo* "
    "distributionInfo? dataQualityInfo* portrayalCatalogueInfo* "
    "metadataConstraints* applicationSchemaInfo* "
    "metadataMaintenance? series* describes* propertyType* "
    "featureType* featureAttribute*",
    "CI_ResponsibleParty": "individualName? organisationName? positionName? contactInfo? role",
    "MD_ReferenceSystem": "referenceSystemIdentifier?",
    "RS_Identifier": "authority? code codeSpace? version?",
    "MD_DataIdentification": "citation abstract purpose? credit* status* pointOfContact* "
    "resourceMaintenance* graphicOverview* resourceFormat* "
    "descriptiveKeywords* resourceSpecificUsage* "
    "resourceConstraints* aggregationInfo* "
    "spatialRepresentationType* spatialResolution* language+ "
    "characterSet* topicCategory* environmentDescription? extent* "
    "supplementalInformation?",
    "CI_Citation": "title alternateTitle* date+ edition? editionDate? identifier* "
    "citedResponsibleParty* presentationForm* series? "
    "otherCitationDetails? collectiveTitle? ISBN? ISSN?",
    "CI_Date": "date dateType",
    "EX_Extent": "description? geographicElement* temporalElement* verticalElement*",
    "EX_GeographicBoundingBox": "extentTypeCode? westBoundLongitude eastBoundLongitude "
    "southBoundLatitude northBoundLatitude",
    "DQ_DataQuality": "scope report* lineage?",
    "DQ_Scope": "level extent* levelDescription*",
    "DQ_RelativeInternalPositionalAccuracy": "nameOfMeasure* measureIdentification? measureDescription? "
    "evaluationMethodType? evaluationMethodDescription? "
    "evaluationProcedure? dateTime* result+",
    "DQ_QuantitativeResult": "valueType? valueUnit errorStatistic? value+",
    "LI_Lineage": "statement? processStep* source*",
}
CODES = {"MD_ScopeCode", "CI_RoleCode", "CI_DateTypeCode"}


def test_the_metadata_have_the_elements_of_iso_19139_in_their_order_and_number(delivered):
    root = ET.parse(delivered[0] / "metadata.xml").getroot()
    types = [e for e in root.iter() if e.tag.removeprefix(GMD)[:3].rstrip("_").isupper()]
    for element in types:
        name = element.tag.removeprefix(GMD)
        if name in CODES:
            assert element.get("codeList", "").endswith(f"#{name}")
            assert element.get("codeListValue") == element.text
        elif name == "MD_TopicCategoryCode":
            assert element.attrib == {}
            assert element.text == "imageryBaseMapsEarthCover"
        else:
            children = "".join(child.tag.removeprefix(GMD) + " " for child in element)
            parts = re.findall(r"(\w+)([?*+]?)", SEQUENCES[name])
            pattern = "".join(f"(?:{part} ){often}" for part, often in parts)
            assert re.fullmatch(pattern, children), f"{name}: {children}"
            properties = [child for child in element if not child.text or not child.text.strip()]
            assert all(len(child) == 1 for child in properties if child.tag != f"{GMD}valueUnit"), name
    assert {e.tag.removeprefix(GMD) for e in types} >= set(SEQUENCES)


def test_the_accuracy_statement_gives_95_percent_values_by_the_published_factors(delivered):
    text = " ".join((delivered[0] / "accuracy.html").read_text(encoding="utf-8").split())
    assert "GDA2020 / MGA zone 50 (EPSG:7850)" in text
    assert "5.2 cm" in text  # 1.7308 x 3 cm
    assert "3.9 cm" in text  # 1.96 x 2 cm
    assert "Fewer than 30" not in text
    assert "Signature" in text


def test_without_control_nothing_is_called_tested(change_directory):
    run_facts = json.loads((change_directory / "run.json").read_text())
    registration = json.loads((change_directory / "registration.json").read_text())
    facts = accuracy_facts(run_facts, registration, None)
    assert facts["control"] is None
    assert facts["relative"]["vertical_95_m"] == pytest.approx(1.96 * 0.004)
    assert facts["relative"]["horizontal_95_m"] == pytest.approx(2.4477 * 0.002)
    few = {"points": 5, "horizontal_points": 0, "rmse_horizontal_m": None, "vertical_points": 5,
           "rmse_vertical_m": 0.02}  # fmt: skip
    assert not accuracy_facts(run_facts, registration, few)["control"]["enough"]


def test_what_cannot_be_delivered_is_refused_and_leaves_nothing(change_directory, tmp_path, capsys):
    (tmp_path / "check.json").write_text("{}")
    with pytest.raises(InputError, match="not the output of 'subiaco check --json'"):
        read_check(tmp_path / "check.json")
    words = ["deliver", str(change_directory), "-o", str(tmp_path / "out"), "--without-clouds"]
    assert run([*words, "--cell", "-1"]) == 2
    assert "--cell -1.0: must be larger than 0" in capsys.readouterr().err
    assert run([*words, "--review", "some"]) == 2
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("verb", ["report", "deliver", "review"])
def test_a_change_directory_without_its_geopackage_is_refused_in_one_line(
    change_directory, tmp_path, capsys, verb
):
    partial = shutil.ignore_patterns("changes.gpkg", "viewer")
    shutil.copytree(change_directory, tmp_path / "copy", ignore=partial)
    files = sorted((tmp_path / "copy").rglob("*"))
    words = [verb, str(tmp_path / "copy"), *(["-o", str(tmp_path / "out")] if verb == "deliver" else [])]
    assert run(words) == 2
    assert "changes.gpkg: the file is missing; run 'subiaco change' again" in capsys.readouterr().err
    assert sorted((tmp_path / "copy").rglob("*")) == files
    assert not (tmp_path / "out").exists()


def test_cells_without_an_area_are_refused_before_anything_is_written(
    change_directory, tmp_path, monkeypatch
):
    monkeypatch.setattr("subiaco_report.delivery._copy", lambda *_: pytest.fail("the work began"))
    with pytest.raises(InputError, match="--cell -1"):
        deliver(change_directory, tmp_path / "out", Delivery(cell=-1.0))
