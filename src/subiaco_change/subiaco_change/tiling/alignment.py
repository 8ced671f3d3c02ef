"""Stage: corrections beyond the rigid transform, and the level of detection that follows.

Tiles hand up medians and residuals, a few hundred numbers each; smooth fields over the whole city
come of them; every tile then gets its level of detection.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from subiaco_change.level_of_detection.alignment_corrections import (
    PlacingConfig,
    Residuals,
    bias_field,
    estimate_warp,
    tile_medians,
)
from subiaco_change.level_of_detection.common_frame import BlockGrid
from subiaco_change.level_of_detection.displacement_lod import (
    CylinderStats,
    Displacements,
    LodConfig,
    combine,
    displacements,
    make_surface,
)
from subiaco_change.level_of_detection.registration_uncertainty import (
    BiasSamples,
    Poses,
    SigmaField,
    UncertaintyConfig,
    bias_samples,
    join_samples,
    pose_errors,
    sigma_of,
    spread_residuals,
    unstated_poses,
)
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.segmentation.ground_model import Mask
from subiaco_change.strategies import Part, choose_strategies
from subiaco_change.tiling.epoch_tiles import EPOCHS, EpochContext
from subiaco_change.tiling.retiling import LabelledPoints, load_points
from subiaco_change.tiling.stage_inputs import (
    REGISTRATION,
    Correction,
    PairRegistration,
    TileParams,
    load_frame,
)
from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import Semantic
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.tiles import tile_named
from subiaco_geo.work.tasks import Inputs

_EVERY = NUMBERS.tiling.sigma_step


@dataclass(frozen=True)
class PlacingSlice:
    """What the corrections read of the configuration."""

    placing: PlacingConfig


@dataclass(frozen=True)
class DisplacementSlice:
    """What displacements read of the configuration."""

    placing: PlacingConfig
    lod: LodConfig


@dataclass(frozen=True)
class LodSlice:
    """What levels of detection read of the configuration."""

    placing: PlacingConfig
    lod: LodConfig
    without: tuple[Part, ...]


@dataclass(frozen=True)
class HeightMedians:
    """Median height differences of the ground in the blocks (rows, columns) of a tile [m], where known."""

    medians: Floats
    known: Mask


@dataclass(frozen=True)
class EpochDisplacements:
    """Displacements at the points (N,) of one epoch in a tile.

    ``floored``: variance [m2] that the level of detection rests on, NaN where nothing is claimed;
    ``distance``: displacement from *before* to *after* along the normal [m].
    """

    floored: Floats
    distance: NDArray[np.float32]


@dataclass(frozen=True)
class TileDisplacements:
    """Displacements of a tile in both epochs; ``samples`` tell what the epochs lie apart."""

    before: EpochDisplacements
    after: EpochDisplacements
    samples: BiasSamples

    def of(self, epoch: str) -> EpochDisplacements:
        """Return the displacements of an epoch."""
        return self.before if epoch == "before" else self.after


@dataclass(frozen=True)
class SigmaBlocks:
    """Parts of a :class:`~subiaco_change.level_of_detection.registration_uncertainty.SigmaField` by block."""

    grid: BlockGrid
    bias: Floats
    count: Ints
    covariance: Floats
    centre: Floats


@dataclass(frozen=True)
class StatedPoses:
    """Pose covariances (K, 6, 6) that a map states, and positions (K, 3) of the poses in the world [m]."""

    positions: Floats
    covariances: Floats


@dataclass(frozen=True)
class ChangedPoints:
    """Which points (N,) of a tile an earlier comparison calls changed, or cannot vouch for."""

    changed: Mask


@dataclass(frozen=True)
class EpochLods:
    """Level of detection at the points (N,) of one epoch in a tile [m], infinite where nothing is claimed.

    ``distance`` (N,): displacement along the normal [m], NaN where nothing is claimed.
    """

    lod: NDArray[np.float32]
    distance: NDArray[np.float32]


@dataclass(frozen=True)
class TileLods:
    """Levels of detection of a tile in both epochs; sigma_reg at some points of *before*."""

    before: EpochLods
    after: EpochLods
    sigma: Floats

    def of(self, epoch: str) -> EpochLods:
        """Return the levels of detection of an epoch."""
        return self.before if epoch == "before" else self.after


def _with_rim(
    inputs: Inputs, side: EpochContext, params: TileParams[DisplacementSlice], rim: float
) -> tuple[PointCloud, int]:
    """Points of the tile first, then of its neighbours within ``rim`` [m]; and how many it has itself."""
    tile, own = params.square(rim), params.tile
    parts, count = [], 0
    for name in sorted(inputs.under(f"points/{side.epoch}"), key=lambda n: (n != own, n)):
        cloud = load_points(inputs, side, name, params.origin)
        if name == own:
            count = len(cloud)
            parts.append(cloud)
        else:
            parts.append(cloud.select(tile.in_buffered(cloud.world()[:, :2])))
    xyz = np.concatenate([np.zeros((0, 3)), *(c.xyz for c in parts)])
    normals = np.concatenate([np.zeros((0, 3)), *(np.asarray(c.fields["normals"]) for c in parts)])
    return PointCloud(xyz, params.origin, side.crs, {"normals": normals}), count


def tile_heights(inputs: Inputs, params: TileParams[PlacingSlice]) -> HeightMedians:
    """Find the median height differences of the ground in the blocks of a tile."""
    config = params.config.placing.vertical
    side_count = round(params.size / config.tile)
    corner = np.array(params.square().core[:2]) - params.origin[:2]
    grid = BlockGrid(corner, config.tile, (side_count, side_count))
    ground = []
    for side in params.sides:
        piece = inputs.find(LabelledPoints, f"points/{side.epoch}/{params.tile}")
        if piece is None:
            ground.append(np.zeros((0, 3)))
            continue
        cloud = load_points(inputs, side, params.tile, params.origin)
        ground.append(cloud.xyz[piece.semantic == Semantic.GROUND])
    if min(map(len, ground)) == 0:
        return HeightMedians(np.full(grid.shape, np.nan), np.zeros(grid.shape, dtype=bool))
    return HeightMedians(*tile_medians(ground[0], ground[1], grid))


def city_grid(tiles: list[str], size: float, block: float, origin: Floats) -> BlockGrid:
    """Blocks [m] over all tiles, in the common frame about ``origin`` (3,)."""
    corners = np.array([[int(part) for part in name.split("_")] for name in tiles], dtype=np.float64)
    low, high = corners.min(axis=0) * size, (corners.max(axis=0) + 1) * size
    columns, rows = np.round((high - low) / block).astype(int).tolist()
    return BlockGrid(low - origin[:2], block, (rows, columns))


def find_bias(inputs: Inputs, params: TileParams[PlacingSlice]) -> Correction:
    """Smooth the heights of all tiles into the vertical bias."""
    config = params.config.placing.vertical
    tiles = inputs.under("heights")
    grid = city_grid(tiles, params.size, config.tile, params.origin)
    medians, known = np.full(grid.shape, np.nan), np.zeros(grid.shape, dtype=bool)
    for name in tiles:
        piece = inputs.of(HeightMedians, f"heights/{name}")
        corner = np.array(tile_named(name, params.size, 0.0).core[:2]) - params.origin[:2]
        column, row = np.round((corner - grid.corner) / grid.cell).astype(int)
        height, width = piece.medians.shape
        medians[row : row + height, column : column + width] = piece.medians
        known[row : row + height, column : column + width] = piece.known
    return Correction(bias_field(medians, known, grid, config))


def tile_residuals(inputs: Inputs, params: TileParams[DisplacementSlice]) -> Residuals:
    """Find the residuals of *before* against *after* that may move the warp."""
    config = params.config
    (before, _), found = _compare(inputs, params, ("before",))
    moved = found["before"]
    chosen = spread_residuals(before, moved, config.placing.uncertainty, _unsteady(inputs, params, 0))
    normals = np.asarray(before.fields["normals"])[chosen]
    return Residuals(before.xyz[chosen], normals, moved.distance[chosen])


def find_warp(inputs: Inputs, params: TileParams[PlacingSlice]) -> Correction:
    """Fit the residual warp to the residuals of all tiles."""
    config = params.config.placing.warp
    tiles = inputs.under("residuals")
    grid = city_grid(tiles, params.size, config.block, params.origin)
    parts = [inputs.of(Residuals, f"residuals/{name}") for name in tiles]
    joined = Residuals(
        np.concatenate([p.xyz for p in parts]),
        np.concatenate([p.normals for p in parts]),
        np.concatenate([p.distance for p in parts]),
    )
    return Correction(estimate_warp(joined, grid, config))


def _compare(
    inputs: Inputs, params: TileParams[DisplacementSlice], epochs: tuple[str, ...]
) -> tuple[list[PointCloud], dict[str, Displacements]]:
    """Points of the tile of both epochs, and displacements at those of ``epochs``."""
    config = params.config.lod
    rim = 2.0 * max(config.radius, config.half_length, config.self_half_length)
    loaded = [_with_rim(inputs, side, params, rim) for side in params.sides]
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


def _unsteady(inputs: Inputs, params: TileParams[DisplacementSlice], e: int) -> Mask:
    """Tell which points of a tile say nothing of the registration: plants, vehicles, known changes."""
    place = f"{params.sides[e].epoch}/{params.tile}"
    piece = inputs.find(LabelledPoints, f"points/{place}")
    if piece is None:
        return np.zeros(0, dtype=bool)
    mask = np.isin(piece.semantic, (Semantic.VEGETATION, Semantic.MOBILE))
    changed = inputs.find(ChangedPoints, f"changed/{place}")
    return mask if changed is None else mask | changed.changed


def tile_displacements(inputs: Inputs, params: TileParams[DisplacementSlice]) -> TileDisplacements:
    """Measure displacements both ways in a tile."""
    config = params.config.placing.uncertainty
    own, found = _compare(inputs, params, ("before", "after"))
    samples = [
        bias_samples(own[e], found[name], config, _unsteady(inputs, params, e))
        for e, name in enumerate(("before", "after"))
    ]
    before, after = found["before"], found["after"]
    return TileDisplacements(
        EpochDisplacements(before.floored, before.distance.astype(np.float32)),
        EpochDisplacements(after.floored, -after.distance.astype(np.float32)),
        join_samples(samples),
    )


def find_sigma(inputs: Inputs, params: TileParams[PlacingSlice]) -> SigmaBlocks:
    """Estimate the uncertainty of the registration, block by block, from the samples of all tiles."""
    config = params.config.placing.uncertainty
    tiles = inputs.under("displacements")
    grid = city_grid(tiles, params.size, config.block, params.origin)
    parts = [inputs.of(TileDisplacements, f"displacements/{name}").samples for name in tiles]
    registration = inputs.of(PairRegistration, REGISTRATION).registration
    sigma = sigma_of(join_samples(parts), grid, params.origin, registration, config)
    return SigmaBlocks(grid, sigma.bias, sigma.count, sigma.covariance, sigma.centre)


def load_sigma(inputs: Inputs, origin: Floats, config: UncertaintyConfig) -> SigmaField:
    """Return the field of :func:`find_sigma`, with the pose covariances that the maps carry."""
    piece = inputs.of(SigmaBlocks, "sigma")
    poses = _poses(inputs, origin, config)
    return SigmaField(
        piece.grid, piece.bias, piece.count, piece.covariance, piece.centre, poses, config.floor
    )


def _poses(inputs: Inputs, origin: Floats, config: UncertaintyConfig) -> tuple[Poses, ...]:
    """Pose covariances of each epoch, turned into the common frame; a default for one that states none."""
    if not config.pose_covariance:
        return ()
    frame = load_frame(inputs, origin)
    T_frame_after = np.eye(4)
    T_frame_after[:3, 3] = -frame.origin
    stated = []
    for epoch, T in (("before", frame.T_frame_before), ("after", T_frame_after)):
        piece = inputs.find(StatedPoses, f"poses/{epoch}")
        if piece is not None:
            stated.append(pose_errors(piece.positions, piece.covariances, T))
    missing = len(EPOCHS) - len(stated)
    return (*stated, *[unstated_poses(stated, config.unstated_pose)] * missing)


def tile_lods(inputs: Inputs, params: TileParams[LodSlice]) -> TileLods:
    """Find the level of detection at the points of a tile."""
    config, strategy = params.config, choose_strategies(params.config.without)
    sigma = load_sigma(inputs, params.origin, config.placing.uncertainty)
    result: dict[str, EpochLods] = {}
    sample = np.zeros(0)
    for side in params.sides:
        moved = inputs.of(TileDisplacements, "displacements").of(side.epoch)
        if len(moved.floored) == 0:
            result[side.epoch] = EpochLods(np.zeros(0, np.float32), np.zeros(0, np.float32))
            continue
        cloud = load_points(inputs, side, params.tile, params.origin)
        values = sigma.at(cloud.xyz, np.asarray(cloud.fields["normals"]))
        if side.epoch == "before":
            sample = values[::_EVERY]
        claimed = np.isfinite(combine(moved.floored, values, config.lod.combine))
        distance = np.where(claimed, moved.distance, np.float32(np.nan))
        result[side.epoch] = EpochLods(strategy.lods(moved.floored, values, config.lod.combine), distance)
    return TileLods(result["before"], result["after"], sample)
