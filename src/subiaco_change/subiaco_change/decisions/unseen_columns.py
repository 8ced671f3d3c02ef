"""Tops of the columns of a building that no survey saw: of most houses the street sees half of the roof."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.frames import Floats

Cells = NDArray[np.bool_]


def body_tops(tops: Floats, inside: Cells, free: Cells, levels: Floats) -> Floats:
    """Tops (nx, ny) of a body [m], those interpolated that were not seen; 0 outside.

    Columns at its edge count whole, as those of a change do: a change is a share of what is measured alike.

    Parameters
    ----------
    tops : (nx, ny) float64
        Highest surface seen in every column [m]; 0 where none.
    inside : (nx, ny) bool
        Rectangle around the body.
    free : (nx, ny, nz) bool
        Cells that were seen free; a column of mostly free cells is no part of the body.
    levels : (nz,) float64
        Heights of the middles of the cells [m].
    """
    filled = interpolated_tops(tops)
    below = levels < filled[:, :, None]
    opened = 2 * (free & below).sum(axis=2) >= below.sum(axis=2)
    return np.where((tops > 0) | (inside & ~opened), filled, 0.0)


def interpolated_tops(tops: Floats) -> Floats:
    """Tops (nx, ny) [m], where none was seen (0) the mean of the interpolations along both walls.

    Of a pitched roof the half in front is seen, and the walls at its ends.
    """
    total, count = np.zeros_like(tops), np.zeros_like(tops)
    for filled, known in ((total, tops), (total.T, tops.T)):
        place = np.arange(known.shape[1])
        for number, row in enumerate(known):
            if row.any():
                filled[number] += np.interp(place, place[row > 0], row[row > 0])
    for axis in (0, 1):
        count += np.any(tops > 0, axis=axis, keepdims=True)
    return np.asarray(np.where(tops > 0, tops, total / np.maximum(count, 1.0)))
