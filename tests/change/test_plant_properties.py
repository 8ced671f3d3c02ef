"""Properties of the decisions on randomly drawn trees, drives and sensors, for every kind of evidence."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from random_houses import KINDS, compare, labels
from random_plants import draw_plants

from subiaco_geo.codes import Change

SEEDS = range(6)
MORE = {Change.ADDED, Change.INCREASED}
LESS = {Change.REMOVED, Change.DECREASED}


@cache
def case(seed):
    """One street with fewer and with more plants, each surveyed by a drive of its own."""
    return draw_plants(seed)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", SEEDS)
def test_a_plant_that_came_is_never_less_and_one_that_went_is_never_more(seed, kind):
    few, many = case(seed).surveys
    assert not set(labels(compare(few, many, kind))) & LESS, case(seed).what
    assert not set(labels(compare(many, few, kind))) & MORE, case(seed).what


@pytest.mark.parametrize("seed", [seed for seed in SEEDS if seed % 3 == 0])
def test_a_new_tree_that_the_other_drive_looked_across_is_found(seed):
    few, many = case(seed).surveys
    assert labels(compare(few, many, "observed"))[0] is Change.ADDED
    assert labels(compare(many, few, "observed"))[0] is Change.REMOVED


@pytest.mark.parametrize("seed", SEEDS)
def test_less_evidence_never_turns_the_sign_of_a_plant(seed):
    rng = np.random.default_rng(seed)
    few, many = case(seed).surveys
    for share in (0.5, 0.1):
        blind = [_forgetful(survey, share, rng) for survey in (few, many)]
        assert not set(labels(compare(*blind, "observed"))) & LESS
        assert not set(labels(compare(*blind[::-1], "observed"))) & MORE


def _forgetful(survey, share, rng):
    """The survey with the record of a share of the voxels that its beams passed."""
    grid = survey.map.visibility
    kept = (rng.random(len(grid.keys)) < share) | (grid.hits > 0)
    less = replace(grid, keys=grid.keys[kept], hits=grid.hits[kept], passes=grid.passes[kept])
    return replace(survey, map=replace(survey.map, visibility=less))
