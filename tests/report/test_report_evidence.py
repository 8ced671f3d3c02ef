"""The picture of a row shows its object: before, after and difference, in plan and section."""

import io

import geopandas as gpd
import numpy as np
import pytest
from PIL import Image
from result_scene import ORIGIN
from shapely.geometry import MultiPolygon, box

from subiaco_change.outputs.clouds import open_labelled
from subiaco_change.records import CHANGE_COLOURS
from subiaco_geo.cloud_windows import CloudFile
from subiaco_geo.codes import Change
from subiaco_geo.ply_io import write_ply
from subiaco_report.colours import BACKGROUND
from subiaco_report.evidence_pictures import (
    HEIGHT,
    MAX_BYTES,
    PANEL,
    SECTION,
    WIDTH,
    choose_view,
    compact,
    draw,
    evidence_pictures,
    svg_path,
)


@pytest.fixture(scope="module")
def epochs(change_directory):
    return tuple(open_labelled(change_directory, epoch) for epoch in ("before", "after"))


def footprint(result, number):
    return next(r for r in result.records if r.object_id == number).footprint


def panel(picture, number, section=False):
    """Cells (rows, columns, 3) of a plan or of a section."""
    cells = picture.shape[1] // 3
    rows = slice(cells, None) if section else slice(0, cells)
    return picture[rows, number * cells : (number + 1) * cells].astype(int)


def share_of(pixels, rgb, spread):
    """Share of pixels whose colour is this one, lit darker or brighter."""
    light = pixels.sum(axis=2) / sum(rgb)
    near = np.abs(pixels - light[..., None] * np.array(rgb)).max(axis=2) < spread
    return float(near.mean())


def test_a_removed_house_stands_before_is_gone_after_and_differs_in_red(epochs, result):
    view = choose_view(epochs, footprint(result, 2), flat=False)
    picture = draw(epochs, view)
    red = CHANGE_COLOURS[Change.REMOVED]
    assert picture.shape == (view.cells * (PANEL + SECTION) // PANEL, 3 * view.cells, 3)
    assert share_of(panel(picture, 2), red, 12) > 0.15
    assert share_of(panel(picture, 2, section=True), red, 12) > 0.05
    drawn = [(panel(picture, e, section=True) != BACKGROUND).any(axis=2).mean() for e in (0, 1)]
    assert drawn[0] > 2 * drawn[1]


def test_what_is_drawn_over_a_picture_lies_on_its_object(epochs, result, change_directory):
    rows = gpd.read_parquet(change_directory / "changes.parquet").set_index("object_id").loc[[1]]
    (found,) = evidence_pictures(epochs, rows)
    west, south, east, north = footprint(result, 1).bounds
    view = choose_view(epochs, footprint(result, 1), flat=False)
    assert view.centre == pytest.approx([(west + east) / 2, (south + north) / 2])
    assert view.side >= 1.5 * max(east - west, north - south)
    corners = np.array([[float(v) for v in c.split()] for c in found.outline.strip("MZ").split("L")])
    scale = PANEL / view.side
    assert np.ptp(corners, axis=0) == pytest.approx([(east - west) * scale, (north - south) * scale], abs=0.2)
    assert corners.mean(axis=0) == pytest.approx([PANEL / 2, PANEL / 2], abs=0.2)
    assert found.ticks == pytest.approx((corners[:, 0].min(), corners[:, 0].max()), abs=0.2)
    assert found.bar == pytest.approx(found.bar_m * scale, abs=0.1)
    assert found.note == "looking north"


def test_a_raised_patch_of_ground_is_exaggerated_and_a_house_is_not(epochs, result):
    assert choose_view(epochs, footprint(result, 10), flat=True).exaggeration >= 5
    assert choose_view(epochs, footprint(result, 1), flat=False).exaggeration == 1


def test_a_section_holds_the_whole_object(epochs, result):
    view = choose_view(epochs, box(*ORIGIN[:2], *(ORIGIN[:2] + 0.5)), flat=False)
    tree = choose_view(epochs, footprint(result, 4), flat=False)
    assert view.side >= 8.0
    low, high = tree.heights
    assert high - low <= tree.side * SECTION / PANEL


def test_a_place_without_points_is_drawn_empty(epochs):
    far = ORIGIN[:2] + 5000.0
    picture = draw(epochs, choose_view(epochs, box(*far, *(far + 3.0)), flat=False))
    assert share_of(panel(picture, 0), BACKGROUND, 3) > 0.8


def test_no_picture_is_larger_than_the_bound_even_of_noise():
    noise = np.random.default_rng(5).integers(0, 255, (HEIGHT // 4, WIDTH // 4, 3), dtype=np.uint8)
    picture = Image.fromarray(noise).resize((WIDTH, HEIGHT), Image.Resampling.NEAREST)
    data = compact(picture)
    assert len(data) <= MAX_BYTES
    assert Image.open(io.BytesIO(data)).size == (WIDTH, HEIGHT)


def test_pictures_come_in_the_order_of_the_rows_and_the_same_each_time(epochs, change_directory):
    rows = gpd.read_parquet(change_directory / "changes.parquet").iloc[[1, 3, 0]]
    first = evidence_pictures(epochs, rows)
    assert first == evidence_pictures(epochs, rows)
    assert first[::-1] == evidence_pictures(epochs, rows.iloc[::-1])
    assert len({picture.webp for picture in first}) == 3


def test_outlines_are_metres_from_the_north_west_corner():
    path = svg_path(MultiPolygon([box(110.0, 210.0, 120.0, 220.0)]), 100.0, 240.0)
    assert sorted(path.strip("MZ").split("L")) == ["10 20", "10 30", "20 20", "20 30"]


def test_an_epoch_of_one_point_does_not_stop_the_other(epochs, result, tmp_path):
    write_ply(tmp_path / "one.ply", result.after.select(np.arange(1)))
    pair = (epochs[0], CloudFile(tmp_path / "one.ply", ("change", "semantic")))
    picture = draw(pair, choose_view(pair, footprint(result, 2), flat=False))
    assert (panel(picture, 1) == BACKGROUND).mean() > 0.99
