"""Candidate groups: objects that may interact in the comparison; different groups are independent."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import shapely
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from subiaco_change.tiling.epoch_tiles import EPOCHS, Side
from subiaco_change.tiling.retiling import load_points, near_tile
from subiaco_geo.clouds import voxel_indices, voxel_keys
from subiaco_geo.codes import Semantic
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.work.store import Arrays
from subiaco_geo.work.tasks import Inputs

_BOXES = 0.2  # overlap of bounding boxes, seen from above, of two objects that may be one
_PLAY = 0.25  # added to every reach [m]


def tile_links(inputs: Inputs, params: Mapping[str, Any]) -> Arrays:
    """Find pairs of objects that come near each other in a tile.

    Parameters
    ----------
    inputs : Inputs
        ``points/<epoch>/<tile>`` of the tile and its neighbours, ``united/<epoch>``, frame.
    params : mapping
        ``tile size sides origin config``.

    Returns
    -------
    arrays
        ``across`` (E, 2), objects of *before* and *after* within reach; ``before after`` (F, 2), a
        building and another object of one epoch that may be its wing. For each epoch ``<epoch>_objects``
        (K,), those with points in the tile, and ``<epoch>_sums`` (K, 8): points, sums of x, y,
        z, least and largest x and y, in the common frame.
    """
    config = params["config"]
    reach = config.measures.tolerance + _PLAY
    touch = config.association.parts.touch + _PLAY
    loaded = [_voxels(inputs, side, params, max(reach, touch)) for side in params["sides"]]
    result: dict[str, Any] = {}
    (places_b, numbers_b, own_b), (places_a, numbers_a, own_a) = loaded
    forward = _near(places_b[own_b], numbers_b[own_b], places_a, numbers_a, reach)
    backward = _near(places_a[own_a], numbers_a[own_a], places_b, numbers_b, reach)
    result["across"] = _unique(np.concatenate([forward, backward[:, ::-1]]))
    for side, (places, numbers, own) in zip(params["sides"], loaded, strict=True):
        united = inputs[f"united/{side.epoch}"]["semantic"]
        flat, of, inside = _columns(places, numbers, own, config.measures.voxel)
        house = united[of] == Semantic.BUILDING if len(of) else inside
        pairs = np.concatenate(
            [
                _near(flat[inside & house], of[inside & house], flat, of, touch),
                _near(flat[inside], of[inside], flat[house], of[house], touch),
            ]
        )
        result[side.epoch] = _unique(pairs[pairs[:, 0] != pairs[:, 1]])
        result |= _sums(inputs, side, params)
    return result


def _numbered(inputs: Inputs, side: Side, name: str, params: Mapping[str, Any]) -> tuple[Floats, Ints]:
    """Points (N, 3) of objects in a tile, in the common frame, and their objects (N,)."""
    alias = f"points/{side.epoch}/{name}"
    if alias not in inputs:
        return np.zeros((0, 3)), np.zeros(0, dtype=np.int64)
    number = inputs[alias]["number"].astype(np.int64)
    return load_points(inputs, side, name, params).xyz[number >= 0], number[number >= 0]


def _voxels(inputs: Inputs, side: Side, params: Mapping[str, Any], rim: float) -> tuple[Floats, Ints, Any]:
    """Mean places (M, 3) of the voxels of objects around a tile, their objects, and which lie in it."""
    edge = params["config"].measures.voxel
    parts = [_numbered(inputs, side, name, params) for name in inputs.under(f"points/{side.epoch}")]
    xyz = np.concatenate([np.zeros((0, 3)), *(p[0] for p in parts)])
    number = np.concatenate([np.zeros(0, np.int64), *(p[1] for p in parts)])
    near = near_tile(params["tile"], rim + edge, params)(xyz)
    xyz, number = xyz[near], number[near]
    keys = voxel_keys(voxel_indices(xyz, edge))
    order = np.lexsort((keys, number))
    fresh = np.diff(number[order], prepend=-1).astype(bool) | np.diff(keys[order], prepend=-1).astype(bool)
    slot = np.cumsum(fresh) - 1
    count = np.maximum(np.bincount(slot), 1) if len(slot) else np.ones(0)
    means = [np.bincount(slot, xyz[order, k], len(count)) / count for k in range(3)]
    places = np.stack(means, axis=1) if len(slot) else np.zeros((0, 3))
    return places, number[order][fresh], near_tile(params["tile"], 0.0, params)(places)


def _columns(places: Floats, numbers: Ints, own: Any, edge: float) -> tuple[Floats, Ints, Any]:
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
    return np.stack(np.divmod(np.unique(pairs[:, 0] * base + pairs[:, 1]), base), axis=1)


def _sums(inputs: Inputs, side: Side, params: Mapping[str, Any]) -> dict[str, Any]:
    xyz, number = _numbered(inputs, side, params["tile"], params)
    objects, slot = np.unique(number, return_inverse=True)
    count = len(objects)
    sums = np.zeros((count, 8))
    sums[:, 0] = np.bincount(slot, minlength=count)
    for k in range(3):
        sums[:, 1 + k] = np.bincount(slot, xyz[:, k], count)
    sums[:, 4:6], sums[:, 6:8] = np.inf, -np.inf
    np.minimum.at(sums[:, 4:6], slot, xyz[:, :2])
    np.maximum.at(sums[:, 6:8], slot, xyz[:, :2])
    return {f"{side.epoch}_objects": objects.astype(np.int64), f"{side.epoch}_sums": sums}


def find_groups(inputs: Inputs, params: Mapping[str, Any]) -> Arrays:
    """Join what is linked into groups, and give each to the tile that holds its middle.

    Returns
    -------
    arrays
        ``tiles`` names; ``anchor`` (G,) position in it; ``low high`` (G, 2) box of the group in
        the common frame [m]; ``before after`` (K,), group of every object.
    """
    tiles = inputs.under("candidate_pairs")
    pieces = [inputs[f"candidate_pairs/{name}"] for name in tiles]
    sums = [_total(pieces, epoch, int(params["counts"][e])) for e, epoch in enumerate(EPOCHS)]
    size_b, size_a = (len(s) for s in sums)
    edges = [np.zeros((0, 2), dtype=np.int64)]
    for piece in pieces:
        edges += [piece["across"] + np.array([0, size_b]), piece["before"], piece["after"] + size_b]
    edges.append(_alike(sums, params["config"].association.gate_distance) + np.array([0, size_b]))
    pairs = np.concatenate(edges)
    nodes = size_b + size_a
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(nodes, nodes))
    group = connected_components(graph.tocsr(), directed=False)[1].astype(np.int64)
    every = np.concatenate(sums)
    count = int(group.max(initial=-1)) + 1
    total = np.stack([np.bincount(group, every[:, k], count) for k in range(3)], axis=1)
    middle = total[:, 1:3] / np.maximum(total[:, :1], 1.0) + params["origin"][:2]
    names = [f"{c}_{r}" for c, r in np.floor(middle / params["size"]).astype(int).tolist()]
    anchors, anchor = np.unique(np.array(names, dtype=np.str_), return_inverse=True)
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    np.minimum.at(low, group, every[:, 4:6])
    np.maximum.at(high, group, every[:, 6:8])
    return {
        "tiles": anchors,
        "anchor": anchor.astype(np.int64),
        "low": low,
        "high": high,
        "before": group[:size_b],
        "after": group[size_b:],
    }


def _total(pieces: list[Arrays], epoch: str, count: int) -> Floats:
    """Add up the sums (K, 8) of every object over the tiles."""
    total = np.zeros((count, 8))
    total[:, 4:6], total[:, 6:8] = np.inf, -np.inf
    for piece in pieces:
        objects, sums = piece[f"{epoch}_objects"], piece[f"{epoch}_sums"]
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
        cKDTree(centres[1]), gate + _PLAY, output_type="coo_matrix"
    )
    boxes = [shapely.box(s[:, 4], s[:, 5], s[:, 6], s[:, 7]) for s in sums]
    first, second = shapely.STRtree(boxes[1]).query(boxes[0], predicate="intersects")
    common = shapely.area(shapely.intersection(boxes[0][first], boxes[1][second]))
    whole = shapely.area(boxes[0][first]) + shapely.area(boxes[1][second]) - common
    alike = common > _BOXES * whole
    pairs = [np.column_stack([near.row, near.col]), np.column_stack([first[alike], second[alike]])]
    return np.asarray(np.concatenate(pairs), dtype=np.int64)
