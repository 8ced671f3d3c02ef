"""Confidence is a probability that follows the evidence, and the fit finds known coefficients."""

import math
from dataclasses import MISSING, fields, replace

import numpy as np
import pandas as pd
import pytest
from scipy.special import expit

from subiaco_change.decisions.confidence import (
    calibration_of,
    confidence,
    decided_anew,
    discounted,
    features,
    kind_of,
    near_limits,
    probability,
    rows_of_pair,
)
from subiaco_change.decisions.confidence_config import FEATURES, Coefficients, ConfidenceConfig
from subiaco_change.decisions.config import DecisionConfig
from subiaco_change.decisions.rules import Decision, decide
from subiaco_change.objects.measures import Measures
from subiaco_change.objects.space_carving import Interval
from subiaco_change.records import ChangeRecord
from subiaco_evaluation.confidence_fit import fit, fit_confidence, measured_bands
from subiaco_geo.codes import Change, Semantic


def _record(**said):
    nothing = {f.name: math.nan for f in fields(ChangeRecord) if f.default is MISSING}
    row = ChangeRecord(**{**nothing, "semantic": Semantic.VEGETATION, "change": Change.ADDED})
    return replace(row, **said)


TYPICAL = Measures(
    iou=0.9, d_perp=0.0, delta_c=0.1, delta_h=0.0, delta_v=0.0, delta_v_surface=0.0, volume=100.0,
    gone_share=0.0, new_share=0.0, observed_fraction=0.8, observed_voxels=50, net_changed_fraction=0.0,
)  # fmt: skip

NONE = {"margin": 0.0, "gate": 0.0, "observed": 0.0, "size": 0.0, "purity": 0.0, "solid": 0.0, "density": 0.0}


def test_a_typical_row_has_the_confidence_of_the_intercept():
    zero = dict.fromkeys(FEATURES, 1.0)
    config = ConfidenceConfig(single=Coefficients(intercept=1.2, **zero))
    row = Decision(Change.ADDED, "", 1.0)
    found = features(row, TYPICAL, Semantic.MOBILE, 0.7)
    assert confidence(row, found, TYPICAL, config) == pytest.approx(expit(1.2), abs=0.005)


def test_the_fit_recovers_the_model_that_made_the_labels_and_its_mean_is_the_share_of_right_ones():
    rng = np.random.default_rng(5)
    truth = np.array([0.8, 1.0, -0.5, 0.7, 0.0, 0.3, 0.2, *np.zeros(len(FEATURES) - 6)])
    others = len(FEATURES) - 6
    x = np.column_stack([rng.normal(size=(20_000, 6)), np.zeros((20_000, others))])
    right = rng.random(20_000) < expit(truth[0] + x @ truth[1:])
    model = fit(x, right)
    found = [model.intercept, *(getattr(model, name) for name in FEATURES)]
    assert np.allclose(found, truth, atol=0.06)
    slopes = np.array(found[1:])
    assert expit(found[0] + x @ slopes).mean() == pytest.approx(right.mean(), abs=0.002)


def test_a_fit_on_few_rows_stays_near_their_share():
    model = fit(np.eye(len(FEATURES))[[0, 4]], np.array([True, True]), ridge=5.0)
    assert abs(model.margin) < 0.5


def test_evidence_that_may_only_raise_a_confidence_never_lowers_it_whatever_few_rows_say():
    rng = np.random.default_rng(7)
    x = rng.normal(size=(400, len(FEATURES)))
    size, purity, density = (FEATURES.index(name) for name in ("size", "purity", "density"))
    right = rng.random(400) < expit(1.0 - 2.0 * x[:, size] + x[:, purity] + x[:, density])
    free, bound = fit(x, right), fit(x, right, rising=("size", "purity"))
    assert free.size < -1.0
    assert bound.size == 0.0
    assert bound.purity > 0.4
    assert free.density == 0.0  # densities that differ more are no reason for trust


