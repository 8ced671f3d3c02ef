"""The preview of a change run: even, small, and the same boxes however the tiles fall."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from subiaco_change.outputs.preview import CloudThinning, build_preview
from subiaco_change.records import Registration, TiledResult
from subiaco_geo.clouds import PointCloud
from subiaco_geo.frames import Floats

ORIGIN = np.array([390_000.0, 6_460_000.0, 10.0])


def cloud(xyz: Floats) -> PointCloud:
    number = (xyz[:, 0] // 5).astype(np.int32) - 1
    return PointCloud(xyz, ORIGIN, "EPSG:7850", {"instance": number})


def tiled(before: list[Floats], after: list[Floats]) -> TiledResult:
    clouds = {
        (epoch, str(k)): cloud(xyz)
        for epoch, parts in (("before", before), ("after", after))
        for k, xyz in enumerate(parts)
    }
    registration = Registration(np.eye(4), ORIGIN, 0.0, 0.0, 1.0, np.zeros(6), "given")
    names = [str(k) for k in range(len(before))]

    def tile(epoch: str, name: str) -> PointCloud:
        return clouds[epoch, name]

    return TiledResult((), "EPSG:7850", registration, None, (), None, {}, names, tile, tile)


@given(st.lists(st.integers(0, 4_000), min_size=1, max_size=6), st.integers(1, 3_000))
def test_at_most_so_many_points_are_kept_and_all_where_there_are_no_more(sizes: list[int], most: int) -> None:
    thinning = CloudThinning(most)
    for k, size in enumerate(sizes):
        thinning.add(cloud(np.full((size, 3), float(k))))
    kept = len(thinning.cloud())
    assert kept <= most
    assert kept == sum(sizes) if sum(sizes) <= most else kept > 0.3 * most - 20


def test_every_part_of_a_city_keeps_its_share() -> None:
    rng = np.random.default_rng(3)
    parts = [rng.uniform(10.0 * k, 10.0 * k + 10.0, (5_000, 3)) for k in range(20)]
    preview = build_preview(tiled(parts, parts), 10_000)
    shares = np.histogram(preview.before.xyz[:, 0], bins=20, range=(0, 200))[0] / len(preview.before)
    assert len(preview.before) == pytest.approx(6_250, rel=0.1)  # 100,000 points, halved four times
    np.testing.assert_allclose(shares, 1 / 20, atol=0.01)


def test_boxes_span_tiles_and_epochs_and_do_not_depend_on_the_tiles() -> None:
    rng = np.random.default_rng(5)
    first, second = rng.uniform(0, 60, (2, 3_000, 3))
    whole = build_preview(tiled([first], [second]), 100)
    cut = build_preview(tiled(np.array_split(first, 7), np.array_split(second, 7)), 100)
    assert whole.boxes.keys() == cut.boxes.keys() == set(range(11))
    both = np.concatenate([first, second])
    mine = both[both[:, 0] // 5 == 4]
    for boxes in (whole.boxes, cut.boxes):
        low, high = boxes[3]
        np.testing.assert_array_equal(low, ORIGIN + mine.min(axis=0))
        np.testing.assert_array_equal(high, ORIGIN + mine.max(axis=0))


def test_a_tile_without_points_is_no_matter() -> None:
    empty = np.zeros((0, 3))
    preview = build_preview(tiled([empty, empty], [empty, np.ones((4, 3))]), 3)
    assert len(preview.before) == 0
    assert preview.before.crs == "EPSG:7850"
