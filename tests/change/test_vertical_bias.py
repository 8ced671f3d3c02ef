"""Heights between epochs: the long wave goes, what happened to the ground stays."""

import numpy as np
import pytest
from assembled_run import vertical_bias

from subiaco_change.level_of_detection.alignment_corrections import VerticalBiasConfig


def ground(seed, lift=None, size=(200.0, 160.0)):
    rng = np.random.default_rng(seed)
    n = int(size[0] * size[1] * 6)
    xyz = np.column_stack([rng.uniform(0, size[0], n), rng.uniform(0, size[1], n), rng.normal(0, 0.01, n)])
    xyz[:, 2] += 0.02 * xyz[:, 0]
    if lift is not None:
        xyz[:, 2] += lift(xyz[:, 0], xyz[:, 1])
    return xyz


def left(lift, seed=0, **settings):
    """Differences that the correction leaves, at the points of *after*."""
    before, after = ground(10 + seed), ground(20 + seed, lift)
    field = vertical_bias(before, after, np.zeros(3), VerticalBiasConfig(**settings))
    assert field is not None
    return after, lift(after[:, 0], after[:, 1]) - field.at(after)[:, 2]


def test_an_offset_as_of_a_real_pair_is_found_and_removed():
    _, rest = left(lambda x, y: np.full_like(x, -0.41))
    assert np.abs(rest).max() < 0.005


def test_a_long_wave_is_found_and_removed():
    _, rest = left(lambda x, y: 0.05 * np.sin(2 * np.pi * x / 400.0) + 0.1)
    assert np.abs(rest).max() < 0.03
    assert np.sqrt(np.mean(rest**2)) < 0.012


@pytest.mark.parametrize("rise", [-0.30, 0.20])
def test_a_change_that_fills_a_tile_keeps_its_size(rise):
    after, rest = left(lambda x, y: rise * ((x > 60) & (x < 80) & (y > 60) & (y < 80)) - 0.41)
    changed = (after[:, 0] > 61) & (after[:, 0] < 79) & (after[:, 1] > 61) & (after[:, 1] < 79)
    assert np.median(rest[changed]) == pytest.approx(rise, abs=0.01)
    assert np.abs(np.median(rest[~changed])) < 0.01


def test_a_change_of_25_square_metres_keeps_its_size():
    after, rest = left(lambda x, y: 0.2 * ((x > 65) & (x < 70) & (y > 65) & (y < 70)))
    changed = (after[:, 0] > 65) & (after[:, 0] < 70) & (after[:, 1] > 65) & (after[:, 1] < 70)
    assert np.median(rest[changed]) == pytest.approx(0.2, abs=0.01)


def test_several_tiles_of_works_side_by_side_keep_their_size():
    after, rest = left(lambda x, y: -0.3 * ((x > 60) & (x < 120) & (y > 60) & (y < 100)))
    changed = (after[:, 0] > 62) & (after[:, 0] < 118) & (after[:, 1] > 62) & (after[:, 1] < 98)
    assert np.median(rest[changed]) == pytest.approx(-0.3, abs=0.01)


def test_too_little_ground_gives_no_correction():
    small = ground(1, size=(30.0, 20.0)), ground(2, lambda x, y: 0.0 * x - 0.41, size=(30.0, 20.0))
    assert vertical_bias(*small, np.zeros(3), VerticalBiasConfig()) is None
    assert vertical_bias(small[0][:0], small[1], np.zeros(3), VerticalBiasConfig()) is None


def test_an_offset_beyond_belief_is_kept_and_said(caplog):
    before, after = ground(1), ground(2, lambda x, y: 0.0 * x + 3.0)
    assert vertical_bias(before, after, np.zeros(3), VerticalBiasConfig()) is None
    assert "max_offset" in caplog.text


def test_tiles_stand_on_whole_multiples_in_the_world():
    origin = np.array([391_007.0, 6_464_013.0, 0.0])
    field = vertical_bias(ground(1), ground(2), origin, VerticalBiasConfig())
    assert np.allclose((field.grid.corner + origin[:2]) % 20.0, 0.0)
