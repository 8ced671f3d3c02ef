"""Volume of a roof that rose or fell by less than the thinnest change that space carving keeps.

Carved cells are dropped where a change is thin: two samplings of one wall or one steep roof differ by a cell.
A roof that was lifted by half a metre is thin too, but its columns all moved the same way. Where both epochs
know the tops of adjoining columns, the difference of the tops is the volume.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import switchable
from subiaco_geo.frames import Floats

_MOST = NUMBERS.space_carving.moved_share
_ADJOIN = np.ones((3, 3), dtype=bool)


def adjoining(columns: NDArray[np.bool_], least: float) -> NDArray[np.bool_]:
    """Keep of some columns (nx, ny) those that adjoin others, and are as many as ``least`` together."""
    number, count = ndimage.label(columns, _ADJOIN)
    enough = np.bincount(number.ravel(), minlength=count + 1) >= least
    return np.asarray(columns & enough[number])


def _none(*_: object) -> tuple[float, float]:
    """Return no rise."""
    return 0.0, 0.0


@switchable("thin_changes", _none)
def thin_rise(
    old: tuple[Floats, Floats],
    new: tuple[Floats, Floats],
    counted: Floats,
    thin: tuple[float, float],
    columns: float,
    enough: float,
    widest: float,
) -> tuple[float, float]:
    """Return by how much a roof rose beyond what is counted already: its known tops, and all of it.

    Parts of a roof differ by a step between two samplings: most of the known tops must have risen together.

    Parameters
    ----------
    old, new : (lowest, highest) of (nx, ny)
        Bounds of the tops of the columns of each epoch above the ground [m]; 0 where an epoch has nothing.
    counted : (nx, ny) float64
        Height of what was carved as new in each column [m].
    thin : (float, float)
        Smallest rise that counts, and the rise from which carving keeps it [m].
    columns : float
        Number of columns of the whole roof.
    enough : float
        Number of columns that must have risen; half of the roof is enough too.
    widest : float
        Distance between the bounds of a top up to which the top is known [m].

    Returns
    -------
    (float, float)
        Sums over columns [m]. The second takes the columns whose tops are not known to have risen as the
        others did on average.
    """
    known = (old[0] > 0) & (new[0] > 0) & _known(old, widest) & _known(new, widest)
    number, rise = np.count_nonzero(known), new[0] - old[0]
    least = max(_MOST * number, min(enough, _MOST * columns))
    risen = adjoining(known & (rise >= thin[0]) & (rise < thin[1]), least)
    if not risen.any():
        return 0.0, 0.0
    sure = float(np.maximum(rise - counted, 0.0)[risen].sum())
    return sure, sure * max(columns / number, 1.0)


def _known(bounds: Sequence[Floats], widest: float) -> NDArray[np.bool_]:
    return np.asarray(bounds[1] - bounds[0] <= widest)
