"""Rows of what hangs over a building, or in it, joined to that of the building."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from subiaco_change.decisions.object_decision import ObjectChange
from subiaco_change.decisions.split_merge import join_rows
from subiaco_change.geometry import column_keys
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import first_argument, switchable
from subiaco_change.objects.voxel_objects import Voxels, join_voxels
from subiaco_geo.codes import Semantic
from subiaco_geo.frames import Floats, Ints

_CELL = NUMBERS.roof_structures.cell
_LOWEST = NUMBERS.roof_structures.lowest
_OVER = NUMBERS.roof_structures.share


@switchable("hanging_parts", first_argument)
def join_hanging_parts(changes: list[ObjectChange]) -> list[ObjectChange]:
    """Let what hangs over a building, or in it, join the row of the building.

    A chimney, a dormer and a ceiling seen through a window are as rough and as small as plants, and begin
    higher than a room. They are smaller than the building, which is there in the same epochs. Statistics stay
    those of the building without them.
    """
    hosts = [number for number, change in enumerate(changes) if change.semantic is Semantic.BUILDING]
    bodies = [[join_voxels(side) for side in (changes[i].before, changes[i].after)] for i in hosts]
    columns = [_columns_of([body[epoch] for body in bodies]) for epoch in (0, 1)]
    joined: dict[int, list[int]] = {}
    for number, change in enumerate(changes):
        if change.semantic not in (Semantic.VEGETATION, Semantic.OTHER):
            continue
        voxels = [join_voxels(side) for side in (change.before, change.after)]
        height = np.concatenate([v.height for v in voxels])
        if height.min(initial=np.inf) < _LOWEST:  # a crown has a trunk, of which few points may have been met
            continue
        over = np.concatenate([_owners(v.xyz, c) for v, c in zip(voxels, columns, strict=True)])
        inside = over[over >= 0]
        if len(inside) < _OVER * len(over):
            continue
        most = int(np.bincount(inside).argmax())
        if all(len(own) <= len(body) for own, body in zip(voxels, bodies[most], strict=True)):
            joined.setdefault(hosts[most], []).append(number)
    return join_rows(changes, joined)


def _columns_of(bodies: Sequence[Voxels]) -> tuple[Ints, Ints]:
    """Return the columns (M,) of bodies, sorted, and the body (M,) that each is of."""
    keys = [np.unique(column_keys(body.xyz, _CELL)) for body in bodies]
    owner = np.repeat(np.arange(len(keys)), [len(k) for k in keys])
    built, first = np.unique(np.concatenate([*keys, np.zeros(0, dtype=np.int64)]), return_index=True)
    return built, owner[first]


def _owners(xyz: Floats, columns: tuple[Ints, Ints]) -> Ints:
    """Return the body (N,) in whose columns places (N, 3) lie, -1 for none."""
    built, owner = columns
    if len(built) == 0:
        return np.full(len(xyz), -1, dtype=np.int64)
    keys = column_keys(xyz, _CELL)
    slot = np.minimum(np.searchsorted(built, keys), len(built) - 1)
    return np.where(built[slot] == keys, owner[slot], -1)
