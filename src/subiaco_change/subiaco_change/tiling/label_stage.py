"""Stage: label of every point of a tile."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from subiaco_change.decisions.ablation import Part, pointwise
from subiaco_change.decisions.ground_cells import shown_lod
from subiaco_change.decisions.ground_change import GroundComparison, GroundPatch, ground_raster
from subiaco_change.decisions.measures import same_place
from subiaco_change.decisions.point_labels import Labels, label_rest, unlabelled
from subiaco_change.decisions.voxel_objects import occupied
from subiaco_change.segmentation.ground_model import Mask
from subiaco_change.tiling.epoch_tiles import EPOCHS
from subiaco_change.tiling.retiling import load_points, near_tile
from subiaco_change.tiling.tile_surroundings import Region, load_region
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.tiles import tile_named
from subiaco_geo.work.store import Arrays
from subiaco_geo.work.tasks import Inputs

_RIM = 4.0  # around a tile, for what the other epoch saw there [m]


def point_rows(inputs: Inputs, epoch: str, tile: str, count: int) -> tuple[Ints, Ints]:
    """Anchor (N,), position among the ``compared`` inputs, and row there, of points of a tile; -1: none."""
    anchor, row = np.full(count, -1, dtype=np.int64), np.full(count, -1, dtype=np.int64)
    for position, name in enumerate(inputs.under("compared")):
        piece = inputs[f"compared/{name}"]
        here = np.flatnonzero(piece[f"{epoch}_tiles"] == tile)
        if len(here) == 0:
            continue
        points = piece[f"{epoch}_points"]
        points = points[points[:, 0] == here[0]]
        anchor[points[:, 1]], row[points[:, 1]] = position, points[:, 2]
    return anchor, row


def patch_cells(inputs: Inputs, params: Mapping[str, Any]) -> tuple[Ints, list[tuple[str, int]]]:
    """Patch (rows, columns) of every cell of a tile, -1 for none, and anchor and number of each."""
    config = params["config"].ground
    edge = round(params["size"] / config.cell)
    corner = np.round(np.array(tile_named(params["tile"], params["size"]).core[:2]) / config.cell).astype(
        np.int64
    )
    cells = np.full((edge, edge), -1, dtype=np.int64)
    found: list[tuple[str, int]] = []
    for name in inputs.under("patched"):
        piece = inputs[f"patched/{name}"]["cells"]
        place = piece[:, :2] - corner[::-1]
        inside = ((place >= 0) & (place < edge)).all(axis=1)
        for number in np.unique(piece[inside, 2]).tolist():
            mine = place[inside & (piece[:, 2] == number)]
            cells[mine[:, 0], mine[:, 1]] = len(found)
            found.append((name, int(number)))
    return cells, found


def tile_changed(inputs: Inputs, params: Mapping[str, Any]) -> Arrays:
    """Tell which points of a tile a pass calls changed, or cannot vouch for: ``changed`` (N,)."""
    side = params["side"]
    count = len(inputs[f"points/{side.epoch}/{params['tile']}"]["semantic"])
    anchor, row = point_rows(inputs, side.epoch, params["tile"], count)
    table = inputs["table"]
    changed = np.zeros(count, dtype=bool)
    for position, name in enumerate(inputs.under("compared")):
        members = np.flatnonzero(anchor == position)
        change = table["change"][_first(table, "", name) + row[members]]
        changed[members] = change != Change.UNCHANGED
    cells, _ = patch_cells(inputs, params)
    changed |= _in_patch(inputs, params, cells)
    return {"changed": changed}


def _first(table: Arrays, prefix: str, anchor: str) -> int:
    """Position of the first row of an anchor."""
    where = int(np.flatnonzero(table[f"{prefix}anchors"] == anchor)[0])
    return int(table[f"{prefix}offset"][where])


def _in_patch(inputs: Inputs, params: Mapping[str, Any], cells: Ints) -> Mask:
    """Tell which points (N,) of a tile lie above cells of a patch."""
    cloud = load_points(inputs, params["side"], params["tile"], params)
    cell = params["config"].ground.cell
    corner = np.array(tile_named(params["tile"], params["size"]).core[:2]) - np.asarray(params["origin"])[:2]
    index = np.clip(np.floor((cloud.xyz[:, :2] - corner) / cell).astype(np.int64), 0, len(cells) - 1)
    return np.asarray(cells[index[:, 1], index[:, 0]] >= 0)


def label_tile(inputs: Inputs, params: Mapping[str, Any]) -> Arrays:
    """Label the points of a tile of both epochs.

    Parameters
    ----------
    inputs : Inputs
        ``points lods beams`` of the tile and its neighbours, ``table``,
        ``compared/<anchor>`` and ``patched/<anchor>`` that reach into the tile, ``ground``, frame.
    params : mapping
        ``tile size sides origin config``.

    Returns
    -------
    arrays
        For each epoch ``<epoch>_xyz`` (N, 3) float64 in the common frame, ``_normals`` float32,
        ``_change _semantic`` uint8, ``_instance`` int32, ``_confidence _lod95 _m3c2_distance``
        float32, ``_m3c2_significant`` uint8; ``raster_dz
        raster_confidence`` of the reporting cells, row 0 in the north; ``patch_points`` (P, 3):
        row, points in *before*, in *after*.
    """
    config, tile = params["config"], params["tile"]
    near = near_tile(tile, _RIM, params)
    regions = [load_region(inputs, side, params, near) for side in params["sides"]]
    cells, found = patch_cells(inputs, params)
    ground, ids = _comparison(inputs, params, cells, found)
    result: dict[str, Any] = {}
    patched = np.zeros((len(found), 2), dtype=np.int64)
    for e, epoch in enumerate(EPOCHS):
        own = _own(regions[e], tile)
        view = _select(regions[e], own)
        labels = _of_objects(inputs, epoch, tile, view, regions[e].index[own])
        other = regions[1 - e].view
        known = other.xyz[other.semantic == Semantic.GROUND]
        there = partial(occupied, points=other.xyz, reach=same_place(config.measures))
        label_rest(view, labels, ground, ids, regions[1 - e].observed, config.evidence, known, there)
        if Part.OBJECTS in config.without:
            labels = _by_point(view, other, regions[1 - e], labels, epoch, config)
        patched[:, e] = [np.count_nonzero(labels.instance == i) for i in ids]
        result |= {f"{epoch}_{name}": values for name, values in labels.fields().items()}
        result |= _displacement(inputs, tile, epoch, regions[e].index[own], labels.lod95, view.normals)
        result[f"{epoch}_xyz"] = view.xyz
        result[f"{epoch}_normals"] = view.normals.astype(np.float32)
    result["patch_points"] = np.column_stack([np.array(ids, dtype=np.int64), patched])
    if ground is not None:
        raster = ground_raster(ground, np.asarray(params["origin"]), config.ground)
        result |= {"raster_dz": raster.dz, "raster_confidence": raster.confidence}
    return result


def _displacement(
    inputs: Inputs, tile: str, epoch: str, index: Ints, lod95: NDArray[np.float32], normals: Floats
) -> dict[str, NDArray[Any]]:
    """Return the displacement at points of a tile, and whether it exceeds their level of detection.

    Positive where the surface moved to the side of its normal that is turned upwards.
    """
    alias = f"lods/{tile}"
    none = np.full(len(index), np.nan, dtype=np.float32)
    distance = inputs[alias][f"{epoch}_distance"][index] if alias in inputs and len(index) else none
    distance = np.where(normals[:, 2] < 0.0, -distance, distance)
    significant = np.abs(distance) > lod95  # never where either is not known
    return {
        f"{epoch}_m3c2_distance": distance,
        f"{epoch}_m3c2_significant": significant.astype(np.uint8),
    }


def _own(region: Region, tile: str) -> Ints:
    """Points of the tile itself, in their order there."""
    if tile not in region.tiles:
        return np.zeros(0, dtype=np.int64)
    members = np.flatnonzero(region.slot == region.tiles.index(tile))
    return members[np.argsort(region.index[members])]


def _select(region: Region, members: Ints) -> Any:
    view = region.view
    chosen: dict[str, Any] = {
        name: None if getattr(view, name) is None else getattr(view, name)[members]
        for name in view.__dataclass_fields__
    }
    return replace(view, **chosen)


def _of_objects(inputs: Inputs, epoch: str, tile: str, view: Any, index: Ints) -> Labels:
    labels = unlabelled(view)
    anchor, row = point_rows(inputs, epoch, tile, int(index.max(initial=-1)) + 1)
    anchor, row = anchor[index], row[index]
    table = inputs["table"]
    for position, name in enumerate(inputs.under("compared")):
        members = np.flatnonzero(anchor == position)
        if len(members):
            rows = _first(table, "", name) + row[members]
            labels.change[members], labels.semantic[members] = table["change"][rows], table["semantic"][rows]
            labels.instance[members], labels.confidence[members] = (
                table["id"][rows],
                table["confidence"][rows],
            )
    return labels


def _comparison(
    inputs: Inputs, params: Mapping[str, Any], cells: Ints, found: list[tuple[str, int]]
) -> tuple[GroundComparison | None, list[int]]:
    """Put the ground of a tile together as one comparison, and the ids of its patches."""
    piece = inputs[f"ground/{params['tile']}"]
    dz, lod = piece["dz"], piece["lod"]
    if not np.isfinite(dz).any() and not found:
        return None, []
    table, patches, ids = inputs["table"], [], []
    for anchor, number in found:
        row = _first(table, "patch_", anchor) + number
        change, height = Change(int(table["patch_change"][row])), float(table["patch_dz"][row])
        level, sure = float(table["patch_lod"][row]), float(table["patch_confidence"][row])
        none = np.zeros((0, 2), dtype=np.int64)
        patches.append(GroundPatch(change, 0.0, height, 0.0, level, none, shapely.Point(), sure))
        ids.append(int(table["patch_id"][row]))
    corner = np.array(tile_named(params["tile"], params["size"]).core[:2]) - np.asarray(params["origin"])[:2]
    cell = params["config"].ground.cell
    return GroundComparison(corner, cell, dz, shown_lod(lod), cells, tuple(patches)), ids


def _by_point(view: Any, other: Any, seen: Region, labels: Labels, epoch: str, config: Any) -> Labels:
    """Label what is not ground point by point."""
    alone = pointwise(view, other, seen.observed, epoch, same_place(config.measures))
    return replace(labels, change=np.where(view.semantic == Semantic.GROUND, labels.change, alone))
