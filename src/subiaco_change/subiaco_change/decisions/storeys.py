"""Storeys built on a house of a row, or taken off one: parted from the row where the change ends at a wall.

A row of houses without steps is one instance. What was built on one of them ends at its party walls, in the
carved difference of the two epochs, although neither its roof nor the walls below tell it from the others.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from subiaco_change.decisions.column_change import ColumnChange
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.segmentation.ground_model import Mask
from subiaco_change.segmentation.object_rows import ProfileConfig
from subiaco_geo.frames import Floats, Ints

_STOREY = ProfileConfig(step=NUMBERS.storeys.new_storey)  # a smaller change is a new roof
_ROOM = NUMBERS.storeys.room_height
_ACROSS = NUMBERS.storeys.columns_across
_GAP = NUMBERS.storeys.unseen_gap
_THROUGH = NUMBERS.storeys.depth_share
_SAME = NUMBERS.storeys.same_top
_ALIKE = NUMBERS.storeys.neighbour_share
_NEAR = NUMBERS.storeys.wall_slots
_WALL = NUMBERS.storeys.step_height


def changed_houses(found: ColumnChange, xy: Floats) -> Ints:
    """Part (N,) of places (N, 2) [m] in a row: its houses whose storeys changed, and what lies between.

    A cut lies where a change through the row ends, a wall rises in the epoch that has the storey, and the
    neighbour beyond has the same tops in both. Without that neighbour, or with a slope between, it is one
    house of which a part was built on.
    """
    slot = found.slots(xy)
    labels = np.zeros(len(xy), dtype=np.int64)
    for axis in (0, 1):
        first, last = np.quantile(slot[:, axis], [0.005, 0.995]).astype(np.int64)
        depth = float(np.ptp(np.quantile(slot[:, 1 - axis], [0.005, 0.995]))) + 1.0
        tops = found.tops.max(axis=2 - axis)
        cuts = set()
        for sign in (1, -1):
            taller = tops[1] if sign > 0 else tops[0]
            for begin, end in _runs(found, axis, sign, depth):
                cuts |= {_wall(taller, begin), len(taller) - _wall(taller[::-1], len(taller) - end)}
        kept = np.sort(
            [cut for cut in cuts if _neighbour(tops[:, first : last + 1], cut - first, found.cell)]
        )
        labels = labels * (len(kept) + 1) + np.searchsorted(kept, slot[:, axis], side="right")
    return labels


def _wall(tops: Floats, begin: int) -> int:
    """Slot near the begin of a run at which tops (slots,) rise most; 0 where they rise by no wall."""
    places = np.arange(max(begin - _NEAR, 2), min(begin + _NEAR, len(tops) - 2) + 1)
    rises = [float(tops[k : k + 2].min() - tops[k - 2 : k].max()) for k in places.tolist()]
    return int(places[int(np.argmax(rises))]) if rises and max(rises) >= _WALL else 0


def _neighbour(tops: Floats, cut: int, cell: float) -> bool:
    """Tell whether one side of a cut is a house whose tops (2, slots) are the same in both epochs."""
    width = round(_STOREY.width / cell)
    if min(cut, tops.shape[1] - cut) < width:
        return False
    same = (tops > 0).all(axis=0) & (np.abs(tops[1] - tops[0]) < _SAME)
    return bool(max(same[cut - width : cut].mean(), same[cut : cut + width].mean()) >= _ALIKE)


def _runs(found: ColumnChange, axis: int, sign: int, depth: float) -> list[tuple[int, int]]:
    """First slot and end of every stretch along an axis whose columns rose, or fell, by a storey."""
    amount = np.where(found.foot >= _ROOM, np.maximum(sign * found.change, 0.0), 0.0)
    amount = amount if axis == 0 else amount.T
    changed: Mask = np.count_nonzero(amount, axis=1) >= _ACROSS
    gap = round(_GAP / found.cell)
    closed = ndimage.binary_closing(np.pad(changed, gap + 1), np.ones(gap + 1))[gap + 1 : -gap - 1]
    numbers, count = ndimage.label(closed)
    runs = []
    for number in range(1, count + 1):
        inside = np.flatnonzero(numbers == number)
        across = np.flatnonzero(amount[inside].any(axis=0))
        if (
            len(inside) * found.cell >= _STOREY.width
            and amount[inside].max() >= _STOREY.step
            and across[-1] + 1 - across[0] >= _THROUGH * depth
        ):
            runs.append((int(inside[0]), int(inside[-1]) + 1))
    return runs
