"""Confidence of a row: the paper's score, and a calibrated probability (method, Decisions 15 and 19)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.special import expit, ndtr

from subiaco_change.decisions.confidence_config import (
    FEATURES,
    ClaimKind,
    Coefficients,
    ConfidenceConfig,
    MeasuredBand,
)
from subiaco_change.decisions.rules import Decision
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.objects.measures import Measures
from subiaco_change.records import ChangeRecord
from subiaco_change.visibility_evidence import KINDS
from subiaco_geo.codes import ONE_EPOCH, Change, Semantic
from subiaco_geo.frames import Floats

#: Weights h, v, o, c, p of the paper.
PAPER_WEIGHTS = {
    Semantic.BUILDING: (0.35, 0.30, 0.20, 0.10, 0.05),
    Semantic.VEGETATION: (0.30, 0.35, 0.15, 0.10, 0.10),
    Semantic.GROUND: (0.50, 0.0, 0.25, 0.0, 0.25),
}
_SIGMA_HEIGHT = NUMBERS.confidence.score_height_sigma
_SIGMA_VOLUME = NUMBERS.confidence.score_volume_sigma
_EPSILON = 1e-6
#: Confidences from which on the bands of the summary begin.
BANDS = NUMBERS.confidence.band_limits

#: The first of these follow from the decision alone.
_DECIDED = 2
_CLAIMS = ("single", "reshaped")
_COMPARED = ("reshaped", "unchanged")
_NEAR = FEATURES.index("near_limits")
_TYPICAL_NEAR = NUMBERS.confidence.typical_near_limits
_NEAR_ROWS = NUMBERS.confidence.near_limits_rows
_TYPICAL_SHARE = NUMBERS.confidence.typical_observed
_SIGMAS = NUMBERS.confidence.gate_sigmas


def paper_score(semantic: Semantic, measures: Measures, lod: float) -> float:
    """Return the paper's score, never below 0.5; NaN for mobile, other and unmatched objects."""
    if semantic not in PAPER_WEIGHTS or not math.isfinite(measures.delta_c) or not math.isfinite(lod):
        return math.nan
    shift = 2.0 if semantic is Semantic.VEGETATION else 1.5
    terms = (
        abs(measures.delta_h) / math.hypot(lod, _SIGMA_HEIGHT),
        abs(measures.delta_v) / math.sqrt((measures.volume * _SIGMA_VOLUME) ** 2 + _EPSILON),
        1.0 - measures.iou,
        max(0.0, measures.delta_c - shift) / shift,
        abs(measures.d_perp) / max(lod, 1e-6) if math.isfinite(measures.d_perp) else 0.0,
    )
    total = sum(w * t for w, t in zip(PAPER_WEIGHTS[semantic], terms, strict=True))
    return float(expit(min(total, 50.0)))


def kind_of(change: Change) -> ClaimKind | None:
    """Name the model of a label; None for labels that claim nothing."""
    if change in ONE_EPOCH:
        return "single"
    if change in (Change.INCREASED, Change.DECREASED):
        return "reshaped"
    return "unchanged" if change is Change.UNCHANGED else None


def features(
    decision: Decision,
    measures: Measures,
    semantic: Semantic,
    class_score: float,
    density: float = 0.0,
    evidence: str = "observed",
) -> Floats:
    """Return what a confidence rests on (13,), about zero for a typical row.

    In the order of :data:`FEATURES`: those of :func:`decision_features`; observed share less 0.8; log10 of
    the observed voxels less 1.7; class score less 0.7; whether it is a building or vegetation; whether it
    is vegetation; the size of the log ratio of the point densities ``density``, at most 2; the kind of
    ``evidence``; and 0 until the pair is known (:func:`rows_of_pair`).
    """
    return np.array(
        [
            *decision_features(decision),
            measures.observed_fraction - _TYPICAL_SHARE,
            math.log10(max(measures.observed_voxels, 1)) - 1.7,
            class_score - 0.7,
            float(semantic in (Semantic.BUILDING, Semantic.VEGETATION)),
            float(semantic is Semantic.VEGETATION),
            min(abs(density), 2.0),
            *(float(evidence == kind) for kind in KINDS[1:]),
            0.0,
        ]
    )


def decision_features(decision: Decision) -> tuple[float, float]:
    """Return what follows from the decision alone.

    The log of the margin (how often over the threshold that decided, between 1 and 20; for Unchanged how near
    the threshold, 0 to 1); and the distance between measure and limit in 3 standard deviations less 1,
    between -1 and 1, 0 where unknown.
    """
    unchanged = decision.change is Change.UNCHANGED
    margin = min(decision.margin, 1.0) if unchanged else math.log(min(max(decision.margin, 1.0), 20.0))
    if math.isnan(decision.sigmas):
        return margin, 0.0
    beyond = -decision.sigmas if unchanged else decision.sigmas
    return margin, 2.0 * min(max(beyond, 0.0), _SIGMAS) / _SIGMAS - 1.0


def probability(decision: Decision, found: Floats, config: ConfidenceConfig) -> float:
    """Return the probability that a label is right, from :func:`features`, by its fitted model."""
    kind = kind_of(decision.change)
    return float(expit(1.0 + 2.0 * decision.margin)) if kind is None else _modelled(kind, found, config)


def _modelled(kind: ClaimKind, found: Floats, config: ConfidenceConfig) -> float:
    """Return the probability of the model of a kind of row."""
    model: Coefficients = getattr(config, kind)
    p = float(model.probability(found))
    if kind not in _CLAIMS:
        return p
    hidden = min(max(1.0 - _TYPICAL_SHARE - found[FEATURES.index("observed")], 0.0), 1.0)
    return min(p, 1.0 - config.unseen * hidden**2)


