"""Class of every superpoint without training data: ground, building, vegetation, mobile, other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import none_of_them, rule_mask, switchable
from subiaco_change.segmentation.building_interiors import inside_facades
from subiaco_change.segmentation.buildings import (
    attach_parts,
    building_planes,
    join_parts,
    thick_walls,
    thin_runs,
    within_roofs,
)
from subiaco_change.segmentation.clustering import group_indices, group_reduce, voxel_clusters
from subiaco_change.segmentation.config import BuildingConfig, VehicleConfig
from subiaco_change.segmentation.features import EigenFeatureConfig, Features, compute_features
from subiaco_change.segmentation.ghost_trails import TrafficConfig, moving_points, still_blocks, timed_trails
from subiaco_change.segmentation.ground_model import GroundConfig, GroundModel, Mask, fit_ground
from subiaco_change.segmentation.raised_ground import raised_ground
from subiaco_change.segmentation.raised_surfaces import RaisedConfig, RaisedSurfaces, find_raised
from subiaco_change.segmentation.superpoints import SuperpointConfig, partition
from subiaco_change.segmentation.trail_raster import TrailShapeConfig
from subiaco_change.segmentation.vehicles import (
    free_boxes,
    ground_boxes,
    release_false_vehicles,
    with_cabins,
    with_edges,
)
from subiaco_change.segmentation.wires_and_poles import LineConfig, find_lines
from subiaco_geo.clouds import PointCloud, sort_spatially
from subiaco_geo.codes import Semantic
from subiaco_geo.config import StrictModel
from subiaco_geo.frames import Floats, Ints


class SemanticsConfig(StrictModel):
    """Rules of the five classes; heights are above the local ground model."""

    ground: GroundConfig = GroundConfig()
    raised: RaisedConfig = RaisedConfig()
    features: EigenFeatureConfig = EigenFeatureConfig()
    superpoints: SuperpointConfig = SuperpointConfig()
    traffic: TrafficConfig = TrafficConfig()
    trail_shape: TrailShapeConfig = TrailShapeConfig()
    buildings: BuildingConfig = BuildingConfig()
    vehicles: VehicleConfig = VehicleConfig()
    lines: LineConfig = LineConfig()
    ground_distance: float = Field(
        0.10,
        gt=0,
        description="Largest median distance of a ground superpoint from the ground model [m] (paper)",
    )
    ground_angle_deg: float = Field(
        25.0,
        gt=0,
        lt=90,
        description="Largest angle between the normal of a ground point and the normal of the ground "
        "model [deg] (Decision 6)",
    )
    ground_share: float = Field(
        0.8,
        gt=0,
        le=1,
        description="Smallest fraction of the points of a ground superpoint whose normals agree with the "
        "ground model (paper)",
    )
    ground_close: float = Field(
        0.15,
        gt=0,
        description="Height above the ground model below which kerbs and road markings count as ground [m]",
    )
    foot_roughness: float = Field(
        0.06,
        gt=0,
        description="Roughness above which a point near the ground belongs to the foot of an object [m]",
    )
    foot_height: float = Field(
        0.04,
        ge=0,
        description="Height above the ground model from which rough points belong to the foot of an "
        "object, not to the ground [m]",
    )
    scatter: float = Field(
        0.25,
        gt=0,
        description="Median sqrt(l3 / l1) above which a superpoint is foliage [1] (paper: l3 / l1 > 0.35)",
    )
    sparse_scatter: float = Field(
        0.15,
        gt=0,
        description="Median sqrt(l3 / l1) above which a superpoint is foliage where neighbours are "
        "farther away than sparse_reach [1]",
    )
    sparse_reach: float = Field(
        1.1,
        gt=0,
        description="Distance of the farthest required neighbour above which a superpoint counts as "
        "sparse [m]",
    )
    roughness: float = Field(
        0.06,
        gt=0,
        description="Median roughness (square root of the smallest eigenvalue) above which a superpoint "
        "can be foliage [m]",
    )
    vegetation_height: float = Field(
        0.5,
        gt=0,
        description="Median height above ground that a cluster of vegetation must exceed [m] (paper)",
    )
    level: float = Field(
        0.9, gt=0, le=1, description="Vertical component of the normal above which a point is level [1]"
    )
    tiny_width: float = Field(
        1.0,
        ge=0,
        description="Width below which a low cluster is class other, because its features resemble "
        "foliage at any shape [m]",
    )
    tiny_top: float = Field(
        1.3, ge=0, description="Height above ground below which a narrow cluster is class other [m]"
    )
    cluster_voxel: float = Field(
        0.4,
        gt=0,
        description="Edge of the voxels in which points that are neither ground nor building are "
        "clustered [m]",
    )


@dataclass(frozen=True)
class SemanticResult:
    """Class of every point of a cloud, in the cloud's order.

    ``semantic`` (N,) uint8; ``scores`` (N, 5) float32, rows sum to 1;
    ``height_above_ground`` (N,) float32 [m]; ``ground`` in the cloud's local
    frame; ``superpoint`` (N,) int32; ``moving`` (N,) bool, the part of *mobile*
    that is the trail of something that moved; ``interior`` (N,) bool, the part of *building* that was seen
    through windows.
    """

    semantic: NDArray[np.uint8]
    scores: NDArray[np.float32]
    height_above_ground: NDArray[np.float32]
    ground: GroundModel
    superpoint: NDArray[np.int32]
    moving: Mask
    interior: Mask


def label_points(
    cloud: PointCloud,
    config: SemanticsConfig,
    passed: Floats | None = None,
    raised: RaisedSurfaces | None = None,
    moved: Floats | None = None,
    sensor: Floats | None = None,
) -> SemanticResult:
    """Label every point of a cloud at the working leaf.

    Parameters
    ----------
    cloud : PointCloud
        Normals are not needed; z must be up.
    config : SemanticsConfig
    passed : (N,) float, optional
        Beams that passed through the place of each point for each that returned
        from it, from a visibility layer; tells trails of traffic.
    moved : (N,) float, optional
        Probability that each point moved, from the times of a map or the shape of a trail in a cloud without
        counts; takes the place of ``passed``.
    raised : RaisedSurfaces, optional
        Roofs and decks in the frame of the cloud, known from farther around; found in the cloud if None.
    sensor : (K, 3) float64, optional
        Places of the sensor in the frame of the cloud [m]; tells what was seen through windows.
    """
    sensor = np.zeros((0, 3)) if sensor is None else sensor
    order = sort_spatially(cloud.xyz)
    xyz = cloud.xyz[order]
    surfaces = find_raised(xyz, config.raised) if raised is None else raised
    ground = fit_ground(xyz, config.ground, surfaces)
    height = xyz[:, 2] - ground.height(xyz[:, :2])
    features = compute_features(xyz, config.features)
    parts = partition(_superpoint_features(features, height, config), features.neighbours, config.superpoints)
    beams = [None if b is None else np.asarray(b, dtype=np.float64)[order] for b in (passed, moved)]
    semantic, moving, interior = _classify(xyz, height, features, parts.labels, ground, beams, sensor, config)
    scores = _scores(semantic, features)
    back = np.argsort(order, kind="stable")
    return SemanticResult(
        semantic[back],
        scores[back],
        height[back].astype(np.float32),
        ground,
        parts.labels[back].astype(np.int32),
        moving[back],
        interior[back],
    )


def _superpoint_features(features: Features, height: Floats, config: SemanticsConfig) -> Floats:
    shape = [features.linearity, features.planarity, features.scatter, np.abs(features.normals[:, 2])]
    return np.stack([*shape, height / config.superpoints.height_scale], axis=1)


def _classify(
    xyz: Floats,
    height: Floats,
    features: Features,
    parts: Ints,
    ground: GroundModel,
    beams: Sequence[Floats | None],
    sensor: Floats,
    config: SemanticsConfig,
) -> tuple[NDArray[np.uint8], Mask, Mask]:
    """Apply the classes in the order of their priority; the rest is *other*. Tell trails, interiors too."""
    semantic = np.full(len(xyz), Semantic.OTHER, dtype=np.uint8)
    is_ground = _find_ground(xyz, height, features, parts, ground, config)
    semantic[is_ground] = Semantic.GROUND
    rest = ~is_ground
    planes = building_planes(xyz, height, features, rest, config.buildings)
    moving = np.zeros(len(xyz), dtype=bool)
    passed, moved = beams
    if moved is not None:
        moving = timed_trails(height, moved, rest, config.traffic)
    elif passed is not None:
        moving = moving_points(xyz, height, features, passed, rest, config.traffic)
        moving &= ~still_blocks(xyz, planes.core, moving, config.traffic)
    semantic[moving] = Semantic.MOBILE
    rest &= ~moving
    rest &= ~find_lines(xyz, height, _reach(features, config), rest, planes.core, config.lines)
    foliage = (_find_foliage(height, features, parts, config) | planes.fronds) & rest
    body = rest & ~foliage & (features.linearity < config.vehicles.trunk_linearity)
    trucks, shelters = free_boxes(
        xyz, height, planes.core & rest, (planes.part >= 0) & rest, body, rest, config.vehicles
    )
    semantic[trucks & rest] = Semantic.MOBILE
    rest &= ~(trucks | shelters)
    core = join_parts(xyz, planes, rest, config.buildings)
    smooth = features.roughness < config.buildings.plane_offset
    core |= thick_walls(xyz, height, rest & ~core & (foliage | ~smooth), config.buildings)
    below, apart = within_roofs(xyz, core, features, rest, config.buildings)
    is_building = attach_parts(xyz, core | below, rest & ~apart, foliage, config.buildings)
    steep = np.abs(features.normals[:, 2]) < config.buildings.facade_slope
    interior = inside_facades(xyz, height, core, core & steep, rest & ~core, sensor)
    semantic[is_building | interior] = Semantic.BUILDING
    rest &= ~(is_building | interior)
    rest &= ~thin_runs(xyz, height, features.roughness, rest & ~foliage, config.buildings)
    semantic[rest] = _split_rest(
        xyz[rest], height[rest], foliage[rest], (steep & smooth)[rest], planes.low[rest], config
    )
    level = np.abs(features.normals[:, 2]) > config.level
    semantic = release_false_vehicles(xyz, height, foliage, semantic, moving, level, config.vehicles)
    semantic = with_edges(xyz, height, semantic, moving, config.vehicles)
    return semantic, moving, interior & (semantic == Semantic.BUILDING)


def _reach(features: Features, config: SemanticsConfig) -> Floats:
    """Distance (N,) of the farthest neighbour that eigenvalue features need [m]."""
    return np.asarray(
        features.distances[:, min(config.features.min_neighbours, features.distances.shape[1] - 1)]
    )


def _find_ground(
    xyz: Floats, height: Floats, features: Features, parts: Ints, ground: GroundModel, config: SemanticsConfig
) -> Mask:
    count = int(parts.max()) + 1
    aligned = np.einsum("ij,ij->i", features.normals, ground.normal(xyz[:, :2]))
    level = aligned > np.cos(np.radians(config.ground_angle_deg))
    distance = group_reduce(parts, np.abs(height), count)
    share = np.bincount(parts, level, count) / np.maximum(np.bincount(parts, minlength=count), 1)
    claimed = (distance < config.ground_distance) & (share >= config.ground_share)
    steep = (np.abs(features.normals[:, 2]) < 0.5) & (features.roughness < config.buildings.plane_offset)
    near = (
        (height < config.ground_close)
        & (height > -2 * config.ground_close)
        & ~(steep & (height > 0.5 * config.ground_distance))
    )
    lies = (claimed[parts] & (np.abs(height) < 2 * config.ground_close)) | near
    return np.asarray((lies & ~_rough_foot(height, features, config)) | raised_ground(xyz, height, features))


@switchable("rough_foot", none_of_them)
def _rough_foot(height: Floats, features: Features, config: SemanticsConfig) -> Mask:
    """Tell which points (N,) are rough and just above the ground model: the foot of an object."""
    dense = _reach(features, config) < config.features.radius  # else roughness is that of the terrain
    return np.asarray(dense & (features.roughness > config.foot_roughness) & (height > config.foot_height))


def _find_foliage(height: Floats, features: Features, parts: Ints, config: SemanticsConfig) -> Mask:
    """Vote by superpoint: rough in all directions, and above the grass."""
    count = int(parts.max()) + 1
    scatter = group_reduce(parts, np.sqrt(features.scatter), count)
    rough = group_reduce(parts, features.roughness, count)
    sparse = _is_sparse(group_reduce(parts, _reach(features, config), count), config)
    leafy = (scatter > np.where(sparse, config.sparse_scatter, config.scatter)) & (rough > config.roughness)
    return np.asarray(leafy[parts] & (height > config.ground_close))


@switchable("sparse_foliage", none_of_them)
def _is_sparse(reach: Floats, config: SemanticsConfig) -> Mask:
    """Tell which superpoints (S,) are sparse by the reach of their neighbours [m]."""
    return np.asarray(reach > config.sparse_reach)


def _split_rest(
    xyz: Floats, height: Floats, foliage: Mask, upright: Mask, wall: Mask, config: SemanticsConfig
) -> NDArray[np.uint8]:
    """Label what is neither ground nor building: foliage, vehicles, trunks, poles.

    ``wall`` (N,): upright planes that end below a facade.
    """
    semantic = np.where(foliage, Semantic.VEGETATION, Semantic.OTHER).astype(np.uint8)
    settled = np.zeros(len(xyz), dtype=bool)
    low = np.flatnonzero(height < config.vehicles.mobile_top)
    for members in group_indices(voxel_clusters(xyz[low], config.cluster_voxel)):
        for mine, kind in ground_boxes(xyz, height, foliage, upright, low[members], config.vehicles):
            semantic[mine] = kind
            settled[mine] = True
    semantic[~settled] = _vote_clusters(xyz[~settled], height[~settled], semantic[~settled], config)
    walls = rule_mask("walls_beside_plants", wall & ~foliage & ~settled)
    semantic[walls] = Semantic.OTHER  # however many plants grow beside them
    return with_cabins(xyz, height, semantic, config.vehicles)


def _vote_clusters(
    xyz: Floats, height: Floats, semantic: NDArray[np.uint8], config: SemanticsConfig
) -> NDArray[np.uint8]:
    """Give trunks and twigs to the foliage of their cluster, low or tiny foliage to *other*."""
    semantic = semantic.copy()
    cluster = voxel_clusters(xyz, config.cluster_voxel)
    size = np.bincount(cluster)
    tall = group_reduce(cluster, height, len(size)) > config.vegetation_height
    for kind, limit in ((Semantic.VEGETATION, 0.4), (Semantic.OTHER, 0.8)):
        take = np.bincount(cluster, semantic == kind, len(size)) > limit * size
        if kind is Semantic.VEGETATION:
            take &= tall
        semantic[take[cluster]] = kind
    extent = [
        group_reduce(cluster, xyz[:, axis], len(size), "maximum")
        - group_reduce(cluster, xyz[:, axis], len(size), "minimum")
        for axis in (0, 1)
    ]
    tiny = np.hypot(*extent) < np.sqrt(2) * config.tiny_width
    tiny &= group_reduce(cluster, height, len(size), "maximum") < config.tiny_top
    tiny = rule_mask("tiny_clusters", tiny)
    semantic[tiny[cluster]] = Semantic.OTHER
    return semantic


def _scores(semantic: NDArray[np.uint8], features: Features) -> NDArray[np.float32]:
    """Share of each class among the neighbours: low where classes meet or a region is mixed."""
    counts = _class_counts(semantic, features.neighbours)
    return np.asarray(counts / features.neighbours.shape[1], dtype=np.float32)


@numba.njit(cache=True)
def _class_counts(semantic: NDArray[np.uint8], neighbours: NDArray[np.int32]) -> Ints:
    """Count the neighbours (N, k) of every point by class: (N, 5)."""
    counts = np.zeros((len(neighbours), 5), dtype=np.int64)
    for i in range(len(neighbours)):
        for k in range(neighbours.shape[1]):
            counts[i, semantic[neighbours[i, k]]] += 1
    return counts


_FEWEST = NUMBERS.tiling.map_class_points


def map_classes(cloud: PointCloud, moved: Floats) -> NDArray[np.uint8]:
    """Return the class (N,) of every point of a part of a map.

    Parameters
    ----------
    cloud : PointCloud
        Points at the leaf of the map; z is up.
    moved : (N,) float64
        Probability that each point moved during the survey.

    Returns
    -------
    (N,) uint8
        :class:`~subiaco_geo.codes.Semantic`; *other* for all of a part with fewer than 100 points.
    """
    if len(cloud) < _FEWEST:
        return np.full(len(cloud), Semantic.OTHER, dtype=np.uint8)
    return label_points(cloud, SemanticsConfig(), moved=moved).semantic
