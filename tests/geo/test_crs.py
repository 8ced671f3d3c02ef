"""Coordinate systems: known answers, inverses, and no silent no-op."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyproj import CRS, Proj, Transformer

from subiaco_geo.crs import (
    EnuFrame,
    crs_text,
    fixes_to_datum,
    las_wkt,
    require_crs,
    require_ellipsoidal,
    require_map_crs,
    transformer,
)
from subiaco_geo.errors import InputError
from subiaco_geo.frames import exp_se3, make_pose
from subiaco_geo.geoid import ellipsoidal_heights

MGA = "EPSG:7850"
SUBIACO = EnuFrame(-31.948, 115.825, 20.0)
A, F = 6378137.0, 1 / 298.257222101  # GRS80


def closed_form_enu(lat: float, lon: float, h: float, frame: EnuFrame) -> np.ndarray:
    """East, north, up from the textbook formulas, as the twin of the PROJ pipeline."""

    def ecef(la: float, lo: float, height: float) -> np.ndarray:
        e2 = F * (2 - F)
        n = A / np.sqrt(1 - e2 * np.sin(la) ** 2)
        horizontal = (n + height) * np.cos(la)
        return np.array(
            [horizontal * np.cos(lo), horizontal * np.sin(lo), (n * (1 - e2) + height) * np.sin(la)]
        )

    la, lo = np.radians([frame.latitude_deg, frame.longitude_deg])
    east = [-np.sin(lo), np.cos(lo), 0.0]
    north = [-np.sin(la) * np.cos(lo), -np.sin(la) * np.sin(lo), np.cos(la)]
    up = [np.cos(la) * np.cos(lo), np.cos(la) * np.sin(lo), np.sin(la)]
    return np.array([east, north, up]) @ (ecef(*np.radians([lat, lon]), h) - ecef(la, lo, frame.height))


@pytest.mark.parametrize(("dlat", "dlon", "h"), [(0, 0, 20), (0.03, 0.04, 55), (-0.045, -0.02, 0)])
def test_local_enu_agrees_with_the_closed_form(dlat: float, dlon: float, h: float) -> None:
    lat, lon = SUBIACO.latitude_deg + dlat, SUBIACO.longitude_deg + dlon
    ours = SUBIACO.from_geodetic([lat], [lon], [h])[0]
    np.testing.assert_allclose(ours, closed_form_enu(lat, lon, h, SUBIACO), atol=1e-7)


@given(st.integers(0, 2**32 - 1))
def test_enu_and_map_invert_each_other_within_five_kilometres(seed: int) -> None:
    points = np.random.default_rng(seed).uniform([-5e3, -5e3, -50], [5e3, 5e3, 100], (20, 3))
    back = SUBIACO.points_from_map(SUBIACO.points_to_map(points, MGA), MGA)
    np.testing.assert_allclose(back, points, atol=1e-4)
    geodetic = SUBIACO.to_geodetic(points)
    np.testing.assert_allclose(SUBIACO.from_geodetic(*geodetic.T), points, atol=1e-4)


def test_points_in_the_map_are_where_projecting_their_latitude_puts_them() -> None:
    lat_lon_h = np.array([[-31.95, 115.82, 31.5], [-31.93, 115.85, 12.0]])
    enu = SUBIACO.from_geodetic(*lat_lon_h.T)
    direct = Transformer.from_crs("EPSG:7844", MGA, always_xy=True)
    east, north = direct.transform(lat_lon_h[:, 1], lat_lon_h[:, 0])
    np.testing.assert_allclose(
        SUBIACO.points_to_map(enu, MGA), np.column_stack([east, north, lat_lon_h[:, 2]]), atol=1e-5
    )


def test_the_axes_turn_by_the_meridian_convergence() -> None:
    rotation = SUBIACO.grid_axes(np.zeros((1, 3)), MGA)[0]
    expected = Proj(MGA).get_factors(SUBIACO.longitude_deg, SUBIACO.latitude_deg).meridian_convergence
    assert np.degrees(np.arctan2(rotation[1, 0], rotation[0, 0])) == pytest.approx(expected, abs=1e-5)
    assert abs(expected) > 0.5
    np.testing.assert_allclose(rotation[2], [0, 0, 1], atol=1e-9)


def test_poses_stay_rigid_and_move_as_the_points_do() -> None:
    rng = np.random.default_rng(3)
    poses = exp_se3(rng.normal(size=(5, 6)) * [1, 1, 1, 800, 800, 10])
    mapped = SUBIACO.poses_to_map(poses, MGA)
    rotation = mapped[:, :3, :3]
    np.testing.assert_allclose(
        rotation @ np.swapaxes(rotation, 1, 2), np.tile(np.eye(3), (5, 1, 1)), atol=1e-12
    )
    tip = poses[:, :3, 3] + poses[:, :3, 0]  # one metre along x of each frame
    moved = SUBIACO.points_to_map(tip, MGA) - mapped[:, :3, 3]
    np.testing.assert_allclose(moved, mapped[:, :3, 0], atol=3e-4)  # projection scale 0.99974


def test_far_from_the_origin_up_is_the_local_vertical() -> None:
    far = np.array([[5000.0, 0.0, 0.0]])
    tilt = SUBIACO.grid_axes(far, MGA)[0] @ [0, 0, 1]
    assert np.arccos(tilt[2]) == pytest.approx(5000.0 / 6.38e6, rel=0.01)


def test_gda94_to_gda2020_is_applied_with_its_accuracy() -> None:
    operation = transformer("EPSG:28350", MGA)
    point = np.array([[389000.0, 6463000.0, 10.0]])
    shift = operation.apply(point) - point
    assert 1.6 < np.linalg.norm(shift[0, :2]) < 2.0
    assert operation.accuracy_m == pytest.approx(0.01)
    assert "GDA94 to GDA2020" in operation.name
    back = transformer(MGA, "EPSG:28350").apply(operation.apply(point))
    np.testing.assert_allclose(back, point, atol=1e-3)


def test_the_same_system_is_left_alone_in_a_copy() -> None:
    operation = transformer(MGA, "EPSG:7850")
    points = np.ones((2, 3))
    moved = operation.apply(points)
    np.testing.assert_array_equal(moved, points)
    assert moved is not points
    assert operation.accuracy_m == 0.0


def test_a_change_of_zone_alone_has_no_error_and_keeps_heights() -> None:
    operation = transformer("EPSG:7849", MGA)
    moved = operation.apply(np.array([[389000.0, 6463000.0, 10.0]]))
    assert operation.accuracy_m == 0.0
    assert moved[0, 2] == pytest.approx(10.0, abs=1e-9)


@pytest.mark.parametrize("pair", [("EPSG:2154", MGA), ("EPSG:20350", "EPSG:2154")])
def test_a_ballpark_operation_is_refused(pair: tuple[str, str]) -> None:
    with pytest.raises(InputError, match="ballpark"):
        transformer(*pair)


@pytest.mark.parametrize("text", ["EPSG:99999", "Perth", ""])
def test_an_unknown_crs_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(InputError, match=r"not known; give an EPSG code such as EPSG:7850"):
        require_crs(text)


@pytest.mark.parametrize(("text", "word"), [("EPSG:4326", "projected"), ("EPSG:2992", "foot")])
def test_a_map_is_projected_and_in_metres(text: str, word: str) -> None:
    with pytest.raises(InputError, match=word):
        require_map_crs(text)


@pytest.mark.parametrize("code", ["EPSG:7850", "EPSG:28350", "EPSG:2154", "EPSG:32750"])
def test_las_wkt_reads_back_as_the_three_dimensional_system(code: str) -> None:
    text = las_wkt(require_crs(code))
    assert text.startswith("COMPD_CS[")
    parsed = CRS.from_wkt(text)
    assert [axis.name for axis in parsed.axis_info][2] == "Ellipsoidal height"
    assert crs_text(parsed) == code


def test_unknown_heights_are_not_called_ellipsoidal() -> None:
    text = las_wkt(require_crs("EPSG:2154"), ellipsoidal=False)
    assert text.startswith("PROJCS[")
    assert "llipsoidal" not in text


def test_a_compound_keeps_its_vertical_part() -> None:
    crs = require_crs("EPSG:7850+5711")
    assert crs_text(crs) == "EPSG:7850+5711"
    assert crs_text(CRS.from_wkt(las_wkt(crs))) == "EPSG:7850+5711"


@pytest.mark.parametrize("frame", ["ITRF2014", "EPSG:7912"])
def test_itrf_fixes_move_by_the_plate_motion_since_2020(frame: str) -> None:
    fix = np.array([[-31.948, 115.825, 20.0]])
    moved = fixes_to_datum(fix, frame, MGA, 2026.8)
    east, north, up = EnuFrame(*fix[0]).from_geodetic(*moved.T)[0]
    assert np.hypot(east, north) == pytest.approx(0.47, abs=0.06)  # 7 cm a year, NNE
    assert north < 0
    assert abs(up) < 0.02
    still = fixes_to_datum(fix, frame, MGA, 2020.0)
    np.testing.assert_allclose(still, fix, atol=1e-9)


def test_itrf_fixes_of_europe_move_by_two_and_a_half_centimetres_a_year_since_1989() -> None:
    fix = np.array([[49.04, 8.44, 160.0]])
    moved = fixes_to_datum(fix, "ITRF2014", "EPSG:25832", 2019.0)
    east, north, _ = EnuFrame(*fix[0]).from_geodetic(*moved.T)[0]
    assert np.hypot(east, north) == pytest.approx(30 * 0.025, abs=0.1)
    assert east < 0


def test_itrf_fixes_without_an_epoch_are_refused() -> None:
    with pytest.raises(InputError, match=r"set gnss\.epoch"):
        fixes_to_datum([[-31.9, 115.8, 0.0]], "ITRF2014", MGA)


@pytest.mark.parametrize(
    ("frame", "crs"), [("map", MGA), ("GDA2020", MGA), ("EPSG:7843", MGA), ("ETRS89", "EPSG:25832")]
)
def test_fixes_in_the_datum_of_the_map_are_taken_as_they_are(frame: str, crs: str) -> None:
    fix = [[-31.9, 115.8, 0.0]]
    np.testing.assert_array_equal(fixes_to_datum(fix, frame, crs), fix)


@pytest.mark.parametrize(
    ("frame", "said"),
    [
        ("Atlantis 2001", "not known"),
        ("EPSG:7850", "no system of latitude and longitude"),
        ("WGS84", "good to 3 m only"),  # an ensemble of realisations
    ],
)
def test_a_frame_of_fixes_that_does_not_fit_the_map_is_refused(frame: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        fixes_to_datum([[-31.9, 115.8, 0.0]], frame, MGA)


@pytest.mark.parametrize("origin", [(np.nan, 115.0, 0.0), (-91.0, 115.0, 0.0)])
def test_an_impossible_enu_origin_is_refused(origin: tuple[float, float, float]) -> None:
    with pytest.raises(InputError, match="ENU origin"):
        EnuFrame(*origin)


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(InputError, match=r"\(N, 3\)"):
        SUBIACO.points_to_map(np.zeros(3), MGA)
    with pytest.raises(InputError, match=r"\(N, 4, 4\)"):
        SUBIACO.poses_to_map(make_pose(np.eye(3), np.zeros(3)), MGA)


def geoid(path: Path) -> Path:
    """A geoid that rises by 1 m a degree to the north, -32 m at 32 S, in the GTX format (1 deg grid)."""
    rows = [[-32.0 + row, -32.0 + row, -32.0 + row] for row in range(3)]
    data = struct.pack(">4d2i", -32.0, 115.0, 1.0, 1.0, 3, 3)
    path.write_bytes(data + b"".join(struct.pack(">3f", *row) for row in rows))
    return path


def test_heights_above_the_geoid_become_ellipsoidal_with_a_grid(tmp_path: Path) -> None:
    fixes = np.array([[-31.5, 115.8, 20.0], [-32.0, 116.0, 5.0]])
    found = ellipsoidal_heights(fixes, geoid(tmp_path / "geoid.gtx"))
    np.testing.assert_allclose(found, [[-31.5, 115.8, -11.5], [-32.0, 116.0, -27.0]], atol=1e-4)


def test_a_geoid_in_the_present_folder_needs_no_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    geoid(tmp_path / "geoid.gtx")
    monkeypatch.chdir(tmp_path)
    found = ellipsoidal_heights(np.array([[-31.5, 115.8, 20.0]]), Path("geoid.gtx"))
    np.testing.assert_allclose(found[0, 2], -11.5, atol=1e-4)


def test_a_geoid_that_is_none_or_lies_elsewhere_is_refused(tmp_path: Path) -> None:
    fixes = np.array([[-31.5, 115.8, 20.0]])
    with pytest.raises(InputError, match="no such geoid grid"):
        ellipsoidal_heights(fixes, tmp_path / "absent.gtx")
    (tmp_path / "broken.gtx").write_bytes(b"nothing")
    with pytest.raises(InputError, match="not a geoid grid"):
        ellipsoidal_heights(fixes, tmp_path / "broken.gtx")
    with pytest.raises(InputError, match="does not cover"):
        ellipsoidal_heights(np.array([[48.0, 11.0, 500.0]]), geoid(tmp_path / "geoid.gtx"))


def test_a_map_in_ahd_is_refused_for_proj_would_not_move_its_heights() -> None:
    assert require_ellipsoidal(MGA).to_epsg() == 7850
    with pytest.raises(InputError, match="ellipsoidal heights; name the horizontal part"):
        require_ellipsoidal("EPSG:7850+5711")
