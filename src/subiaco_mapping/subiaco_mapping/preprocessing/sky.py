"""Beams without a return: which of them prove that the air was empty.

A beam comes back with nothing from the open sky, but also from glass, from a wet road that mirrors it
away, from black paint, from twigs thinner than the beam, and now and then from a plain wall (an isolated
drop-out). Only beams to the sky may be traced as free space, so a beam is used where

* all of its neighbourhood of 3 rings x 5 columns returned nothing, in columns that were received: that
  leaves out drop-outs, edges and lost packets;
* hardly anything returned from the rings above it in its own column: a window or a glass door has its
  lintel, wall and roof above, the sky has a wire at most;
* something returned from the rings below it in these columns, for the road and the objects along it do:
  where nothing did, a vehicle or a hand nearer than the sensor measures hid all;
* it points above the horizon, asked later where the vertical is known
  (``fusion.sky_elevation_deg``): that leaves out wet roads and water.

A glass front up to the roof line still passes; ``decode.sky_range: 0`` leaves all such beams out.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from subiaco_geo.frames import Ints
from subiaco_mapping.method_numbers import NUMBERS

RING_STEP = NUMBERS.preprocessing.sky_ring_step
COLUMNS_PER_TURN = NUMBERS.preprocessing.sky_columns
MAX_CLUTTER = NUMBERS.preprocessing.sky_clutter
_BELOW = NUMBERS.preprocessing.sky_below
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
    rings = len(returned)
    most = np.floor(MAX_CLUTTER * np.arange(1, rings + 1, dtype=np.float32)).astype(np.int64)
    least = np.ceil(_BELOW * np.arange(rings - 1, -1, -1, dtype=np.float32)).astype(np.int64)
    return _sky_mask(returned, received, most, least, _RING_REACH, _COLUMN_REACH)


@numba.njit(cache=True)
def _sky_mask(
    returned: Flags, received: Flags, most: Ints, least: Ints, ring_reach: int, column_reach: int
) -> Flags:
    """Mark beams (R, C) with nothing around them, in columns of which at least ``least`` (R,) returned below.

    In their own column at most ``most`` (R,) returned from their ring up.
    """
    rings, columns = returned.shape
    sky, above = np.empty((rings, columns), np.bool_), np.zeros(columns, np.int64)
    total = returned.sum(axis=0)
    calm = np.empty(columns + 2 * column_reach, np.bool_)  # with the columns beyond either end of the turn
    inner = calm[column_reach : column_reach + columns]
    for ring in range(rings):
        inner[:] = True
        for near in range(max(ring - ring_reach, 0), min(ring + ring_reach + 1, rings)):
            for column in range(columns):
                inner[column] &= received[near, column] & ~returned[near, column]
        for column in range(columns):
            above[column] += returned[ring, column]
            inner[column] &= total[column] - above[column] >= least[ring]
        calm[:column_reach] = inner[columns - column_reach :]
        calm[columns + column_reach :] = inner[:column_reach]
        for column in range(columns):
            sky[ring, column] = above[column] <= most[ring]
        for step in range(2 * column_reach + 1):
            for column in range(columns):
                sky[ring, column] &= calm[column + step]
    return sky


def thinned(mask: Flags, turn: int) -> tuple[Ints, Ints]:
    """Return rings and columns of a lattice of the marked beams; each turn takes another one."""
    step = max(mask.shape[1] // COLUMNS_PER_TURN, 1)
    first_column, first_ring = turn % step, (turn // step) % RING_STEP
    ring, column = np.nonzero(mask[first_ring::RING_STEP, first_column::step])
    return ring * RING_STEP + first_ring, column * step + first_column
