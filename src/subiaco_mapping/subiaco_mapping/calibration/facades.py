"""Thickness of facades in the odometry's own map, as proof of a calibration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from subiaco_geo.frames import Floats, Ints
from subiaco_mapping.calibration.config import CalibrationConfig
from subiaco_mapping.planes_in_cubes import planes_in_cubes

POINTS_A_SCAN = 6000
STEEPEST = 0.2  # cosine between a facade's normal and the vertical
FLATTEST = 0.15  # thickness of a facade over the spread along it
HIGHEST = 0.10  # thicker is no facade [m]
MIN_CELLS = 20


@dataclass(frozen=True)
class Facades:
    """Cubes that hold a piece of facade: key (F,) int64 and thickness (F,), one sigma [m]."""

    key: Ints
    thickness: Floats


@dataclass(frozen=True)
class FacadeComparison:
    """The same cubes of two maps.

    Parameters
    ----------
    cells : int
        In both.
    before, after : float
        Median thickness [m]; NaN without cells.
    gain, gain_sigma : float
        Mean share by which a cube became thinner.
    verdict : str
        ``thinner``, ``unchanged``, ``thicker`` or ``no facades``.
    """

    cells: int
    before: float
    after: float
    gain: float
    gain_sigma: float
    verdict: str


def sampled(xyz: Floats, config: CalibrationConfig) -> Floats:
    """Return points (K, 3) of a scan (N, 3) that are near enough, evenly thinned."""
    near = xyz[(xyz * xyz).sum(axis=1) <= config.facade_range**2]
    return near[:: max(len(near) // POINTS_A_SCAN, 1)]


def find_facades(xyz: Floats, up: Floats, config: CalibrationConfig) -> Facades:
    """Return the cubes of a map (N, 3) through which one facade goes; ``up`` (3,) is the vertical."""
    planes = planes_in_cubes(xyz, config.facade_cell, config.facade_points)
    upright = np.abs(planes.normal @ up) < STEEPEST
    flat = (planes.thickness < FLATTEST * planes.width) & (planes.thickness < HIGHEST)
    return Facades(planes.key[upright & flat], planes.thickness[upright & flat])


def compare(before: Facades, after: Facades, config: CalibrationConfig) -> FacadeComparison:
    """Compare the cubes that both maps have."""
    _, first, second = np.intersect1d(before.key, after.key, return_indices=True)
    old, new = before.thickness[first], after.thickness[second]
    if len(old) < MIN_CELLS:
        return FacadeComparison(len(old), np.nan, np.nan, np.nan, np.nan, "no facades")
    share = 1.0 - new / np.maximum(old, 1e-6)
    # neighbouring cubes see the same scans: a tenth of them counts
    gain, sigma = float(np.median(share)), float(1.25 * share.std() / np.sqrt(len(share) / 10))
    verdict = "unchanged"
    if abs(gain) > max(config.facade_gain, 2 * sigma):
        verdict = "thinner" if gain > 0 else "thicker"
    return FacadeComparison(len(old), float(np.median(old)), float(np.median(new)), gain, sigma, verdict)
