"""What a run does tile by tile, for the clouds of a test: small enough to be put together again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from subiaco_change.config import ChangeConfig
from subiaco_change.decisions.ground_cells import GroundChangeConfig, difference_cells, shown_lod
from subiaco_change.decisions.ground_change import GroundComparison, find_patches
from subiaco_change.level_of_detection.alignment_corrections import (
    PlacingConfig,
    VerticalBiasConfig,
    bias_field,
    tile_medians,
)
from subiaco_change.level_of_detection.common_frame import BlockGrid, CommonFrame, SmoothField
from subiaco_change.level_of_detection.displacement_lod import LodConfig, measure_displacements
from subiaco_change.level_of_detection.registration_uncertainty import (
    EpochPoseErrors,
    SigmaField,
    UncertaintyConfig,
    bias_samples,
    join_samples,
    sigma_of,
)
from subiaco_change.objects.known_space import Empty
from subiaco_change.objects.voxel_objects import EpochView
from subiaco_change.records import Registration
from subiaco_change.tiling.alignment import TileLods, city_grid, load_sigma
from subiaco_change.tiling.epoch_tiles import EPOCHS, EpochContext
from subiaco_change.tiling.retiling import LabelledPoints, PlacedPoints
from subiaco_change.tiling.run import ChangeRun
from subiaco_change.tiling.stage_inputs import PairRegistration, load_frame
from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import Semantic
from subiaco_geo.frames import Floats
from subiaco_geo.sources import LoadedEpoch
from subiaco_geo.survey_map import SurveyMap
from subiaco_geo.tiles import split_by_tile
from subiaco_geo.work.task_runner import TaskRunner
from subiaco_geo.work.tasks import Inputs

_SIZE = 80.0
Pair = tuple[PointCloud, PointCloud]
Masks = tuple[NDArray[np.bool_], NDArray[np.bool_]]


def grid_over(clouds: tuple[Floats, ...], cell: float, origin: Floats) -> BlockGrid:
    """Return the blocks of a run over points (N, 3) about an origin."""
    tiles = {name for xyz in clouds for name in split_by_tile(xyz + origin, _SIZE)}
    return city_grid(sorted(tiles), _SIZE, cell, origin)


def vertical_bias(
    before: Floats, after: Floats, origin: Floats, config: VerticalBiasConfig
) -> SmoothField | None:
    """Return how much *before* must rise, from ground points (N, 3) of both epochs."""
    grid = grid_over((before, after), config.tile, origin)
    return bias_field(*tile_medians(before, after, grid), grid, config)


def sigma_field(
    clouds: Pair,
    registration: Registration,
    config: UncertaintyConfig,
    *,
    poses: tuple[EpochPoseErrors, ...] = (),
    exclude: Masks | None = None,
) -> SigmaField:
    """Return sigma_reg from what two placed epochs lie apart."""
    found = [measure_displacements(clouds[e], clouds[1 - e], LodConfig()) for e in (0, 1)]
    samples = [
        bias_samples(clouds[e], found[e], config, None if exclude is None else exclude[e]) for e in (0, 1)
    ]
    grid = grid_over((clouds[0].xyz, clouds[1].xyz), config.block, clouds[0].origin)
    return sigma_of(join_samples(samples), grid, clouds[0].origin, registration, config, poses)


def compare_ground(
    before: EpochView,
    after: EpochView,
    config: GroundChangeConfig,
    empty: tuple[Empty | None, Empty | None] = (None, None),
) -> GroundComparison | None:
    """Compare the ground of two epochs of one tile; None where they share none.

    ``empty``: which places the beams of either epoch went through.
    """
    xy = [view.xyz[view.semantic == Semantic.GROUND, :2] for view in (before, after)]
    if min(map(len, xy)) == 0:
        return None
    both = np.concatenate(xy)
    corner = np.floor(both.min(axis=0) / config.report_cell) * config.report_cell
    columns, rows = (np.floor((both.max(axis=0) - corner) / config.cell).astype(int) + 1).tolist()
    cells = difference_cells(before, after, corner, (rows, columns), config, empty)
    if not np.isfinite(cells.dz).any():
        return None
    patch, patches = find_patches(cells, corner, config)
    return GroundComparison(corner, config.cell, cells.dz, shown_lod(cells.lod), patch, patches)


@dataclass(frozen=True)
class Placed:
    """Both epochs in the common frame; LoD95 (N,) of *before* and of *after* [m]."""

    frame: CommonFrame
    before: PointCloud
    sigma: SigmaField
    lods: tuple[Floats, Floats]


def place(
    clouds: Pair,
    registration: Registration,
    ground: Masks,
    unsteady: Masks,
    placing: PlacingConfig,
    lod: LodConfig,
    surveys: tuple[SurveyMap, SurveyMap] | None = None,
) -> Placed:
    """Place two clouds with normals, as a run does; ``surveys`` carry covariances of poses.

    What is neither ``ground`` nor ``unsteady`` (plants, vehicles) counts as a building.
    """
    config = ChangeConfig(placing=placing, lod=lod)
    run = ChangeRun(TaskRunner(), config)
    run.origin = clouds[1].origin
    run.sides = tuple(
        EpochContext(epoch, c.origin, c.crs, "assumed", None, np.zeros(3), 0.5)
        for epoch, c in zip(EPOCHS, clouds, strict=True)
    )
    members: list[dict[str, NDArray[np.int64]]] = []
    for e, epoch in enumerate(EPOCHS):
        semantic = np.where(ground[e], Semantic.GROUND, Semantic.BUILDING).astype(np.uint8)
        semantic[unsteady[e]] = Semantic.VEGETATION
        members.append(_cut(run, epoch, clouds[e], CommonFrame(registration, run.origin), semantic))
        if surveys is not None:
            run._keep_poses(epoch, LoadedEpoch(surveys[e]), surveys[e].trajectory)
    key = run.runner.put("registration", "all", PairRegistration(registration, 0.0, None))
    frame, sigma, found = run.place(key, None, (0.0, 1.0))
    inputs = Inputs(run.runner.store, {**frame, **run.poses, "sigma": sigma})
    placed = {name: run.runner.load(PlacedPoints, key).xyz for name, key in run.placed.items()}
    before = PointCloud(_whole(placed, members[0]), run.origin, clouds[1].crs, clouds[0].fields)
    levels = [
        {name: run.runner.load(TileLods, key).of(epoch).lod for name, key in found.items()}
        for epoch in EPOCHS
    ]
    return Placed(
        load_frame(inputs, run.origin), before,
        load_sigma(inputs, run.origin, config.placing.uncertainty),
        (_whole(levels[0], members[0]), _whole(levels[1], members[1])),
    )  # fmt: skip


def _cut(
    run: ChangeRun, epoch: str, cloud: PointCloud, frame: CommonFrame, semantic: NDArray[np.uint8]
) -> dict[str, NDArray[np.int64]]:
    """Cut a cloud by the tiles of the common frame; return which of its points each tile has."""
    moved = frame.bring(cloud) if epoch == "before" else cloud
    members = split_by_tile(moved.world(), run.size)
    normals = np.asarray(cloud.fields["normals"], dtype=np.float32)
    for name, own in members.items():
        none = np.zeros(0, dtype=np.float32)
        points = LabelledPoints(
            xyz=cloud.xyz[own], normals=normals[own], semantic=semantic[own], score=none, height=none,
            passed=none, moved=none, number=np.full(len(own), -1, dtype=np.int32), intensity=None,
            sources=(name,), source=np.zeros(len(own), np.int32), row=np.arange(len(own), dtype=np.int32),
        )  # fmt: skip
        run.points.setdefault(epoch, {})[name] = run.runner.put("retiling", f"{epoch}_{name}", points)
    return members


def _whole(parts: dict[str, NDArray[np.generic]], members: dict[str, NDArray[np.int64]]) -> Floats:
    """Put the values of tiles into the order of the cloud that they were cut from."""
    held = [name for name in members if name in parts]
    values = np.concatenate([parts[name] for name in held]).astype(np.float64)
    result = np.empty_like(values)
    result[np.concatenate([members[name] for name in held])] = values
    return result
