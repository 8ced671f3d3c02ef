"""Instances that are separate in one epoch and merged in the other, split in both; row houses above all.

Row houses that the two epochs split at different walls are split at the walls that either epoch shows. What
joins them in one epoch alone is a house of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence, Set
from itertools import combinations

import numpy as np
from scipy.spatial import cKDTree

from subiaco_change.association.config import AssociationConfig, PartConfig
from subiaco_change.geometry import column_keys
from subiaco_change.instance_splitting.changed_houses import changed_houses
from subiaco_change.instance_splitting.one_epoch_parts import split_by_labels
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import never
from subiaco_change.objects.layers import is_layer
from subiaco_change.objects.voxel_objects import ObjectInstance, Voxels, height_of, join_voxels
from subiaco_change.segmentation.bounding_rectangles import wall_coordinates
from subiaco_change.segmentation.clustering import connect, group_indices, voxel_clusters
from subiaco_change.segmentation.ground_model import Mask
from subiaco_geo.codes import Semantic
from subiaco_geo.frames import Floats, Ints

_CELL = NUMBERS.merged_instances.cell
_COLUMN = NUMBERS.rows_of_houses.cell
_SHARED = NUMBERS.rows_of_houses.shared_columns
_FRONT = NUMBERS.rows_of_houses.house_front
_ROOM = NUMBERS.changed_houses.room_height
_LEFT = NUMBERS.changed_houses.left_columns
_END = NUMBERS.changed_houses.end_front
_ALIKE = NUMBERS.changed_houses.neighbour_share
_PAIR = NUMBERS.changed_houses.pair_front
_ACROSS = NUMBERS.changed_houses.across_row

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
    """Divide an instance by the numbers (M,) of its voxels: number and piece of each part."""
    numbers, labels = np.unique(owner, return_inverse=True)
    return list(zip(numbers.tolist(), split_by_labels(obj, labels, following), strict=True))


def separate_bodies(
    objects: Sequence[ObjectInstance], config: AssociationConfig
) -> list[list[ObjectInstance]]:
    """Group the objects of one epoch that are large enough into bodies that stand side by side."""
    largest = max((len(t.voxels) for t in objects), default=0)
    large = [t for t in objects if len(t.voxels) >= config.apart * largest]
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


def group_row_houses(
    pieces: Sequence[Piece],
    claimed: Sequence[bool],
    config: AssociationConfig,
    apart: Callable[[int, int], bool] = never,
) -> list[list[int]]:
    """Group matches (positions) into rows of houses.

    Parameters
    ----------
    pieces : sequence of Piece
        Buildings in both epochs.
    claimed : sequence of bool
        Which of them are new or gone.
    config : AssociationConfig
    apart : callable, optional
        Tells of a building of one epoch and of one of both (positions) whether a gap between them is open.

    Returns
    -------
    list of list of int
        A house of one match lies in a house of another; or both adjoin in one epoch and stand a house apart
        in the other one; or what is new or gone adjoins both.
    """
    columns = [
        [
            (k, np.unique(column_keys(join_voxels(body).xyz, _COLUMN)))
            for k, piece in enumerate(pieces)
            if not claimed[k]
            for body in separate_bodies(piece[epoch], config)
            if body
        ]
        for epoch in (0, 1)
    ]
    links = [
        (k, m)
        for k, one in columns[0]
        for m, two in columns[1]
        if k != m and len(np.intersect1d(one, two)) > _SHARED * min(len(one), len(two))
    ]
    links.extend(_rows_of_one_epoch(pieces, config.parts.gap, apart))
    joined = connect(len(pieces), np.array(links, dtype=np.int64).reshape(-1, 2))
    return [group.tolist() for group in group_indices(joined)]


def _rows_of_one_epoch(
    pieces: Sequence[Piece], gap: float, apart: Callable[[int, int], bool]
) -> list[tuple[int, int]]:
    """Links (positions) between buildings of both epochs that one epoch has in one row.

    They adjoin in one epoch and stand a house apart in the other one, or what one epoch has adjoins both.
    Scaffolding before their walls joins no houses, nor does a garage between them with gaps beside it.
    """
    places = [(_tall(b), _tall(a)) for b, a in pieces]
    both = [k for k, sides in enumerate(places) if all(map(len, sides))]
    links = []
    for k, m in combinations(both, 2):
        gaps = [_distance(one, other) for one, other in zip(places[k], places[m], strict=True)]
        if min(gaps) <= gap and max(gaps) >= _FRONT:
            links.append((k, m))
    for k, sides in enumerate(places):
        epoch = 0 if len(sides[0]) else 1
        if len(sides[epoch]) and not len(sides[1 - epoch]):
            near = [m for m in both if _distance(sides[epoch], places[m][epoch]) <= gap]
            beside = [m for m in near if not apart(k, m)]
            if len(beside) > 1 and not _is_before_fronts(pieces[k], [pieces[m] for m in beside], epoch):
                links.extend((k, m) for m in beside)
    return links


def _is_before_fronts(piece: Piece, beside: Sequence[Piece], epoch: int) -> bool:
    """Tell whether what one epoch alone has stands close before the fronts of the houses beside it.

    Party walls face along the row: what is new or gone between them is a house.
    """
    houses = [join_voxels(house[epoch]) for house in beside]
    row = houses[-1].xyz[:, :2].mean(axis=0) - houses[0].xyz[:, :2].mean(axis=0)
    along = row / max(float(np.linalg.norm(row)), _CELL)
    fronts = [house.select(np.abs(house.normal[:, :2] @ along) < _ACROSS) for house in houses]
    return is_layer(join_voxels(piece[epoch]).xyz, Voxels.joined(fronts))


def _tall(objects: Sequence[ObjectInstance]) -> Floats:
    """Places (N, 2) of what is higher than a room: no fence joins two houses."""
    voxels = join_voxels(objects)
    return voxels.xyz[voxels.height >= _ROOM, :2]


def _distance(one: Floats, other: Floats) -> float:
    """Smallest distance between places (N, 2) and (M, 2) [m], or that of their boxes where it is large."""
    apart = np.maximum(one.min(axis=0) - other.max(axis=0), other.min(axis=0) - one.max(axis=0))
    if apart.max() >= _FRONT:
        return float(apart.max())
    return float(cKDTree(one).query(other)[0].min())


def split_at_walls(
    before: Sequence[ObjectInstance],
    after: Sequence[ObjectInstance],
    config: AssociationConfig,
    following: int,
) -> list[Piece]:
    """Divide a row at the walls that either epoch shows, and where its houses changed.

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
    labels, house = changed_houses(*voxels)
    houses = np.split(house > 0, [len(voxels[0])])
    for side, other, of_house in zip(sides, voxels[::-1], houses, strict=True):
        bodies = [b for b in separate_bodies(side, config) if b and height_of(b) >= _ROOM]
        bodies = [body for body in bodies if not _is_wing(body, side, other, of_house)] or [list(side)]
        owner = np.repeat(np.arange(len(bodies)), [sum(len(t.voxels) for t in body) for body in bodies])
        places = np.concatenate([t.voxels.xyz[:, :2] for body in bodies for t in body])
        labels = labels * len(bodies) + owner[cKDTree(places).query(xy)[1]]
    labels = np.where(house > 0, labels.max() + house, labels)
    return _pieces(sides, xy, labels, house > 0, config, following)


