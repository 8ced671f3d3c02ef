"""Robust least squares with priors, which reports the parameters that the data do not determine."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.frames import Floats

KERNEL = 3.0  # Cauchy [sigma]
ROUNDS = 20
STEP = 1e-4  # of the differences [prior sigma]
SETTLED = 0.01  # change that ends the rounds [sigma]


@dataclass(frozen=True)
class Estimate:
    """A solution.

    Parameters
    ----------
    values : (P,) float64
    sigma : (P,) float64
        Standard deviations, priors included.
    observed : (P,) bool
        False where sigma exceeds its limit: the value is the one given.
    """

    values: Floats
    sigma: Floats
    observed: NDArray[np.bool_]


@dataclass(frozen=True)
class Parameter:
    """One parameter of the rig, for people: name, unit, before and after, and how well it is known."""

    name: str
    unit: str
    given: float
    value: float
    sigma: float
    observed: bool


def _jacobian(residual: Callable[[Floats], Floats], values: Floats, at: Floats, step: Floats) -> Floats:
    """Return the forward differences (R, P)."""
    moved = [residual(values + np.where(np.arange(len(values)) == k, step, 0.0)) for k in range(len(values))]
    return np.asarray((np.array(moved) - at).T / step)


def _fit(
    residual: Callable[[Floats], Floats], start: Floats, given: Floats, prior: Floats
) -> tuple[Floats, Floats]:
    """Return the values (P,) and their covariance (P, P): Gauss-Newton, reweighted in every round."""
    values = start.copy()
    for _ in range(ROUNDS):
        at = residual(values)
        weight = 1.0 / (1.0 + (at / KERNEL) ** 2)
        slope = _jacobian(residual, values, at, STEP * prior) * prior
        information = slope.T @ (weight[:, None] * slope) + np.eye(len(values))
        pull = slope.T @ (weight * at) + (values - given) / prior
        covariance = np.linalg.inv(information)
        change = covariance @ pull
        values = values - prior * change
        if (np.abs(change) < SETTLED * np.sqrt(np.diag(covariance))).all():
            break
    return values, covariance * np.outer(prior, prior)


def solve(
    residual: Callable[[Floats], Floats],
    given: Floats,
    prior: Floats,
    limits: Floats,
    start: Floats | None = None,
) -> Estimate:
    """Fit all at once; then what the data do not hold goes back to what was given.

    The rest keeps its values, which with their sigmas allow for everything that was not held.

    Parameters
    ----------
    residual : callable
        Values (P,) to whitened residuals (R,).
    given, prior : (P,) float64
        Means and sigmas believed beforehand.
    limits : (P,) float64
        Largest sigma with which a parameter counts as observed; infinite for nuisances.
    start : (P,) float64, optional
        Where to begin; ``given`` if absent.
    """
    values, covariance = _fit(residual, given if start is None else start, given, prior)
    sigma = np.sqrt(np.diag(covariance))
    observed = sigma <= limits
    return Estimate(np.where(observed, values, given), sigma, observed)


def spread(residuals: Floats) -> float:
    """Return the standard deviation of residuals, outliers left out (1.48 MAD about zero)."""
    return float(1.4826 * np.median(np.abs(residuals))) if residuals.size else float("nan")
