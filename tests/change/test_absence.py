"""What beams prove about a place they crossed, and how that enters decision and confidence."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import expit, logit
from test_decisions import CONFIG, SAME

from subiaco_change.decisions.confidence import confidence, features
from subiaco_change.decisions.confidence_config import ConfidenceConfig
from subiaco_change.decisions.rules import decide
from subiaco_change.objects.known_space import KnownSpace
from subiaco_change.objects.measures import absence, opacity, pooled, porous_chance
from subiaco_change.objects.voxel_objects import ObjectInstance, Voxels
from subiaco_change.visibility_evidence import EvidenceConfig
from subiaco_geo.codes import Change, Semantic

ALONE = replace(SAME, iou=0.0, gone_share=1.0, delta_c=np.nan, delta_h=np.nan, observed_voxels=60)


def trust(decision, measures):
    found = features(decision, measures, Semantic.VEGETATION, 1.0)
    return confidence(decision, found, measures, ConfidenceConfig())


def after_beams(count):
    """The chance that a place is free that so many beams crossed and none returned from."""
    return np.array([(count + 0.5) / (count + 1.0)])


@given(beams=st.integers(0, 500), returned=st.floats(0.01, 0.99))
def test_more_beams_prove_more_and_the_more_an_object_returned_the_fewer_are_needed(beams, returned):
    chance = porous_chance(after_beams(beams), returned)[0]
    assert 0.5 <= chance <= 1.0
    assert porous_chance(after_beams(beams + 1), returned)[0] >= chance
    assert porous_chance(after_beams(beams), min(returned + 0.005, 0.995))[0] >= chance


def test_a_beam_through_the_place_of_a_wall_says_more_than_four_through_that_of_a_hedge():
    assert porous_chance(after_beams(2), 0.7)[0] > 0.9
    assert porous_chance(after_beams(4), 0.1)[0] == pytest.approx(1 / (1 + 0.9**4))
    assert porous_chance(after_beams(4), 0.1)[0] < CONFIG.min_free


def test_without_counts_of_its_own_survey_the_chance_is_that_of_the_beams():
    chances = np.array([0.2, 0.5, 0.75, 0.99])
    assert porous_chance(chances, None) == pytest.approx(chances)


def obj(passed, occupied_in_other=0):
    """Ten voxels, the first ``occupied_in_other`` also in the other epoch; ``passed`` beams a return."""
    count = 10
    xyz = np.column_stack([np.arange(count), np.zeros(count), np.ones(count)])
    held = np.arange(count) < occupied_in_other
    voxels = Voxels(
        np.zeros(count, int), xyz, xyz * 0, np.ones(count), np.ones(count, dtype=bool), held, ~held
    )
    return ObjectInstance(
        0, Semantic.VEGETATION, 0.9, np.arange(count), voxels, 0.03, xyz, np.full(count, passed)
    )


def after_knows(free):
    """Only the later survey knows what is free."""
    return KnownSpace(), KnownSpace(free=free)


def test_the_absence_of_an_object_is_asked_of_the_other_epoch_and_of_free_places_alone():
    def known(xyz):
        assert (xyz[:, 0] >= 4).all()
        return np.full(len(xyz), 0.9)

    found = absence([obj(1.0, occupied_in_other=4)], [], after_knows(known))
    assert opacity([obj(1.0)]) == pytest.approx(0.5)
    assert found == pytest.approx(expit(logit(1 / (1 + 0.5**4)) * (6 / 4) ** 0.5))
    assert absence([obj(1.0)], [], after_knows(known)[::-1]) == 1.0


@pytest.mark.parametrize(("count", "least", "most"), [(4, 0.6, 0.7), (20, 0.7, 0.85), (400, 0.95, 1.0)])
def test_thin_evidence_in_many_places_is_evidence(count, least, most):
    xyz = np.column_stack([np.arange(count), np.zeros(count), np.ones(count)])
    yes = np.ones(count, dtype=bool)
    voxels = Voxels(np.zeros(count, int), xyz, xyz * 0, np.ones(count), yes, ~yes, yes)
    part = ObjectInstance(0, Semantic.VEGETATION, 0.9, np.arange(count), voxels, 0.03, xyz, np.zeros(0))
    assert least <= absence([part], [], after_knows(lambda places: np.full(len(places), 0.64))) <= most


@given(count=st.integers(1, 400), chance=st.floats(0.5, 0.99), certain=st.floats(0.6, 1.0))
def test_what_all_places_of_an_object_share_bounds_what_they_prove_together(count, chance, certain):
    xyz = np.column_stack([np.arange(count), np.zeros(count), np.ones(count)])
    yes = np.ones(count, dtype=bool)
    voxels = Voxels(np.zeros(count, int), xyz, xyz * 0, np.ones(count), yes, ~yes, yes)
    part = ObjectInstance(0, Semantic.VEGETATION, 0.9, np.arange(count), voxels, 0.03, xyz, np.zeros(0))
    spaces = after_knows(lambda places: np.full(len(places), chance))
    whole = replace(spaces[1], certain=lambda places: np.full(len(places), certain))
    bounded = absence([part], [], (spaces[0], whole))
    assert bounded <= certain + 1e-12
    assert bounded == pytest.approx(certain * absence([part], [], spaces))


@pytest.mark.parametrize(("voxels", "claimed"), [(8, False), (40, True), (400, True)])
def test_in_a_bare_cloud_few_free_places_claim_nothing_and_many_are_not_certain(voxels, claimed):
    config = EvidenceConfig()
    free = config.shadow_certain * pooled(config.shadow_trust, voxels)
    decision = decide(Semantic.OTHER, False, True, replace(ALONE, new_share=1.0, free=free), 0.03, CONFIG)
    assert (decision.change is Change.ADDED) is claimed
    assert free < 0.86


def removed(**changes):
    return decide(Semantic.VEGETATION, True, False, replace(ALONE, **changes), 0.03, CONFIG)


def test_what_too_few_beams_crossed_is_unobserved():
    assert removed().change is Change.REMOVED
    assert removed(free=0.6).change is Change.UNOBSERVED


def test_one_beam_through_each_place_never_gives_nine_tenths():
    """However large the object is and however well its class is known."""
    measures = replace(ALONE, free=0.75, observed_voxels=5000)
    decision = replace(removed(), margin=20.0)
    assert trust(decision, measures) <= 0.75
    sure = replace(measures, free=0.99)
    assert trust(decision, sure) > 0.9


def test_with_a_fifth_of_its_place_seen_nothing_is_claimed():
    assert removed(observed_fraction=0.19).change is Change.UNOBSERVED
