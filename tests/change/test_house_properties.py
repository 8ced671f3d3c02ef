"""Properties of the decisions on randomly drawn houses, drives and sensors, for every kind of evidence.

What was built is never called less, what was taken away never more; the same on more houses:
``tests/benchmarks/bench_wrong_signs.py``.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from random_houses import BUILT, KINDS, OPPOSITE, compare, draw_case, label_of, labels, seen_from_street

from subiaco_geo.codes import Change

SEEDS = range(8)
QUICK = tuple(kind for kind in KINDS if kind != "trajectory")
QUIET = {Change.UNCHANGED, Change.UNOBSERVED}


@cache
def case(seed):
    """One street with a house and the house extended, each surveyed by a drive of its own."""
    return draw_case(seed)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", SEEDS[:4])
def test_what_was_built_is_never_less_and_what_was_taken_away_never_more(seed, kind):
    small, large = case(seed).surveys
    for before, after, truth in ((small, large, Change.INCREASED), (large, small, Change.DECREASED)):
        found = labels(compare(before, after, kind))
        assert not set(found) & set(OPPOSITE[truth]), (case(seed).what, found)


@pytest.mark.parametrize("kind", QUICK)
def test_extensions_that_both_drives_saw_are_found(kind):
    shown = [seed for seed in SEEDS if seen_from_street(case(seed))]
    right = [label_of(compare(*case(seed).surveys, kind)) is Change.INCREASED for seed in shown]
    assert len(shown) >= 4
    assert sum(right) >= 0.75 * len(shown)


def test_where_absence_is_assumed_a_wall_behind_a_new_wing_is_a_wall_of_the_house():
    """Seed 1002 builds in front of the house, and hides a wall that the earlier drive saw."""
    small, large = draw_case(1002).surveys
    assert labels(compare(small, large, "assumed")) == [Change.INCREASED]
    assert labels(compare(large, small, "assumed")) == [Change.DECREASED]


@pytest.mark.parametrize("seed", [2297, 2488], ids=["taken away", "built"])
def test_where_absence_is_assumed_a_hidden_wall_of_a_house_called_unchanged_is_no_change(seed):
    """The wing beside the house hides its side wall; what is known of the wing is too little for a claim."""
    small, large = draw_case(seed, kinds=(*BUILT, "roof"), least=0.1).surveys
    built = seed % 2 == 0
    found = labels(compare(small, large, "assumed") if built else compare(large, small, "assumed"))
    assert not set(found) & set(OPPOSITE[Change.INCREASED if built else Change.DECREASED])


@pytest.mark.parametrize("kind", QUICK)
def test_two_drives_past_one_house_find_no_change_of_it(kind):
    """Other lane, other beams, other noise."""
    for seed in SEEDS[:3]:
        again = draw_case(seed, extended=False)
        assert label_of(compare(*again.surveys, kind)) in QUIET


@pytest.mark.parametrize("seed", SEEDS[:4])
def test_less_evidence_may_silence_a_claim_and_never_turns_it(seed):
    rng = np.random.default_rng(seed)
    small, large = case(seed).surveys
    truth = label_of(compare(small, large, "observed"))
    for share in (0.5, 0.1):
        blind = [_forgetful(survey, share, rng) for survey in (small, large)]
        assert label_of(compare(blind[0], blind[1], "observed")) in {truth, Change.INCREASED, *QUIET}
        assert label_of(compare(blind[1], blind[0], "observed")) in {Change.DECREASED, *QUIET}


def _forgetful(survey, share, rng):
    """The survey with the record of a share of the blocks of 2 m that its beams passed."""
    grid = survey.map.visibility
    block, slot = np.unique(grid.keys >> 2, return_inverse=True)
    kept = (rng.random(len(block)) < share)[slot] | (grid.hits > 0)
    less = replace(grid, keys=grid.keys[kept], hits=grid.hits[kept], passes=grid.passes[kept])
    return replace(survey, map=replace(survey.map, visibility=less))
