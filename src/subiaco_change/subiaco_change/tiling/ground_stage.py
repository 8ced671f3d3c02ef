"""Stage: changes of the ground over tiles, with patches that continue from tile to tile."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from shapely.geometry.base import BaseGeometry

from subiaco_change.decisions.ground_cells import GroundCells, GroundChangeConfig, difference_cells
from subiaco_change.decisions.ground_change import GroundPatch, beyond_threshold, find_patches
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import obeys_rules
from subiaco_change.segmentation.clustering import connect
from subiaco_change.tiling.retiling import near_tile
from subiaco_change.tiling.stage_inputs import TileParams
from subiaco_change.tiling.tile_surroundings import load_region
from subiaco_change.visibility_evidence import EvidenceConfig
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.tiles import Tile
from subiaco_geo.work.tasks import Inputs

_SIGNS = (1.0, -1.0)
_CELLS = ("dz", "lod", "bridged", "height", "other", "inside", "raised", "lowered")
_RIM = NUMBERS.tiling.ground_margin


@dataclass(frozen=True)
class GroundSlice:
    """What the difference of the ground reads of the configuration."""

    RULE_STAGES: ClassVar[tuple[str, ...]] = ("ground",)

    evidence: EvidenceConfig
    ground: GroundChangeConfig
    rules_off: tuple[str, ...]


@dataclass(frozen=True)
class PatchSlice:
    """What patches of the ground read of the configuration."""

    RULE_STAGES: ClassVar[tuple[str, ...]] = ("ground",)

    ground: GroundChangeConfig
    rules_off: tuple[str, ...]


@dataclass(frozen=True)
class PatchStart:
    """A patch that begins in a tile: its direction (0 raised, 1 lowered), number, and all tiles of it."""

    direction: int
    number: int
    tiles: tuple[str, ...]


@dataclass(frozen=True)
class PatchParams(TileParams[PatchSlice]):
    """``patches``: those that begin in the tile."""

    patches: tuple[PatchStart, ...]


@dataclass(frozen=True)
class ThresholdLabels:
    """Components (2, rows, columns) of the cells of a tile that rose, or sank, beyond the threshold."""

    labels: Ints


@dataclass(frozen=True)
class Components:
    """Components of one direction over all tiles: label k of tile t is ``patch[offset[t] + k - 1]``."""

    offset: Ints
    patch: Ints


@dataclass(frozen=True)
class JoinedComponents:
    """Components over all ``tiles``, of raised and of lowered ground, each numbered from 0."""

    tiles: tuple[str, ...]
    raised: Components
    lowered: Components

    def of(self, direction: int) -> Components:
        """Return the components of a direction, 0 or 1."""
        return self.lowered if direction else self.raised


@dataclass(frozen=True)
class PatchRow:
    """A patch of changed ground: area [m2], mean difference, its spread, level of detection, height [m].

    ``outline`` in the common frame.
    """

    change: Change
    area: float
    dz: float
    dz_spread: float
    lod: float
    confidence: float
    reason: str
    height: float
    outline: BaseGeometry


@dataclass(frozen=True)
class TilePatches:
    """Patches that begin in a tile; ``cells`` (C, 3): row and column over the city, position in ``rows``."""

    rows: tuple[PatchRow, ...]
    cells: Ints


def _window(tile: Tile, origin: Floats, config: GroundChangeConfig) -> tuple[Floats, tuple[int, int], int]:
    """Return corner in the common frame [m] and shape of a tile with its rim; and cells of the rim."""
    low, high = np.array(tile.buffered[:2]), np.array(tile.buffered[2:])
    count = round(float(high[0] - low[0]) / config.cell)
    return low - origin[:2], (count, count), round((tile.core[0] - tile.buffered[0]) / config.cell)


@obeys_rules
def tile_ground(inputs: Inputs, params: TileParams[GroundSlice]) -> GroundCells:
    """Difference the ground in the cells of a tile."""
    config, origin, tile = params.config.ground, params.origin, params.square(_RIM)
    near = near_tile(params.tile, _RIM, params.size, origin)
    regions = [load_region(inputs, side, origin, params.config.evidence, near) for side in params.sides]
    views = [region.view for region in regions]
    before, after = (
        region.empty if side.kind == "observed" else None
        for region, side in zip(regions, params.sides, strict=True)
    )
    corner, shape, rim = _window(tile, origin, config)
    if any(not (view.semantic == Semantic.GROUND).any() for view in views):
        nothing, none = np.full(shape, np.nan), np.zeros(shape, dtype=bool)
        cells = GroundCells(nothing, nothing, none, nothing, none, none, none, none)
    else:
        cells = difference_cells(views[0], views[1], corner, shape, config, (before, after))
    return GroundCells(*(getattr(cells, name)[rim:-rim, rim:-rim] for name in _CELLS))


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
        piece = inputs.of(GroundCells, f"ground/{name}")
        for field in _CELLS:
            part = getattr(piece, field)
            empty = False if part.dtype == bool else np.nan
            array = whole.setdefault(field, np.full(shape, empty, dtype=part.dtype))
            array[row * edge : (row + 1) * edge, column * edge : (column + 1) * edge] = part
    return GroundCells(**whole), low * size


@obeys_rules
def tile_over(inputs: Inputs, params: TileParams[PatchSlice]) -> ThresholdLabels:
    """Label the cells of a tile beyond the threshold, for either direction."""
    config = params.config.ground
    cells, south_west = _mosaic(inputs, inputs.under("ground"), params.size, config)
    edge = round(params.size / config.cell)
    column, row = (
        np.round((np.array(params.square().core[:2]) - south_west) / config.cell).astype(int).tolist()
    )
    inner = np.s_[row : row + edge, column : column + edge]
    labels = [
        ndimage.label(beyond_threshold(cells, sign, config)[inner], structure=np.ones((3, 3)))[0]
        for sign in _SIGNS
    ]
    return ThresholdLabels(np.stack(labels))


def join_over(inputs: Inputs, _: TileParams[PatchSlice]) -> JoinedComponents:
    """Join components that continue across the edges of tiles."""
    tiles = inputs.under("threshold_components")
    labels = {name: inputs.of(ThresholdLabels, f"threshold_components/{name}").labels for name in tiles}
    found = []
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
                    touching = _across(labels[name][d], labels[other][d], dc, dr)
                    pairs.append(touching + np.array([start[name] - 1, start[other] - 1]))
        found.append(Components(offset, connect(int(offset[-1]), np.concatenate(pairs))))
    return JoinedComponents(tuple(tiles), found[0], found[1])


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


def patch_tiles(over: JoinedComponents) -> dict[str, list[PatchStart]]:
    """Return the patches by the first of their tiles."""
    tiles = over.tiles
    result: dict[str, list[PatchStart]] = {}
    for d in range(2):
        offset, patch = over.of(d).offset, over.of(d).patch
        owner = np.repeat(np.arange(len(tiles)), np.diff(offset))
        pairs = np.unique(np.column_stack([patch, owner]), axis=0) if len(patch) else np.zeros((0, 2), int)
        for number in np.unique(patch).tolist():
            names = tuple(tiles[t] for t in pairs[pairs[:, 0] == number, 1].tolist())
            result.setdefault(names[0], []).append(PatchStart(d, number, names))
    return result


@obeys_rules
def tile_patches(inputs: Inputs, params: PatchParams) -> TilePatches:
    """Measure the patches that begin in a tile, and keep those large and clear enough."""
    rows: list[PatchRow] = []
    cells = [np.zeros((0, 3), dtype=np.int64)]
    for p, height, base in _own_patches(inputs, params):
        cells.append(np.column_stack([p.cells + base, np.full(len(p.cells), len(rows))]))
        found = (p.change, p.area, p.dz, p.dz_spread, p.lod, p.confidence, p.reason)
        rows.append(PatchRow(*found, height, p.outline))
    return TilePatches(tuple(rows), np.concatenate(cells))


def _own_patches(inputs: Inputs, params: PatchParams) -> Iterator[tuple[GroundPatch, float, Ints]]:
    """Yield patches that begin in a tile, their height in *after* [m], and where their cells count from."""
    config, size, own = params.config.ground, params.size, params.patches
    around = inputs.under("ground")
    cells, south_west = _mosaic(inputs, around, size, config)
    numbers = [_numbers(inputs, d, around, size, config) for d in range(2)]
    wanted = [np.array([p.number for p in own if p.direction == e], dtype=np.int64) for e in range(2)]
    corner = south_west - params.origin[:2]
    base = np.round(south_west / config.cell).astype(np.int64)[::-1]
    for patch in find_patches(cells, corner, config)[1]:
        direction = 0 if patch.change is Change.INCREASED else 1
        where = tuple(patch.cells.T)
        if np.isin(numbers[direction][where], wanted[direction]).any():
            yield patch, float(np.nanmedian(cells.height[where])), base


def _numbers(inputs: Inputs, d: int, names: Sequence[str], size: float, config: GroundChangeConfig) -> Ints:
    """Return the number over the city of what each cell hangs together with, -1 for none."""
    over = inputs.of(JoinedComponents, "threshold_components")
    tiles, offset, patch = over.tiles, over.of(d).offset, over.of(d).patch
    places = np.array([[int(v) for v in name.split("_")] for name in names])
    low = places.min(axis=0)
    edge = round(size / config.cell)
    numbers = np.full(tuple(((places.max(axis=0) - low + 1)[::-1] * edge).tolist()), -1, dtype=np.int64)
    for name, (column, row) in zip(names, (places - low).tolist(), strict=True):
        labels = inputs.of(ThresholdLabels, f"over_labels/{name}").labels[d]
        first = int(offset[tiles.index(name)])
        known = np.concatenate([[-1], patch[first : first + int(labels.max(initial=0))]])
        numbers[row * edge : (row + 1) * edge, column * edge : (column + 1) * edge] = known[labels]
    return numbers
