"""Top views show the right point in the right pixel, in the colours of the paper."""

import io

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from subiaco_change.outputs.terrain import hillshade
from subiaco_change.records import CHANGE_COLOURS
from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import Change
from subiaco_report import pictures
from subiaco_report.colours import BACKGROUND, instance_colours, paint
from subiaco_report.top_views import Above, Frame, fill_holes, top_view

FRAME = Frame(0.0, 0.0, 2.0, 1.0, 0.5)


def cloud_of(xyz, change, origin=(0.0, 0.0, 0.0)):
    fields = {
        "change": np.asarray(change, np.uint8),
        "semantic": np.ones(len(xyz), np.uint8),
        "instance": np.arange(len(xyz), dtype=np.int32),
    }
    return PointCloud(np.asarray(xyz, float), np.asarray(origin, float), None, fields)


def test_the_highest_point_of_a_pixel_is_seen_with_row_0_in_the_north():
    xyz = np.array([[0.1, 0.9, 1.0], [0.2, 0.8, 5.0], [1.9, 0.1, 0.0], [9.0, 9.0, 9.0]])
    view = top_view(xyz, FRAME)
    assert view.tolist() == [[1, -1, -1, -1], [-1, -1, -1, 2]]


def test_priority_beats_height():
    xyz = np.array([[0.1, 0.9, 1.0], [0.2, 0.8, 5.0]])
    assert top_view(xyz, FRAME, np.array([True, False]))[0, 0] == 0


points = st.lists(
    st.tuples(st.floats(0, 1.99), st.floats(0.01, 0.99), st.integers(0, 50)), min_size=1, max_size=40
)


