"""Tiles cover the ground exactly once in their cores."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from subiaco_geo.errors import InputError
from subiaco_geo.tiles import tile_grid

coordinate = st.floats(-5e3, 7e6, allow_nan=False)
extent = st.floats(0.0, 500.0)


@given(coordinate, coordinate, extent, extent, st.floats(20.0, 200.0), st.integers(0, 2**32 - 1))
def test_every_point_lies_in_exactly_one_core(
    x: float, y: float, width: float, depth: float, size: float, seed: int
) -> None:
    bounds = (x, y, x + width, y + depth)
    inside = np.random.default_rng(seed).uniform(bounds[:2], bounds[2:], (200, 2))
    corners = np.array([[bounds[i], bounds[j]] for i in (0, 2) for j in (1, 3)])
    edges = np.floor(inside / size) * size  # on the seams between tiles
    seams = edges[(edges >= bounds[:2]).all(axis=1)]
    points = np.vstack([inside, corners, seams])
    covered = sum(tile.in_core(points).astype(int) for tile in tile_grid(bounds, size, 10.0))
    np.testing.assert_array_equal(covered, 1)


def test_tiles_are_anchored_so_that_reruns_agree() -> None:
    first = {tile.id: tile for tile in tile_grid((10.0, 10.0, 300.0, 90.0))}
    second = {tile.id: tile for tile in tile_grid((-70.0, 30.0, 170.0, 60.0))}
    shared = first.keys() & second.keys()
    assert shared >= {"0_0", "1_0", "2_0"}
    assert all(first[name] == second[name] for name in shared)


def test_the_buffer_reaches_the_overlap_beyond_the_core() -> None:
    (tile,) = tile_grid((1.0, 1.0, 2.0, 2.0), size=80.0, overlap=10.0)
    assert tile.core == (0.0, 0.0, 80.0, 80.0)
    points = np.array([[-9.9, 5.0], [-10.1, 5.0], [89.9, 89.9], [90.0, 5.0]])
    np.testing.assert_array_equal(tile.in_buffered(points), [True, False, True, False])
    assert not tile.in_core(points).any()


@pytest.mark.parametrize("bounds", [(1, 0, 0, 1), (0, 0, np.nan, 1), (0, 0, np.inf, 1)])
def test_impossible_bounds_are_refused(bounds: tuple[float, ...]) -> None:
    with pytest.raises(InputError, match="bounds"):
        tile_grid(bounds)


def test_a_size_of_zero_is_refused() -> None:
    with pytest.raises(InputError, match="size"):
        tile_grid((0, 0, 1, 1), size=0.0)
