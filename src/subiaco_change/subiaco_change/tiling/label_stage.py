"""Stage: label of every point of a tile."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar

import numpy as np
import shapely
from numpy.typing import NDArray

from subiaco_change.decisions.ground_cells import GroundCells, GroundChangeConfig, shown_lod
from subiaco_change.decisions.ground_change import GroundComparison, GroundPatch, ground_raster
from subiaco_change.decisions.point_labels import PointLabels, label_rest, unlabelled
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import obeys_rules
from subiaco_change.objects.measures import MeasureConfig, same_place
from subiaco_change.objects.voxel_objects import EpochView, occupied
from subiaco_change.segmentation.ground_model import Mask
from subiaco_change.strategies import Part, PointComparison, choose_strategies
from subiaco_change.tiling.alignment import ChangedPoints, TileLods
from subiaco_change.tiling.decision_stages import TileComparison
from subiaco_change.tiling.epoch_tiles import EPOCHS, EpochContext
from subiaco_change.tiling.ground_stage import PatchSlice, TilePatches
from subiaco_change.tiling.retiling import LabelledPoints, load_points, near_tile
from subiaco_change.tiling.stage_inputs import TileParams
from subiaco_change.tiling.table_stage import TableColumns
from subiaco_change.tiling.tile_surroundings import Region, load_region
from subiaco_change.visibility_evidence import EvidenceConfig
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.tiles import tile_named
from subiaco_geo.work.tasks import Inputs

_RIM = NUMBERS.tiling.label_margin


@dataclass(frozen=True)
class LabelSlice:
    """What the labelling of points reads of the configuration."""

    RULE_STAGES: ClassVar[tuple[str, ...]] = ("labels",)

    evidence: EvidenceConfig
    ground: GroundChangeConfig
    measures: MeasureConfig
    without: tuple[Part, ...]
    rules_off: tuple[str, ...]


@dataclass(frozen=True)
class ChangedParams(TileParams[PatchSlice]):
    """``side``: the epoch whose points are asked."""

    side: EpochContext


@dataclass(frozen=True)
class EpochLabels:
    """Labelled points of one epoch: ``xyz`` (N, 3) in the common frame [m], ``normals`` (N, 3), labels.

    ``m3c2_distance`` (N,): displacement along the normal [m]; ``m3c2_significant`` (N,): 1 where it exceeds
    the level of detection.
    """

    xyz: Floats
    normals: NDArray[np.float32]
    labels: PointLabels
    m3c2_distance: NDArray[np.float32]
    m3c2_significant: NDArray[np.uint8]


@dataclass(frozen=True)
class TileLabels:
    """Labelled points of a tile of both epochs.

    ``raster_dz`` and ``raster_confidence`` (rows, columns) of the reporting cells, row 0 in the north, where
    either epoch has ground; ``added_points`` (P, 3): row, points in *before* and in *after* that it has
    besides those of its objects: points of patches of ground, and fragments.
    """

    before: EpochLabels
    after: EpochLabels
    raster_dz: NDArray[np.float32] | None
    raster_confidence: NDArray[np.float32] | None
    added_points: Ints

    def of(self, epoch: str) -> EpochLabels:
        """Return the points of an epoch."""
        return self.before if epoch == "before" else self.after


def point_rows(inputs: Inputs, epoch: str, tile: str, count: int) -> tuple[Ints, Ints]:
    """Anchor (N,), position among the ``compared`` inputs, and row there, of points of a tile; -1: none."""
    anchor, row = np.full(count, -1, dtype=np.int64), np.full(count, -1, dtype=np.int64)
    for position, name in enumerate(inputs.under("compared")):
        piece = inputs.of(TileComparison, f"compared/{name}").of(epoch)
        if tile not in piece.tiles:
            continue
        points = piece.points[piece.points[:, 0] == piece.tiles.index(tile)]
        anchor[points[:, 1]], row[points[:, 1]] = position, points[:, 2]
    return anchor, row


def patch_cells(
    inputs: Inputs, tile: str, size: float, config: GroundChangeConfig
) -> tuple[Ints, list[tuple[str, int]]]:
    """Patch (rows, columns) of every cell of a tile, -1 for none, and anchor and number of each."""
    edge = round(size / config.cell)
    corner = np.round(np.array(tile_named(tile, size).core[:2]) / config.cell).astype(np.int64)
    cells = np.full((edge, edge), -1, dtype=np.int64)
    found: list[tuple[str, int]] = []
    for name in inputs.under("patched"):
        piece = inputs.of(TilePatches, f"patched/{name}").cells
        place = piece[:, :2] - corner[::-1]
        inside = ((place >= 0) & (place < edge)).all(axis=1)
        for number in np.unique(piece[inside, 2]).tolist():
            mine = place[inside & (piece[:, 2] == number)]
            cells[mine[:, 0], mine[:, 1]] = len(found)
            found.append((name, int(number)))
    return cells, found


def tile_changed(inputs: Inputs, params: ChangedParams) -> ChangedPoints:
    """Tell which points of a tile a comparison calls changed, or cannot vouch for."""
    side = params.side
    count = len(inputs.of(LabelledPoints, f"points/{side.epoch}/{params.tile}").semantic)
    anchor, row = point_rows(inputs, side.epoch, params.tile, count)
    table = inputs.of(TableColumns, "table").objects
    changed = np.zeros(count, dtype=bool)
    for position, name in enumerate(inputs.under("compared")):
        members = np.flatnonzero(anchor == position)
        change = table.change[table.first(name) + row[members]]
        changed[members] = change != Change.UNCHANGED
    cells, _ = patch_cells(inputs, params.tile, params.size, params.config.ground)
    changed |= _in_patch(inputs, params, cells)
    return ChangedPoints(changed)


def _in_patch(inputs: Inputs, params: ChangedParams, cells: Ints) -> Mask:
    """Tell which points (N,) of a tile lie above cells of a patch."""
    cloud = load_points(inputs, params.side, params.tile, params.origin)
    cell = params.config.ground.cell
    corner = np.array(params.square().core[:2]) - params.origin[:2]
    index = np.clip(np.floor((cloud.xyz[:, :2] - corner) / cell).astype(np.int64), 0, len(cells) - 1)
    return np.asarray(cells[index[:, 1], index[:, 0]] >= 0)


@obeys_rules
def label_tile(inputs: Inputs, params: TileParams[LabelSlice]) -> TileLabels:
    """Label the points of a tile of both epochs.

    ``inputs`` hold ``points lods beams`` of the tile and its neighbours, ``table``, ``compared/<anchor>`` and
    ``patched/<anchor>`` that reach into the tile, ``ground`` and the frame.
    """
    config, tile, origin = params.config, params.tile, params.origin
    strategy = choose_strategies(config.without)
    near = near_tile(tile, _RIM, params.size, origin)
    regions = [load_region(inputs, side, origin, config.evidence, near) for side in params.sides]
    cells, found = patch_cells(inputs, tile, params.size, config.ground)
    ground, ids = _comparison(inputs, params, cells, found)
    labelled: list[EpochLabels] = []
    added: list[Ints] = []
    for e, epoch in enumerate(EPOCHS):
        own = _own(regions[e], tile)
        view = _select(regions[e], own)
        labels = _of_objects(inputs, epoch, tile, view, regions[e].index[own])
        other, reach = regions[1 - e].view, same_place(config.measures)
        known = other.xyz[other.semantic == Semantic.GROUND]
        there = partial(occupied, points=other.xyz, reach=reach)
        joined = label_rest(
            view,
            labels,
            ground,
            ids,
            regions[1 - e].observed,
            config.evidence,
            known,
            there,
            config.measures.voxel,
        )
        compared = PointComparison(view, other, regions[1 - e].observed, epoch, reach)
        labels = replace(labels, change=strategy.labels(compared, labels.change))
        in_patches = np.flatnonzero(np.isin(labels.instance, ids))
        added.append(labels.instance[np.concatenate([joined, in_patches])])
        moved, significant = _displacement(
            inputs, tile, epoch, regions[e].index[own], labels.lod95, view.normals
        )
        normals = view.normals.astype(np.float32)
        labelled.append(EpochLabels(view.xyz, normals, labels, moved, significant))
    counts = _counted(added[0], added[1])
    raster = None if ground is None else ground_raster(ground, origin, config.ground)
    dz, confidence = (None, None) if raster is None else (raster.dz, raster.confidence)
    return TileLabels(labelled[0], labelled[1], dz, confidence, counts)


def _counted(before: Ints, after: Ints) -> Ints:
    """Return (P, 3) the rows of points of *before* and *after*, and how often each occurs among them."""
    rows = np.unique(np.concatenate([before, after]))
    places = [np.searchsorted(rows, points) for points in (before, after)]
    return np.column_stack([rows, *(np.bincount(p, minlength=len(rows)) for p in places)]).astype(np.int64)


def _displacement(
    inputs: Inputs, tile: str, epoch: str, index: Ints, lod95: NDArray[np.float32], normals: Floats
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return the displacement at points of a tile, and whether it exceeds their level of detection.

    Positive where the surface moved to the side of its normal that is turned upwards.
    """
    lods = inputs.find(TileLods, f"lods/{tile}")
    none = np.full(len(index), np.nan, dtype=np.float32)
    distance = none if lods is None or len(index) == 0 else lods.of(epoch).distance[index]
    distance = np.where(normals[:, 2] < 0.0, -distance, distance)
    significant = np.abs(distance) > lod95  # never where either is not known
    return distance, significant.astype(np.uint8)


