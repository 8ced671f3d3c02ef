"""Parts of an instance that exist in one epoch only, split off as objects of their own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import permutations

import numpy as np
from scipy.spatial import cKDTree

from subiaco_change.association.config import PartConfig
from subiaco_change.geometry import column_keys, in_outline_of
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import applies, first_argument, never, switchable
from subiaco_change.objects.layers import is_layer, walls_of_both
from subiaco_change.objects.voxel_objects import ObjectInstance, Voxels
from subiaco_change.segmentation.bounding_rectangles import box_coordinates
from subiaco_change.segmentation.clustering import connect, group_indices, voxel_clusters
from subiaco_change.segmentation.ground_model import Mask
from subiaco_geo.codes import Semantic
from subiaco_geo.frames import Floats, Ints

_CELL = NUMBERS.one_epoch_parts.cell
_LITTLE = NUMBERS.one_epoch_parts.little_left
_END = NUMBERS.one_epoch_parts.vehicle_end
_FAR = NUMBERS.one_epoch_parts.far_share
_ABOVE = NUMBERS.one_epoch_parts.overhang
_TOP = NUMBERS.felled_crowns.top_reach
_REMAINS = NUMBERS.one_epoch_parts.remains_inside
_OBJECT = NUMBERS.one_epoch_parts.object_voxels


@switchable("parts_of_one_epoch", first_argument)
def split_one_epoch_parts(
    objects: Sequence[ObjectInstance], config: PartConfig, seen_free: Sequence[Mask] | None = None
) -> list[ObjectInstance]:
    """Split every instance into what the other epoch holds too and the parts that stand alone.

    What grew or was trimmed stays with its object: it hangs over columns that
    stood in both epochs. A part of its own stands on the ground, in columns
    that the other epoch saw free from bottom to top.

    Parameters
    ----------
    objects : sequence of ObjectInstance
        Of one epoch.
    config : PartConfig
    seen_free : sequence of (M,) bool, optional
        Of every object, voxels whose place the other epoch observed free, although it has points near.
    """
    if config.points == 0:
        return list(objects)
    rests: list[ObjectInstance] = []
    parts: list[ObjectInstance] = []
    following = max((t.instance for t in objects), default=-1) + 1
    for number, obj in enumerate(objects):
        plain = obj.voxels
        free = np.zeros(len(plain), dtype=bool) if seen_free is None else seen_free[number]
        labels = _parts_of(replace(obj, voxels=with_free(plain, free)), plain, config)
        parted = replace(obj, voxels=with_free(plain, free & (labels > 0)))
        rest, *own = split_by_labels(parted, labels, following) if labels.any() else [obj]
        following += len(own)
        rests.append(rest)
        parts.extend(own)
    return [*rests, *_united(parts, config)]


def split_by_labels(obj: ObjectInstance, labels: Ints, following: int) -> list[ObjectInstance]:
    """Divide an instance by a label (M,) of its voxels: the first keeps its number, others get new ones."""
    owner = labels[cKDTree(obj.voxels.xyz).query(obj.xyz)[1]]
    names = [obj.instance, *(following + number for number in range(int(labels.max())))]
    return [
        replace(
            obj,
            instance=name,
            whole=obj.body,
            points=obj.points[owner == number],
            voxels=replace(voxels, owner=np.full(len(voxels), name)),
            xyz=obj.xyz[owner == number],
            passed=obj.passed[owner == number] if len(obj.passed) else obj.passed,
            moved=obj.moved[owner == number] if len(obj.moved) else obj.moved,
        )
        for number, name in enumerate(names)
        for voxels in [obj.voxels.select(labels == number)]
    ]


def with_free(voxels: Voxels, free: Mask) -> Voxels:
    """Voxels of which some (M,) lie in places that the other epoch observed free."""
    return replace(
        voxels, observed=voxels.observed | free, occupied_in_other=voxels.occupied_in_other & ~free
    )


def _united(parts: Sequence[ObjectInstance], config: PartConfig) -> list[ObjectInstance]:
    """Make one object of parts that touch: the segmentation may divide one object between two others."""
    if len(parts) < 2:
        return list(parts)
    cluster = voxel_clusters(np.concatenate([p.voxels.xyz for p in parts]), config.gap)
    owner = np.repeat(np.arange(len(parts)), [len(p.voxels) for p in parts])
    links = np.column_stack([owner, cluster + len(parts)])
    group = connect(len(parts) + int(cluster.max()) + 1, links)[: len(parts)]
    _, first = np.unique(group, return_index=True)
    return [
        join_parts([p for p, g in zip(parts, group, strict=True) if g == group[k]]) for k in np.sort(first)
    ]


def join_parts(parts: Sequence[ObjectInstance]) -> ObjectInstance:
    """Make one object of parts of one epoch: number, class and origin are those of the largest."""
    if len(parts) == 1:
        return parts[0]
    largest = max(parts, key=lambda p: len(p.points))
    voxels = Voxels.joined([p.voxels for p in parts])
    return replace(
        largest,
        points=np.concatenate([p.points for p in parts]),
        voxels=replace(voxels, owner=np.full(len(voxels), largest.instance)),
        xyz=np.concatenate([p.xyz for p in parts]),
        passed=np.concatenate([p.passed for p in parts]),
        moved=np.concatenate([p.moved for p in parts]),
    )


def _parts_of(obj: ObjectInstance, plain: Voxels, config: PartConfig) -> Ints:
    """Return the part (M,) of every voxel of an instance, 0 for what is left.

    ``plain``: its voxels without the places that were seen free although points lie near.
    """
    voxels = obj.voxels
    labels = np.zeros(len(voxels), dtype=np.int64)
    alone = voxels.observed_unoccupied
    if len(obj.xyz) < config.points or not alone.any() or alone.all():
        return labels
    members = np.flatnonzero(alone)
    column = column_keys(voxels.xyz, _CELL)
    far = plain.observed_unoccupied
    count = 0
    groups = group_indices(voxel_clusters(voxels.xyz[members], config.gap))
    for piece in _on_trunks(obj, [members[group] for group in groups], column):
        whole = _stands(obj, piece, column, alone, config)
        for part in [piece] if whole else _free_columns(obj, piece, column, alone, config):
            if far[part].mean() >= _FAR and (whole or _stands(obj, part, column, alone, config)):
                count += 1
                labels[part] = count
    if count == 0:
        return labels
    return _with_unseen(obj, _with_remains(obj, labels, config), config)


def _on_trunks(obj: ObjectInstance, pieces: Sequence[Ints], column: Ints) -> list[Ints]:
    """Join the crown of a tree, of voxels of a plant, to the trunk that stands apart below it.

    Between both, leaves or parked cars may hide the trunk.
    """
    if obj.semantic is not Semantic.VEGETATION or len(pieces) < 2:
        return list(pieces)
    height = obj.voxels.height
    low, high = ([float(of(height[piece])) for piece in pieces] for of in (np.min, np.max))
    below = [
        (trunk, crown)
        for crown, trunk in permutations(range(len(pieces)), 2)
        if high[trunk] < low[crown]
        and np.isin(column[pieces[trunk]], column[pieces[crown]]).all()
        and _is_tree(obj, pieces[crown])
    ]
    joined = connect(len(pieces), np.array(below, dtype=np.int64).reshape(-1, 2))
    return [np.sort(np.concatenate([pieces[k] for k in group])) for group in group_indices(joined)]


def _with_remains(obj: ObjectInstance, labels: Ints, config: PartConfig) -> Ints:
    """Give a part of a building the pieces of the rest that lie within its outline, apart from all else.

    A tree stood where the corner of a new house is: both epochs have something there, and the corner is still
    of the new house, and not of the neighbour's, whose instance holds both. A facade that is left of a house
    is no house: the house is one object, and shrank. A wall behind an object that is close to it is one.
    """
    voxels = obj.voxels
    rest = np.flatnonzero((labels == 0) & voxels.observed)
    if obj.semantic is not Semantic.BUILDING or len(rest) == 0:
        return labels
    pieces = sorted(group_indices(voxel_clusters(voxels.xyz[rest], config.gap)), key=len)
    for piece in pieces:
        places, largest = voxels.xyz[rest[piece]], piece is pieces[-1]
        least = (_REMAINS if largest else 1.0) * len(piece)
        for part in range(1, int(labels.max()) + 1):
            own = voxels.xyz[labels == part]
            held = len(own) > least and in_outline_of(own[:, :2], places[:, :2], _CELL).mean() >= _REMAINS
            if held and not (largest and is_layer(own, voxels)):
                labels[rest[piece]] = part
                break
    return labels


def _free_columns(
    obj: ObjectInstance, piece: Ints, column: Ints, alone: Mask, config: PartConfig
) -> list[Ints]:
    """Return the connected pieces of a cluster of a plant in those columns that the other epoch saw free.

    Leaves of a plant that moved a little join an object beside the plant to one cluster with it.
    """
    if obj.semantic is not Semantic.VEGETATION:
        return []
    inside = _below(obj, piece, column) & obj.voxels.observed
    keys, slot = np.unique(column[inside], return_inverse=True)
    share = np.bincount(slot, alone[inside]) / np.maximum(np.bincount(slot), 1)
    kept = piece[np.isin(column[piece], keys[share >= config.whole])]
    return [kept[group] for group in group_indices(voxel_clusters(obj.voxels.xyz[kept], config.gap))]


def _stands(obj: ObjectInstance, piece: Ints, column: Ints, alone: Mask, config: PartConfig) -> bool:
    """Tell whether a piece (P,) of an instance stands on the ground, and is no end of a longer vehicle."""
    voxels = obj.voxels
    lowest = voxels.height[piece].min()
    if np.quantile(voxels.height[piece], 0.9) < config.top:
        return False
    if np.linalg.norm(np.ptp(voxels.xyz[piece, :2], axis=0)) + _CELL < config.length:
        return False
    if obj.semantic is Semantic.MOBILE and _is_end(voxels.xyz[:, :2], piece):
        return False
    layer = obj.semantic is Semantic.BUILDING and is_layer(voxels.xyz[piece], voxels)
    if lowest > config.foot and not (lowest <= config.hidden_foot and (layer or _is_tree(obj, piece))):
        return False
    inside = _below(obj, piece, column) & voxels.observed
    if layer:
        inside &= ~walls_of_both(voxels)
    return bool(np.count_nonzero(alone & inside) >= config.whole * np.count_nonzero(inside))


def _is_end(xy: Floats, piece: Ints) -> bool:
    """Tell the end of a vehicle, of places (M, 2), that is longer than one which stood in its place.

    The end is about as wide as the vehicle, and shorter than any; a bin beside a car is narrow.
    """
    turned = box_coordinates(xy)
    along, across = np.ptp(turned[piece], axis=0)
    return bool(along < _END and across >= 0.5 * np.ptp(turned[:, 1]))


@switchable("hidden_trunks", never)
def _is_tree(obj: ObjectInstance, piece: Ints) -> bool:
    """Tell a tree from the trimmed side of a crown: a tree has a top of its own."""
    if obj.semantic is not Semantic.VEGETATION:
        return False
    return has_top(obj.voxels.xyz, piece, np.arange(len(obj.voxels)), _TOP)


def has_top(xyz: Floats, part: Ints, places: Ints, reach: float) -> bool:
    """Tell whether a place of a part is the highest around: of the trimmed side of a crown none is.

    Parameters
    ----------
    xyz : (M, 3) float64
        Places of plants [m].
    part, places : (P,), (Q,) int64
        Which of them the part has, and which count around it.
    reach : float
        Distance seen from above within which no place is higher [m].
    """
    tree, height = cKDTree(xyz[places, :2]), xyz[places, 2]
    around = tree.query_ball_point(xyz[part, :2], reach)
    return any(height[near].max() <= z for near, z in zip(around, xyz[part, 2].tolist(), strict=True))


def _below(obj: ObjectInstance, piece: Ints, column: Ints) -> Mask:
    """Tell which voxels (M,) stand in the columns of a piece and no higher: a bin stands under a crown."""
    keys, slot = np.unique(column[piece], return_inverse=True)
    top = np.full(len(keys), -np.inf)
    np.maximum.at(top, slot, obj.voxels.height[piece])
    place = np.minimum(np.searchsorted(keys, column), len(keys) - 1)
    return np.asarray((keys[place] == column) & (obj.voxels.height <= top[place] + _ABOVE))


def _with_unseen(obj: ObjectInstance, labels: Ints, config: PartConfig) -> Ints:
    """Give what the other epoch did not see to the nearest part or rest; drop parts that are too small.

    Where little still stands beside what is known of a part, the rest gets nothing: the unseen space behind a
    house that is gone was the house, not the gate that is left of the instance.
    """
    known = obj.voxels.observed
    if not known.all():
        left = np.count_nonzero(obj.voxels.occupied_in_other & (labels == 0))
        little = left <= _LITTLE * np.bincount(labels[known])[1:].max()
        source = np.flatnonzero(known & ((labels > 0) | (not applies("unseen_belongs_to_most", little))))
        nearest = cKDTree(obj.voxels.xyz[source]).query(obj.voxels.xyz[~known])[1]
        labels[~known] = labels[source][nearest]
    least = 0.0 if _leaves_object(obj.voxels, labels) else config.remainder * len(obj.xyz)
    return large_parts(labels, obj, config.points, least)


@switchable("remaining_object", never)
def _leaves_object(voxels: Voxels, labels: Ints) -> bool:
    """Tell whether the remainder of an instance is an object: the garage beside a demolished house.

    Remains of walls within the outline of a new building are no object.
    """
    rest, places = (labels == 0) & voxels.occupied_in_other, voxels.xyz[:, :2]
    return bool(np.count_nonzero(~in_outline_of(places[labels > 0], places[rest], _CELL)) >= _OBJECT)


def large_parts(labels: Ints, obj: ObjectInstance, least: int, least_left: float) -> Ints:
    """Return the parts (M,) of voxels with enough points, numbered anew; none where too little is left.

    What is left of an instance has the label 0, and so have the parts that hold fewer points than ``least``.
    """
    points = np.bincount(labels[cKDTree(obj.voxels.xyz).query(obj.xyz)[1]], minlength=labels.max() + 1)
    if points[0] < least_left:
        return np.zeros_like(labels)
    large = points >= least
    large[0] = True
    return np.asarray(np.where(large, np.cumsum(large) - 1, 0)[labels])
