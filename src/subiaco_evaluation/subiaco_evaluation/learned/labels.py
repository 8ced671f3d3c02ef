"""Classes that the point networks predict, and the labels of the change table.

A point network labels the points of one cloud by comparison with the other cloud. Removed is what Added
becomes when the epochs are exchanged, and Decreased what Increased becomes: one network serves both clouds.
A point of a moving object counts as unchanged, because it is no change to report: left out of the loss, these
points were claimed as Added and Removed, and cells of unchanged ground took the claim. Points whose place the
other epoch did not observe are not learned.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.codes import Change
from subiaco_geo.frames import Ints

#: Classes of a point network: unchanged, absent in the other cloud, surface higher here, surface lower here.
CLASSES = ("unchanged", "absent in the other", "higher than the other", "lower than the other")
IGNORED = -1
#: What points of moving objects are learned as; records of weights name it.
MOVING_OBJECTS = "unchanged"
_AS_AFTER = (Change.UNCHANGED, Change.ADDED, Change.INCREASED, Change.DECREASED)
_AS_BEFORE = (Change.UNCHANGED, Change.REMOVED, Change.DECREASED, Change.INCREASED)
#: Labels of a cell after the epochs were exchanged.
EXCHANGED = np.array([Change.REMOVED, Change.ADDED, Change.DECREASED, Change.INCREASED, Change.UNCHANGED])


def to_classes(change: NDArray[Any], epoch: int) -> Ints:
    """Return network classes (N,) of points of epoch 0 or 1; -1 where the label is not learned.

    Parameters
    ----------
    change : (N,) uint8
        Codes of :class:`Change`; NOT_REPORTED of moving objects.
    epoch : int
    """
    table = np.full(256, IGNORED, dtype=np.int64)
    table[int(Change.NOT_REPORTED)] = CLASSES.index(MOVING_OBJECTS)
    for index, code in enumerate(_AS_AFTER if epoch else _AS_BEFORE):
        table[int(code)] = index
    return table[np.asarray(change).astype(np.int64)]


def to_codes(classes: NDArray[Any], epoch: int) -> NDArray[np.uint8]:
    """Return codes of :class:`Change` (N,) of network classes of epoch 0 or 1; 255 where undecided (-1)."""
    table = np.array([*(_AS_AFTER if epoch else _AS_BEFORE), Change.UNOBSERVED], dtype=np.uint8)
    return table[np.asarray(classes).astype(np.int64)]


def class_shares(classes: NDArray[Any], count: int) -> NDArray[np.float64]:
    """Return the share (count,) of every class among the labels that are not ignored."""
    known = classes[classes >= 0]
    return np.bincount(known, minlength=count)[:count] / max(len(known), 1)
