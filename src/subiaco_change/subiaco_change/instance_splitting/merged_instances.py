"""Instances that are separate in one epoch and merged in the other, split in both; row houses above all.

Row houses that the two epochs split at different walls are split at the walls that either epoch shows. A row
of houses without steps is one instance. What was built on one of them ends at its party walls, in the carved
difference of the two epochs, although neither its roof nor the walls below distinguish it from the others.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from subiaco_change.association.costs import AssociationConfig
from subiaco_change.decisions.column_volumes import ColumnChange, column_keys
from subiaco_change.decisions.voxel_objects import ObjectInstance, join_voxels
from subiaco_change.instance_splitting.one_epoch_parts import PartConfig, split_by_labels
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import one_part, switchable
from subiaco_change.segmentation.bounding_rectangles import wall_coordinates
from subiaco_change.segmentation.clustering import connect, group_indices, voxel_clusters
from subiaco_change.segmentation.ground_model import Mask
from subiaco_change.segmentation.object_rows import ProfileConfig, level_steps, part_slots
from subiaco_geo.codes import Semantic
from subiaco_geo.frames import Floats, Ints

_CELL = NUMBERS.merged_instances.cell
_COLUMN = NUMBERS.rows_of_houses.cell
_SHARED = NUMBERS.rows_of_houses.shared_columns
_SHOWN = NUMBERS.rows_of_houses.columns_across
_ROOM = NUMBERS.storeys.room_height
_GAP = NUMBERS.storeys.unseen_gap
_THROUGH = NUMBERS.storeys.depth_share
_SAME = NUMBERS.storeys.same_top
_ALIKE = NUMBERS.storeys.neighbour_share
_NEAR = NUMBERS.storeys.wall_slots
_WALL = NUMBERS.storeys.step_height

#: The objects of *before* and of *after* that are one piece.
Piece = tuple[tuple[ObjectInstance, ...], tuple[ObjectInstance, ...]]


def split_by_bodies(
    before: Sequence[ObjectInstance],
    after: Sequence[ObjectInstance],
    config: AssociationConfig,
    following: int,
) -> list[Piece]:
    """Divide a match into the bodies that one of the epochs holds apart; one piece where there are none.

    Parameters
    ----------
    before, after : sequence of ObjectInstance
        The parts of one match.
    config : AssociationConfig
    following : int
        First free instance number: pieces of a divided instance need their own.

    Returns
    -------
    list of (before, after)
        Things that are no body of their own (too small, or above or below
        another) join the nearest body.
    """
    sides = (tuple(before), tuple(after))
    bodies = [separate_bodies(side, config) for side in sides]
    leader = int(len(bodies[1]) > len(bodies[0]))
    if len(bodies[leader]) < 2:
        return [sides]
    groups = bodies[leader]
    owner = np.repeat(np.arange(len(groups)), [sum(len(t.voxels) for t in group) for group in groups])
    places = np.concatenate([t.voxels.xyz for group in groups for t in group])
    tree, built = cKDTree(places), np.unique(column_keys(places, _CELL))
    found: list[tuple[list[ObjectInstance], list[ObjectInstance]]] = [([], []) for _ in groups]
    for epoch, side in enumerate(sides):
        for obj in side:
            nearest = owner[tree.query(obj.voxels.xyz)[1]]
            if epoch == leader:
                nearest[:] = np.bincount(nearest).argmax()
            elif obj.semantic is Semantic.BUILDING:
                nearest = _undivided(obj, nearest, built, config.parts)
            for number, piece in _along(obj, nearest, following):
                found[number][epoch].append(piece)
            following += len(groups)
    return [(tuple(b), tuple(a)) for b, a in found]


def _undivided(obj: ObjectInstance, owner: Ints, built: Ints, config: PartConfig) -> Ints:
    """Give every connected part beside the bodies, which the other epoch lacks, to one body (M,).

    A wing that closes the gap between two houses is one wing, of the house that is next to most of it. Two
    crowns grow into a gap from both sides.
    ``built``: columns of all bodies.
    """
    voxels = obj.voxels
    beside = ~np.isin(column_keys(voxels.xyz, _CELL), built)
    alone = np.flatnonzero(voxels.observed_unoccupied & beside)
    whole = owner.copy()
    for group in group_indices(voxel_clusters(voxels.xyz[alone], config.gap)) if len(alone) else ():
        whole[alone[group]] = np.bincount(owner[alone[group]]).argmax()
    return whole


def _along(obj: ObjectInstance, owner: Ints, following: int) -> list[tuple[int, ObjectInstance]]:
    """Divide an instance by the body (M,) that its voxels belong to."""
    numbers, labels = np.unique(owner, return_inverse=True)
    return list(zip(numbers.tolist(), split_by_labels(obj, labels, following), strict=True))


def separate_bodies(
    objects: Sequence[ObjectInstance], config: AssociationConfig
) -> list[list[ObjectInstance]]:
    """Group the objects of one epoch that are large enough into bodies that stand side by side."""
    total = sum(len(t.voxels) for t in objects)
    large = [t for t in objects if len(t.voxels) >= config.apart * total]
    if len(large) < 2:
        return [list(large)]
    columns = [np.unique(column_keys(t.voxels.xyz, _CELL)) for t in large]
    links = [
        (i, j)
        for i in range(len(large))
        for j in range(i)
        if len(np.intersect1d(columns[i], columns[j]))
        > config.stacked * min(len(columns[i]), len(columns[j]))
    ]
    joined = connect(len(large), np.array(links, dtype=np.int64).reshape(-1, 2))
    return [[large[k] for k in group] for group in group_indices(joined)]


_STOREY = ProfileConfig(step=NUMBERS.rows_of_houses.new_storey)  # tops that rose by less got a new roof


def group_row_houses(pieces: Sequence[Piece], config: AssociationConfig) -> list[list[int]]:
    """Group matches (positions) of which a house of one lies in a house of another; each group a row."""
    first, second = (
        [
            (k, _columns(body))
            for k, piece in enumerate(pieces)
            for body in separate_bodies(piece[epoch], config)
        ]
        for epoch in (0, 1)
    )
    links = [
        (k, m)
        for k, one in first
        for m, two in second
        if k != m and len(np.intersect1d(one, two)) > _SHARED * min(len(one), len(two))
    ]
    joined = connect(len(pieces), np.array(links, dtype=np.int64).reshape(-1, 2))
    return [group.tolist() for group in group_indices(joined)]


def _columns(objects: Sequence[ObjectInstance]) -> Ints:
    return np.unique(column_keys(join_voxels(objects).xyz, _COLUMN))


def split_at_walls(
    before: Sequence[ObjectInstance],
    after: Sequence[ObjectInstance],
    config: AssociationConfig,
    following: int,
) -> list[Piece]:
    """Divide a row at the walls that either epoch shows, and where its tops rose or fell by a storey.

    A house that was taken from a row, or built into its gap, is a part of its own, without a partner.

    Parameters
    ----------
    before, after : sequence of ObjectInstance
        Everything in the row.
    config : AssociationConfig
    following : int
        First free instance number.
    """
    sides = (tuple(before), tuple(after))
    voxels = [join_voxels(side) for side in sides]
    xy = np.concatenate([v.xyz[:, :2] for v in voxels])
    labels = _moved(voxels[0].xyz, voxels[1].xyz, xy)
    alone = _alone(xy, voxels[0].xyz, voxels[1].xyz)
    for side in sides:
        bodies = [body for body in separate_bodies(side, config) if body] or [list(side)]
        owner = np.repeat(np.arange(len(bodies)), [sum(len(t.voxels) for t in body) for body in bodies])
        places = np.concatenate([t.voxels.xyz[:, :2] for body in bodies for t in body])
        labels = labels * len(bodies) + owner[cKDTree(places).query(xy)[1]]
    labels = np.where(alone > 0, labels.max() + alone, labels)
    return _pieces(sides, xy, labels, config, following)


def _whole_row(before: Sequence[ObjectInstance], after: Sequence[ObjectInstance], *_: object) -> list[Piece]:
    """Return a row as one piece."""
    return [(tuple(before), tuple(after))]


@switchable("storeys_of_row_houses", _whole_row)
def split_at_changed_storeys(
    before: Sequence[ObjectInstance],
    after: Sequence[ObjectInstance],
    columns: ColumnChange,
    config: AssociationConfig,
    following: int,
) -> list[Piece]:
    """Divide a row where a storey was built on one of its houses, or taken off; arguments as for houses_of.

    The storey shows in its walls although no survey sees its roof.
    """
    sides = (tuple(before), tuple(after))
    xy = np.concatenate([join_voxels(side).xyz[:, :2] for side in sides])
    return _pieces(sides, xy, changed_houses(columns, xy), config, following)


def _pieces(sides: Piece, xy: Floats, labels: Ints, config: AssociationConfig, following: int) -> list[Piece]:
    """Divide objects of both epochs by labels (N,) of their voxels (N, 2); small parts join others."""
    labels = np.unique(labels, return_inverse=True)[1]
    large = np.bincount(labels) >= config.apart * len(xy)
    if np.count_nonzero(large) < 2:
        return [sides]
    kept = large[labels]
    labels = labels[kept][cKDTree(xy[kept]).query(xy)[1]]
    labels = np.unique(labels, return_inverse=True)[1]
    found: list[tuple[list[ObjectInstance], list[ObjectInstance]]] = [
        ([], []) for _ in range(labels.max() + 1)
    ]
    for epoch, side in enumerate(sides):
        for obj in side:
            own, labels = labels[: len(obj.voxels)], labels[len(obj.voxels) :]
            numbers, part = np.unique(own, return_inverse=True)
            for number, piece in zip(numbers.tolist(), split_by_labels(obj, part, following), strict=True):
                found[number][epoch].append(piece)
            following += len(numbers)
    return [(tuple(b), tuple(a)) for b, a in found]


def _moved(before: Floats, after: Floats, xy: Floats) -> Ints:
    """Part (N,) of places (N, 2) along the walls of a row whose tops (B, 3), (A, 3) moved by a storey."""
    slot, tops = _tops(before, after, xy)
    rise = tops[1] - tops[0]
    labels = np.zeros(len(xy), dtype=np.int64)
    for axis in (0, 1):
        profile = _profile(rise if axis == 0 else rise.T)
        parts = part_slots(slot[:, axis], level_steps(profile, _STOREY), _STOREY)
        labels = labels * (int(parts.max()) + 1) + parts
    return labels


@switchable("row_house_of_one_epoch", one_part)
def _alone(xy: Floats, before: Floats, after: Floats) -> Ints:
    """Return which stretch of a row, from 1, that one epoch alone holds places (N, 2) lie in; 0 for none.

    A stretch is as long as a house and lies between two; in it the one epoch shows columns across the row and
    the other none.
    """
    slot, tops = _tops(before, after, xy)
    shown = np.isfinite(tops)
    found = np.zeros(len(xy), dtype=np.int64)
    for axis in (0, 1):
        across = shown.sum(axis=2 - axis)
        for own, other in (across, across[::-1]):
            stretch = _gaps((own >= _SHOWN) & (other == 0), np.minimum(own, other) >= _SHOWN)[slot[:, axis]]
            found = np.where((found == 0) & (stretch > 0), found.max() + stretch, found)
    return found


def _gaps(alone: Mask, shared: Mask) -> Ints:
    """Return numbers (S,), from 1, of stretches of one epoch alone between houses that both epochs share.

    At the end of a row this kind of stretch may be a wing of the last house.
    """
    width = round(_STOREY.width / _COLUMN)
    numbers, count = ndimage.label(alone)
    gaps = np.zeros(len(alone), dtype=np.int64)
    for number in range(1, count + 1):
        inside = np.flatnonzero(numbers == number)
        sides = shared[max(inside[0] - width, 0) : inside[0]], shared[inside[-1] + 1 : inside[-1] + 1 + width]
        if len(inside) >= width and all(2 * np.count_nonzero(side) >= width for side in sides):
            gaps[inside] = number
    return gaps


def _tops(before: Floats, after: Floats, xy: Floats) -> tuple[Ints, Floats]:
    """Columns (N, 2) along the walls of places (N, 2), and tops (2, nx, ny) of both epochs; NaN for none."""
    turned = wall_coordinates(xy)
    slot = np.floor((turned - turned.min(axis=0)) / _COLUMN).astype(np.int64)
    tops = np.full((2, *(slot.max(axis=0) + 1).tolist()), np.nan)
    for top, xyz, own in zip(tops, (before, after), np.split(slot, [len(before)]), strict=True):
        np.fmax.at(top, (own[:, 0], own[:, 1]), xyz[:, 2])
    return slot, tops


def _profile(rise: Floats) -> Floats:
    """Median rise along a row, across it, above the lowest top of a house; none where too little shows."""
    shown = np.isfinite(rise).sum(axis=1) >= _SHOWN
    profile = np.zeros(len(rise))
    profile[shown] = np.nanmedian(rise[shown], axis=1)
    return np.asarray(profile - profile.min() + _STOREY.lowest + 1.0)


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
    changed: Mask = np.count_nonzero(amount, axis=1) >= _SHOWN
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
