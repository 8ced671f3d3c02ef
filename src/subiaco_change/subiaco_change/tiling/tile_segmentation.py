"""Stage: classes and instances of one tile of one epoch, seen with its surroundings."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from subiaco_change.decisions.driven_lane import SurveyPath
from subiaco_change.geometry import estimate_normals
from subiaco_change.given_classes import UNGIVEN
from subiaco_change.method_rules.switches import obeys_rules
from subiaco_change.objects.measures import MeasureConfig
from subiaco_change.segmentation.building_interiors import LOOKED_FROM, SENSOR_STEP
from subiaco_change.segmentation.classes import SemanticsConfig, label_points
from subiaco_change.segmentation.ground_model import Mask
from subiaco_change.segmentation.instances import InstanceConfig
from subiaco_change.segmentation.raised_surfaces import find_raised
from subiaco_change.strategies import Classified, Part, choose_strategies
from subiaco_change.survey_places import SensorPlaces
from subiaco_change.tiling.epoch_preparation import load_moved, load_observer, load_turn
from subiaco_change.tiling.epoch_tiles import EpochContext, TilePoints
from subiaco_change.visibility_evidence import EvidenceConfig
from subiaco_geo.clouds import PointCloud
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.free_space.expected_visibility import sample_poses
from subiaco_geo.tiles import Tile, tile_named
from subiaco_geo.work.tasks import Inputs


@dataclass(frozen=True)
class SegmentationSlice:
    """What the segmentation reads of the configuration."""

    RULE_STAGES: ClassVar[tuple[str, ...]] = ("segmentation",)

    semantics: SemanticsConfig
    instances: InstanceConfig
    evidence: EvidenceConfig
    leaf: float
    normal_radius: float
    without: tuple[Part, ...]
    measures: MeasureConfig
    rules_off: tuple[str, ...]


@dataclass(frozen=True)
class SegmentationParams:
    """Parameters of the segmentation of a tile.

    ``overlap``: width of the surroundings [m]; ``edge``: their outermost part, in which nothing is classified
    [m]; ``given``: fields of the points that replace a stage.
    """

    tile: str
    size: float
    overlap: float
    edge: float
    side: EpochContext
    config: SegmentationSlice
    given: tuple[str, ...]

    @property
    def rules_off(self) -> tuple[str, ...]:
        """Rules that are switched off in the stage."""
        return self.config.rules_off


@dataclass(frozen=True)
class TileSegmentation:
    """Classes and objects of a tile and its surroundings.

    Of the points of the tile: ``normals`` (N, 3); ``semantic`` (N,); ``score`` (N,) of the class; ``height``
    (N,) above ground [m]; ``passed`` (N,), empty where nothing counted beams; ``moved`` (N,), empty where
    nothing kept their times. Of the tile and then of its surroundings: ``instance`` (N + M,), numbers of this
    tile, and ``inner`` (N + M,), away from the outer edge. Of the surroundings: ``near_tile`` (M,), position
    among ``neighbours``; ``near_index`` (M,) there. ``objects`` (K, 4): class, points in the tile, least east
    and north.
    """

    normals: NDArray[np.float32]
    semantic: NDArray[np.uint8]
    score: NDArray[np.float32]
    height: NDArray[np.float32]
    passed: NDArray[np.float32]
    moved: NDArray[np.float32]
    instance: NDArray[np.int32]
    neighbours: tuple[str, ...]
    near_tile: NDArray[np.uint8]
    near_index: NDArray[np.int32]
    inner: Mask
    objects: Floats


@obeys_rules
def prepare_tile(inputs: Inputs, params: SegmentationParams) -> TileSegmentation:
    """Label the points of a tile and its surroundings, and find their objects.

    ``inputs`` hold ``cloud/<tile>`` of the tile and its neighbours, ``beams/<epoch>/...``, ``levelling`` for
    local clouds, and ``trails/<tile>`` where nothing counted beams.
    """
    side = params.side
    tile = tile_named(params.tile, params.size, params.overlap)
    names = [name for name in inputs.under("cloud") if name != params.tile]
    own, around, where = _gather(inputs, params.tile, names, side, tile)
    cloud = PointCloud(np.concatenate([own, *around]), side.origin, side.crs)
    world = cloud.world()
    observer = load_observer(inputs, side, world, params.config.evidence)
    passed, moved = observer.passes(world), observer.moved(world)
    if passed is None:
        moved = load_moved(inputs, params.tile, names, where)
    count = len(own)
    normals = estimate_normals(cloud.xyz, params.config.normal_radius, count)
    wide = np.concatenate([inputs.of(TilePoints, f"cloud/{name}").xyz for name in inputs.under("cloud")])
    semantic, instance, score, height = _label(cloud, (passed, moved), params, inputs, names, where, wide)
    inner = tile_named(params.tile, params.size, params.overlap - params.edge)
    return TileSegmentation(
        normals=normals.astype(np.float32),
        semantic=semantic[:count],
        score=score[:count],
        height=height[:count],
        passed=_known(passed, count),
        moved=_known(moved, count),
        instance=instance,
        neighbours=tuple(names),
        near_tile=np.repeat(np.arange(len(names), dtype=np.uint8), [len(w) for w in where]),
        near_index=np.concatenate([np.zeros(0, np.int64), *where]).astype(np.int32),
        inner=inner.in_buffered(world[:, :2]),
        objects=_summary(instance, semantic, world, count),
    )


def _known(values: Floats | None, count: int) -> NDArray[np.float32]:
    """Return the first values, none where they are not known."""
    return np.zeros(0, np.float32) if values is None else values[:count].astype(np.float32)


def _gather(
    inputs: Inputs, name: str, names: list[str], side: EpochContext, tile: Tile
) -> tuple[Floats, list[Floats], list[Ints]]:
    """Points of the tile, of each neighbour those nearby, and where they stand there."""
    around, where = [], []
    for other in names:
        xyz = inputs.of(TilePoints, f"cloud/{other}").xyz
        inside = np.flatnonzero(tile.in_buffered(xyz[:, :2] + side.origin[:2]))
        around.append(xyz[inside])
        where.append(inside)
    return inputs.of(TilePoints, f"cloud/{name}").xyz, around, where


def _label(
    cloud: PointCloud,
    beams: tuple[Floats | None, Floats | None],
    params: SegmentationParams,
    inputs: Inputs,
    names: list[str],
    where: list[Ints],
    wide: Floats,
) -> tuple[NDArray[np.uint8], NDArray[np.int32], NDArray[np.float32], NDArray[np.float32]]:
    """Class, instance, score of the class and height above ground of every point.

    ``wide`` (N, 3) are all points of the tile and its neighbours: a hall may fill the tile.
    """
    config, strategy = params.config, choose_strategies(params.config.without)
    turn = load_turn(inputs)
    upright = cloud if turn is None else PointCloud(cloud.xyz @ turn.T, cloud.origin)
    passed, moved = beams
    raised = find_raised(wide if turn is None else wide @ turn.T, config.semantics.raised)
    sensor = _sensor(inputs, cloud)
    result = label_points(
        upright, config.semantics, passed, raised, moved, sensor if turn is None else sensor @ turn.T
    )
    semantic = result.semantic
    score = np.take_along_axis(result.scores, semantic[:, None].astype(np.int64), axis=1)[:, 0]
    if "semantic" in params.given:
        given = _given("semantic", inputs, params.tile, names, where).astype(np.uint8)
        own = given == UNGIVEN
        semantic = np.where(own, semantic, given)
        score = np.where(own, score, np.float32(1.0))
        result = replace(
            result, semantic=semantic, moving=result.moving & own, interior=result.interior & own
        )
    if "instance" in params.given:
        instance = _given("instance", inputs, params.tile, names, where).astype(np.int32)
    else:
        found = Classified(cloud, upright, result, config.instances, config.measures.voxel)
        semantic, instance = strategy.instances(found)
    return semantic, strategy.kept(instance), score.astype(np.float32), result.height_above_ground


def _sensor(inputs: Inputs, cloud: PointCloud) -> Floats:
    """Return places of the sensor (K, 3) around a cloud, in its frame [m]; none if they are not known."""
    path, estimated = inputs.find(SurveyPath, "path"), inputs.find(SensorPlaces, "places")
    places = np.zeros((0, 3))
    if path is not None:
        places = path.positions[sample_poses(path.positions, SENSOR_STEP)]
    elif estimated is not None:
        places = estimated.xyz
    if len(cloud) == 0 or len(places) == 0:
        return np.zeros((0, 3))
    places = places - cloud.origin
    low, high = cloud.xyz[:, :2].min(axis=0) - LOOKED_FROM, cloud.xyz[:, :2].max(axis=0) + LOOKED_FROM
    return np.asarray(places[((places[:, :2] > low) & (places[:, :2] < high)).all(axis=1)])


def _given(field: str, inputs: Inputs, tile: str, names: list[str], where: list[Ints]) -> NDArray[np.generic]:
    pieces: list[tuple[str, Any]] = [(tile, slice(None)), *zip(names, where, strict=True)]
    parts = []
    for name, members in pieces:
        piece = inputs.of(TilePoints, f"cloud/{name}")
        values = piece.semantic if field == "semantic" else piece.instance
        if values is None:
            raise InputError(f"--{'instances' if field == 'instance' else field} given: no field {field!r}")
        parts.append(values[members])
    return np.concatenate(parts)


def _summary(instance: NDArray[np.int32], semantic: NDArray[np.uint8], world: Floats, count: int) -> Floats:
    """Class, points in the tile, least east and north [m], of every number of the tile."""
    size = int(instance.max(initial=-1)) + 1
    summary = np.zeros((size, 4))
    members = np.flatnonzero(instance >= 0)
    votes = np.zeros((size, 5), dtype=np.int64)
    np.add.at(votes, (instance[members], semantic[members]), 1)
    summary[:, 0] = votes.argmax(axis=1) if size else 0
    own = members[members < count]
    summary[:, 1] = np.bincount(instance[own], minlength=size)
    summary[:, 2:] = np.inf
    np.minimum.at(summary[:, 2:], instance[own], world[own, :2])
    return summary
