"""Changes of the ground over tiles: differences of cells, patches that go on from tile to tile, the raster."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from subiaco_change.changes.ground_change import (
    GroundChangeConfig,
    GroundPatch,
    beyond_gate,
    difference_cells,
    ground_hidden,
    make_patch,
    shown_lod,
    stands_out,
)
from subiaco_change.semantics.ground import Mask
from subiaco_change.tiled.regions import load_region
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.tiles import Tile, tile_named
from subiaco_geo.work.store import Arrays
from subiaco_geo.work.tasks import Inputs

_SIGNS = ((1.0, Change.INCREASED), (-1.0, Change.DECREASED))
_RIM = 10.0  # around a tile, so that its own cells know their surroundings [m]


def _window(tile: Tile, origin: Floats, config: GroundChangeConfig) -> tuple[Floats, tuple[int, int], int]:
    """South-west corner in the common frame [m] and shape of the cells of a tile with its rim; cells of the rim."""
    low, high = np.array(tile.buffered[:2]), np.array(tile.buffered[2:])
    count = round(float(high[0] - low[0]) / config.cell)
    return low - origin[:2], (count, count), round((tile.core[0] - tile.buffered[0]) / config.cell)


def tile_ground(inputs: Inputs, params: Mapping[str, Any]) -> Arrays:
    """Difference the ground in the cells of a tile.

    Returns
    -------
    arrays
        ``dz lod height`` (rows, columns) [m], row 0 in the south; height is that of *after*.
    """
    config = params["config"].ground
    tile = tile_named(params["tile"], params["size"], _RIM)
    origin = np.asarray(params["origin"])

    def near(xyz: Floats) -> Mask:
        return tile.in_buffered(xyz[:, :2] + origin[:2])

    views = [load_region(inputs, side, params, near).view for side in params["sides"]]
    corner, shape, rim = _window(tile, origin, config)
    if any(not (view.semantic == Semantic.GROUND).any() for view in views):
        dz = lod = height = np.full(shape, np.nan)
    else:
        dz, lod, height = difference_cells(views[0], views[1], corner, shape, config)
    inner = np.s_[rim:-rim, rim:-rim]
    return {"dz": dz[inner], "lod": lod[inner], "height": height[inner]}


def _mosaic(inputs: Inputs, alias: str, names: list[str], size: float, config: GroundChangeConfig) -> Any:
    """Cells of tiles side by side: a function of the name of an array, and the tile in the south-west."""
    places = np.array([[int(v) for v in name.split("_")] for name in names])
    low, high = places.min(axis=0), places.max(axis=0)
    edge = round(size / config.cell)
    shape = tuple(((high - low + 1)[::-1] * edge).tolist())

    def array(field: str, empty: float) -> NDArray[Any]:
        parts = [inputs[f"{alias}/{name}"][field] for name in names]
        whole = np.full(shape, empty, dtype=parts[0].dtype)
        for (column, row), part in zip((places - low).tolist(), parts, strict=True):
            whole[row * edge : (row + 1) * edge, column * edge : (column + 1) * edge] = part
        return whole

    return array, low * size


def tile_over(inputs: Inputs, params: Mapping[str, Any]) -> Arrays:
    """Label the cells of a tile beyond the gate, one direction after the other: ``labels`` (2, rows, columns)."""
    config = params["config"].ground
    names = inputs.under("ground")
    array, south_west = _mosaic(inputs, "ground", names, params["size"], config)
    dz, lod = array("dz", np.nan), array("lod", np.nan)
    tile = tile_named(params["tile"], params["size"], 0.0)
    edge = round(params["size"] / config.cell)
    column, row = np.round((np.array(tile.core[:2]) - south_west) / config.cell).astype(int).tolist()
    inner = np.s_[row : row + edge, column : column + edge]
    labels = [
        ndimage.label(beyond_gate(dz, lod, sign, config)[inner], structure=np.ones((3, 3)))[0]
        for sign, _ in _SIGNS
    ]
    return {"labels": np.stack(labels).astype(np.int32)}


def join_over(inputs: Inputs, params: Mapping[str, Any]) -> Arrays:
    """Join what goes on across the edges of tiles.

    Returns
    -------
    arrays
        ``tiles`` (T,); ``offset`` (2, T + 1); ``patch`` (2, L), number of label k of tile t at
        ``offset[d, t] + k - 1``; for each direction d numbers count on.
    """
    tiles = inputs.under("over")
    labels = {name: inputs[f"over/{name}"]["labels"] for name in tiles}
    result: dict[str, Any] = {"tiles": np.array(tiles, dtype=np.str_)}
    for d in range(2):
        counts = [int(labels[name][d].max(initial=0)) for name in tiles]
        offset = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        start = dict(zip(tiles, offset.tolist(), strict=False))
        pairs = [np.zeros((0, 2), np.int64)]
        for name in tiles:
            column, row = (int(v) for v in name.split("_"))
            for dc, dr in ((1, 0), (0, 1), (1, 1), (1, -1)):
                other = f"{column + dc}_{row + dr}"
                if other in labels:
                    found = _across(labels[name][d], labels[other][d], dc, dr)
                    pairs.append(found + (start[name] - 1, start[other] - 1))
        links = np.concatenate(pairs)
        size = int(offset[-1])
        graph = coo_array((np.ones(len(links)), (links[:, 0], links[:, 1])), shape=(size, size))
        result[f"offset_{d}"] = offset
        result[f"patch_{d}"] = (
            connected_components(graph.tocsr(), directed=False)[1].astype(np.int64)
            if size
            else np.zeros(0, np.int64)
        )
    return result


def _across(first: Ints, second: Ints, dc: int, dr: int) -> Ints:
    """Pairs (E, 2) of labels that touch across an edge or a corner between two tiles."""
    if dc and dr:
        a = first[-1 if dr > 0 else 0, -1]
        b = second[0 if dr > 0 else -1, 0]
        return np.array([[a, b]], dtype=np.int64) if a and b else np.zeros((0, 2), dtype=np.int64)
    here, there = (first[:, -1], second[:, 0]) if dc else (first[-1], second[0])
    found = []
    for step in (-1, 0, 1):
        moved = np.roll(there, step)
        if step:
            moved[0 if step > 0 else -1] = 0
        both = (here > 0) & (moved > 0)
        found.append(np.column_stack([here[both], moved[both]]))
    return np.unique(np.concatenate(found), axis=0).astype(np.int64)


def patch_tiles(over: Arrays) -> dict[str, list[tuple[int, int, list[str]]]]:
    """Return, for the first tile of every patch, direction, number and all tiles of it."""
    tiles = over["tiles"].tolist()
    result: dict[str, list[tuple[int, int, list[str]]]] = {}
    for d in range(2):
        offset, patch = over[f"offset_{d}"], over[f"patch_{d}"]
        owner = np.repeat(np.arange(len(tiles)), np.diff(offset))
        pairs = np.unique(np.column_stack([patch, owner]), axis=0) if len(patch) else np.zeros((0, 2), int)
        for number in np.unique(patch).tolist():
            names = [tiles[t] for t in pairs[pairs[:, 0] == number, 1].tolist()]
            result.setdefault(names[0], []).append((d, number, names))
    return result


def tile_patches(inputs: Inputs, params: Mapping[str, Any]) -> Arrays:
    """Measure the patches that begin in a tile, and keep those large and clear enough.

    Returns
    -------
    arrays
        ``records``, JSON: what changed, area, mean difference, spread, level of detection,
        height and outline in the common frame; ``cells`` (C, 3): row and column of the city's cells, patch.
    """
    config = params["config"].ground
    over = inputs["over"]
    words, cells = [], [np.zeros((0, 3), dtype=np.int64)]
    for d, number, names in params["patches"]:
        around = [n for n in inputs.under("ground") if _touches(n, names)]
        array, south_west = _mosaic(inputs, "ground", around, params["size"], config)
        where, others = _cells_of(inputs, over, d, number, around, params["size"], config)
        patch = _measure(where, others, array("dz", np.nan), array("lod", np.nan), d, south_west, params)
        if patch is None:
            continue
        base = np.round(south_west / config.cell).astype(np.int64)[::-1]
        cells.append(np.column_stack([patch.cells + base, np.full(len(patch.cells), len(words))]))
        words.append(
            {
                "change": int(patch.change),
                "area": patch.area,
                "dz": patch.dz,
                "dz_spread": patch.dz_spread,
                "lod": patch.lod,
                "height": float(np.nanmedian(array("height", np.nan)[where])),
                "outline": shapely.to_wkb(patch.outline, hex=True),
            }
        )
    return {"records": np.array(json.dumps(words)), "cells": np.concatenate(cells)}


def _touches(name: str, names: list[str]) -> bool:
    column, row = (int(v) for v in name.split("_"))
    return any(
        max(abs(column - int(c)), abs(row - int(r))) <= 1 for c, r in (other.split("_") for other in names)
    )


def _cells_of(
    inputs: Inputs, over: Arrays, d: int, number: int, names: list[str], size: float, config: GroundChangeConfig
) -> tuple[Mask, Mask]:
    """Cells of a patch among tiles, and cells of any patch of its direction."""
    tiles = over["tiles"].tolist()
    places = np.array([[int(v) for v in name.split("_")] for name in names])
    low = places.min(axis=0)
    edge = round(size / config.cell)
    shape = tuple(((places.max(axis=0) - low + 1)[::-1] * edge).tolist())
    own, every = np.zeros(shape, dtype=bool), np.zeros(shape, dtype=bool)
    for name, (column, row) in zip(names, (places - low).tolist(), strict=True):
        labels = inputs[f"over_labels/{name}"]["labels"][d]
        offset = int(over[f"offset_{d}"][tiles.index(name)])
        count = int(labels.max(initial=0))
        mine = np.concatenate([[False], over[f"patch_{d}"][offset : offset + count] == number])
        part = np.s_[row * edge : (row + 1) * edge, column * edge : (column + 1) * edge]
        own[part], every[part] = mine[labels], labels > 0
    return own, every


def _measure(
    where: Mask, every: Mask, dz: Floats, lod: Floats, d: int, south_west: Floats, params: Mapping[str, Any]
) -> GroundPatch | None:
    config = params["config"].ground
    hidden = ground_hidden(where, ~np.isfinite(dz) & ~every, config)
    if (where.sum() + min(hidden, where.sum())) * config.cell**2 <= config.area:
        return None
    typical = float(np.median(shown_lod(lod)))
    corner = south_west - np.asarray(params["origin"])[:2]
    patch = make_patch(_SIGNS[d][1], where, dz, lod, corner, config.cell, typical)
    return patch if stands_out(patch, config) else None
