"""Candidate groups: objects that may interact in the comparison; different groups are independent."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from scipy.spatial import cKDTree

from subiaco_change.association.config import AssociationConfig
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.objects.measures import MeasureConfig
from subiaco_change.segmentation.clustering import connect
from subiaco_change.segmentation.ground_model import Mask
from subiaco_change.tiling.epoch_tiles import EpochContext
from subiaco_change.tiling.retiling import EpochObjects, LabelledPoints, load_points, near_tile
from subiaco_change.tiling.stage_inputs import TileParams
from subiaco_geo.clouds import unique_keys, voxel_indices, voxel_keys
from subiaco_geo.codes import Semantic
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.work.tasks import Inputs

_BOXES = NUMBERS.tiling.box_overlap
_MARGIN = NUMBERS.tiling.reach_margin


@dataclass(frozen=True)
class CandidateSlice:
    """What the search for candidate pairs reads of the configuration."""

    measures: MeasureConfig
    association: AssociationConfig


@dataclass(frozen=True)
class GroupSlice:
    """What the grouping reads of the configuration."""

    association: AssociationConfig


@dataclass(frozen=True)
class GroupParams(TileParams[GroupSlice]):
    """``counts``: numbers of objects of *before* and of *after*."""

    counts: tuple[int, int]


@dataclass(frozen=True)
class EpochPairs:
    """Objects of one epoch in a tile.

    ``pairs`` (F, 2): a building and another object that may be its extension; ``objects`` (K,): those with
    points in the tile; ``sums`` (K, 8): points, sums of x, y, z, least and largest x and y, common frame.
    """

    pairs: Ints
    objects: Ints
    sums: Floats


@dataclass(frozen=True)
class CandidatePairs:
    """Objects that come near each other in a tile; ``across`` (E, 2): of *before* and of *after*."""

    across: Ints
    before: EpochPairs
    after: EpochPairs


@dataclass(frozen=True)
class CandidateGroups:
    """Groups of objects that may interact.

    ``tiles``: those that answer for groups; ``anchor`` (G,): position in ``tiles``; ``low`` and ``high``
    (G, 2): box of the group in the common frame [m]; ``before`` and ``after`` (K,): group of every object.
    """

    tiles: tuple[str, ...]
    anchor: Ints
    low: Floats
    high: Floats
    before: Ints
    after: Ints


def tile_links(inputs: Inputs, params: TileParams[CandidateSlice]) -> CandidatePairs:
    """Find pairs of objects that come near each other in a tile.

    ``inputs`` hold ``points/<epoch>/<tile>`` of the tile and its neighbours, ``united/<epoch>``, the frame.
    """
    config = params.config
    reach = config.measures.tolerance + _MARGIN
    touch = config.association.parts.touch + _MARGIN
    loaded = [_voxels(inputs, side, params, max(reach, touch)) for side in params.sides]
    (places_b, numbers_b, own_b), (places_a, numbers_a, own_a) = loaded
    forward = _near(places_b[own_b], numbers_b[own_b], places_a, numbers_a, reach)
    backward = _near(places_a[own_a], numbers_a[own_a], places_b, numbers_b, reach)
    found = []
    for side, (places, numbers, own) in zip(params.sides, loaded, strict=True):
        united = inputs.of(EpochObjects, f"united/{side.epoch}").semantic
        flat, of, inside = _columns(places, numbers, own, config.measures.voxel)
        house = united[of] == Semantic.BUILDING if len(of) else inside
        pairs = np.concatenate(
            [
                _near(flat[inside & house], of[inside & house], flat, of, touch),
                _near(flat[inside], of[inside], flat[house], of[house], touch),
            ]
        )
        links = _unique(pairs[pairs[:, 0] != pairs[:, 1]])
        found.append(EpochPairs(links, *_sums(inputs, side, params)))
    return CandidatePairs(_unique(np.concatenate([forward, backward[:, ::-1]])), found[0], found[1])


def _numbered(inputs: Inputs, side: EpochContext, name: str, origin: Floats) -> tuple[Floats, Ints]:
    """Points (N, 3) of objects in a tile, in the common frame, and their objects (N,)."""
    piece = inputs.find(LabelledPoints, f"points/{side.epoch}/{name}")
    if piece is None:
        return np.zeros((0, 3)), np.zeros(0, dtype=np.int64)
    number = piece.number.astype(np.int64)
    return load_points(inputs, side, name, origin).xyz[number >= 0], number[number >= 0]


def _voxels(
    inputs: Inputs, side: EpochContext, params: TileParams[CandidateSlice], rim: float
) -> tuple[Floats, Ints, Mask]:
    """Mean places (M, 3) of the voxels of objects around a tile, their objects, and which lie in it."""
    edge, origin = params.config.measures.voxel, params.origin
    parts = [_numbered(inputs, side, name, origin) for name in inputs.under(f"points/{side.epoch}")]
    xyz = np.concatenate([np.zeros((0, 3)), *(p[0] for p in parts)])
    number = np.concatenate([np.zeros(0, np.int64), *(p[1] for p in parts)])
    near = near_tile(params.tile, rim + edge, params.size, origin)(xyz)
    xyz, number = xyz[near], number[near]
    keys = voxel_keys(voxel_indices(xyz, edge))
    order = np.lexsort((keys, number))
    fresh = np.diff(number[order], prepend=-1).astype(bool) | np.diff(keys[order], prepend=-1).astype(bool)
    slot = np.cumsum(fresh) - 1
    count = np.maximum(np.bincount(slot), 1) if len(slot) else np.ones(0)
    means = [np.bincount(slot, xyz[order, k], len(count)) / count for k in range(3)]
    places = np.stack(means, axis=1) if len(slot) else np.zeros((0, 3))
    return places, number[order][fresh], near_tile(params.tile, 0.0, params.size, origin)(places)


def _columns(places: Floats, numbers: Ints, own: Mask, edge: float) -> tuple[Floats, Ints, Mask]:
    """One place of every column of voxels of an object, seen from above."""
    cell = np.column_stack([numbers, np.floor(places[:, :2] / edge).astype(np.int64)])
    _, first = np.unique(cell, axis=0, return_index=True)
    return places[first, :2], numbers[first], own[first]


def _near(first: Floats, first_of: Ints, second: Floats, second_of: Ints, reach: float) -> Ints:
    """Pairs (E, 2) of objects with places within reach [m], each once."""
    if len(first) == 0 or len(second) == 0:
        return np.zeros((0, 2), dtype=np.int64)
    found = cKDTree(first).sparse_distance_matrix(cKDTree(second), reach, output_type="coo_matrix")
    return _unique(np.column_stack([first_of[found.row], second_of[found.col]]).astype(np.int64))


def _unique(pairs: Ints) -> Ints:
    """Return every pair (E, 2) of numbers from 0 once, in order; sorting rows takes ten times as long."""
    if len(pairs) == 0:
        return np.zeros((0, 2), dtype=np.int64)
    base = int(pairs[:, 1].max()) + 1
    return np.stack(np.divmod(unique_keys(pairs[:, 0] * base + pairs[:, 1]), base), axis=1)


def _sums(inputs: Inputs, side: EpochContext, params: TileParams[CandidateSlice]) -> tuple[Ints, Floats]:
    """Objects (K,) of an epoch in a tile, and their sums (K, 8)."""
    xyz, number = _numbered(inputs, side, params.tile, params.origin)
    objects, slot = np.unique(number, return_inverse=True)
    count = len(objects)
    sums = np.zeros((count, 8))
    sums[:, 0] = np.bincount(slot, minlength=count)
    for k in range(3):
        sums[:, 1 + k] = np.bincount(slot, xyz[:, k], count)
    sums[:, 4:6], sums[:, 6:8] = np.inf, -np.inf
    np.minimum.at(sums[:, 4:6], slot, xyz[:, :2])
    np.maximum.at(sums[:, 6:8], slot, xyz[:, :2])
    return objects.astype(np.int64), sums


def find_groups(inputs: Inputs, params: GroupParams) -> CandidateGroups:
    """Join what is linked into groups, and give each to the tile that holds its middle."""
    tiles = inputs.under("candidate_pairs")
    pieces = [inputs.of(CandidatePairs, f"candidate_pairs/{name}") for name in tiles]
    by_epoch = ([piece.before for piece in pieces], [piece.after for piece in pieces])
    sums = [_total(own, count) for own, count in zip(by_epoch, params.counts, strict=True)]
    size_b, size_a = (len(s) for s in sums)
    edges = [np.zeros((0, 2), dtype=np.int64)]
    for piece in pieces:
        edges += [piece.across + np.array([0, size_b]), piece.before.pairs, piece.after.pairs + size_b]
    edges.append(_alike(sums, params.config.association.gate_distance) + np.array([0, size_b]))
    group = connect(size_b + size_a, np.concatenate(edges))
    every = np.concatenate(sums)
    count = int(group.max(initial=-1)) + 1
    total = np.stack([np.bincount(group, every[:, k], count) for k in range(3)], axis=1)
    middle = total[:, 1:3] / np.maximum(total[:, :1], 1.0) + params.origin[:2]
    names = [f"{c}_{r}" for c, r in np.floor(middle / params.size).astype(int).tolist()]
    anchors, anchor = np.unique(np.array(names, dtype=np.str_), return_inverse=True)
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    np.minimum.at(low, group, every[:, 4:6])
    np.maximum.at(high, group, every[:, 6:8])
    return CandidateGroups(
        tuple(anchors.tolist()), anchor.astype(np.int64), low, high, group[:size_b], group[size_b:]
    )


def _total(pieces: Sequence[EpochPairs], count: int) -> Floats:
    """Add up the sums (K, 8) of every object over the tiles."""
    total = np.zeros((count, 8))
    total[:, 4:6], total[:, 6:8] = np.inf, -np.inf
    for piece in pieces:
        objects, sums = piece.objects, piece.sums
        total[objects, :4] += sums[:, :4]
        total[objects, 4:6] = np.minimum(total[objects, 4:6], sums[:, 4:6])
        total[objects, 6:8] = np.maximum(total[objects, 6:8], sums[:, 6:8])
    return total


def _alike(sums: list[Floats], gate: float) -> Ints:
    """Pairs (E, 2) of objects of two epochs with near centres, or with boxes that mostly coincide."""
    if min(map(len, sums)) == 0:
        return np.zeros((0, 2), dtype=np.int64)
    centres = [s[:, 1:4] / np.maximum(s[:, :1], 1.0) for s in sums]
    near = cKDTree(centres[0]).sparse_distance_matrix(
        cKDTree(centres[1]), gate + _MARGIN, output_type="coo_matrix"
    )
    boxes = [shapely.box(s[:, 4], s[:, 5], s[:, 6], s[:, 7]) for s in sums]
    first, second = shapely.STRtree(boxes[1]).query(boxes[0], predicate="intersects")
    common = shapely.area(shapely.intersection(boxes[0][first], boxes[1][second]))
    whole = shapely.area(boxes[0][first]) + shapely.area(boxes[1][second]) - common
    alike = common > _BOXES * whole
    pairs = [np.column_stack([near.row, near.col]), np.column_stack([first[alike], second[alike]])]
    return np.asarray(np.concatenate(pairs), dtype=np.int64)
