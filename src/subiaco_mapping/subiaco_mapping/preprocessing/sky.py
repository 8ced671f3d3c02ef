"""Beams without a return: which of them prove that the air was empty.

A beam comes back with nothing from the open sky, but also from glass, from a wet road that mirrors it
away, from black paint, from twigs thinner than the beam, and now and then from a plain wall (an isolated
drop-out). Only beams to the sky may be traced as free space, so a beam is used where

* all of its neighbourhood of 3 rings x 5 columns returned nothing, in columns that were received: that
  leaves out drop-outs, edges and lost packets;
* hardly anything returned from the rings above it in its own column: a window or a glass door has its
  lintel, wall and roof above, the sky has a wire at most;
* it points above the horizon, asked later where the vertical is known
  (``fusion.sky_elevation_deg``): that leaves out wet roads and water.

A glass front up to the roof line still passes; ``decode.sky_range: 0`` leaves all such beams out.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.frames import Ints
from subiaco_mapping.method_numbers import NUMBERS

RING_STEP = NUMBERS.preprocessing.sky_ring_step
COLUMNS_PER_TURN = NUMBERS.preprocessing.sky_columns
MAX_CLUTTER = NUMBERS.preprocessing.sky_clutter
_RING_REACH, _COLUMN_REACH = 1, 2

Flags = NDArray[np.bool_]


def sky_mask(returned: Flags, received: Flags) -> Flags:
    """Mark the beams of one turn that are surely sky.

    Parameters
    ----------
    returned : (rings, columns) bool
        Something came back; destaggered (columns are azimuths), highest ring first.
    received : (rings, columns) bool
        The beam's column arrived.

    Returns
    -------
    (rings, columns) bool
        Beyond the highest and lowest ring nothing is asked; azimuth closes in itself.
    """
    nothing = received & ~returned
    calm = nothing.copy()
    for step in range(1, _RING_REACH + 1):
        calm[step:] &= nothing[:-step]
        calm[:-step] &= nothing[step:]
    level = calm.copy()
    for step in range(1, _COLUMN_REACH + 1):
        level &= np.roll(calm, step, axis=1) & np.roll(calm, -step, axis=1)
    above = np.zeros(returned.shape[1], dtype=np.int16)
    most = np.floor(MAX_CLUTTER * np.arange(1, len(returned) + 1, dtype=np.float32)).astype(np.int16)
    for ring, limit in enumerate(most):  # four times as fast as a sum down the columns of a whole turn
        above += returned[ring]
        level[ring] &= above <= limit
    return np.asarray(level)


def thinned(mask: Flags, turn: int) -> tuple[Ints, Ints]:
    """Return rings and columns of a lattice of the marked beams; each turn takes another one."""
    step = max(mask.shape[1] // COLUMNS_PER_TURN, 1)
    first_column, first_ring = turn % step, (turn // step) % RING_STEP
    ring, column = np.nonzero(mask[first_ring::RING_STEP, first_column::step])
    return ring * RING_STEP + first_ring, column * step + first_column
