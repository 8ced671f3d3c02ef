"""Whether a cloud without trajectory was measured from above, by the shape of the cloud alone.

From the air every column of the ground has points, roofs and crowns included, and the points of high columns
lie on their tops. From a street the ground behind walls lacks points, and walls and crowns hold points from
below upwards. A view from above reaches every height over a point that it met: it has no upper end.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from subiaco_change.method_numbers import NUMBERS
from subiaco_geo.frames import Floats

_CELL = NUMBERS.view_from_above.cell
_SPACINGS = NUMBERS.view_from_above.cell_spacings
_TALL = NUMBERS.view_from_above.tall
_RAISED = NUMBERS.view_from_above.raised
_TOP = NUMBERS.view_from_above.top_share
_GAP = NUMBERS.view_from_above.gap
_LEAST = NUMBERS.view_from_above.least_tall
_FILLED = NUMBERS.view_from_above.filled_share
_TOPMOST = NUMBERS.view_from_above.topmost_share


@dataclass(frozen=True)
class ColumnCounts:
    """What the columns of a piece of a cloud hold.

    Parameters
    ----------
    covered : int
        Columns that the outline of the piece encloses.
    filled : int
        Columns with points.
    tall : int
        Columns with points at very different heights.
    raised : int
        Points in tall columns, those near the lowest point of a column left out.
    topmost : int
        Points of ``raised`` near the highest point of their column.
    """

    covered: int
    filled: int
    tall: int
    raised: int
    topmost: int


def count_columns(xyz: Floats, spacing: float) -> ColumnCounts:
    """Count the columns of points (N, 3) [m] of a piece of a cloud.

    Parameters
    ----------
    xyz : (N, 3) float64
        Upright [m].
    spacing : float
        Median distance between neighbouring points on surfaces of the cloud [m].
    """
    if len(xyz) == 0:
        return ColumnCounts(0, 0, 0, 0, 0)
    cell = max(_CELL, _SPACINGS * spacing) if np.isfinite(spacing) else _CELL
    ij = np.floor((xyz[:, :2] - xyz[:, :2].min(axis=0)) / cell).astype(np.int64)
    shape = tuple((ij.max(axis=0) + 1).tolist())
    column = np.ravel_multi_index((ij[:, 0], ij[:, 1]), shape)
    low, high = np.full(shape, np.inf), np.full(shape, -np.inf)
    np.minimum.at(low.ravel(), column, xyz[:, 2])
    np.maximum.at(high.ravel(), column, xyz[:, 2])
    filled = np.isfinite(low)
    extent = np.where(filled, high - low, 0.0)
    own, above = extent.ravel()[column], xyz[:, 2] - low.ravel()[column]
    raised = (own > _TALL) & (above > _RAISED)
    topmost = raised & (above > (1.0 - _TOP) * own)
    return ColumnCounts(
        int(np.count_nonzero(_outlined(filled, cell))),
        int(np.count_nonzero(filled)),
        int(np.count_nonzero(extent > _TALL)),
        int(np.count_nonzero(raised)),
        int(np.count_nonzero(topmost)),
    )


def _outlined(filled: np.ndarray[tuple[int, ...], np.dtype[np.bool_]], cell: float) -> Floats:
    """Return which columns (nx, ny) the outline of the filled ones encloses, gaps between them closed."""
    rim = int(np.ceil(_GAP / cell))
    padded = np.pad(filled, rim)
    closed = ndimage.binary_fill_holes(ndimage.binary_closing(padded, iterations=rim))
    return np.asarray(closed[rim:-rim, rim:-rim])


def seen_from_above(pieces: Iterable[ColumnCounts]) -> bool:
    """Tell whether the pieces of a cloud together show a view from above.

    False where too few columns are tall to tell.
    """
    found = list(pieces)
    covered, filled = sum(p.covered for p in found), sum(p.filled for p in found)
    raised, topmost = sum(p.raised for p in found), sum(p.topmost for p in found)
    if sum(p.tall for p in found) < _LEAST:
        return False
    return filled >= _FILLED * covered and topmost >= _TOPMOST * raised
