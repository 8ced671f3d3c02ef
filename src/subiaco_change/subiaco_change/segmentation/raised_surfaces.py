"""Roofs and decks that a local ground filter takes for ground: wide surfaces that end in a drop.

An opening tells a roof from the ground as far as its window reaches, and so does a tile as far as it
sees. A hall wider than both looks like a plain. What tells it is its edge: ground goes on, is cut off by
what was not seen, or has things on it; only what is built ends in a drop on nearly every side.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy import ndimage

from subiaco_change.method_rules.switches import switchable
from subiaco_change.segmentation.clustering import connect
from subiaco_geo.clouds import extent_of
from subiaco_geo.config import StrictModel
from subiaco_geo.frames import Floats

Mask = NDArray[np.bool_]
_LATTICE = 16.0  # the raster begins on whole multiples, so that tiles share their cells [m]


class RaisedConfig(StrictModel):
    """Roofs and decks wider than the window of the ground filter."""

    cell: float = Field(
        1.0, gt=0, description="Edge of the raster cells in which raised surfaces are searched [m]"
    )
    area: float = Field(
        200.0,
        ge=0,
        description="Smallest area of a raised surface, a deck or large roof [m2]; the ground filter "
        "removes smaller ones",
    )
    step: float = Field(
        0.3, gt=0, description="Largest step between neighbouring cells of one raised surface [m]"
    )
    slope: float = Field(
        0.6,
        ge=0,
        description="Steepest slope between neighbouring cells of one raised surface [m/m]; a pitched "
        "roof needs about 0.6",
    )
    drop: float = Field(
        2.0,
        gt=0,
        description="Height by which the edge of a raised surface must exceed the surface below [m]",
    )
    reach: float = Field(
        2.0,
        gt=0,
        description="Distance from the edge of a raised surface within which the lower surface must begin "
        "[m]",
    )
    share: float = Field(
        0.7,
        gt=0.5,
        le=1,
        description="Fraction of the edge of a raised surface that must end in a drop, walls above the "
        "edge excluded",
    )


@dataclass(frozen=True)
class RaisedSurfaces:
    """Cells (rows, columns) of raised surfaces, row 0 in the south, from a corner (2,) [m].

    ``lowest``: height from which on points of a cell and of those around it are on or above a raised
    surface [m], inf where there is none.

    ``below`` [m]: median height of the lowest points of all other cells, NaN where there are none.
    """

    corner: Floats
    cell: float
    lowest: Floats
    below: float = math.nan

    def holds(self, xyz: Floats) -> Mask:
        """Tell which points (N, 3) lie on or above a raised surface: none of these is ground."""
        index = np.floor((xyz[:, :2] - self.corner) / self.cell).astype(np.int64)[:, ::-1]
        inside = ((index >= 0) & (index < self.lowest.shape)).all(axis=1)
        index = np.clip(index, 0, np.array(self.lowest.shape) - 1)
        return np.asarray(inside & (xyz[:, 2] >= self.lowest[index[:, 0], index[:, 1]]))


def _no_raised(xyz: Floats, config: RaisedConfig) -> RaisedSurfaces:
    """Return raised surfaces that hold nothing."""
    return RaisedSurfaces(xyz[:, :2].min(axis=0), config.cell, np.full((1, 1), np.inf))


@switchable("raised_surfaces", _no_raised)
def find_raised(xyz: Floats, config: RaisedConfig) -> RaisedSurfaces:
    """Find the raised surfaces of a cloud, z up, and of as much around as tells how they end.

    Parameters
    ----------
    xyz : (N, 3) float64
        Local coordinates [m].
    config : RaisedConfig
    """
    corner = np.floor(extent_of(xyz[:, :2])[0] / _LATTICE) * _LATTICE
    index = np.maximum(np.floor((xyz[:, :2] - corner) / config.cell).astype(np.int64), 0)[:, ::-1]
    shape = tuple((extent_of(index)[1] + 1).tolist())
    lowest = np.full(shape, np.inf)
    np.minimum.at(lowest, (index[:, 0], index[:, 1]), xyz[:, 2])
    known = np.isfinite(lowest)
    label = _surfaces(lowest, known, config)
    size = np.bincount(label[known])
    raised = np.zeros(shape, dtype=bool)
    for number in np.flatnonzero(size * config.cell**2 >= config.area).tolist():
        surface = known & (label == number)
        if _drops(surface, lowest, known, config):
            raised |= surface
    others = lowest[known & ~raised]
    below = float(np.median(others)) if len(others) else math.nan
    around = 2 * round(config.reach / config.cell) + 1  # an edge shares cells with the ground below
    heights = np.where(raised, lowest, np.inf)
    heights = ndimage.minimum_filter(heights, around, mode="constant", cval=np.inf)
    return RaisedSurfaces(corner, config.cell, heights - 0.5 * config.drop, below)


def _surfaces(lowest: Floats, known: Mask, config: RaisedConfig) -> NDArray[np.int64]:
    """Label (rows, columns) the cells that go on from each other without a step."""
    number = np.arange(lowest.size).reshape(lowest.shape)
    limit = config.step + config.slope * config.cell
    pairs = []
    for first, second in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):
        height = np.where(known, lowest, np.nan)
        with np.errstate(invalid="ignore"):
            smooth = np.abs(height[first] - height[second]) < limit
        pairs.append(np.column_stack([number[first][smooth], number[second][smooth]]))
    return connect(lowest.size, np.concatenate(pairs)).reshape(lowest.shape)


def _drops(surface: Mask, lowest: Floats, known: Mask, config: RaisedConfig) -> bool:
    """Tell whether a surface ends in a drop on nearly all of its edge that nothing rises from.

    An edge where nothing was seen is no drop: what a survey saw of a terrace ends there.
    """
    whole = ndimage.binary_fill_holes(surface)
    edge = whole & ~ndimage.binary_erosion(whole, np.ones((3, 3)))
    edge &= surface
    size = 2 * round(config.reach / config.cell) + 1
    outside = known & ~whole
    low = ndimage.minimum_filter(np.where(outside, lowest, np.inf), size, mode="constant", cval=np.inf)
    high = ndimage.maximum_filter(np.where(outside, lowest, -np.inf), 3, mode="constant", cval=-np.inf)
    height = lowest[edge]
    drop = low[edge] <= height - config.drop
    rise = ~drop & (high[edge] > height + config.drop)
    counted = np.count_nonzero(~rise)
    least = config.share * max(float(counted), 0.5 * len(height))
    return bool(counted > 0 and np.count_nonzero(drop) >= least)
