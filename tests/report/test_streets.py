"""The street of every row in the report, from the lots of the run."""

from __future__ import annotations

import base64
import gzip
import json
import re
from pathlib import Path

import geopandas as gpd
import pytest
from result_scene import SceneConfig
from shapely.geometry import box

from subiaco_change.outputs.directory import ChangeInputs, write_change_directory
from subiaco_change.records import ChangeResult
from subiaco_report.pages import write_pages
from subiaco_report.row_data import places_of, streets_of

CRS = "EPSG:7850"


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A GeoPackage with three lots in two streets, one of them without a name."""
    lots = gpd.GeoDataFrame(
        {"lot": ["1", "2", "3"], "Street_Name": ["Bagot Road", "Bagot Road", None]},
        geometry=[box(0, 0, 10, 10), box(10, 0, 20, 10), box(20, 0, 30, 10)],
        crs=CRS,
    )
    lots.to_file(tmp_path / "changes.gpkg", layer="parcels")
    return tmp_path / "changes.gpkg"


def rows(*west: float) -> gpd.GeoDataFrame:
    return gpd.GeoDataFrame(geometry=[box(x, 1, x + 2, 3) for x in west], crs=CRS)


def test_a_row_has_the_street_of_its_lot_and_none_elsewhere(package: Path) -> None:
    table = rows(25, 12, 1, 50)
    assert streets_of(table, package) == ["", "Bagot Road", "Bagot Road", ""]
    assert places_of(table, [], package)[:3] == ["3", "2", "1"]


def test_lots_that_name_no_street_give_none(package: Path) -> None:
    lots = gpd.read_file(package, layer="parcels").drop(columns="Street_Name")
    lots.to_file(package, layer="parcels")
    assert streets_of(rows(1), package) == []


def test_the_report_of_a_run_with_streets_filters_by_them(tmp_path: Path, result: ChangeResult) -> None:
    first = result.records[0].footprint
    lots = gpd.GeoDataFrame(
        {"lot": ["7"], "street": ["Bagot Road"]}, geometry=[first.buffer(1.0)], crs=result.after.crs
    )
    target = tmp_path / "out"
    write_change_directory(target, result, SceneConfig(), ChangeInputs(lots=lots), write_pages=write_pages)
    html = (target / "report.html").read_text(encoding="utf-8")
    assert '<select id="f-street"><option value="">all</option><option>Bagot Road</option></select>' in html
    packed = re.search(r'id="data">([^<]*)<', html)
    assert packed is not None
    rows = json.loads(gzip.decompress(base64.b64decode(packed.group(1))))["rows"]
    streets = dict(zip(rows["object_id"], rows["street"], strict=True))
    assert streets[result.records[0].object_id] == "Bagot Road"
    assert "" in streets.values()
