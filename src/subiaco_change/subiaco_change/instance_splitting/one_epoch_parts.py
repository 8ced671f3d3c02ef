"""Parts of an instance that exist in one epoch only, split off as objects of their own, or left to a vehicle.

Where another vehicle stands in the place of the first, it is longer or higher by a part; and of a parked
vehicle, one epoch may have seen an end that the other only grazed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from pydantic import Field
from scipy.spatial import cKDTree
from shapely import Point

from subiaco_change.decisions.column_volumes import column_keys
from subiaco_change.decisions.measures import Measures, oriented_rectangle
from subiaco_change.decisions.rules import Decision
from subiaco_change.decisions.voxel_objects import ObjectInstance, Voxels, join_voxels
from subiaco_change.geometry import in_box_around, lies_near
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import applies, first_argument, no_decision, switchable
from subiaco_change.segmentation.bounding_rectangles import in_box_of
from subiaco_change.segmentation.clustering import connect, group_indices, voxel_clusters
from subiaco_change.segmentation.ground_model import Mask
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.config import StrictModel
from subiaco_geo.frames import Floats, Ints

_CELL = NUMBERS.one_epoch_parts.cell
_WELL_KNOWN = NUMBERS.one_epoch_parts.observed_voxels
_FAR = NUMBERS.one_epoch_parts.far_share
_ABOVE = NUMBERS.one_epoch_parts.overhang
_ACROSS = NUMBERS.vehicle_parts.crossed_share
_VEHICLE = NUMBERS.vehicle_parts.vehicle_width
_NEXT = NUMBERS.vehicle_parts.adjacent
_HELD = NUMBERS.vehicle_parts.adjacent_share
_LENGTH = NUMBERS.vehicle_parts.vehicle_length
_HELD_END = NUMBERS.vehicle_parts.adjacent_share_of_end


class PartConfig(StrictModel):
    """What makes a part of an instance an object of its own."""

    points: int = Field(
        20,
        ge=0,
        description="Smallest number of points of a part that changed on its own; 0 never splits instances",
    )
    gap: float = Field(
        0.75, gt=0, description="Edge of the voxels in which pieces of one part are connected [m]"
    )
    length: float = Field(0.8, gt=0, description="Smallest horizontal extent of a part that is split off [m]")
    foot: float = Field(
        1.1,
        gt=0,
        description="Height above ground below which a part must begin to be split off [m]; a voxel of the "
        "trunk above the foot that no epoch counts",
    )
    top: float = Field(
        0.6,
        ge=0,
        description="Height above ground that the upper tenth of a part must exceed [m]; lower parts are "
        "misclassified ground",
    )
    whole: float = Field(
        0.75,
        gt=0,
        le=1,
        description="Fraction of the observed voxels in the columns of a part that must exist in one "
        "epoch alone",
    )
    remainder: float = Field(
        0.1, ge=0, lt=1, description="Fraction of the instance that must remain when its parts are split off"
    )
    touch: float = Field(1.5, gt=0, description="Distance within which a part adjoins a building [m]")
    subordinate: float = Field(
        1.0,
        gt=0,
        description="Ratio of part volume to building volume below which an adjoining part is an extension "
        "of the building",
    )


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
    for group in group_indices(voxel_clusters(voxels.xyz[members], config.gap)):
        piece = members[group]
        whole = _stands(obj, piece, column, alone, config)
        for part in [piece] if whole else _free_columns(obj, piece, column, alone, config):
            if far[part].mean() >= _FAR and (whole or _stands(obj, part, column, alone, config)):
                count += 1
                labels[part] = count
    if count == 0:
        return labels
    return _with_unseen(obj, labels, config)


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
    voxels = obj.voxels
    if voxels.height[piece].min() > config.foot or np.quantile(voxels.height[piece], 0.9) < config.top:
        return False
    if np.linalg.norm(np.ptp(voxels.xyz[piece, :2], axis=0)) + _CELL < config.length:
        return False
    inside = _below(obj, piece, column) & voxels.observed
    return bool(np.count_nonzero(alone & inside) >= config.whole * np.count_nonzero(inside))


def _below(obj: ObjectInstance, piece: Ints, column: Ints) -> Mask:
    """Tell which voxels (M,) stand in the columns of a piece and no higher: a bin stands under a crown."""
    keys, slot = np.unique(column[piece], return_inverse=True)
    top = np.full(len(keys), -np.inf)
    np.maximum.at(top, slot, obj.voxels.height[piece])
    place = np.minimum(np.searchsorted(keys, column), len(keys) - 1)
    return np.asarray((keys[place] == column) & (obj.voxels.height <= top[place] + _ABOVE))


def _with_unseen(obj: ObjectInstance, labels: Ints, config: PartConfig) -> Ints:
    """Give what the other epoch did not see to the nearest part or rest; drop parts that are too small.

    Where less still stands than is known of a part, the rest gets nothing: the unseen space behind a
    house that is gone was the house, not the gate that is left of the instance.
    """
    known = obj.voxels.observed
    if not known.all():
        left = np.count_nonzero(obj.voxels.occupied_in_other & (labels == 0))
        gone = np.bincount(labels[known])[1:].max()
        most = applies("unseen_belongs_to_most", left < gone and gone >= _WELL_KNOWN)
        source = np.flatnonzero(known & ((labels > 0) | (not most)))
        nearest = cKDTree(obj.voxels.xyz[source]).query(obj.voxels.xyz[~known])[1]
        labels[~known] = labels[source][nearest]
    return large_parts(labels, obj, config.points, config.remainder * len(obj.xyz))


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


@switchable("parts_of_vehicles", no_decision)
def decide_vehicle_part(
    objects: Sequence[ObjectInstance], semantic: Semantic, measures: Measures, standing: Floats
) -> Decision | None:
    """Decide what was parted from a vehicle and stands in one epoch alone; None where it may be one.

    A part as wide as a vehicle and shorter is the end of a longer vehicle that stood in the place of another
    one, if only some of the part lies beside what the other epoch has.

    ``standing`` (N, 3) are the points of the other epoch that stand, of any class.
    """
    if semantic is not Semantic.MOBILE or any(t.whole < 0 for t in objects):
        return None
    across = 0.5 * abs(measures.net_changed_fraction) / max(measures.gone_share, measures.new_share)
    if across < _ACROSS:
        reason = (
            f"The other survey observed {across:.0%} of this part of a vehicle, less than the limit of"
            f" {_ACROSS:.0%}: nothing is claimed."
        )
        return Decision(Change.UNOBSERVED, reason, 1.0 - across)
    xyz = join_voxels(objects).xyz
    narrow, long = footprint_sides(xyz)
    short = applies("ends_of_vehicles", _VEHICLE <= long < _LENGTH)
    if narrow >= _VEHICLE and not short:
        return _decide_shell(xyz, long, standing)
    held = float(lies_near(xyz, standing, _NEXT).mean())
    limit = _HELD_END if short else _HELD
    if held < limit:
        return None
    reason = (
        f"{held:.0%} of this part of a vehicle lies beside points of the other survey (limit"
        f" {limit:.0%}): the part belongs to an object that both surveys have."
    )
    return Decision(Change.UNCHANGED, reason, held)


@switchable("shells_of_vehicles", no_decision)
def _decide_shell(xyz: Floats, long: float, standing: Floats) -> Decision | None:
    """Decide a part (M, 3) as large as a vehicle, whose longer side is ``long`` [m].

    A lorry leaves its sides around the car that stands in its place in the other epoch, whose points
    ``standing`` (N, 3) are; what surrounds nothing is a vehicle of its own.
    """
    if not _surrounds(xyz, standing):
        return None
    reason = (
        f"This part of a vehicle is {long:.1f} m long (limit {_LENGTH:g} m) and lies around an object of the"
        " other survey: another vehicle is in the place of the first, and no change is claimed."
    )
    return Decision(Change.UNCHANGED, reason, long / _LENGTH)


def _surrounds(xyz: Floats, points: Floats) -> bool:
    """Tell whether places (M, 3) lie around points (N, 3) as long as a car: the sides of a larger vehicle."""
    inside = points[in_box_around(points, xyz, 0.0)]
    inside = inside[in_box_of(xyz[:, :2], inside[:, :2], 0.0)]
    if len(inside) == 0 or footprint_sides(inside)[1] < _LENGTH:
        return False
    return bool(oriented_rectangle(inside[:, :2]).contains(Point(xyz[:, :2].mean(axis=0))))


def footprint_sides(xyz: Floats) -> tuple[float, float]:
    """Shorter and longer side of the footprint of places (M, 3) [m]."""
    corners = np.array(oriented_rectangle(xyz[:, :2]).exterior.coords)
    narrow, long = np.sort(np.linalg.norm(np.diff(corners[:3], axis=0), axis=1)).tolist()
    return narrow, long
