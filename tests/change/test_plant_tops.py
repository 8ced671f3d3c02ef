"""Tops of plants, column by column at equal density, where the space above was observed."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from subiaco_change.config import ChangeConfig
from subiaco_change.method_rules.switches import rules_switched_off
from subiaco_change.objects.known_space import KnownSpace
from subiaco_change.objects.plant_tops import TopConfig, change_of_tops, expected_top
from subiaco_change.point_spacing import at_spacing

CONFIG = TopConfig()
NOTHING = KnownSpace()


def crown(seed, points=3000, top=9.0, height=4.0, radius=2.5, x=0.0):
    """Points in an ellipsoid of foliage, more of them in its skin."""
    rng = np.random.default_rng(seed)
    way = rng.normal(size=(points, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    reach = rng.uniform(0.5, 1.0, (points, 1)) ** 0.5
    return way * reach * [radius, radius, 0.5 * height] + [x, 0.0, top - 0.5 * height]


def test_the_expected_top_of_a_draw_is_the_mean_over_all_draws():
    heights = np.array([1.0, 4.0, 2.5, 7.0, 3.0])
    for drawn in (1, 2, 3, 5):
        mean = np.mean([max(heights[list(draw)]) for draw in itertools.combinations(range(5), drawn)])
        found = expected_top(heights, np.zeros(5, dtype=int), np.array([drawn]))
        assert found == pytest.approx([mean])


@pytest.mark.parametrize("rise", [-0.7, -0.4, 0.4, 0.7])
@pytest.mark.parametrize("points", [(900, 3000), (3000, 900)])
def test_a_crown_that_grew_or_was_topped_is_measured_whatever_the_densities(rise, points):
    before = crown(1, points[0])
    after = crown(2, points[1], top=9.0 + rise, height=4.0 + rise)
    found = change_of_tops(before, after, (NOTHING, NOTHING), CONFIG)
    assert found.median == pytest.approx(rise, abs=0.15)
    assert abs(found.median) > 2 * found.sigma


def test_density_alone_moves_no_top_and_its_error_says_how_far_it_could():
    beyond = []
    for seed in range(40):
        pair = crown(2 * seed, 500), crown(2 * seed + 1, 4000)
        found = change_of_tops(*pair, (NOTHING, NOTHING), CONFIG)
        beyond.append(abs(found.median) > 3 * np.hypot(found.sigma, 0.03))
    assert np.mean(beyond) <= 0.05


@pytest.mark.parametrize("hidden", ["before", "after"])
def test_a_crown_of_which_one_survey_saw_the_upper_part_alone_has_the_same_top(hidden):
    """Of the crown behind a house, some 60 points above the ridge, and 700 of the whole crown of 8 m."""

    def medians():
        for seed in range(12):
            part = crown(2 * seed, 600, height=8.0)
            pair = part[part[:, 2] > 7.5], crown(2 * seed + 1, 700, height=8.0)
            found = change_of_tops(*(pair if hidden == "before" else pair[::-1]), (NOTHING, NOTHING), CONFIG)
            yield found.median

    assert abs(np.mean(list(medians()))) < 0.1
    with rules_switched_off(("common_view_of_crowns",)):
        assert abs(np.mean(list(medians()))) > 0.25


@pytest.mark.parametrize("rise", [3.0, -3.0])
def test_a_crown_that_lies_wholly_above_the_old_one_is_measured_whole(rise):
    low, high = crown(1, top=6.0, height=2.0), crown(2, top=6.0 + abs(rise), height=2.0)
    pair = (low, high) if rise > 0 else (high, low)
    assert change_of_tops(*pair, (NOTHING, NOTHING), CONFIG).median == pytest.approx(rise, abs=0.2)


def test_a_top_above_the_view_of_the_other_epoch_is_not_known():
    before, after = crown(1), crown(2)
    cut = before[before[:, 2] < 8.2]  # its view ended there

    def free(xyz):
        return np.where(xyz[:, 2] < 8.2, 0.9, 0.5)

    blind = KnownSpace(above=free)
    assert np.isnan(change_of_tops(cut, after, (blind, NOTHING), CONFIG).median)
    with rules_switched_off(["space_above_tops"]):
        assert change_of_tops(cut, after, (blind, NOTHING), CONFIG).median > 0.2
    open_sky = replace(blind, above=lambda xyz: np.full(len(xyz), 0.9))
    assert change_of_tops(cut, after, (open_sky, NOTHING), CONFIG).median > 0.2


def test_one_free_place_above_a_top_does_not_show_that_the_plant_ends_there():
    """A plant 1.4 m lower in *after*, where one ring passed 0.5 m above its points and none higher."""
    before, after = crown(1, top=4.0, height=3.5), crown(2, top=2.6, height=2.1)

    def ring(xyz):
        return np.where(xyz[:, 2] < 3.15, 0.9, 0.5)

    found = change_of_tops(before, after, (NOTHING, KnownSpace(above=ring)), CONFIG)
    assert np.isnan(found.median)
    assert found.unseen
    open_sky = KnownSpace(above=lambda xyz: np.full(len(xyz), 0.9))
    seen = change_of_tops(before, after, (NOTHING, open_sky), CONFIG)
    assert seen.median == pytest.approx(-1.4, abs=0.2)
    assert not seen.unseen


def test_plants_that_share_no_columns_have_no_unseen_tops():
    found = change_of_tops(crown(1), crown(2, x=20.0), (NOTHING, NOTHING), CONFIG)
    assert np.isnan(found.median)
    assert not found.unseen


def test_points_of_another_class_between_the_tops_contradict_growth():
    before, after = crown(1), crown(2, top=9.6, height=4.6)
    lost = crown(3, top=9.6, height=4.6)
    other = KnownSpace(lost[lost[:, 2] > 8.0])
    assert change_of_tops(before, after, (NOTHING, NOTHING), CONFIG).median > 0.4
    assert np.isnan(change_of_tops(before, after, (other, NOTHING), CONFIG).median)


def test_a_part_that_rose_is_told_from_scatter():
    before = np.concatenate([crown(1), crown(2, x=5.0), crown(3, x=10.0)])
    grown = crown(4, top=10.5, height=5.5, x=10.0)
    same = np.concatenate([crown(5), crown(6, x=5.0)])
    found = change_of_tops(before, np.concatenate([same, grown]), (NOTHING, NOTHING), CONFIG)
    assert found.rise_of_part > 0.3
    assert found.fall_of_part == 0.0
    still = change_of_tops(before, np.concatenate([same, crown(7, x=10.0)]), (NOTHING,) * 2, CONFIG)
    assert (still.rise_of_part, still.fall_of_part) == (0.0, 0.0)


def test_tops_of_sparse_crowns_are_read_from_columns_as_wide_as_their_points_ask():
    """60 points a crown of 28 m2: columns of 0.75 m hold one of them, and no comparison rests on these."""
    wide = at_spacing(ChangeConfig(), 0.6).plants.tops
    rises = []
    for seed in range(60):
        pair = crown(2 * seed, 60, radius=3.0), crown(2 * seed + 1, 60, radius=3.0)
        rises.append(change_of_tops(*pair, (NOTHING, NOTHING), wide))
    known = [r for r in rises if np.isfinite(r.median)]
    assert len(known) >= 51
    assert np.isnan(change_of_tops(crown(0, 60), crown(1, 60), (NOTHING, NOTHING), CONFIG).median)
    assert np.mean([abs(r.median) > 3 * np.hypot(r.sigma, 0.1) for r in known]) <= 0.1
    grown = change_of_tops(
        crown(1, 60, radius=3.0), crown(2, 60, radius=3.3, top=10.5, height=5.5), (NOTHING, NOTHING), wide
    )
    assert grown.median > 0.8