def _own(region: Region, tile: str) -> Ints:
    """Points of the tile itself, in their order there."""
    if tile not in region.tiles:
        return np.zeros(0, dtype=np.int64)
    members = np.flatnonzero(region.slot == region.tiles.index(tile))
    return members[np.argsort(region.index[members])]


def _select(region: Region, members: Ints) -> EpochView:
    view = region.view
    chosen: dict[str, Any] = {
        name: None if getattr(view, name) is None else getattr(view, name)[members]
        for name in view.__dataclass_fields__
    }
    return replace(view, **chosen)


def _of_objects(inputs: Inputs, epoch: str, tile: str, view: EpochView, index: Ints) -> PointLabels:
    labels = unlabelled(view)
    anchor, row = point_rows(inputs, epoch, tile, int(index.max(initial=-1)) + 1)
    anchor, row = anchor[index], row[index]
    table = inputs.of(TableColumns, "table").objects
    for position, name in enumerate(inputs.under("compared")):
        members = np.flatnonzero(anchor == position)
        if len(members):
            rows = table.first(name) + row[members]
            labels.change[members], labels.semantic[members] = table.change[rows], table.semantic[rows]
            labels.instance[members], labels.confidence[members] = table.id[rows], table.confidence[rows]
    return labels


def _comparison(
    inputs: Inputs, params: TileParams[LabelSlice], cells: Ints, found: list[tuple[str, int]]
) -> tuple[GroundComparison | None, list[int]]:
    """Put the ground of a tile together as one comparison, and the ids of its patches."""
    piece = inputs.of(GroundCells, f"ground/{params.tile}")
    if not np.isfinite(piece.dz).any() and not found:
        return None, []
    table, patches, ids = inputs.of(TableColumns, "table").patches, [], []
    for anchor, number in found:
        row = table.first(anchor) + number
        change, height = Change(int(table.change[row])), float(table.dz[row])
        level, sure = float(table.lod[row]), float(table.confidence[row])
        none = np.zeros((0, 2), dtype=np.int64)
        patches.append(GroundPatch(change, 0.0, height, 0.0, level, none, shapely.Point(), sure))
        ids.append(int(table.id[row]))
    corner = np.array(params.square().core[:2]) - params.origin[:2]
    cell = params.config.ground.cell
    return GroundComparison(corner, cell, piece.dz, shown_lod(piece.lod), cells, tuple(patches)), ids
