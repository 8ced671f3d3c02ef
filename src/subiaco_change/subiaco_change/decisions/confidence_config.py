"""Settings of the confidence: a logistic model for each kind of row, fitted on simulated surveys."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field
from scipy.special import expit

from subiaco_change.method_numbers import NUMBERS
from subiaco_change.visibility_evidence import KINDS
from subiaco_geo.config import StrictModel
from subiaco_geo.frames import Floats

#: Largest calibration error on surveys left out of the fit at which confidences count as probabilities.
CALIBRATED = NUMBERS.confidence.largest_calibration_error

#: What a row's confidence is a function of, in the order of the coefficients. Counted beams are no feature.
FEATURES = (
    "margin", "gate", "observed", "size", "purity", "solid", "plant", "density",
    *KINDS[1:], "near_limits",
)  # fmt: skip

ClaimKind = Literal["single", "reshaped", "unchanged"]


class Coefficients(StrictModel):
    """Logistic model of one kind of row; see :func:`features`."""

    intercept: float = Field(description="Log odds of a typical row [1]")
    margin: float = Field(description="Coefficient of the margin by which the deciding rule was met")
    gate: float = Field(
        0.0,
        description="Coefficient of the distance between measure and limit, in units of 3 standard "
        "deviations",
    )
    observed: float = Field(
        description="Coefficient of the observed fraction, which is about 0.8 in a typical row"
    )
    size: float = Field(
        description="Coefficient of log10 of the number of observed voxels, which is about 1.7 in a "
        "typical row"
    )
    purity: float = Field(description="Coefficient of the class score, which is about 0.7 in a typical row")
    solid: float = Field(
        description="Coefficient of the class: 1 for buildings and vegetation, 0 for mobile and other objects"
    )
    plant: float = Field(0.0, description="Coefficient of the class: 1 for vegetation, 0 for all others")
    density: float = Field(
        0.0, description="Coefficient of the absolute log ratio of the point densities of both epochs"
    )
    trajectory: float = Field(
        0.0, description="Coefficient of free space from a given trajectory (1 where that is the evidence)"
    )
    estimated: float = Field(
        0.0,
        description="Coefficient of free space from poses estimated from the cloud (1 where that is the "
        "evidence)",
    )
    shadow: float = Field(
        0.0, description="Coefficient of free space from a shadow test (1 where that is the evidence)"
    )
    assumed: float = Field(
        0.0, description="Coefficient of free space that is assumed (1 where that is the evidence)"
    )
    near_limits: float = Field(
        0.0,
        description="Coefficient of the fraction of the buildings and plants of the pair that lie near a "
        "limit, in tenths, which is about 0.45 in a typical pair",
    )

    def probability(self, found: Floats) -> Floats:
        """Return the probability (...) of rows from :func:`features` (..., 13)."""
        slopes = np.array([getattr(self, name) for name in FEATURES])
        return np.asarray(expit(self.intercept + found @ slopes))


class MeasuredBand(StrictModel):
    """How many claims with a confidence in one band were right, on surveys left out of the fit."""

    low: float = Field(ge=0, le=1, description="Lowest confidence of the band [1]")
    high: float = Field(ge=0, description="Confidence at which the next band begins [1]")
    right: int = Field(ge=0, description="Number of claims in the band that were right")
    claims: int = Field(ge=1, description="Number of claims in the band")


class ConfidenceConfig(StrictModel):
    """Coefficients fitted on simulated surveys by ``scripts/calibrate_confidence.py``.

    On surveys that no rule was tuned on: where rules are tuned they are right more often than elsewhere.
    On four of the eleven the changes run through every limit and the epochs are measured by unlike sensors.
    Each was compared with its visibility layers, with trajectories, and bare. Some 230 of 2505 changed rows
    are wrong; ``held_out_ece`` says how far off the probability was on surveys left out.
    """

    fitted_on: str = Field(
        "simulated: default_106, default_107, default_108, hard_106, hard_107, hard_108, suburb_106, "
        "suburb_107, suburb_108, suburb_109, easy_106; evidence: layer, trajectory, bare; 2026-11-26; "
        "2505 changed of 10003 rows",
        description="Surveys, seeds, rows and date of the confidence fit; empty if the coefficients were "
        "not fitted",
    )
    held_out_ece: float = Field(
        0.004,
        ge=0,
        le=1,
        description="Expected calibration error over changed rows of surveys left out of the fit [1]",
    )
    bands: tuple[MeasuredBand, ...] = Field(
        (
            MeasuredBand(low=0.9, high=1.01, right=1566, claims=1640),
            MeasuredBand(low=0.7, high=0.9, right=666, claims=794),
            MeasuredBand(low=0.0, high=0.7, right=45, claims=71),
        ),
        description="Claims per confidence band, right and total, on surveys left out of the fit, as "
        "printed on the summary page; bands without claims are absent",
    )
    evidence: tuple[str, ...] = Field(
        ("observed", "shadow", "trajectory"),
        description="Kinds of evidence among the rows of the fit; the confidence of rows with other kinds "
        "is discounted",
    )
    clouds: Literal["simulated", "own"] = Field(
        "simulated",
        description="Clouds of the fit: simulated surveys, or injected copies of the compared survey. "
        "Rows of other clouds are discounted",
    )
    discount: float = Field(
        0.75,
        gt=0,
        le=1,
        description="Factor on the log odds of rows whose kind of evidence or cloud was never calibrated. "
        "Lower values are more cautious",
    )
    cap: float = Field(
        0.9,
        gt=0.5,
        le=1,
        description="Highest confidence of rows whose kind of evidence or cloud was never calibrated [1]",
    )
    cap_shadow: float = Field(
        0.85,
        gt=0.5,
        le=1,
        description="Highest confidence of a change in a cloud of which nobody knows whence it was measured "
        "[1]: what its shadows hide is alike for all parts of an object",
    )
    unseen: float = Field(
        0.25,
        ge=0,
        le=1,
        description="Doubt about a change in a place that the other survey did not observe at all, as a "
        "probability. Higher values are more cautious",
    )
    unchanged_share: float = Field(
        0.75,
        ge=0,
        le=1,
        description="Probability that a building did not change where the bounds of its change leave that "
        "open [1]",
    )
    single: Coefficients = Coefficients(
        intercept=2.035,
        margin=0.0,
        gate=0.31,
        observed=0.664,
        size=1.144,
        purity=1.092,
        solid=-0.678,
        plant=1.074,
        density=-0.503,
        trajectory=-0.28,
        shadow=-0.45,
        near_limits=-0.69,
    )
    reshaped: Coefficients = Coefficients(
        intercept=0.9,
        margin=0.037,
        gate=0.576,
        observed=0.267,
        size=0.781,
        purity=0.571,
        solid=0.0,
        plant=1.539,
        density=-0.656,
        trajectory=-0.054,
        shadow=-0.03,
        near_limits=-1.12,
    )
    unchanged: Coefficients = Coefficients(
        intercept=3.781,
        margin=-1.292,
        gate=0.56,
        observed=1.815,
        size=1.179,
        purity=0.0,
        solid=-2.132,
        plant=0.64,
        density=-0.284,
        trajectory=-0.238,
        shadow=-0.303,
        near_limits=-0.608,
    )

    @property
    def calibrated(self) -> bool:
        """Whether confidences may be read as probabilities: fitted, and at most 0.05 off on other surveys."""
        return bool(self.fitted_on) and self.held_out_ece <= CALIBRATED

    def calibrated_for(self, evidence: str, simulated: bool) -> bool:
        """Whether the fit saw rows of this kind of evidence, on clouds of this kind."""
        return self.calibrated and evidence in self.evidence and (simulated or self.clouds == "own")
