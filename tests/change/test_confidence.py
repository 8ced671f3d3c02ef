"""Confidence is a probability that follows the evidence, and the fit finds known coefficients."""

import numpy as np
import pytest
from scipy.special import expit

from subiaco_change.changes.confidence import (
    FEATURES,
    Coefficients,
    ConfidenceConfig,
    confidence,
    features,
    fit,
    kind_of,
)
from subiaco_change.changes.decisions import Decision
from subiaco_change.changes.measures import Measures
from subiaco_geo.codes import Change, Semantic

TYPICAL = Measures(
    iou=0.9, d_perp=0.0, delta_c=0.1, delta_h=0.0, delta_v=0.0, delta_v_surface=0.0, volume=100.0, chi2=0.0,
    gone_share=0.0, new_share=0.0, observed_fraction=0.8, seen_voxels=50, carried=0.0,
)  # fmt: skip


def test_a_typical_row_has_the_confidence_of_the_intercept():
    zero = dict.fromkeys(FEATURES, 1.0)
    config = ConfidenceConfig(single=Coefficients(intercept=1.2, **zero))
    row = Decision(Change.ADDED, "", 1.0)
    assert confidence(row, TYPICAL, Semantic.MOBILE, 0.7, config) == pytest.approx(expit(1.2), abs=0.005)


def test_the_fit_recovers_the_model_that_made_the_labels_and_its_mean_is_the_share_of_right_ones():
    rng = np.random.default_rng(5)
    truth = np.array([0.8, 1.0, -0.5, 0.7, 0.0, 0.3])
    x = rng.normal(size=(20_000, 5))
    right = rng.random(20_000) < expit(truth[0] + x @ truth[1:])
    model = fit(x, right)
    found = [model.intercept, *(getattr(model, name) for name in FEATURES)]
    assert np.allclose(found, truth, atol=0.06)
    slopes = np.array(found[1:])
    assert expit(found[0] + x @ slopes).mean() == pytest.approx(right.mean(), abs=0.002)


def test_a_fit_on_few_rows_stays_near_their_share():
    model = fit(np.array([[1.0, 0, 0, 0, 0], [0.0, 0, 0, 0, 1]]), np.array([True, True]), ridge=5.0)
    assert abs(model.margin) < 0.5


def test_evidence_that_may_only_raise_a_confidence_never_lowers_it_whatever_few_rows_say():
    rng = np.random.default_rng(7)
    x = rng.normal(size=(400, 5))
    right = rng.random(400) < expit(1.0 - 2.0 * x[:, 2] + x[:, 3])
    free, bound = fit(x, right), fit(x, right, rising=("size", "purity"))
    assert free.size < -1.0
    assert bound.size == 0.0
    assert bound.purity > 0.5


def test_labels_that_claim_nothing_have_no_model_and_the_margin_of_unchanged_is_bounded():
    assert kind_of(Change.UNOBSERVED) is None
    assert kind_of(Change.NOT_REPORTED) is None
    unchanged = features(Decision(Change.UNCHANGED, "", 7.0), TYPICAL, Semantic.BUILDING, 0.7)
    added = features(Decision(Change.ADDED, "", 1e9), TYPICAL, Semantic.BUILDING, 0.7)
    assert unchanged[0] == 1.0
    assert added[0] == pytest.approx(np.log(20.0))


def test_a_fit_that_missed_on_other_surveys_is_not_called_calibrated():
    assert ConfidenceConfig(fitted_on="seeds", held_out_ece=0.04).calibrated
    assert not ConfidenceConfig(fitted_on="seeds", held_out_ece=0.06).calibrated
    assert not ConfidenceConfig(fitted_on="", held_out_ece=0.0).calibrated
