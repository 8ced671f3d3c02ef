"""Ground, building, vegetation, mobile, other, without training data (method, part C3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy import ndimage
from scipy.spatial import cKDTree

from subiaco_change.semantics.clustering import group_indices, group_reduce, voxel_clusters
from subiaco_change.semantics.features import FeatureConfig, Features, compute_features
from subiaco_change.semantics.ground import GroundConfig, GroundModel, Mask, fit_ground
from subiaco_change.semantics.planes import Patches, planar_patches
from subiaco_change.semantics.superpoints import SuperpointConfig, partition
from subiaco_change.semantics.vehicles import VehicleConfig, large_vehicles, sheds, vehicle_parts
from subiaco_geo.clouds import PointCloud, sort_spatially
from subiaco_geo.codes import Semantic
from subiaco_geo.config import StrictModel
from subiaco_geo.frames import Floats, Ints


class SemanticsConfig(StrictModel):
    """Rules of the five classes; heights are above the local ground model."""

    ground: GroundConfig = GroundConfig()
    features: FeatureConfig = FeatureConfig()
    superpoints: SuperpointConfig = SuperpointConfig()
    vehicles: VehicleConfig = VehicleConfig()
    ground_distance: float = Field(
        0.10, gt=0, description="median distance of ground to its model [m], paper"
    )
    ground_angle_deg: float = Field(
        25.0, gt=0, lt=90, description="normal against the model's normal [deg], Decision 6"
    )
    ground_share: float = Field(0.8, gt=0, le=1, description="share of near-horizontal points, paper")
    ground_close: float = Field(
        0.15, gt=0, description="band in which kerbs and markings are closed into ground [m]"
    )
    max_linearity: float = Field(
        0.92, gt=0, lt=1, description="linearity of a point that may join a patch; lines have no normal"
    )
    plane_angle_deg: float = Field(10.0, gt=0, description="angle between coplanar neighbours [deg], paper")
    plane_offset: float = Field(0.08, gt=0, description="distance to the neighbour's plane [m], paper")
    plane_area: float = Field(6.0, gt=0, description="planar area of a facade or roof [m2], paper")
    plane_inner: float = Field(
        0.3, ge=0, le=1, description="share of a raised facade away from its border; wires have less"
    )
    wire_height: float = Field(4.0, gt=0, description="lowest wire [m]")
    facade_slope: float = Field(0.25, gt=0, description="|n.e_z| of a facade, paper")
    facade_top: float = Field(
        2.3, gt=0, description="height that a facade reaches; lower walls are other [m]"
    )
    roof_height: float = Field(
        2.0, gt=0, description="height above which any planar patch is a roof [m], Decision in C3"
    )
    roof_level: float = Field(0.5, gt=0, lt=1, description="|n.e_z| of a roof's points")
    roof_cell: float = Field(0.5, gt=0, description="cell of the footprint of roofs [m]")
    chimney: float = Field(1.2, ge=0, description="height above a roof that still belongs to it [m]")
    attach: float = Field(1.0, ge=0, description="reach of a building over its small parts [m]")
    edge: float = Field(
        0.6, ge=0, description="reach of a building over rough points: edges look like foliage [m]"
    )
    scatter: float = Field(
        0.25,
        gt=0,
        description="ratio of standard deviations sqrt(l3 / l1) of foliage (paper: l3 / l1 > 0.35)",
    )
    roughness: float = Field(0.06, gt=0, description="root of the smallest eigenvalue in foliage [m]")
    vegetation_height: float = Field(0.5, gt=0, description="median height of vegetation [m], paper")
    cluster_voxel: float = Field(0.4, gt=0, description="voxel in which the rest falls into clusters [m]")


@dataclass(frozen=True)
class SemanticResult:
    """Class of every point of a cloud, in the cloud's order.

    ``semantic`` (N,) uint8; ``scores`` (N, 5) float32, rows sum to 1;
    ``height_above_ground`` (N,) float32 [m]; ``ground`` in the cloud's local
    frame; ``superpoint`` (N,) int32; ``energy`` of the partition.
    """

    semantic: NDArray[np.uint8]
    scores: NDArray[np.float32]
    height_above_ground: NDArray[np.float32]
    ground: GroundModel
    superpoint: NDArray[np.int32]
    energy: float


def label_points(cloud: PointCloud, config: SemanticsConfig) -> SemanticResult:
    """Label every point of a cloud at the working leaf.

    Parameters
    ----------
    cloud : PointCloud
        Normals are not needed; z must be up.
    config : SemanticsConfig
    """
    order = sort_spatially(cloud.xyz)
    xyz = cloud.xyz[order]
    ground = fit_ground(xyz, config.ground)
    height = xyz[:, 2] - ground.height(xyz[:, :2])
    features = compute_features(xyz, config.features)
    parts = partition(_superpoint_features(features, height, config), features.neighbours, config.superpoints)
    semantic = _classify(xyz, height, features, parts.labels, ground, config)
    scores = _scores(semantic, features)
    back = np.argsort(order, kind="stable")
    return SemanticResult(
        semantic[back],
        scores[back],
        height[back].astype(np.float32),
        ground,
        np.unique(parts.labels, return_inverse=True)[1][back].astype(np.int32),
        parts.energy,
    )


def _superpoint_features(features: Features, height: Floats, config: SemanticsConfig) -> Floats:
    shape = [features.linearity, features.planarity, features.scatter, np.abs(features.normals[:, 2])]
    return np.stack([*shape, height / config.superpoints.height_scale], axis=1)


def _classify(
    xyz: Floats, height: Floats, features: Features, parts: Ints, ground: GroundModel, config: SemanticsConfig
) -> NDArray[np.uint8]:
    """Apply the classes in the order of their priority; what none claims is *other*."""
    parts = np.unique(parts, return_inverse=True)[1]
    semantic = np.full(len(xyz), Semantic.OTHER, dtype=np.uint8)
    is_ground = _find_ground(xyz, height, features, parts, ground, config)
    semantic[is_ground] = Semantic.GROUND
    foliage = _find_foliage(height, features, parts, config) & ~is_ground
    is_building = _find_buildings(xyz, height, features, ~is_ground, foliage, config)
    semantic[is_building] = Semantic.BUILDING
    rest = ~is_ground & ~is_building
    trucks = large_vehicles(xyz, height, is_building, config.vehicles)
    if trucks.any():
        open_points = np.flatnonzero(rest & (height < config.vehicles.truck_top))
        near = _distance_to(xyz[open_points], xyz[trucks], config.edge) < config.edge
        trucks[open_points[near]] = True
        semantic[trucks] = Semantic.MOBILE
        rest &= ~trucks
    semantic[rest] = _split_rest(xyz[rest], height[rest], foliage[rest], config)
    upright = (np.abs(features.normals[:, 2]) < config.facade_slope) & (
        features.roughness < config.plane_offset
    )
    semantic[
        sheds(xyz, height, upright, semantic == Semantic.MOBILE, config.cluster_voxel, config.vehicles)
    ] = Semantic.BUILDING
    return semantic


def _find_ground(
    xyz: Floats, height: Floats, features: Features, parts: Ints, ground: GroundModel, config: SemanticsConfig
) -> Mask:
    count = int(parts.max()) + 1
    aligned = np.einsum("ij,ij->i", features.normals, ground.normal(xyz[:, :2]))
    level = aligned > np.cos(np.radians(config.ground_angle_deg))
    distance = group_reduce(parts, np.abs(height), count)
    share = np.bincount(parts, level, count) / np.maximum(np.bincount(parts, minlength=count), 1)
    claimed = (distance < config.ground_distance) & (share >= config.ground_share)
    steep = (np.abs(features.normals[:, 2]) < 0.5) & (features.roughness < config.plane_offset)
    near = (
        (height < config.ground_close)
        & (height > -2 * config.ground_close)
        & ~(steep & (height > 0.5 * config.ground_distance))
    )
    return np.asarray((claimed[parts] & (np.abs(height) < 2 * config.ground_close)) | near)


def _find_foliage(height: Floats, features: Features, parts: Ints, config: SemanticsConfig) -> Mask:
    """Vote by superpoint: rough in all directions, and above the grass."""
    count = int(parts.max()) + 1
    scatter = group_reduce(parts, np.sqrt(features.scatter), count)
    rough = group_reduce(parts, features.roughness, count)
    leafy = (scatter > config.scatter) & (rough > config.roughness)
    return np.asarray(leafy[parts] & (height > config.ground_close))


def _find_buildings(
    xyz: Floats, height: Floats, features: Features, free: Mask, foliage: Mask, config: SemanticsConfig
) -> Mask:
    """Facades, roofs, and the small parts that hang on them."""
    candidate = (
        free & (features.linearity < config.max_linearity) & (features.roughness < config.plane_offset)
    )
    patches = planar_patches(xyz, features, candidate, config.plane_angle_deg, config.plane_offset)
    core = _building_patches(patches, np.abs(features.normals[:, 2]), height, config)
    inside = np.zeros(len(xyz), dtype=bool)
    inside[patches.label >= 0] = core[patches.label[patches.label >= 0]]
    if not inside.any():
        return inside
    roof = inside & (np.abs(features.normals[:, 2]) > config.roof_level)
    within = _within_roofs(xyz, roof, free, config)
    return _attach_parts(xyz, inside | within, free, foliage, config)


def _building_patches(patches: Patches, level: Floats, height: Floats, config: SemanticsConfig) -> Mask:
    """Tell which smooth patches (hips and gables chain into one) are facades or roofs."""
    inside = patches.label >= 0
    count = len(patches.area)
    top = group_reduce(patches.label[inside], height[inside], count, "maximum")
    middle = group_reduce(patches.label[inside], height[inside], count, "median")
    upright = group_reduce(patches.label[inside], level[inside], count) < config.facade_slope
    facade = upright & (top > config.facade_top)
    roof = ~upright & (middle > config.roof_height)
    bottom = group_reduce(patches.label[inside], height[inside], count, "minimum")
    wires = upright & (bottom > config.wire_height) & (patches.inner < config.plane_inner * patches.area)
    large = (patches.area > config.plane_area) & ~wires
    return np.asarray(large & (facade | roof))


def _within_roofs(xyz: Floats, roof: Mask, free: Mask, config: SemanticsConfig) -> Mask:
    """Tell which free points lie in the footprint of a roof and not far above it: chimneys, gables, walls."""
    if not roof.any():
        return roof
    cell = np.floor(xyz[:, :2] / config.roof_cell).astype(np.int64)
    cell -= cell.min(axis=0) - 2
    shape = tuple((cell.max(axis=0) + 3).tolist())
    top = np.full(shape, -np.inf)
    np.maximum.at(top, tuple(cell[roof].T), xyz[roof, 2])
    top = ndimage.grey_closing(top, size=(3, 3))
    return np.asarray(free & (xyz[:, 2] < top[tuple(cell.T)] + config.chimney))


def _attach_parts(xyz: Floats, core: Mask, free: Mask, foliage: Mask, config: SemanticsConfig) -> Mask:
    """Add the free points within reach of the core; rough ones from less far."""
    attached = core.copy()
    loose = np.flatnonzero(free & ~core)
    distance = _distance_to(xyz[loose], xyz[core], config.attach)
    reach = np.where(foliage[loose], config.edge, config.attach)
    attached[loose[distance < reach]] = True
    return attached


def _distance_to(query: Floats, reference: Floats, limit: float) -> Floats:
    """Distance (N,) to the nearest reference point, inf beyond a limit [m]."""
    return np.asarray(cKDTree(reference).query(query, distance_upper_bound=limit)[0])


def _split_rest(xyz: Floats, height: Floats, foliage: Mask, config: SemanticsConfig) -> NDArray[np.uint8]:
    """Label what is neither ground nor building: foliage, vehicles, trunks, poles."""
    semantic = np.where(foliage, Semantic.VEGETATION, Semantic.OTHER).astype(np.uint8)
    low = np.flatnonzero(height < config.vehicles.mobile_top)
    for members in group_indices(voxel_clusters(xyz[low], config.cluster_voxel)):
        for mine in vehicle_parts(xyz, height, foliage, low[members], config.vehicles):
            semantic[mine] = Semantic.MOBILE
    return _vote_clusters(xyz, height, semantic, config)


def _vote_clusters(
    xyz: Floats, height: Floats, semantic: NDArray[np.uint8], config: SemanticsConfig
) -> NDArray[np.uint8]:
    """Give trunks and twigs to the foliage of their cluster, low or tiny foliage to *other*."""
    semantic = semantic.copy()
    for kind, limit in ((Semantic.VEGETATION, 0.4), (Semantic.OTHER, 0.8)):
        open_points = np.flatnonzero(semantic != Semantic.MOBILE)
        cluster = voxel_clusters(xyz[open_points], config.cluster_voxel)
        count = int(cluster.max(initial=-1)) + 1
        share = np.bincount(cluster, semantic[open_points] == kind, count) / np.maximum(
            np.bincount(cluster), 1
        )
        take = share > limit
        if kind is Semantic.VEGETATION:
            take &= group_reduce(cluster, height[open_points], count) > config.vegetation_height
        semantic[open_points[take[cluster]]] = kind
    return semantic


def _scores(semantic: NDArray[np.uint8], features: Features) -> NDArray[np.float32]:
    """Share of each class among the neighbours: low where classes meet or a region is mixed."""
    neighbours = features.neighbours
    counts = np.stack([(semantic[neighbours] == c).sum(axis=1) for c in range(5)], axis=1)
    return np.asarray(counts / neighbours.shape[1], dtype=np.float32)