def test_labels_that_claim_nothing_have_no_model_and_the_margin_of_unchanged_is_bounded():
    assert kind_of(Change.UNOBSERVED) is None
    assert kind_of(Change.NOT_REPORTED) is None
    unchanged = features(Decision(Change.UNCHANGED, "", 7.0), TYPICAL, Semantic.BUILDING, 0.7)
    added = features(Decision(Change.ADDED, "", 1e9), TYPICAL, Semantic.BUILDING, 0.7)
    assert unchanged[0] == 1.0
    assert added[0] == pytest.approx(np.log(20.0))


def test_the_distance_from_the_limit_counts_in_standard_deviations_and_is_neutral_where_unknown():
    gate = FEATURES.index("gate")

    def found(change, sigmas):
        return features(Decision(change, "", 2.0, sigmas), TYPICAL, Semantic.VEGETATION, 0.7)[gate]

    assert [found(Change.INCREASED, s) for s in (0.0, 3.0, 6.0, 60.0)] == [-1.0, 0.0, 1.0, 1.0]
    assert [found(Change.UNCHANGED, s) for s in (0.0, -3.0, -60.0)] == [-1.0, 0.0, 1.0]
    assert found(Change.INCREASED, np.nan) == 0.0
    assert found(Change.UNCHANGED, -np.inf) == 1.0


def test_each_kind_of_evidence_has_its_own_feature_and_counted_beams_have_none():
    row = Decision(Change.ADDED, "", 1.0)
    kinds = ("trajectory", "estimated", "shadow", "assumed")
    slots = [FEATURES.index(kind) for kind in kinds]
    for kind in kinds:
        found = features(row, TYPICAL, Semantic.MOBILE, 0.7, evidence=kind)
        assert found[FEATURES.index(kind)] == 1.0
        assert found[slots].sum() == 1.0
    assert features(row, TYPICAL, Semantic.MOBILE, 0.7)[slots].sum() == 0.0


@pytest.mark.parametrize("p", [0.55, 0.7, 0.85, 0.97, 0.999])
def test_evidence_or_clouds_that_were_never_calibrated_lower_a_confidence_and_keep_the_order(p):
    config = ConfidenceConfig(fitted_on="seeds", held_out_ece=0.02, evidence=("observed",))
    row = _record(confidence=p, evidence="observed")
    assert discounted(row, True, config).confidence == p
    for other, simulated in ((row, False), (replace(row, evidence="shadow"), True)):
        low = discounted(other, simulated, config).confidence
        assert 0.5 < low < p
        assert low <= config.cap
    unchanged = replace(row, change=Change.UNCHANGED)
    assert discounted(unchanged, False, config).confidence == p  # the discount is for claims
    lower = discounted(replace(row, confidence=0.9 * p), False, config).confidence
    assert lower <= discounted(row, False, config).confidence


def test_a_bare_cloud_never_makes_a_claim_nearly_certain():
    row = _record(confidence=0.9999, evidence="shadow")
    config = ConfidenceConfig()
    for change in (Change.ADDED, Change.INCREASED):
        assert discounted(replace(row, change=change), False, config).confidence == config.cap_shadow < 0.9


def test_copies_of_the_survey_itself_calibrate_its_confidences_and_unobserved_rows_are_left_alone():
    own = ConfidenceConfig(fitted_on="injected", held_out_ece=0.02, clouds="own")
    assert discounted(_record(confidence=0.97, evidence="observed"), False, own).confidence == 0.97
    unseen = _record(confidence=0.97, evidence="assumed", change=Change.UNOBSERVED)
    assert discounted(unseen, False, ConfidenceConfig()).confidence == 0.97


