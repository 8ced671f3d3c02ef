"""What an epoch knows of the space around its objects: points above the ground, free places, its view."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from subiaco_change.segmentation.ground_model import Mask
from subiaco_geo.frames import Floats

#: How probable it is, (N,), that nothing stood at places (N, 3).
Free = Callable[[Floats], Floats]
#: How probable it is, (N,), that what is known of places (N, 3) is right as a whole.
Certainty = Callable[[Floats], Floats]
#: Tells which places (N, 3) a survey saw free.
Empty = Callable[[Floats], Mask]


@dataclass(frozen=True)
class KnownSpace:
    """What one epoch knows of the space around, in the common frame.

    ``standing`` (N, 3): its points above the ground, of any class [m]. ``free``: how probable it finds places
    free; None: certain. ``above``: the same above the tops of plants. ``below_view``: which places are no
    higher than its view is known to reach; None: all. ``certain``: how probable it is that its evidence is
    right as a whole; None: 1. Of a bare cloud nobody knows whence it was measured, and one hidden place
    tells of all the others.
    """

    standing: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    free: Free | None = None
    above: Free | None = None
    below_view: Empty | None = None
    certain: Certainty | None = None


#: Of *before* and of *after*.
KnownSpaces = tuple[KnownSpace, KnownSpace]
#: All space counts as observed, and nothing stands in it.
ALL_FREE: KnownSpaces = (KnownSpace(), KnownSpace())