def _is_wing(
    body: Sequence[ObjectInstance], side: Sequence[ObjectInstance], other: Voxels, of_house: Mask
) -> bool:
    """Tell whether a body that one epoch alone has is a wing of a house, and no house of its row.

    No changed house of the row is there (``of_house`` (M,), of the voxels of the epoch), and the body is
    narrower than a house at the end of a row, or than one of a pair and less deep than the rest.
    """
    members = [any(t is b for b in body) for t in side]
    mine = np.repeat(members, [len(t.voxels) for t in side])
    if mine.all() or of_house[mine].mean() >= 0.5:
        return False
    xyz = join_voxels(side).xyz
    columns = np.unique(column_keys(xyz[mine], _COLUMN))
    shared = np.intersect1d(columns, column_keys(other.xyz[other.height >= _ROOM], _COLUMN))
    if len(shared) > _LEFT * len(columns):
        return False
    turned = wall_coordinates(xyz[:, :2])
    row = int(np.abs(np.median(turned[mine], axis=0) - np.median(turned[~mine], axis=0)).argmax())
    own, rest = (np.ptp(turned[part], axis=0) for part in (mine, ~mine))
    shallow = own[1 - row] < _ALIKE * rest[1 - row]
    return bool(own[row] < (_PAIR if shallow else _END))


def _undivided_between(houses: Set[int], obj: ObjectInstance, labels: Ints, changed: Mask) -> Ints:
    """Return one label for all voxels (M,) of what one epoch alone has between houses of both epochs.

    A garage is of one of them. ``houses``: their labels; ``changed`` (M,): voxels of a changed house of the
    row.
    """
    between = _is_alone(obj) and not changed.any() and set(labels.tolist()) <= houses
    return np.full_like(labels, np.bincount(labels).argmax()) if between else labels


def _is_alone(obj: ObjectInstance) -> bool:
    """Tell whether most of an object stands in its own epoch alone."""
    return bool(obj.voxels.observed_unoccupied.mean() > 0.5)


def _pieces(
    sides: Piece, xy: Floats, labels: Ints, changed: Mask, config: AssociationConfig, following: int
) -> list[Piece]:
    """Divide objects of both epochs by labels (N,) of their voxels (N, 2); small parts join others.

    A ``changed`` (N,) house is as wide as a house, however few its voxels. If all large parts are changed
    houses, small parts are not joined to them: the garage beside a demolished house is an object of its own.
    """
    labels = np.unique(labels, return_inverse=True)[1]
    size, moved = np.bincount(labels), np.bincount(labels, changed) > 0
    enough = size >= config.parts.points
    large = np.where(moved, enough, size >= config.apart * size.max())
    large = large if (large & ~moved).any() else enough
    if np.count_nonzero(large) < 2:
        return [sides]
    kept = large[labels]
    whole = kept & ~moved[labels] if (large & ~moved).any() else kept
    labels = np.where(kept, labels, labels[whole][cKDTree(xy[whole]).query(xy)[1]])
    labels = np.unique(labels, return_inverse=True)[1]
    found: list[tuple[list[ObjectInstance], list[ObjectInstance]]] = [
        ([], []) for _ in range(labels.max() + 1)
    ]
    ends = np.cumsum([len(obj.voxels) for side in sides for obj in side])[:-1]
    owners, moves = np.split(labels, ends), np.split(changed, ends)
    epochs = [epoch for epoch, side in enumerate(sides) for _ in side]
    members = list(zip(epochs, (*sides[0], *sides[1]), owners, moves, strict=True))
    standing: tuple[set[int], set[int]] = (set(), set())
    for epoch, obj, own, _ in members:
        if not _is_alone(obj):
            standing[epoch].update(own.tolist())
    houses = standing[0] & standing[1]
    for epoch, obj, own, of_house in members:
        parts = _along(obj, _undivided_between(houses, obj, own, of_house), following)
        for number, piece in parts:
            found[number][epoch].append(piece)
        following += len(parts)
    return [(tuple(b), tuple(a)) for b, a in found]
