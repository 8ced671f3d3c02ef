"""Two methods on the same tiles."""

import numpy as np
import pytest

from subiaco_evaluation.grid import GridConfig, cell_centres, cell_keys
from subiaco_evaluation.paired import paired_difference, tile_matrices
from subiaco_evaluation.scores import confusion
from subiaco_geo.errors import InputError

GRID = GridConfig()
FAR = np.array([389_000.0, 6_464_000.0])


def survey(seed, wrong):
    """Labels of 4 by 4 tiles' cells, and what a method said that is wrong in a share of them."""
    rng = np.random.default_rng(seed)
    xy = FAR + rng.uniform(0, 320, (20_000, 2))
    keys = np.unique(cell_keys(xy, GRID))
    truth = np.random.default_rng(1).integers(0, 5, len(keys))
    said = np.where(rng.random(len(keys)) < wrong, rng.integers(0, 5, len(keys)), truth)
    return keys, truth, said


def test_the_middle_of_a_cell_is_in_it():
    keys = np.unique(cell_keys(FAR + np.random.default_rng(0).uniform(-300, 300, (500, 2)), GRID))
    assert np.array_equal(cell_keys(cell_centres(keys, GRID), GRID), keys)


def test_tiles_add_up_to_the_whole_and_lie_on_the_80_m_grid():
    keys, truth, said = survey(0, 0.2)
    tiles = tile_matrices(keys, truth, said, GRID)
    assert len(tiles) == 20  # five columns, for 389 000 is no multiple of 80, and four rows
    assert np.array_equal(tiles.sum(axis=0), confusion(truth, said))


def test_the_better_method_is_better_in_every_draw_and_the_same_one_is_never():
    keys, truth, good = survey(0, 0.1)
    bad = np.where(np.random.default_rng(5).random(len(keys)) < 0.3, 4, good)
    first, second = (tile_matrices(keys, truth, said, GRID) for said in (good, bad))
    found = paired_difference(first, second, 200, 0)
    assert found["miou"]["better_fraction"] == 1.0
    low, high = found["miou"]["interval_95_percent"]
    assert 0 < low < found["miou"]["difference_percent"] < high
    turned = paired_difference(second, first, 200, 0)
    assert turned["miou"]["difference_percent"] == -found["miou"]["difference_percent"]
    same = paired_difference(first, first, 200, 0)
    assert same["miou"]["interval_95_percent"] == [0.0, 0.0]
    assert same["miou"]["better_fraction"] == 0.0


def test_what_one_tile_alone_speaks_for_is_not_certain():
    """Equal on nine tiles, better on one: a third of the draws miss that one."""
    keys, truth, good = survey(0, 0.1)
    tiles = tile_matrices(keys, truth, good, GRID)[:10]
    worse = tiles.copy()
    worse[0] = np.roll(worse[0], 1, axis=1)
    share = paired_difference(tiles, worse, 2000, 0)["miou"]["better_fraction"]
    assert share == pytest.approx(1 - 0.9**10, abs=0.03)


def test_tiles_of_different_surveys_are_refused():
    keys, truth, said = survey(0, 0.1)
    tiles = tile_matrices(keys, truth, said, GRID)
    with pytest.raises(InputError, match="same survey"):
        paired_difference(tiles, tiles[:-1], 100, 0)
