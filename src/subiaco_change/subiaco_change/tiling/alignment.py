"""Stage: corrections beyond the rigid transform, and the level of detection that follows.

Tiles hand up medians and residuals, a few hundred numbers each; smooth fields over the whole city
come of them; every tile then gets its level of detection.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from subiaco_change.decisions.ablation import Part
from subiaco_change.level_of_detection.displacement_field import BlockGrid
from subiaco_change.level_of_detection.displacement_lod import (
    CylinderStats,
    Displacements,
    combine,
    displacements,
    make_surface,
)
from subiaco_change.level_of_detection.registration_uncertainty import (
    BiasSamples,
    Poses,
    SigmaField,
    bias_samples,
    join_samples,
    pose_errors,
    sigma_of,
    spread_residuals,
    unstated_poses,
)
from subiaco_change.level_of_detection.vertical_bias import bias_field, tile_medians
from subiaco_change.registration.warp import Residuals, estimate_warp
from subiaco_change.segmentation.ground_model import Mask
from subiaco_change.tiling.epoch_tiles import EPOCHS, Side
from subiaco_change.tiling.frame_arrays import field_arrays, load_frame, registration_of
from subiaco_change.tiling.retiling import load_points
from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import Semantic
from subiaco_geo.frames import Floats
from subiaco_geo.tiles import tile_named
from subiaco_geo.work.store import Arrays
from subiaco_geo.work.tasks import Inputs

_EVERY = 16  # sigma of every so many points is handed up


def _with_rim(inputs: Inputs, side: Side, params: Mapping[str, Any], rim: float) -> tuple[PointCloud, int]:
    """Points of the tile first, then of its neighbours within ``rim`` [m]; and how many it has itself."""
    tile = tile_named(params["tile"], params["size"], rim)
    own = params["tile"]
    parts, count = [], 0
    for name in sorted(inputs.under(f"points/{side.epoch}"), key=lambda n: (n != own, n)):
        cloud = load_points(inputs, side, name, params)
        if name == own:
            count = len(cloud)
            parts.append(cloud)
        else:
            parts.append(cloud.select(tile.in_buffered(cloud.world()[:, :2])))
    origin = np.asarray(params["origin"], dtype=np.float64)
    xyz = np.concatenate([np.zeros((0, 3)), *(c.xyz for c in parts)])
    normals = np.concatenate([np.zeros((0, 3)), *(np.asarray(c.fields["normals"]) for c in parts)])
    return PointCloud(xyz, origin, side.crs, {"normals": normals}), count


def tile_heights(inputs: Inputs, params: Mapping[str, Any]) -> Arrays:
    """Median height differences of the ground in the blocks of a tile: ``medians known`` (rows, columns)."""
    config = params["config"].placing.vertical
    tile = tile_named(params["tile"], params["size"], 0.0)
    side_count = round(params["size"] / config.tile)
    corner = np.array(tile.core[:2]) - params["origin"][:2]
    grid = BlockGrid(corner, config.tile, (side_count, side_count))
    ground = []
    for side in params["sides"]:
        alias = f"points/{side.epoch}/{params['tile']}"
        if alias not in inputs:
            ground.append(np.zeros((0, 3)))
            continue
        cloud = load_points(inputs, side, params["tile"], params)
        ground.append(cloud.xyz[inputs[alias]["semantic"] == Semantic.GROUND])
    if min(map(len, ground)) == 0:
        nothing = np.full(grid.shape, np.nan)
        return {"medians": nothing, "known": np.zeros(grid.shape, dtype=bool)}
    medians, known = tile_medians(ground[0], ground[1], grid)
    return {"medians": medians, "known": known}


def city_grid(tiles: list[str], size: float, block: float, origin: Floats) -> BlockGrid:
    """Blocks [m] over all tiles, in the common frame about ``origin`` (3,)."""
    corners = np.array([[int(part) for part in name.split("_")] for name in tiles], dtype=np.float64)
    low, high = corners.min(axis=0) * size, (corners.max(axis=0) + 1) * size
    columns, rows = np.round((high - low) / block).astype(int).tolist()
    return BlockGrid(low - origin[:2], block, (rows, columns))


def find_bias(inputs: Inputs, params: Mapping[str, Any]) -> Arrays:
    """Smooth the heights of all tiles into the vertical bias."""
    config = params["config"].placing.vertical
    tiles = inputs.under("heights")
    grid = city_grid(tiles, params["size"], config.tile, params["origin"])
    medians, known = np.full(grid.shape, np.nan), np.zeros(grid.shape, dtype=bool)
    for name in tiles:
        piece = inputs[f"heights/{name}"]
        corner = np.array(tile_named(name, params["size"], 0.0).core[:2]) - params["origin"][:2]
        column, row = np.round((corner - grid.corner) / grid.cell).astype(int)
        height, width = piece["medians"].shape
        medians[row : row + height, column : column + width] = piece["medians"]
        known[row : row + height, column : column + width] = piece["known"]
    return field_arrays(bias_field(medians, known, grid, config))


def tile_residuals(inputs: Inputs, params: Mapping[str, Any]) -> Arrays:
    """Residuals of *before* against *after* that may move the warp: ``xyz normals distance``."""
    config = params["config"]
    (before, _), found = _compare(inputs, params, ("before",))
    moved = found["before"]
    chosen = spread_residuals(before, moved, config.placing.uncertainty, _unsteady(inputs, params, 0))
    normals = np.asarray(before.fields["normals"])[chosen]
    return {"xyz": before.xyz[chosen], "normals": normals, "distance": moved.distance[chosen]}


def find_warp(inputs: Inputs, params: Mapping[str, Any]) -> Arrays:
    """Fit the residual warp to the residuals of all tiles."""
    config = params["config"].placing.warp
    tiles = inputs.under("residuals")
    grid = city_grid(tiles, params["size"], config.block, params["origin"])
    parts = [inputs[f"residuals/{name}"] for name in tiles]
    joined = Residuals(*(np.concatenate([p[f] for p in parts]) for f in ("xyz", "normals", "distance")))
    return field_arrays(estimate_warp(joined, grid, config))


def _compare(
    inputs: Inputs, params: Mapping[str, Any], epochs: tuple[str, ...]
) -> tuple[list[PointCloud], dict[str, Displacements]]:
    """Points of the tile of both epochs, and displacements at those of ``epochs``."""
    config = params["config"].lod
    rim = 2.0 * max(config.radius, config.half_length, config.self_half_length)
    loaded = [_with_rim(inputs, side, params, rim) for side in params["sides"]]
    found = {epoch: _nothing(loaded[EPOCHS.index(epoch)][1]) for epoch in epochs}
    if all(len(cloud) for cloud, _ in loaded):
        sides = [make_surface(cloud, config) for cloud, _ in loaded]
        for epoch in epochs:
            e = EPOCHS.index(epoch)
            found[epoch] = displacements(sides[e], sides[1 - e], config, loaded[e][1])
    return [cloud.select(np.arange(count)) for cloud, count in loaded], found


def _nothing(count: int) -> Displacements:
    """Return what is known of points without another epoch."""
    unknown = np.full(count, np.nan)
    stats = CylinderStats(unknown, unknown, np.zeros(count, dtype=np.int64))
    return Displacements(unknown, unknown, unknown, stats, stats)


def _unsteady(inputs: Inputs, params: Mapping[str, Any], e: int) -> Mask:
    """Tell which points of a tile say nothing of the registration: plants, vehicles, known changes."""
    side: Side = params["sides"][e]
    alias = f"points/{side.epoch}/{params['tile']}"
    if alias not in inputs:
        return np.zeros(0, dtype=bool)
    mask = np.isin(inputs[alias]["semantic"], (Semantic.VEGETATION, Semantic.MOBILE))
    changed = f"changed/{side.epoch}/{params['tile']}"
    return mask | inputs[changed]["changed"] if changed in inputs else mask


def tile_displacements(inputs: Inputs, params: Mapping[str, Any]) -> Arrays:
    """Measure displacements both ways in a tile.

    Returns
    -------
    arrays
        For each epoch ``<epoch>_floored`` (N,), the variance [m2] that its level of detection
        rests on, NaN where nothing is claimed, ``<epoch>_distance`` (N,) float32, the displacement from
        *before* to *after* along the normal [m]; and samples of the bias, ``xyz lies distance variance``.
    """
    config = params["config"].placing.uncertainty
    own, found = _compare(inputs, params, ("before", "after"))
    samples = [
        bias_samples(own[e], found[name], config, _unsteady(inputs, params, e))
        for e, name in enumerate(("before", "after"))
    ]
    joined = join_samples(samples)
    return {
        "before_floored": found["before"].floored,
        "after_floored": found["after"].floored,
        "before_distance": found["before"].distance.astype(np.float32),
        "after_distance": -found["after"].distance.astype(np.float32),
        **{name: getattr(joined, name) for name in BiasSamples.__dataclass_fields__},
    }


def find_sigma(inputs: Inputs, params: Mapping[str, Any]) -> Arrays:
    """Estimate the uncertainty of the registration, block by block, from the samples of all tiles."""
    config = params["config"].placing.uncertainty
    tiles = inputs.under("displacements")
    grid = city_grid(tiles, params["size"], config.block, params["origin"])
    names = BiasSamples.__dataclass_fields__
    parts = [BiasSamples(*(inputs[f"displacements/{name}"][f] for f in names)) for name in tiles]
    registration = registration_of(inputs["registration"])
    sigma = sigma_of(join_samples(parts), grid, params["origin"], registration, config)
    return {
        "corner": grid.corner,
        "cell": np.array(grid.cell),
        "shape": np.array(grid.shape),
        "bias": sigma.bias,
        "count": sigma.count,
        "covariance": sigma.covariance,
        "centre": sigma.centre,
    }


def load_sigma(inputs: Inputs, params: Mapping[str, Any]) -> SigmaField:
    """Return the field of :func:`find_sigma`, with the pose covariances that the maps carry."""
    piece = inputs["sigma"]
    grid = BlockGrid(piece["corner"], float(piece["cell"]), tuple(piece["shape"].tolist()))
    return SigmaField(
        grid, piece["bias"], piece["count"], piece["covariance"], piece["centre"],
        _poses(inputs, params), params["config"].placing.uncertainty.floor,
    )  # fmt: skip


def _poses(inputs: Inputs, params: Mapping[str, Any]) -> tuple[Poses, ...]:
    """Pose covariances of each epoch, turned into the common frame; a default for one that states none."""
    config = params["config"].placing.uncertainty
    if not config.pose_covariance:
        return ()
    frame = load_frame(inputs, params["origin"])
    T_frame_after = np.eye(4)
    T_frame_after[:3, 3] = -frame.origin
    stated = []
    for epoch, T in (("before", frame.T_frame_before), ("after", T_frame_after)):
        if f"poses/{epoch}" in inputs:
            piece = inputs[f"poses/{epoch}"]
            stated.append(pose_errors(piece["positions"], piece["covariances"], T))
    missing = len(EPOCHS) - len(stated)
    return (*stated, *[unstated_poses(stated, config.unstated_pose)] * missing)


def tile_lods(inputs: Inputs, params: Mapping[str, Any]) -> Arrays:
    """Find the level of detection at the points of a tile.

    Returns
    -------
    arrays
        ``before after`` (N,) float32 [m], infinite where nothing is claimed; ``before_distance
        after_distance`` (N,) float32, the displacement along the normal [m], NaN there; ``sigma`` of some.
    """
    config = params["config"]
    sigma = load_sigma(inputs, params)
    result: dict[str, NDArray[Any]] = {}
    sample = np.zeros(0)
    for side in params["sides"]:
        floored = inputs["displacements"][f"{side.epoch}_floored"]
        if len(floored) == 0:
            result[side.epoch] = result[f"{side.epoch}_distance"] = np.zeros(0, dtype=np.float32)
            continue
        cloud = load_points(inputs, side, params["tile"], params)
        values = sigma.at(cloud.xyz, np.asarray(cloud.fields["normals"]))
        if side.epoch == "before":
            sample = values[::_EVERY]
        result[side.epoch] = _lod(floored, values, config)
        distance = inputs["displacements"][f"{side.epoch}_distance"]
        claimed = np.isfinite(combine(floored, values, config.lod.combine))
        result[f"{side.epoch}_distance"] = np.where(claimed, distance, np.float32(np.nan))
    return {**result, "sigma": sample}


def _lod(floored: Floats, sigma: Floats, config: Any) -> NDArray[np.float32]:
    if Part.LOD in config.without:
        return np.zeros(len(floored), dtype=np.float32)
    lod = combine(floored, sigma, config.lod.combine)
    return np.where(np.isfinite(lod), lod, np.inf).astype(np.float32)
