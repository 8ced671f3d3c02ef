"""Control points against a map whose surface is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from subiaco_geo.clouds import PointCloud
from subiaco_geo.errors import InputError
from subiaco_mapping.control import check_control, describe_control
from subiaco_mapping.control_points import read_control

CRS = "EPSG:7850"
ORIGIN = np.array([388_000.0, 6_464_000.0, 10.0])


def sloping_map(seed: int = 3) -> PointCloud:
    """A street of 40 m x 40 m that rises 5 % to the east and lies 3 cm too high, with a lamp post."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0, 40, (26_000, 2))
    z = 0.05 * xy[:, 0] + 0.03 + rng.normal(0, 0.004, len(xy))
    post = np.column_stack([np.full((6, 2), 20.0), rng.uniform(0, 0.9, 6) + 1.0])
    return PointCloud(np.vstack([np.column_stack([xy, z]), post]), ORIGIN, CRS)


def write_points(path: Path, rows: list[str], header: str = "name,east,north,height") -> Path:
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


def surveyed(x: float, y: float) -> str:
    return f"{388_000 + x:.3f},{6_464_000 + y:.3f},{10 + 0.05 * x:.4f}"


def test_a_map_three_centimetres_too_high_says_so_on_a_slope_and_beside_a_post(tmp_path: Path) -> None:
    rows = [f"P{i},{surveyed(5 + i, 20)}" for i in range(30)] + [f"POST,{surveyed(20.1, 20)}"]
    points = read_control(write_points(tmp_path / "c.csv", rows), CRS)
    summary = check_control(sloping_map(), points).summary()
    assert summary["vertical_points"] == 31
    assert summary["bias_vertical_m"] == pytest.approx(0.03, abs=0.002)
    assert summary["rmse_vertical_m"] == pytest.approx(0.03, abs=0.003)
    assert summary["rmse_horizontal_m"] is None
    assert any("no horizontal residual" in text for text in summary["warnings"])


def test_picked_points_give_horizontal_residuals_and_few_points_are_warned_of(tmp_path: Path) -> None:
    header = "name,east,north,height,map_east,map_north,map_height"
    rows = [
        f"A,{surveyed(10, 10)},{388_010.03},{6_464_009.96},",
        f"B,{surveyed(12, 10)},{388_012.03},{6_464_009.96},{10.6}",
    ]
    residuals = check_control(
        sloping_map(), read_control(write_points(tmp_path / "c.csv", rows, header), CRS)
    )
    np.testing.assert_allclose(residuals.horizontal, [[0.03, -0.04]] * 2, atol=1e-6)
    assert residuals.summary()["rmse_horizontal_m"] == pytest.approx(0.05, abs=1e-6)
    assert residuals.vertical[1] == pytest.approx(0.0, abs=1e-9)
    text = describe_control(residuals)
    assert "RMSE horizontal: 0.050 m over 2 points" in text
    assert "2 vertical points: 30 or more are needed" in text


def test_a_point_outside_the_map_has_no_residual_and_is_named(tmp_path: Path) -> None:
    path = write_points(tmp_path / "c.csv", [f"IN,{surveyed(10, 10)}", f"OUT,{surveyed(400, 10)}"])
    residuals = check_control(sloping_map(), read_control(path, CRS))
    assert np.isnan(residuals.vertical[1])
    assert any("OUT" in text for text in residuals.summary()["warnings"])


@pytest.mark.parametrize(("shift", "side"), [(32.9, "below"), (-32.9, "above")])
def test_heights_above_the_geoid_are_told_from_a_point_outside_the_map(
    tmp_path: Path, shift: float, side: str
) -> None:
    rows = [f"P{i},{388_005 + i},{6_464_020},{10 + 0.05 * (5 + i) + shift:.4f}" for i in range(6)]
    path = write_points(tmp_path / "ahd.csv", [*rows, f"OUT,{surveyed(400, 10)}"])
    text = describe_control(check_control(sloping_map(), read_control(path, CRS)))
    assert f"warning: the map lies 32.9 m {side} 6 of 7 control points" in text
    assert "geoid (AHD" in text
    assert "no map surface" not in text


def test_control_points_in_gda94_are_named_by_the_shift_of_the_picked_places(tmp_path: Path) -> None:
    header = "name,east,north,height,map_east,map_north"
    rows = [f"P{i},{surveyed(5 + i, 20)},{388_005 + i + 0.99},{6_464_020 + 1.50}" for i in range(5)]
    points = read_control(write_points(tmp_path / "gda94.csv", rows, header), CRS)
    (said, *_) = check_control(sloping_map(), points).summary()["warnings"]
    assert "1.80 m off the control points" in said
    assert "probably in GDA94; give their CRS with --crs" in said


def test_control_in_another_system_is_brought_to_the_map(tmp_path: Path) -> None:
    points = read_control(
        write_points(tmp_path / "c.csv", ["A,388000,6464000,10"]), "EPSG:28350", "EPSG:7850"
    )
    moved = points.surveyed[0, :2] - [388_000, 6_464_000]
    assert 1.0 < np.linalg.norm(moved) < 2.5  # GDA94 and GDA2020 lie about 1.8 m apart


@pytest.mark.parametrize(
    ("rows", "header", "words"),
    [
        (["A,1,2"], "name,east,north", "column height is missing"),
        (["A,1,x,3"], "name,east,north,height", "line 2: north is 'x'"),
        (["A,1,,3"], "name,east,north,height", "line 2: a surveyed coordinate is missing"),
        ([], "name,east,north,height", "holds no control points"),
    ],
)
def test_a_bad_file_is_refused_with_its_line(
    tmp_path: Path, rows: list[str], header: str, words: str
) -> None:
    with pytest.raises(InputError, match=words):
        read_control(write_points(tmp_path / "c.csv", rows, header), CRS)


def test_semicolons_and_decimal_commas_are_read_as_a_spreadsheet_writes_them(tmp_path: Path) -> None:
    path = write_points(
        tmp_path / "c.csv", ["A, gate;388010,5;6464010,2;12,1;0,02"], "name;east;north;height;sigma_v"
    )
    points = read_control(path, CRS)
    assert points.names == ("A, gate",)
    assert points.surveyed.tolist() == [[388_010.5, 6_464_010.2, 12.1]]
    assert points.sigma[0, 1] == 0.02


def test_points_outside_the_map_are_said_to_be_so_far_outside_and_exchanged_columns_are_named(
    tmp_path: Path,
) -> None:
    east, north, height = surveyed(10, 10).split(",")
    for row, words in (
        (
            f"A,{float(east) + 1030},{north},{height}",
            "1 of 1 control points lie outside the map, by 1000 m: check",
        ),
        (f"A,{north},{east},{height}", "with east and north exchanged they lie inside it"),
    ):
        path = write_points(tmp_path / "c.csv", [row])
        first = check_control(sloping_map(), read_control(path, CRS)).summary()["warnings"][0]
        assert words in first
