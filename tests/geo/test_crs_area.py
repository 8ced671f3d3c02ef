"""A map's CRS is refused where it is not made for."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from subiaco_geo.crs import require_map_crs
from subiaco_geo.crs_area import MAX_SCALE, crs_at, require_inside, scale_factors, suggested
from subiaco_geo.errors import InputError

ELSEWHERE = [
    pytest.param(-33.87, 151.21, "EPSG:7850", "EPSG:7856", id="Sydney in Perth's zone"),
    pytest.param(-34.93, 138.60, "EPSG:7850", "EPSG:7854", id="Adelaide in Perth's zone"),
    pytest.param(49.04, 8.44, "EPSG:7850", "EPSG:25832", id="Karlsruhe in Perth's zone"),
    pytest.param(40.10, -105.15, "EPSG:25832", "EPSG:6342", id="Colorado in Germany's zone"),
    pytest.param(0.0, 0.0, "EPSG:7850", "EPSG:32631", id="a receiver without a solution"),
    pytest.param(-31.95, 115.8, "EPSG:3857", "EPSG:7850", id="web Mercator, 179 m a kilometre"),
]


@pytest.mark.parametrize(("latitude", "longitude", "crs", "better"), ELSEWHERE)
def test_a_place_outside_is_refused_with_crs_place_and_remedy(
    latitude: float, longitude: float, crs: str, better: str
) -> None:
    with pytest.raises(InputError) as refused:
        require_inside(latitude, longitude, crs)
    text = str(refused.value)
    assert "\n" not in text
    assert crs in text
    assert f"{latitude:.4f}" in text
    assert f"--set crs={better}" in text


@pytest.mark.parametrize(
    ("latitude", "longitude", "crs"),
    [
        (-31.948, 115.825, "EPSG:7850"),
        (-31.948, 120.3, "EPSG:7850"),  # a survey across the edge of the zone
        (49.04, 8.44, "EPSG:25832"),
        (48.86, 2.35, "EPSG:2154"),
        (-17.8, -179.9, "EPSG:3460"),  # Fiji: an area across the 180th meridian
    ],
)
def test_a_place_inside_is_taken(latitude: float, longitude: float, crs: str) -> None:
    require_inside(latitude, longitude, crs)


@settings(max_examples=15, deadline=None)  # a search of PROJ's database takes 0.2 s
@given(st.floats(-80, 80), st.floats(-180, 180))
def test_what_is_suggested_is_taken_at_its_own_place(latitude: float, longitude: float) -> None:
    crs = suggested(latitude, longitude)
    require_inside(latitude, longitude, crs)
    assert np.abs(scale_factors(latitude, longitude, require_map_crs(crs)) - 1).max() <= MAX_SCALE


@pytest.mark.parametrize(
    ("latitude", "longitude", "code"),
    [
        pytest.param(-31.95, 115.80, 7850, id="Perth, GDA2020"),
        pytest.param(-42.90, 147.30, 7855, id="Hobart, GDA2020"),
        pytest.param(49.04, 8.44, 25832, id="Karlsruhe, ETRS89"),
        pytest.param(37.77, -122.40, 6339, id="San Francisco, NAD83(2011)"),
        pytest.param(-23.50, -46.60, 31983, id="Sao Paulo, SIRGAS 2000"),
        pytest.param(35.68, 139.70, 6691, id="Tokyo, JGD2011"),
        pytest.param(-1.29, 36.80, 32737, id="Nairobi, whose own datum is 300 m off: WGS 84"),
        pytest.param(82.00, 10.00, 25832, id="the far north, where WGS 72 is near WGS 84"),
    ],
)
def test_auto_takes_the_utm_zone_of_the_region_s_newest_datum_and_a_given_crs_stays(
    latitude: float, longitude: float, code: int
) -> None:
    assert crs_at(latitude, longitude, "auto") == f"EPSG:{code}"
    assert crs_at(latitude, longitude, "EPSG:2154") == "EPSG:2154"