def test_a_row_decided_anew_has_the_reason_and_the_confidence_of_the_new_decision():
    config = ConfidenceConfig()
    first, second = Decision(Change.INCREASED, "a", 2.0, 3.0), Decision(Change.UNCHANGED, "b", 0.5, -2.0)
    rows = [features(d, TYPICAL, Semantic.VEGETATION, 0.8, 0.4, "trajectory") for d in (first, second)]
    old = _record(confidence=probability(first, rows[0], config), features=tuple(rows[0].tolist()))
    new = decided_anew(old, second, config)
    assert (new.change, new.reason) == (Change.UNCHANGED, "b")
    assert new.features == pytest.approx(rows[1].tolist())
    assert new.confidence == pytest.approx(probability(second, rows[1], config))


def _pair(sigmas, config, semantic=Semantic.VEGETATION):
    """Rows of unchanged plants whose measures lie below their limits by these standard deviations."""
    rows = []
    for value in sigmas:
        row = Decision(Change.UNCHANGED, "", 0.5, -value)
        found = features(row, TYPICAL, semantic, 0.8)
        certain = probability(row, found, config)
        rows.append(
            _record(semantic=semantic, change=row.change, features=tuple(found.tolist()), confidence=certain)
        )
    return rows


def test_a_claim_is_less_certain_in_a_pair_of_which_many_plants_lie_near_their_limits():
    model = Coefficients(intercept=2.0, **{**NONE, "gate": 0.5}, near_limits=-0.5)
    config = ConfidenceConfig(single=model, unchanged=model)
    row = Decision(Change.ADDED, "", 2.0)
    found = features(row, TYPICAL, Semantic.OTHER, 0.8)
    certain = probability(row, found, config)
    claim = _record(
        semantic=Semantic.OTHER, features=tuple(found.tolist()), confidence=certain, evidence="observed"
    )
    clear, crowded = _pair([3.0] * 60, config), _pair([0.2] * 60, config)
    apart, among = (rows_of_pair([claim, *rows], True, config)[0] for rows in (clear, crowded))
    assert among.confidence < certain < apart.confidence
    assert among.features[:-1] == claim.features[:-1]
    assert rows_of_pair([claim], True, config)[0].confidence == pytest.approx(certain), "one row says nothing"
    capped = replace(claim, confidence=0.6)  # by how surely its place was free
    assert rows_of_pair([capped, *clear], True, config)[0].confidence == 0.6
    assert rows_of_pair([capped, *crowded], True, config)[0].confidence <= 0.6


def test_only_buildings_and_plants_of_both_surveys_tell_how_near_to_the_limits_changes_lie():
    config = ConfidenceConfig()
    assert near_limits([]) == pytest.approx(0.0)
    near = _pair([0.2] * 180, config)
    assert near_limits(near) == pytest.approx(10 * (189 / 200 - 0.45))
    assert near_limits(_pair([0.2] * 180, config, Semantic.OTHER)) == pytest.approx(0.0)
    assert near_limits([replace(row, change=Change.ADDED) for row in near]) == pytest.approx(0.0)


def test_a_fit_that_missed_on_other_surveys_is_not_called_calibrated():
    assert ConfidenceConfig(fitted_on="seeds", held_out_ece=0.04).calibrated
    assert not ConfidenceConfig(fitted_on="seeds", held_out_ece=0.06).calibrated
    assert not ConfidenceConfig(fitted_on="", held_out_ece=0.0).calibrated


def test_a_run_says_what_its_confidences_were_fitted_on_and_why_they_do_not_hold_for_a_pair():
    config = ConfidenceConfig(fitted_on="seeds", held_out_ece=0.02, evidence=("observed", "trajectory"))
    known = calibration_of({"observed"}, True, config)
    assert known.lacking == ()
    assert known.calibrated_for["evidence"] == ["observed", "trajectory"]
    foreign = calibration_of({"observed", "assumed"}, False, config)
    assert len(foreign.lacking) == 2
    assert "not calibrated for this kind of cloud" in foreign.lacking[0]
    assert "assumed" in foreign.lacking[1]
    never = calibration_of({"observed"}, True, ConfidenceConfig(fitted_on=""))
    assert never.calibrated_for == {}
    assert never.lacking


