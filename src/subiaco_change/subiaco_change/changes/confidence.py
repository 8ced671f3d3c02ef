"""How far to trust a row: the paper's score, and a probability (method, Decision 15)."""

from __future__ import annotations

import math

from subiaco_change.changes.decisions import Decision
from subiaco_change.changes.measures import Measures
from subiaco_change.records import Change, Semantic

#: Weights h, v, o, c, p of the paper.
PAPER_WEIGHTS = {
    Semantic.BUILDING: (0.35, 0.30, 0.20, 0.10, 0.05),
    Semantic.VEGETATION: (0.30, 0.35, 0.15, 0.10, 0.10),
    Semantic.GROUND: (0.50, 0.0, 0.25, 0.0, 0.25),
}
_SIGMA_HEIGHT = 0.10
_SIGMA_VOLUME = 0.05
_EPSILON = 1e-6


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
    return _logistic(total)


def confidence(decision: Decision, measures: Measures, class_score: float) -> float:
    """Return a probability that the label is right, from the margin of the rule that decided.

    **Not yet calibrated** on simulated surveys: a monotone logistic model
    whose coefficients are judgements. It rises with the distance from the
    threshold, with the observed share of the object, with its size, and with
    the purity of its class.
    """
    if decision.change in (Change.UNOBSERVED, Change.NOT_REPORTED):
        return _logistic(1.0 + 2.0 * decision.margin)
    changed = decision.change is not Change.UNCHANGED
    distance = math.log(max(decision.margin, 1e-3)) if changed else 1.0 - min(decision.margin, 1.5)
    size = math.log10(max(measures.seen_voxels, 1) / 20.0)
    z = (
        0.5
        + 2.0 * distance
        + 1.0 * (measures.observed_fraction - 0.5)
        + 0.7 * size
        + 1.0 * (class_score - 0.6)
    )
    return _logistic(z)


def _logistic(value: float) -> float:
    return 1.0 / (1.0 + math.exp(-max(min(value, 50.0), -50.0)))
