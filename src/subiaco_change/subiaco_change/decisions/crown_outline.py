"""Shift of the outline of a crown, direction by direction.

Two drives see different leaves of one tree, from different sides and with
different densities. Voxels that are occupied in one epoch alone then say
little, and half a metre hides a trim. What compares well is the reach of the
foliage in one direction, where both epochs have points in it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from subiaco_geo.config import StrictModel
from subiaco_geo.frames import Floats, Ints


class OutlineConfig(StrictModel):
    """Sectors in which outlines are compared."""

    sectors: int = Field(
        12, ge=4, description="Number of horizontal directions in which outlines are compared"
    )
    rings: int = Field(
        5,
        ge=1,
        description="Number of vertical directions, from bottom to top, in which outlines are compared",
    )
    points: int = Field(3, ge=1, description="Number of points that a direction needs in either epoch")
    directions: int = Field(16, ge=4, description="Number of directions that an outline needs to be compared")


@dataclass(frozen=True)
class Outline:
    """Median shift outwards [m], its standard error [m], and the median shift relative to the reach."""

    shift: float = math.nan
    sigma: float = math.nan
    relative: float = math.nan

    @property
    def reach(self) -> float:
        """Reach that the relative shift is a share of [m]; NaN where unknown."""
        return abs(self.shift / self.relative) if self.relative else math.nan

    @property
    def known(self) -> bool:
        """Whether enough directions were seen in both epochs."""
        return math.isfinite(self.shift)


def compare_outlines(before: Floats, after: Floats, config: OutlineConfig) -> Outline:
    """Compare the reach of two point sets (N, 3), (M, 3) [m] from their common middle.

    In every direction the epoch with more points is read at the quantile that
    the outermost of as few points as the other has would have: density alone
    moves nothing. The error is that of a median over the directions.
    """
    if min(len(before), len(after)) < config.points * config.directions:
        return Outline()
    both = np.concatenate([before, after])
    middle = 0.5 * (np.quantile(both, 0.05, axis=0) + np.quantile(both, 0.95, axis=0))
    sides = [_directions(xyz - middle, config) for xyz in (before, after)]
    shifts, reaches = [], []
    for direction in np.intersect1d(sides[0][0], sides[1][0]):
        first, second = (radius[code == direction] for code, radius in sides)
        fewest = min(len(first), len(second))
        if fewest < config.points:
            continue
        low, high = (float(np.quantile(radius, fewest / (fewest + 1))) for radius in (first, second))
        shifts.append(high - low)
        reaches.append(0.5 * (low + high))
    if len(shifts) < config.directions:
        return Outline()
    shift = np.array(shifts)
    middle_shift = float(np.median(shift))
    spread = 1.4826 * float(np.median(np.abs(shift - middle_shift)))
    relative = float(np.median(shift / np.maximum(reaches, 1e-6)))
    return Outline(middle_shift, 1.2533 * spread / math.sqrt(len(shift)), relative)


def _directions(step: Floats, config: OutlineConfig) -> tuple[Ints, Floats]:
    """Direction (N,) and distance (N,) of steps (N, 3); directions share the sphere equally."""
    radius = np.linalg.norm(step, axis=1)
    turn = np.arctan2(step[:, 1], step[:, 0]) / (2 * np.pi) + 0.5
    sector = np.minimum((turn * config.sectors).astype(np.int64), config.sectors - 1)
    rise = 0.5 * (step[:, 2] / np.maximum(radius, 1e-9) + 1.0)
    ring = np.minimum((rise * config.rings).astype(np.int64), config.rings - 1)
    return sector * config.rings + ring, radius