@given(points)
def test_the_view_equals_a_plain_loop(rows):
    xyz = np.array(rows, dtype=float)
    highest = np.full(FRAME.shape, -np.inf)
    for x, y, z in xyz:
        row, column = int((1.0 - y) // 0.5), int(x // 0.5)
        highest[row, column] = max(highest[row, column], z)
    view = top_view(xyz, FRAME)
    seen = np.where(view >= 0, xyz[view, 2], -np.inf)
    np.testing.assert_array_equal(seen, highest)


@given(points, st.integers(0, 2**40 - 1))
def test_of_equal_heights_the_last_point_is_seen_and_priority_comes_before_height(rows, drawn):
    xyz = np.array(rows, dtype=float)
    priority = np.array([bool(drawn >> k & 1) for k in range(len(xyz))])
    best = {}
    for k, (x, y, z) in enumerate(xyz):
        pixel = int((1.0 - y) // 0.5), int(x // 0.5)
        best[pixel] = max(best.get(pixel, (False, -np.inf, -1)), (priority[k], z, k))
    view = top_view(xyz, FRAME, priority)
    assert {pixel: view[pixel] for pixel in best} == {pixel: found[2] for pixel, found in best.items()}
    assert (view >= 0).sum() == len(best)


def test_holes_next_to_points_are_filled_and_farther_ones_stay():
    view = np.full((5, 5), -1)
    view[0, 0] = 3
    filled = fill_holes(view)
    assert (filled >= 0).sum() == 4
    assert (fill_holes(view, 2) >= 0).sum() == 9
    assert set(np.unique(filled)) == {-1, 3}


def test_slopes_to_the_light_are_brighter():
    column = np.arange(10.0)
    rising_east = hillshade(np.tile(column, (10, 1)), 1.0)
    rising_west = hillshade(np.tile(-column, (10, 1)), 1.0)
    assert rising_east.mean() > hillshade(np.zeros((10, 10)), 1.0).mean() > rising_west.mean()


@pytest.mark.parametrize("change", [Change.ADDED, Change.REMOVED, Change.INCREASED, Change.DECREASED])
def test_change_is_painted_in_the_hue_of_the_paper_at_world_coordinates(change):
    origin = (391_000.0, 6_464_000.0, 0.0)
    grid = np.stack(np.meshgrid(np.arange(0.25, 5, 0.5), np.arange(0.25, 5, 0.5)), -1).reshape(-1, 2)
    cloud = cloud_of(np.column_stack([grid, np.zeros(len(grid))]), [int(change)] * len(grid), origin)
    frame = Frame(391_000.0, 6_464_000.0, 391_005.0, 6_464_005.0, 0.5)
    picture = paint(cloud, frame, "change").astype(float)
    expected = np.array(CHANGE_COLOURS[change], float)
    np.testing.assert_allclose(picture[5, 5] / picture[5, 5].max(), expected / expected.max(), atol=0.03)


def test_empty_pixels_keep_the_background():
    picture = paint(cloud_of([[0.1, 0.1, 0.0]], [4]), Frame(10.0, 10.0, 12.0, 12.0, 0.5), "semantics")
    assert (picture == BACKGROUND).all()


def test_an_object_has_one_colour_everywhere_and_points_of_none_are_grey():
    colours = instance_colours(np.array([5, -1, 5, 6]))
    assert (colours[0] == colours[2]).all()
    assert len(set(colours[1])) == 1
    assert np.abs(colours[0] - colours[3]).max() > 40


@given(points, st.integers(0, 2**32 - 1), st.integers(1, 5))
def test_a_view_gathered_from_parts_is_the_view_of_all_points(rows, seed, parts):
    rng = np.random.default_rng(seed)
    xyz, change = np.array(rows, float), rng.choice([int(c) for c in Change], len(rows))
    above = Above(FRAME)
    for part in np.array_split(np.arange(len(xyz)), parts):
        above.add(xyz[part], change[part].astype(np.uint8))
    np.testing.assert_array_equal(
        paint(above.cloud(), FRAME, "change"), paint(cloud_of(xyz, change), FRAME, "change")
    )


def grid_of(*clouds):
    world = np.concatenate([cloud.world() for cloud in clouds])
    grid = pictures.PictureBlocks(world.min(axis=0)[:2], world.max(axis=0)[:2])
    for cloud in clouds:
        grid.add(cloud.world())
    return grid.blocks()


def test_every_point_lies_in_exactly_one_block_core(result):
    blocks = grid_of(result.before, result.after)
    assert [b.name for b in blocks] == ["A1", "A2"]
    world = np.concatenate([result.before.world(), result.after.world()])[::50]
    owners = [sum(b.holds(x, y) for b in blocks) for x, y, _ in world]
    assert set(owners) == {1}
    assert blocks[0].bounds[2] - blocks[1].bounds[0] == pytest.approx(10.0)


def test_a_block_has_its_five_pictures_at_one_size(result):
    block = grid_of(result.before, result.after)[0]
    drawn = pictures.block_pictures(result.before, result.after, block)
    assert list(drawn) == ["projection", "height", "semantics", "instances", "change"]
    images = [Image.open(io.BytesIO(webp)).convert("RGB") for webp in drawn.values()]
    assert {image.size for image in images} == {(2 * 90 * 4, 90 * 4)}  # two of 90 m, four pixels a metre
    assert len({image.tobytes() for image in images}) == 5


def test_pictures_do_not_need_intensity_and_are_the_same_every_time(result):
    bare = result.after.fields.keys() - {"intensity"}
    after = PointCloud(result.after.xyz, result.after.origin, None, {n: result.after.fields[n] for n in bare})
    block = grid_of(after)[0]
    frame = Frame(*block.bounds, 0.5)
    first = paint(after, frame, "projection")
    assert len(np.unique(first.reshape(-1, 3), axis=0)) > 5
    above = Above(frame)
    above.add(after.world(), after.fields["change"])
    assert pictures.overview(above, [block]) == pictures.overview(above, [block])


def test_an_overview_names_no_objects_where_nobody_could_read_them(result):
    world = result.after.world()
    above = Above(pictures.overview_frame(world[:, :2].min(axis=0), world[:, :2].max(axis=0), 100))
    above.add(world, result.after.fields["change"])
    mark = pictures.Mark(*world[0, :2], "1")
    plain = pictures.overview(above, [])
    assert pictures.overview(above, [], [mark]) != plain
    assert pictures.overview(above, [], [mark] * 301) == plain


def test_every_colour_of_the_legend_stands_in_the_written_overview_exactly(result):
    world = result.after.world()
    above = Above(pictures.overview_frame(world[:, :2].min(axis=0), world[:, :2].max(axis=0)))
    above.add(world, np.full(len(world), Change.REMOVED, np.uint8))
    written = np.asarray(Image.open(io.BytesIO(pictures.overview(above, []))).convert("RGB")).reshape(-1, 3)
    for change, colour in CHANGE_COLOURS.items():
        assert (written == colour).all(axis=1).sum() > 50, change.label