@pytest.mark.parametrize(("share", "most"), [(0.19, 0.85), (0.5, 0.94), (1.0, 1.0)])
def test_a_claim_about_a_place_that_was_hardly_observed_is_never_sure(share, most):
    sure = ConfidenceConfig(single=Coefficients(intercept=8.0, **dict.fromkeys(FEATURES, 0.0)))
    row = Decision(Change.ADDED, "", 5.0)
    seen = replace(TYPICAL, observed_fraction=share)
    found = confidence(row, features(row, seen, Semantic.BUILDING, 0.9), seen, sure)
    assert most - 0.02 < found <= most


@pytest.mark.parametrize(
    ("low", "high", "most"), [(6.0, 14.5, 0.6), (9.0, 15.0, 0.92), (11.0, 15.0, 1.0), (-2.0, 4.0, 1.0)]
)
def test_bounds_that_straddle_the_limit_of_a_building_cap_the_confidence(low, high, most):
    bounds = Interval(low, high)
    house = replace(
        TYPICAL,
        iou=0.9,
        volume=100.0,
        delta_v=bounds.middle,
        volume_bounds=bounds,
        height_bounds=Interval(0.0, 0.0),
    )
    decision = decide(Semantic.BUILDING, True, True, house, 0.1, DecisionConfig())
    assert decision.change is (Change.INCREASED if bounds.middle > 10.0 else Change.UNCHANGED)
    sure = ConfidenceConfig(
        reshaped=Coefficients(intercept=9.0, **NONE), unchanged=Coefficients(intercept=9.0, **NONE)
    )
    found = confidence(decision, features(decision, house, Semantic.BUILDING, 0.7), house, sure)
    assert most - 0.1 < found <= most


def test_a_building_whose_bounds_leave_everything_open_is_unchanged_as_most_buildings_are():
    bounds = Interval(-60.0, 80.0)
    house = replace(
        TYPICAL, volume=100.0, delta_v=10.0, volume_bounds=bounds, height_bounds=Interval(0.0, 0.0)
    )
    decision = decide(Semantic.BUILDING, True, True, house, 0.1, DecisionConfig())
    sure = ConfidenceConfig(unchanged=Coefficients(intercept=9.0, **NONE))
    assert decision.change is Change.UNCHANGED
    found = features(decision, house, Semantic.BUILDING, 0.7)
    assert confidence(decision, found, house, sure) == pytest.approx(0.875, abs=0.01)


def test_bands_are_called_by_what_was_measured_on_surveys_left_out():
    rng = np.random.default_rng(8)
    count = 600
    x = np.zeros((count, len(FEATURES)))
    x[:, FEATURES.index("observed")] = rng.uniform(-2.0, 2.0, count)
    right = rng.random(count) < expit(1.0 + 1.5 * x[:, FEATURES.index("observed")])
    rows = pd.DataFrame({"kind": "single", "features": list(x), "right": right, "evidence": "observed"})
    rows["survey"] = np.where(np.arange(count) % 2, "a", "b")
    bands = measured_bands(rows)
    assert [(b["low"], b["high"]) for b in bands] == [(0.9, 1.01), (0.7, 0.9), (0.0, 0.7)]
    assert sum(b["claims"] for b in bands) == count
    assert sum(b["right"] for b in bands) == right.sum()
    for band in bands:
        share = band["right"] / band["claims"]
        assert band["low"] - 0.06 <= share <= band["high"] + 0.06
    config = ConfidenceConfig(**fit_confidence(rows, "made up"))
    assert calibration_of(["observed"], True, config).bands == config.bands
    assert len(config.bands) == 3


def test_bands_that_were_measured_on_other_surveys_are_not_printed():
    ours = ConfidenceConfig()
    assert calibration_of(["observed"], True, ours).bands == ours.bands != ()
    assert calibration_of(["observed"], False, ours).bands == ()
    assert calibration_of(["assumed"], True, ours).bands == ()
    refitted = ConfidenceConfig(fitted_on="another fit without bands")
    assert calibration_of(["observed"], True, refitted).bands == ()
