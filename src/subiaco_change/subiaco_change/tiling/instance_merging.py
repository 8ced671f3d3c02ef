"""Stage: instances that lie in several tiles merged into one (method, part C5)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from subiaco_change.tiling.tile_segmentation import TileSegmentation
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.work.tasks import Inputs

_SHARED = 0.5  # share of the smaller fragment, of the points that both tiles see, that makes two one
_LEAST = 3  # points


@dataclass(frozen=True)
class MergingParams:
    """``given``: whether instances were given, and carry one number everywhere."""

    given: bool


@dataclass(frozen=True)
class EpochObjects:
    """The objects of one epoch over all tiles.

    ``number`` (L,): object of number k of tile t at ``offset[t] + k``, -1 where none of its points lies in
    a tile; ``semantic`` (K,) and ``points`` (K,): class and number of points of the objects.
    """

    tiles: tuple[str, ...]
    offset: Ints
    number: NDArray[np.int32]
    semantic: NDArray[np.uint8]
    points: Ints


def unite(inputs: Inputs, params: MergingParams) -> EpochObjects:
    """Give the objects of one epoch numbers over all tiles, from ``prepared/<tile>`` of every tile."""
    tiles = inputs.under("prepared")
    summaries = [inputs.of(TileSegmentation, f"prepared/{name}").objects for name in tiles]
    offset = np.concatenate([[0], np.cumsum([len(s) for s in summaries])]).astype(np.int64)
    every = np.concatenate([np.zeros((0, 4)), *summaries])
    if params.given:
        number = np.concatenate([np.zeros(0, np.int64), *(np.arange(len(s)) for s in summaries)])
        group = np.unique(number, return_inverse=True)[1]
    else:
        group = _groups(_links(inputs, tiles, offset, every), len(every))
    number, semantic, points = _renumber(group.astype(np.int64), every)
    return EpochObjects(tuple(tiles), offset, number.astype(np.int32), semantic.astype(np.uint8), points)


def _links(inputs: Inputs, tiles: list[str], offset: Ints, every: Floats) -> Ints:
    """Pairs (E, 2) of fragments of one class that share most of what both of their tiles see of them."""
    slot = {name: t for t, name in enumerate(tiles)}
    shared: dict[tuple[int, int], list[Ints]] = {}
    for name in tiles:
        piece = inputs.of(TileSegmentation, f"prepared/{name}")
        count = len(piece.semantic)
        seen, inner = piece.instance[count:], piece.inner[count:]
        near, index = piece.near_tile, piece.near_index
        for position, other in enumerate(piece.neighbours):
            members = (near == position) & inner
            there = inputs.of(TileSegmentation, f"prepared/{other}").instance[index[members]]
            pair = np.column_stack([seen[members], there]).astype(np.int64)
            a, b = slot[name], slot[other]
            rows = pair if a < b else pair[:, ::-1]
            shared.setdefault((min(a, b), max(a, b)), []).append(rows)
    found = [_pairs(np.concatenate(rows), offset[a], offset[b], every) for (a, b), rows in shared.items()]
    return np.concatenate([np.zeros((0, 2), np.int64), *found])


def _pairs(rows: Ints, first: int, second: int, every: Floats) -> Ints:
    """Fragments of two tiles that are one, from the numbers (M, 2) that both give to shared points."""
    rows = rows[(rows >= 0).any(axis=1)]
    totals = [np.bincount(rows[rows[:, e] >= 0, e]) for e in (0, 1)]
    both = rows[(rows >= 0).all(axis=1)]
    if len(both) == 0:
        return np.zeros((0, 2), dtype=np.int64)
    pairs, count = np.unique(both, axis=0, return_counts=True)
    smaller = np.minimum(totals[0][pairs[:, 0]], totals[1][pairs[:, 1]])
    pairs, enough = pairs + np.array([first, second]), (count >= _LEAST) & (count >= _SHARED * smaller)
    alike = every[pairs[:, 0], 0] == every[pairs[:, 1], 0]
    return np.asarray(pairs[enough & alike])


def _groups(links: Ints, count: int) -> Ints:
    graph = coo_array((np.ones(len(links)), (links[:, 0], links[:, 1])), shape=(count, count))
    return np.asarray(connected_components(graph.tocsr(), directed=False)[1])


def _renumber(group: Ints, every: Floats) -> tuple[Ints, Ints, Ints]:
    """Give groups numbers by class and from the west; what has no point in any tile gets -1."""
    size = int(group.max(initial=-1)) + 1
    points = np.bincount(group, every[:, 1], size).astype(np.int64)
    votes = np.zeros((size, 5))
    np.add.at(votes, (group, every[:, 0].astype(np.int64)), every[:, 1])
    semantic = votes.argmax(axis=1) if size else np.zeros(0, dtype=np.int64)
    least = np.full((size, 2), np.inf)
    np.minimum.at(least, group, every[:, 2:])
    kept = np.flatnonzero(points > 0)
    order = kept[np.lexsort((points[kept], least[kept, 1], least[kept, 0], semantic[kept]))]
    number = np.full(size, -1, dtype=np.int64)
    number[order] = np.arange(len(order))
    return number[group], semantic[order], points[order]


def object_numbers(inputs: Inputs, tile: str, count: int) -> NDArray[np.int32]:
    """Object (N,) int32 of the points of a tile, -1 for none, from ``united`` and ``prepared/<tile>``."""
    united = inputs.of(EpochObjects, "united")
    position = united.tiles.index(tile)
    own = inputs.of(TileSegmentation, f"prepared/{tile}").instance[:count].astype(np.int64)
    found = own >= 0
    result = np.full(count, -1, dtype=np.int32)
    result[found] = united.number[int(united.offset[position]) + own[found]]
    return result
