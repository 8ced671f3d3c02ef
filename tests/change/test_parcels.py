"""Lots: the rows add up to the table, and what was not looked at says so."""

from __future__ import annotations

from pathlib import Path

import geopandas as gpd
import numpy as np
import pytest
from shapely.geometry import box

from subiaco_change.outputs.parcels import (
    OUTSIDE,
    build_parcels,
    coverage_polygons,
    read_lots,
    refuse_lots_elsewhere,
)
from subiaco_change.outputs.rasters import Coverage
from subiaco_geo.errors import InputError

CRS = "EPSG:7850"
EAST, NORTH = 391_000.0, 6_464_000.0


def square(x: float, y: float, width: float, height: float = 10.0):
    return box(EAST + x, NORTH + y, EAST + x + width, NORTH + y + height)


def made_table() -> gpd.GeoDataFrame:
    """A shed on lot A, an extension over both lots, a bin on the road, an unchanged house on B."""
    rows = [
        ("Added", 30.0, square(2, 2, 3, 3)),
        ("Increased", 40.0, square(15, 2, 8, 2)),  # 5 m on A, 3 m on B
        ("Removed", -2.0, square(-5, 1, 2, 1)),
        ("Unchanged", 9.0, square(30, 2, 4, 4)),
        ("Unobserved", np.nan, square(25, 8, 1, 1)),
    ]
    label, volume, geometry = zip(*rows, strict=True)
    return gpd.GeoDataFrame({"label": label, "delta_v_m3": volume}, geometry=list(geometry), crs=CRS)


def lots() -> gpd.GeoDataFrame:
    return gpd.GeoDataFrame({"lot": ["A", "B"]}, geometry=[square(0, 0, 20), square(20, 0, 20)], crs=CRS)


def coverage() -> Coverage:
    """Both epochs saw lot A; only the first saw the west half of B; nobody saw the rest."""
    code = np.zeros((10, 40), dtype=np.uint8)
    code[:, :20], code[:, 20:30] = 1, 2
    return Coverage(code, np.full((10, 40), 0.12, dtype=np.float32), EAST, NORTH + 10, 1.0)


def test_every_lot_has_a_row_and_the_rows_add_up_to_the_table():
    rows = build_parcels(made_table(), lots(), coverage()).set_index("lot")
    assert list(rows.index) == ["A", "B", OUTSIDE]
    assert rows.loc["A", ["added", "increased", "removed"]].tolist() == [1, 1, 0]
    assert rows.loc["B", ["unchanged", "unobserved"]].tolist() == [1, 1]
    assert rows.loc[OUTSIDE, "removed"] == 1
    np.testing.assert_allclose(rows["net_m3"], [30 + 40 * 5 / 8, 40 * 3 / 8, -2])
    np.testing.assert_allclose(rows["changed_m2"], [9 + 10, 6, 2])
    assert rows[["added", "removed", "increased", "decreased", "unchanged", "unobserved"]].sum().sum() == 5


def test_a_lot_that_was_half_seen_by_one_epoch_alone_is_not_observed():
    rows = build_parcels(made_table(), lots(), coverage()).set_index("lot")
    assert rows.loc["A", "observed_fraction"] == 1.0
    assert rows.loc["B", "observed_fraction"] == 0.0


def test_lots_that_overlap_divide_a_footprint_and_add_up_still():
    twice = gpd.GeoDataFrame({"lot": ["A", "A again"]}, geometry=[square(0, 0, 20)] * 2, crs=CRS)
    rows = build_parcels(made_table(), twice, coverage())
    assert rows["net_m3"].sum() == pytest.approx(68.0)


def test_coverage_polygons_have_the_areas_of_the_raster():
    layer = coverage_polygons(coverage(), CRS).set_index("seen")
    assert layer.loc["both", "area_m2"] == layer.loc["both"].geometry.area == 200.0
    assert layer.loc["only before"].geometry.bounds == pytest.approx(
        (EAST + 20, NORTH, EAST + 30, NORTH + 10)
    )
    assert layer["lod95_m"].tolist() == pytest.approx([0.12, 0.12], abs=1e-4)


def test_lots_in_another_system_are_brought_to_the_table_and_keep_their_names(tmp_path: Path):
    path = tmp_path / "lots.geojson"
    frame = lots().rename(columns={"lot": "LOT_ID"}).to_crs("EPSG:7844")
    frame.to_file(path, driver="GeoJSON", engine="pyogrio")
    read = read_lots(path, CRS)
    assert read["lot"].tolist() == ["A", "B"]
    np.testing.assert_allclose(read.geometry.area, 200.0, rtol=1e-3)


@pytest.mark.parametrize(("crs", "words"), [(None, "maps have no CRS"), (CRS, "no lots could be read")])
def test_lots_that_cannot_be_placed_or_read_are_refused(tmp_path: Path, crs: str | None, words: str):
    (tmp_path / "lots.gpkg").write_text("not a package")
    with pytest.raises(InputError, match=words):
        read_lots(tmp_path / "lots.gpkg", crs)


def test_lots_of_which_none_touches_the_later_map_are_refused_with_both_extents(tmp_path: Path):
    low, high = np.array([EAST, NORTH]), np.array([EAST + 15.0, NORTH + 10.0])
    refuse_lots_elsewhere(tmp_path, lots(), low, high)
    away = np.array([100_000.0, 0.0])
    told = "the lots span E 391000 to 391040, N 6464000 to 6464010, the map E 491000 to 491015"
    with pytest.raises(InputError, match=f"{told}.*check the CRS"):
        refuse_lots_elsewhere(tmp_path, lots(), low + away, high + away)
