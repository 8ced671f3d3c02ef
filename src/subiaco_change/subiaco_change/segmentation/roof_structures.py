"""Parts of roofs that look like something else: chimneys, dormers, railings.

The class of a point comes from the points around it, and a chimney is as rough and as small as a bush. Where
it begins tells: a plant grows from the ground, or its crown reaches beyond the house beside it.
"""

from __future__ import annotations

import numpy as np

from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import switchable
from subiaco_change.quantiles import quantile_of
from subiaco_change.segmentation.clustering import group_indices
from subiaco_geo.clouds import unique_cells
from subiaco_geo.frames import Floats, Ints

_CELL = NUMBERS.roof_structures.cell
_LOWEST = NUMBERS.roof_structures.lowest
_OVER = NUMBERS.roof_structures.share
_FOOT = NUMBERS.roof_structures.foot_quantile


def _of_no_building(labels: Ints, *_: object) -> Ints:
    """Return -1 for every point (N,)."""
    return np.full(len(labels), -1, dtype=np.int64)


@switchable("roof_structures", _of_no_building)
def buildings_beneath(
    labels: Ints, xyz: Floats, height: Floats, places: Floats, tops: Floats, building: Ints
) -> Ints:
    """Return the building (N,) of every point of an object that stands on its roof, -1 elsewhere.

    The object begins higher than a room above the ground, most of its points lie in columns of buildings, it
    has fewer points than the building that has most of these columns, and it is as high as the roof of that.
    What has a trunk begins at the ground, however few points of the trunk were met.

    Parameters
    ----------
    labels : (N,) int64
        Object of every point, -1 for none.
    xyz : (N, 3) float64
        Places of the points, local [m].
    height : (N,) float64
        Heights of the points above the ground [m].
    places : (M, 2) float64
        Places of points of buildings [m].
    tops : (M,) float64
        Heights of these points above the ground [m].
    building : (M,) int64
        Instance of each of them.
    """
    owner = np.full(len(labels), -1, dtype=np.int64)
    if len(places) == 0:
        return owner
    cells, cell = unique_cells(np.floor(np.concatenate([places, xyz[:, :2]]) / _CELL).astype(np.int64))
    of_cell, top_of_cell = np.full(len(cells), -1, dtype=np.int64), np.zeros(len(cells))
    np.maximum.at(of_cell, cell[: len(places)], building)
    np.maximum.at(top_of_cell, cell[: len(places)], tops)
    beneath, size = of_cell[cell[len(places) :]], np.bincount(building)
    for members in group_indices(labels):
        over = beneath[members][beneath[members] >= 0]
        if len(over) < _OVER * len(members) or height[members].min() < _LOWEST:
            continue
        most = int(np.bincount(over).argmax())
        if len(members) >= size[most]:
            continue
        roof = quantile_of(top_of_cell[of_cell == most], 0.95)
        if quantile_of(height[members], 1.0 - _FOOT) >= roof:
            owner[members] = most
    return owner
