"""Quantiles of few values, of which a comparison asks tens of thousands, and what rests on medians."""

from __future__ import annotations

import numpy as np

from subiaco_geo.frames import Floats


def quantile_of(values: Floats, share: float) -> float:
    """Return a quantile of float64 values (N,), none of them NaN: bit for bit that of ``np.quantile``.

    Of a hundred values numpy takes ten times as long: it looks for ways to interpolate, for weights and NaN.
    """
    place = (len(values) - 1) * share
    first = int(place)
    second = min(first + 1, len(values) - 1)
    ordered = np.partition(values, (first, second))
    low, high, part = float(ordered[first]), float(ordered[second]), place - first
    step = high - low
    return high - step * (1.0 - part) if part >= 0.5 else low + step * part


def median_and_spread(values: Floats) -> tuple[float, float]:
    """Return the median of values (N,) and their standard deviation by the median distance from it.

    The factor holds for a normal distribution.
    """
    middle = float(np.median(values))
    return middle, 1.4826 * float(np.median(np.abs(values - middle)))
