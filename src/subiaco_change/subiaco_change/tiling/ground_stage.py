"""Stage: changes of the ground over tiles, with patches that continue from tile to tile."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from subiaco_change.decisions.ground_cells import GroundCells, GroundChangeConfig, difference_cells
from subiaco_change.decisions.ground_change import GroundPatch, beyond_gate, find_patches
from subiaco_change.tiling.retiling import near_tile
from subiaco_change.tiling.tile_surroundings import load_region
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.tiles import Tile, tile_named
from subiaco_geo.work.store import Arrays
from subiaco_geo.work.tasks import Inputs

_SIGNS = (1.0, -1.0)
_CELLS = ("dz", "lod", "bridged", "known", "height", "other", "inside")
_RIM = 10.0  # around a tile, so that its own cells know their surroundings [m]


def _window(tile: Tile, origin: Floats, config: GroundChangeConfig) -> tuple[Floats, tuple[int, int], int]:
    """Return corner in the common frame [m] and shape of a tile with its rim; and cells of the rim."""
    low, high = np.array(tile.buffered[:2]), np.array(tile.buffered[2:])
    count = round(float(high[0] - low[0]) / config.cell)
    return low - origin[:2], (count, count), round((tile.core[0] - tile.buffered[0]) / config.cell)


def tile_ground(inputs: Inputs, params: Mapping[str, Any]) -> Arrays:
    """Difference the ground in the cells of a tile.

    Returns
    -------
    arrays
        Of :class:`~subiaco_change.decisions.ground_change.GroundCells`, row 0 in the south.
    """
    config = params["config"].ground
    tile = tile_named(params["tile"], params["size"], _RIM)
    origin = np.asarray(params["origin"])

    near = near_tile(params["tile"], _RIM, params)
    views = [load_region(inputs, side, params, near).view for side in params["sides"]]
    corner, shape, rim = _window(tile, origin, config)
    if any(not (view.semantic == Semantic.GROUND).any() for view in views):
        nothing, none = np.full(shape, np.nan), np.zeros(shape, dtype=bool)
        cells = GroundCells(nothing, nothing, none, none, nothing, none, none)
    else:
        cells = difference_cells(views[0], views[1], corner, shape, config)
    return {name: getattr(cells, name)[rim:-rim, rim:-rim] for name in _CELLS}


def _mosaic(
    inputs: Inputs, names: list[str], size: float, config: GroundChangeConfig
) -> tuple[GroundCells, Floats]:
    """Cells of tiles side by side, and their south-west corner in the world [m]."""
    places = np.array([[int(v) for v in name.split("_")] for name in names])
    low, high = places.min(axis=0), places.max(axis=0)
    edge = round(size / config.cell)
    shape = tuple(((high - low + 1)[::-1] * edge).tolist())
    whole: dict[str, NDArray[Any]] = {}
    for (column, row), name in zip((places - low).tolist(), names, strict=True):
        piece = inputs[f"ground/{name}"]
        for field in _CELLS:
            part = piece[field]
            empty = False if part.dtype == bool else np.nan
            array = whole.setdefault(field, np.full(shape, empty, dtype=part.dtype))
            array[row * edge : (row + 1) * edge, column * edge : (column + 1) * edge] = part
    return GroundCells(**whole), low * size


def tile_over(inputs: Inputs, params: Mapping[str, Any]) -> Arrays:
    """Label the cells of a tile beyond the gate, for either direction: ``labels`` (2, rows, columns)."""
    config = params["config"].ground
    cells, south_west = _mosaic(inputs, inputs.under("ground"), params["size"], config)
    tile = tile_named(params["tile"], params["size"], 0.0)
    edge = round(params["size"] / config.cell)
    column, row = np.round((np.array(tile.core[:2]) - south_west) / config.cell).astype(int).tolist()
    inner = np.s_[row : row + edge, column : column + edge]
    labels = [
        ndimage.label(beyond_gate(cells, sign, config)[inner], structure=np.ones((3, 3)))[0]
        for sign in _SIGNS
    ]
    return {"labels": np.stack(labels).astype(np.int32)}


def join_over(inputs: Inputs, _: Mapping[str, Any]) -> Arrays:
    """Join what goes on across the edges of tiles.

    Returns
    -------
    arrays
        ``tiles`` (T,); ``offset`` (2, T + 1); ``patch`` (2, L), number of label k of tile t at
        ``offset[d, t] + k - 1``; for each direction d numbers count on.
    """
    tiles = inputs.under("threshold_components")
    labels = {name: inputs[f"threshold_components/{name}"]["labels"] for name in tiles}
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
                    pairs.append(found + np.array([start[name] - 1, start[other] - 1]))
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
    words: list[dict[str, Any]] = []
    cells = [np.zeros((0, 3), dtype=np.int64)]
    for patch, height, base in _own_patches(inputs, params):
        cells.append(np.column_stack([patch.cells + base, np.full(len(patch.cells), len(words))]))
        words.append(
            {
                "change": int(patch.change),
                "area": patch.area,
                "dz": patch.dz,
                "dz_spread": patch.dz_spread,
                "lod": patch.lod,
                "confidence": patch.confidence,
                "reason": patch.reason,
                "height": height,
                "outline": shapely.to_wkb(patch.outline, hex=True),
            }
        )
    return {"records": np.array(json.dumps(words)), "cells": np.concatenate(cells)}


def _own_patches(inputs: Inputs, params: Mapping[str, Any]) -> Iterator[tuple[GroundPatch, float, Ints]]:
    """Yield patches that begin in a tile, their height in *after* [m], and where their cells count from."""
    config, size = params["config"].ground, params["size"]
    own = params["patches"]
    around = inputs.under("ground")
    cells, south_west = _mosaic(inputs, around, size, config)
    numbers = [_numbers(inputs, d, around, size, config) for d in range(2)]
    wanted = [np.array([k for d, k, _ in own if d == e], dtype=np.int64) for e in range(2)]
    corner = south_west - np.asarray(params["origin"])[:2]
    base = np.round(south_west / config.cell).astype(np.int64)[::-1]
    for patch in find_patches(cells, corner, config)[1]:
        direction = 0 if patch.change is Change.INCREASED else 1
        where = tuple(patch.cells.T)
        if np.isin(numbers[direction][where], wanted[direction]).any():
            yield patch, float(np.nanmedian(cells.height[where])), base


def _numbers(inputs: Inputs, d: int, names: list[str], size: float, config: GroundChangeConfig) -> Ints:
    """Return the number over the city of what each cell hangs together with, -1 for none."""
    over = inputs["threshold_components"]
    tiles = over["tiles"].tolist()
    offset, patch = over[f"offset_{d}"], over[f"patch_{d}"]
    places = np.array([[int(v) for v in name.split("_")] for name in names])
    low = places.min(axis=0)
    edge = round(size / config.cell)
    numbers = np.full(tuple(((places.max(axis=0) - low + 1)[::-1] * edge).tolist()), -1, dtype=np.int64)
    for name, (column, row) in zip(names, (places - low).tolist(), strict=True):
        labels = inputs[f"over_labels/{name}"]["labels"][d]
        first = int(offset[tiles.index(name)])
        known = np.concatenate([[-1], patch[first : first + int(labels.max(initial=0))]])
        numbers[row * edge : (row + 1) * edge, column * edge : (column + 1) * edge] = known[labels]
    return numbers