def confidence(decision: Decision, found: Floats, measures: Measures, config: ConfidenceConfig) -> float:
    """Return the probability that a label is right, from :func:`features`, bounded by its evidence."""
    return _bounded(probability(decision, found, config), decision, measures, config)


def _bounded(fitted: float, decision: Decision, measures: Measures, config: ConfidenceConfig) -> float:
    """Bound a confidence by what the evidence can show at most.

    An object of one epoch: by how surely its place was free in the other. A building of both: by the
    probability that the true change lies on the claimed side of the limit, if the bounds of its change are
    two standard deviations from their middle. Where they leave that open, most buildings did not change.
    """
    if kind_of(decision.change) == "single":
        return min(fitted, measures.free)
    if measures.volume_bounds is None or math.isnan(decision.sigmas):
        return fitted
    beyond = float(ndtr(decision.sigmas))
    if decision.change is Change.UNCHANGED:
        return min(fitted, 1.0 - beyond * (1.0 - config.unchanged_share))
    return min(fitted, beyond)


def decided_anew(
    record: ChangeRecord, decision: Decision, config: ConfidenceConfig, free: float = 1.0
) -> ChangeRecord:
    """Return a row with another decision and the confidence in that, at most the probability ``free``."""
    found = np.array([*decision_features(decision), *record.features[_DECIDED:]])
    return replace(
        record,
        change=decision.change,
        reason=decision.reason,
        confidence=min(probability(decision, found, config), free),
        features=tuple(found.tolist()),
    )


def near_limits(records: Iterable[ChangeRecord]) -> float:
    """Return how many buildings and plants of a pair lie near a limit, as the confidence takes it.

    In tenths more than in a typical pair, of those that both surveys have: their measure exceeds its limit,
    or stays below, by less than 3 standard deviations. Where many lie there, the changes of the pair are
    about as large as the limits, and more claims are wrong than each row shows. Few rows say little.
    """
    gate, solid = FEATURES.index("gate"), FEATURES.index("solid")
    gates = [
        row.features[gate]
        for row in records
        if kind_of(row.change) in _COMPARED and row.features and row.features[solid] > 0
    ]
    near = sum(value < 0.0 for value in gates)
    return 10.0 * ((near + _TYPICAL_NEAR * _NEAR_ROWS) / (len(gates) + _NEAR_ROWS) - _TYPICAL_NEAR)


def rows_of_pair(
    records: Sequence[ChangeRecord], simulated: bool, config: ConfidenceConfig
) -> list[ChangeRecord]:
    """Return the rows of a pair with the confidences that they have among each other.

    How many of them lie near a limit tells of each; confidences that were never calibrated are lowered.
    """
    near = near_limits(records)
    return [discounted(_among(record, near, config), simulated, config) for record in records]


def _among(record: ChangeRecord, near: float, config: ConfidenceConfig) -> ChangeRecord:
    """Return a row whose confidence knows of the pair; what bounded the confidence still does."""
    kind = kind_of(record.change)
    if kind is None or not record.features:
        return record
    alone = np.array(record.features)
    found = alone.copy()
    found[_NEAR] = near
    first = _modelled(kind, alone, config)
    bound = record.confidence if record.confidence < first - _EPSILON else 1.0
    certain = min(_modelled(kind, found, config), bound)
    return replace(record, confidence=certain, features=tuple(found.tolist()))


def discounted(record: ChangeRecord, simulated: bool, config: ConfidenceConfig) -> ChangeRecord:
    """Lower the confidence of a claimed change whose kind of evidence or cloud was never calibrated.

    Parameters
    ----------
    record : ChangeRecord
    simulated : bool
        Whether both clouds come from the simulator.
    config : ConfidenceConfig
    """
    if kind_of(record.change) not in _CLAIMS or config.calibrated_for(record.evidence, simulated):
        return record
    p = min(max(record.confidence, 1e-6), 1.0 - 1e-6)
    cap = min(config.cap, config.cap_shadow) if record.evidence == "shadow" else config.cap
    lowered = min(float(expit(config.discount * math.log(p / (1.0 - p)))), cap)
    return replace(record, confidence=min(lowered, record.confidence))


@dataclass(frozen=True)
class ConfidenceCalibration:
    """What ``run.json`` says of the confidences of a pair.

    ``calibrated_for``: evidence, clouds and surveys of the fit; empty without one. ``lacking``: sentences
    that say why confidences of this pair are not calibrated; empty where they are. ``bands``: how many
    claims of each band were right on surveys left out of the fit; empty where that was never measured.
    """

    calibrated_for: Mapping[str, Any] = field(default_factory=dict)
    lacking: tuple[str, ...] = ("Confidences of this method are not calibrated.",)
    bands: tuple[MeasuredBand, ...] = ()


def calibration_of(kinds: Iterable[str], simulated: bool, config: ConfidenceConfig) -> ConfidenceCalibration:
    """Compare what the confidences were fitted on with a pair: its kinds of evidence and its clouds."""
    if not config.calibrated:
        return ConfidenceCalibration()
    fitted = {"evidence": list(config.evidence), "clouds": config.clouds, "surveys": config.fitted_on}
    lacking = []
    if not simulated and config.clouds != "own":
        lacking.append(
            "Confidence is not calibrated for this kind of cloud: it was fitted on simulated surveys."
            " 'subiaco calibrate' fits it to your own map."
        )
    missing = sorted(set(kinds) - set(config.evidence))
    if missing:
        names = ", ".join(missing)
        lacking.append(f"Confidence is not calibrated for evidence of the kind {names}.")
    own = config.fitted_on == ConfidenceConfig().fitted_on or "bands" in config.model_fields_set
    return ConfidenceCalibration(fitted, tuple(lacking), config.bands if own and not lacking else ())
