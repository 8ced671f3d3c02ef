"""Which lines of sight a depth image says are hidden."""

import numpy as np

from subiaco_geo.free_space.depth_images import DepthImages, ImageGrid, Surfaces, render

_SHOWN = Surfaces(0.15, 0.5, 60.0, 0.0)


def test_lines_end_at_a_wall_and_go_on_beside_above_and_before_it() -> None:
    eyes = np.array([[0.0, 0.0, 2.0], [0.0, 20.0, 2.0]])
    y, z = (v.ravel() for v in np.meshgrid(np.arange(-4, 4, 0.2), np.arange(0, 4, 0.2)))
    wall = np.column_stack([np.full(len(y), 10.0), y, z])
    grid = ImageGrid.covering(0.5, -75.0, 75.0)
    images = DepthImages(eyes, np.tile([0.0, 0.0, 1.0], (2, 1)), render(wall, eyes, grid, _SHOWN), grid)
    places = np.array([[20.0, 0, 1], [20, 15, 1], [20, 0, 9], [9, 0, 1], [10.2, 0, 1]])
    first = np.zeros(len(places), dtype=np.int64)
    lines = np.arange(len(places), dtype=np.int32)
    assert images.hides(places, lines, first, 0.5).tolist() == [True, False, False, False, False]
    assert not images.hides(places, lines, first - 1, 0.5).any()
    shifted = places[:1] + np.array([0.0, 15.0, 0.0])  # behind the wall for the first pose alone
    assert not images.hides(shifted, lines[:1], first[:1] + 1, 0.5).any()
