"""Ground model, surface model, hillshade and contours of a map, read with other programs."""

import geopandas as gpd
import numpy as np
import pandas as pd
import pyogrio
import pytest
import rasterio
from shapely.geometry import LineString

from subiaco_bringup.cli.main import run
from subiaco_change.outputs.terrain import export_terrain
from subiaco_geo.clouds import from_world
from subiaco_geo.errors import InputError
from subiaco_geo.maps import write_map
from subiaco_geo.survey_map import SurveyMap
from subiaco_geo.trajectories import Trajectory

EAST, NORTH = 391_000.0, 6_464_000.0


def height(x):
    """A slope of 5 % to the east."""
    return 20.0 + 0.05 * (x - EAST)


@pytest.fixture(scope="module")
def terrain(tmp_path_factory):
    """A slope of 60 m x 40 m with a house of 10 m x 8 m, 4 m high."""
    x, y = (v.ravel() for v in np.meshgrid(np.arange(0.1, 60.0, 0.25), np.arange(0.1, 40.0, 0.25)))
    inside = (x > 25) & (x < 35) & (y > 16) & (y < 24)
    z = height(x + EAST) + np.where(inside, 4.0, 0.0)
    world = np.column_stack([x + EAST, y + NORTH, z])
    folder = tmp_path_factory.mktemp("terrain")
    times = np.arange(2, dtype=np.int64)
    survey = SurveyMap(from_world(world, "EPSG:7850"), Trajectory(times, np.tile(np.eye(4), (2, 1, 1))))
    write_map(folder / "map", survey)
    line = LineString([(EAST + 5, NORTH + 20), (EAST + 55, NORTH + 20)])
    across = LineString([(EAST + 30, NORTH - 10), (EAST + 30, NORTH + 30)])
    lines = gpd.GeoDataFrame(geometry=[line, across], crs="EPSG:7850").to_crs("EPSG:4326")
    lines.to_file(folder / "lines.geojson")
    command = ["export", str(folder / "map"), "--to", "terrain", "-o", str(folder / "out"), "-q"]
    assert run([*command, "--sections", str(folder / "lines.geojson")]) == 0
    return folder / "out"


def sampled(path, x, y):
    with rasterio.open(path) as dataset:
        assert dataset.crs.to_epsg() == 7850
        assert dataset.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        return float(next(dataset.sample([(EAST + x, NORTH + y)]))[0])


def test_the_ground_runs_under_the_house_and_the_surface_over_it(terrain):
    for x, y in ((10.25, 10.25), (50.25, 30.25)):
        assert sampled(terrain / "dtm.tif", x, y) == pytest.approx(height(EAST + x), abs=0.03)
        assert sampled(terrain / "dsm.tif", x, y) == pytest.approx(height(EAST + x), abs=0.03)
    assert sampled(terrain / "dsm.tif", 30.25, 20.25) == pytest.approx(height(EAST + 30.25) + 4.0, abs=0.03)
    under = sampled(terrain / "dtm.tif", 26.25, 20.25)
    assert np.isnan(under) or under == pytest.approx(height(EAST + 26.25), abs=0.1)


def test_sections_follow_ground_and_surface_along_their_lines(terrain):
    table = pd.read_csv(terrain / "sections.csv")
    first = table[table["section"] == 1]
    assert first["chainage_m"].iloc[[0, -1]].tolist() == pytest.approx([0.0, 50.0], abs=0.01)
    assert np.allclose(first["east"], EAST + 5 + first["chainage_m"], atol=0.01)
    roof = first["chainage_m"].between(21, 29)
    assert np.allclose(first["surface_m"][roof], height(first["east"][roof]) + 4.0, atol=0.05)
    start = first[first["chainage_m"] < 15]
    assert np.allclose(start["surface_m"], height(start["east"]), atol=0.05)
    second = table[table["section"] == 2]
    assert second["surface_m"][second["north"] < NORTH - 1].isna().all()
    shapes = gpd.read_file(terrain / "sections.gpkg")
    assert shapes.crs.to_epsg() == 7850
    assert set(shapes["model"]) == {"ground", "surface"}
    assert shapes.geometry.has_z.all()
    drawing = pyogrio.read_dataframe(terrain / "sections.dxf")
    assert set(drawing["Layer"]) == {"GROUND", "SURFACE"}
    west, _, east, top = drawing[drawing["Layer"] == "SURFACE"].total_bounds
    assert top == pytest.approx(table["surface_m"].max(), abs=0.01)
    assert west == pytest.approx(0.0, abs=0.01)
    assert east == pytest.approx(50.0 + 10.0 + 40.0, abs=0.6)  # the second section is beside the first


def test_a_file_without_lines_is_refused(terrain, tmp_path):
    (tmp_path / "none.geojson").write_text('{"type": "FeatureCollection", "features": []}')
    with pytest.raises(InputError, match="holds no line"):
        export_terrain(terrain.parent / "map", tmp_path / "out", sections=tmp_path / "none.geojson")
    assert not (tmp_path / "out").exists()


def test_the_shade_is_known_where_the_surface_is_and_flat_ground_has_one_tone(terrain):
    with rasterio.open(terrain / "hillshade.tif") as shade, rasterio.open(terrain / "dsm.tif") as dsm:
        assert shade.dtypes == ("uint8",)
        tones, heights = shade.read(1), dsm.read(1)
    np.testing.assert_array_equal(tones > 0, np.isfinite(heights))
    assert np.ptp(tones[5:20, 10:40].astype(int)) <= 12
    assert np.ptp(tones.astype(int)) > 60


def test_contours_lie_at_their_heights_in_both_files(terrain):
    lines = gpd.read_file(terrain / "contours.gpkg", layer="contours")
    assert lines.crs.to_epsg() == 7850
    assert {20.5, 21.0, 21.5, 22.0, 22.5} <= set(lines["height_m"])
    for row in lines.itertuples():
        x = np.array(row.geometry.coords)[:, 0]
        away = np.abs(x - (EAST + (row.height_m - 20.0) / 0.05))
        assert np.median(away) < 0.8  # 5 % slope: 4 cm of height
    drawn = pyogrio.read_dataframe(terrain / "contours.dxf")
    assert len(drawn) == len(lines)
    assert set(drawn["Layer"]) == {"CONTOUR"}
    assert drawn.geometry.length.sum() == pytest.approx(lines.geometry.length.sum(), rel=1e-3)


def test_cells_and_intervals_must_be_positive(terrain, tmp_path):
    with pytest.raises(InputError, match="larger than 0"):
        export_terrain(terrain.parent / "map", tmp_path / "a", cell=0.0)
    with pytest.raises(InputError, match="is no interval"):
        export_terrain(terrain.parent / "map", tmp_path / "b", interval=0.0)
    assert list(tmp_path.iterdir()) == []
