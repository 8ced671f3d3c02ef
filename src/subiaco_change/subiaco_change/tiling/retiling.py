"""Stages after the segmentation: instances merged across tiles, and points cut by new tiles (part C5).

Instances that lie in several tiles become one. The labelled points of an epoch are then cut by the tiles of
the common frame.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from subiaco_change.method_numbers import NUMBERS
from subiaco_change.segmentation.clustering import connect
from subiaco_change.segmentation.ground_model import Mask
from subiaco_change.tiling.epoch_tiles import EpochContext, TilePoints
from subiaco_change.tiling.stage_inputs import in_frame, load_frame
from subiaco_change.tiling.tile_segmentation import TileSegmentation
from subiaco_geo.clouds import PointCloud
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.tiles import tile_named
from subiaco_geo.work.tasks import Inputs

_SHARED = NUMBERS.tiling.shared_fraction
_LEAST = NUMBERS.tiling.shared_points


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
        group = connect(len(every), _links(inputs, tiles, offset, every))
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
    """Fragments of two tiles that are one, from the numbers (M, 2) that both give to shared points.

    A fragment that lies in the surroundings of its tile joins nothing. At their edge it is cut off, and may
    hold together what the tile that sees the whole of it divides: two crowns, or two parked cars.
    """
    rows = rows[(rows >= 0).any(axis=1)]
    totals = [np.bincount(rows[rows[:, e] >= 0, e]) for e in (0, 1)]
    both = rows[(rows >= 0).all(axis=1)]
    if len(both) == 0:
        return np.zeros((0, 2), dtype=np.int64)
    width = int(both[:, 1].max()) + 1
    flat, count = np.unique(both[:, 0] * width + both[:, 1], return_counts=True)
    pairs = np.column_stack(np.divmod(flat, width))
    smaller = np.minimum(totals[0][pairs[:, 0]], totals[1][pairs[:, 1]])
    pairs, enough = pairs + np.array([first, second]), (count >= _LEAST) & (count >= _SHARED * smaller)
    alike = every[pairs[:, 0], 0] == every[pairs[:, 1], 0]
    inside = (every[pairs, 1] > 0).all(axis=1)
    return np.asarray(pairs[enough & alike & inside])


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


_PREPARED = ("normals", "semantic", "score", "height", "passed", "moved")


@dataclass(frozen=True)
class EpochTileParams:
    """Parameters of a stage that looks at one epoch; ``origin`` (3,) is that of the common frame [m]."""

    tile: str
    size: float
    side: EpochContext
    origin: Floats


@dataclass(frozen=True)
class LabelledPoints:
    """Points of an epoch in a tile of the common frame, in the epoch's own frame.

    ``xyz`` (N, 3) [m]; ``normals`` (N, 3); ``semantic`` (N,); ``score`` (N,) of the class; ``height`` (N,)
    above ground [m]; ``passed`` and ``moved`` (N,), empty where not known; ``number`` (N,), object,
    -1 for none; ``intensity`` (N,) where known. ``sources``: tiles of the epoch's own frame that they come
    from; ``source`` and ``row`` (N,): which of these, and which of its points.
    """

    xyz: Floats
    normals: NDArray[np.float32]
    semantic: NDArray[np.uint8]
    score: NDArray[np.float32]
    height: NDArray[np.float32]
    passed: NDArray[np.float32]
    moved: NDArray[np.float32]
    number: NDArray[np.int32]
    intensity: NDArray[Any] | None
    sources: tuple[str, ...]
    source: NDArray[np.int32]
    row: NDArray[np.int32]


@dataclass(frozen=True)
class PlacedPoints:
    """Points (N, 3) [m] of a tile in the common frame, and their normals (N, 3)."""

    xyz: Floats
    normals: NDArray[np.float32]


def recut_tile(inputs: Inputs, params: EpochTileParams) -> LabelledPoints:
    """Take those points of an epoch that the registration brings into a tile.

    ``inputs`` hold ``cloud/<tile> prepared/<tile>`` of the epoch's own tiles, ``united``, ``registration``.
    """
    frame = load_frame(inputs, params.origin)
    tile = tile_named(params.tile, params.size, 0.0)
    columns: dict[str, list[NDArray[Any]]] = {}
    names = inputs.under("cloud")
    for position, name in enumerate(names):
        cloud = inputs.of(TilePoints, f"cloud/{name}")
        prepared = inputs.of(TileSegmentation, f"prepared/{name}")
        inside = tile.in_core(in_frame(cloud.xyz, params.side, frame).world()[:, :2])
        values: dict[str, NDArray[Any]] = {field: getattr(prepared, field) for field in _PREPARED}
        values |= {"xyz": cloud.xyz, "number": object_numbers(inputs, name, len(inside))}
        values |= {"source": np.full(len(inside), position, np.int32)}
        values |= {"row": np.arange(len(inside), dtype=np.int32)}
        if cloud.intensity is not None:
            values["intensity"] = cloud.intensity
        for field, column in values.items():
            columns.setdefault(field, []).append(column[inside] if len(column) == len(inside) else column)
    whole: dict[str, Any] = {field: np.concatenate(parts) for field, parts in columns.items()}
    lit = len(columns.get("intensity", [])) == len(names)
    return LabelledPoints(
        **{**whole, "intensity": whole["intensity"] if lit else None, "sources": tuple(names)}
    )


def place_tile(inputs: Inputs, params: EpochTileParams) -> PlacedPoints:
    """Bring the points of a tile into the common frame, once for all that follows."""
    piece = inputs.of(LabelledPoints, f"points/{params.side.epoch}/{params.tile}")
    cloud = in_frame(
        piece.xyz, params.side, load_frame(inputs, params.origin), piece.normals.astype(np.float64)
    )
    return PlacedPoints(cloud.xyz, np.asarray(cloud.fields["normals"], dtype=np.float32))


def load_points(inputs: Inputs, side: EpochContext, tile: str, origin: Floats) -> PointCloud:
    """Points of a tile in the common frame, with normals.

    From ``placed/<epoch>/<tile>`` where they were brought there; else from ``points`` and the frame.
    """
    alias = f"{side.epoch}/{tile}"
    placed = inputs.find(PlacedPoints, f"placed/{alias}")
    if placed is not None:
        return PointCloud(placed.xyz, origin, side.crs, {"normals": np.asarray(placed.normals, np.float64)})
    piece = inputs.of(LabelledPoints, f"points/{alias}")
    return in_frame(piece.xyz, side, load_frame(inputs, origin), piece.normals.astype(np.float64))


def near_tile(tile: str, rim: float, size: float, origin: Floats) -> Callable[[Floats], Mask]:
    """Tell which places (N, 3) of the common frame lie in a tile or within ``rim`` [m] of it."""
    square = tile_named(tile, size, rim)

    def near(xyz: Floats) -> Mask:
        return square.in_buffered(xyz[:, :2] + origin[:2])

    return near
