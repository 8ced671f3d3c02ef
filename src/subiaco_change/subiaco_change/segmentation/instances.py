"""Object instances of every class: buildings, plants, vehicles, other objects (method, part C4)."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy import ndimage
from scipy.spatial import cKDTree

from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import one_part, switchable
from subiaco_change.quantiles import quantile_of
from subiaco_change.segmentation.bounding_rectangles import box_coordinates
from subiaco_change.segmentation.classes import SemanticResult
from subiaco_change.segmentation.clustering import cell_clusters, group_indices, voxel_clusters
from subiaco_change.segmentation.object_rows import (
    PassageConfig,
    ProfileConfig,
    RowConfig,
    level_steps,
    part_slots,
    split_at_passages,
    split_row,
    split_rows,
)
from subiaco_change.segmentation.roof_structures import buildings_beneath
from subiaco_geo.clouds import PointCloud, voxel_indices, voxel_keys
from subiaco_geo.codes import Semantic
from subiaco_geo.config import StrictModel
from subiaco_geo.frames import Floats, Ints

_FEWEST = NUMBERS.instances.fewest_points
_FEWEST_OF_PLANT = NUMBERS.instances.fewest_points_of_plant


class InstanceConfig(StrictModel):
    """How points of a class fall into objects."""

    passages: PassageConfig = PassageConfig()
    building_gap: float = Field(
        0.8,
        gt=0,
        description="Edge of the cells, seen from above, in which parts of one building are connected [m]",
    )
    terraces: ProfileConfig = ProfileConfig()
    vegetation_gap: float = Field(
        0.8, gt=0, description="Smallest clustering distance of foliage [m] (paper)"
    )
    vegetation_density: float = Field(
        1.8,
        gt=0,
        description="Clustering distance of foliage times the cube root of its point density [1] (paper); "
        "raise it to merge sparse crowns",
    )
    foliage_voxel: float = Field(
        0.9,
        gt=0,
        description="Edge of the voxels of the first clustering of foliage, before each cluster is split "
        "by its own density [m]",
    )
    density_voxel: float = Field(
        1.0, gt=0, description="Edge of the voxels in which the point density of foliage is measured [m]"
    )
    foliage_layers: float = Field(
        1.0,
        ge=1,
        description="Height of the voxels in which foliage is clustered as a multiple of their edge: the "
        "height at which a beam ends in a crown does not follow the point spacing",
    )
    crown_cell: float = Field(
        0.5, gt=0, description="Edge of the canopy raster cells in which crowns are separated [m]"
    )
    crown_radius: float = Field(
        2.0,
        gt=0,
        description="Radius that sets the smoothing of the canopy before crown tops are searched [m]; "
        "raise it for fewer, larger crowns",
    )
    crown_drop: float = Field(
        0.5,
        gt=0,
        description="Depth of the canopy dip that separates two crowns [m]; raise it to merge "
        "neighbouring crowns",
    )
    trunk_top: float = Field(
        2.0, gt=0, description="Height above ground below which tree trunks are searched [m]"
    )
    trunk_width: float = Field(0.8, gt=0, description="Largest width of a tree trunk [m]")
    hedges: ProfileConfig = ProfileConfig(step=0.3, width=2.5, level=2.0, slack=0.35, lowest=0.5)
    hedge_top: float = Field(2.8, gt=0, description="Largest height above ground of a hedge [m]")
    hedge_slender: float = Field(0.4, gt=0, le=1, description="Largest ratio of width to length of a hedge")
    mobile_gap: float = Field(
        0.3,
        gt=0,
        description="Edge of the cells, seen from above, in which points of one vehicle instance are "
        "connected [m]",
    )
    rows: RowConfig = RowConfig()
    mobile_erosion: float = Field(
        0.15,
        ge=0,
        description="Height above ground of the band that is left out when vehicles are clustered [m] "
        "(paper)",
    )
    other_gap: float = Field(
        0.6,
        gt=0,
        description="Edge of the voxels in which points of an object of class other are connected [m]",
    )
    min_points: tuple[int, int, int, int] = Field(
        (60, 40, 25, 12),
        description="Smallest number of points of a building, plant, vehicle and other object, at a point "
        "spacing of 0.25 m (Decision 7)",
    )
    leaf: float = Field(
        0.25,
        gt=0,
        description="Point spacing to which the smallest numbers of points are scaled [m]; set by the "
        "program for every run",
    )


def segment(
    cloud: PointCloud, result: SemanticResult, config: InstanceConfig
) -> tuple[NDArray[np.uint8], NDArray[np.int32]]:
    """Return the class and the instance (N,) of every point.

    The instance is -1 for ground, trails of moving objects, interiors of buildings, and fragments. Ids count
    from 0 by class and then from the south-west, so that they do not depend on the order of the points.
    """
    semantic_of, tall = result.semantic.copy(), result.height_above_ground.astype(np.float64)
    instance = np.full(len(cloud), -1, dtype=np.int64)
    ground = cloud.xyz[result.semantic == Semantic.GROUND, :2]
    split: dict[Semantic, Callable[[Floats, Floats, InstanceConfig], Ints]] = {
        Semantic.BUILDING: partial(_buildings, ground),
        Semantic.VEGETATION: _vegetation,
        Semantic.MOBILE: _vehicles,
        Semantic.OTHER: _others,
    }
    following = 0
    for position, (semantic, function) in enumerate(split.items()):
        members = np.flatnonzero((result.semantic == semantic) & ~(result.moving | result.interior))
        if len(members) == 0:
            continue
        xyz, height = cloud.xyz[members], tall[members]
        labels = function(xyz, height, config)
        if semantic in (Semantic.VEGETATION, Semantic.OTHER):
            built = np.flatnonzero((semantic_of == Semantic.BUILDING) & (instance >= 0))
            house = buildings_beneath(labels, xyz, height, cloud.xyz[built, :2], tall[built], instance[built])
            of_house = house >= 0
            instance[members[of_house]], semantic_of[members[of_house]] = house[of_house], Semantic.BUILDING
            members, labels = members[~of_house], labels[~of_house]
        smallest = config.min_points[position] * (0.25 / config.leaf) ** 2
        fewest = _FEWEST_OF_PLANT if semantic is Semantic.VEGETATION else _FEWEST
        labels = _renumber(cloud.xyz[members], labels, max(fewest, round(smallest)))
        instance[members] = np.where(labels >= 0, labels + following, -1)
        following += int(labels.max(initial=-1)) + 1
    return semantic_of, instance.astype(np.int32)


def _renumber(xyz: Floats, labels: Ints, smallest: int) -> Ints:
    """Drop small groups to -1 and count the rest from the south-west."""
    groups = [g for g in group_indices(labels) if len(g) >= smallest]
    groups.sort(key=lambda g: (np.round(xyz[g, 0].min(), 3), np.round(xyz[g, 1].min(), 3), len(g)))
    renumbered = np.full(len(labels), -1, dtype=np.int64)
    for number, group in enumerate(groups):
        renumbered[group] = number
    return renumbered


def _buildings(ground: Floats, xyz: Floats, height: Floats, config: InstanceConfig) -> Ints:
    """Join walls and roofs whose footprints touch, then part houses at passages, and rows of houses."""
    labels = split_at_passages(
        xyz[:, :2], height, cell_clusters(xyz[:, :2], config.building_gap), ground, config.passages
    )
    parts = np.zeros(len(xyz), dtype=np.int64)
    for members in group_indices(labels):
        parts[members] = split_row(xyz[members, :2], height[members], config.terraces)
    return np.unique(labels * (int(parts.max()) + 1) + parts, return_inverse=True)[1].astype(np.int64)


def _vehicles(xyz: Floats, height: Floats, config: InstanceConfig) -> Ints:
    """Cluster seen from above without the lowest band, which bridges vehicles; that band joins afterwards."""
    raised = height > config.mobile_erosion
    labels = np.full(len(xyz), -1, dtype=np.int64)
    labels[raised] = split_rows(
        xyz[raised, :2], height[raised], cell_clusters(xyz[raised, :2], config.mobile_gap), config.rows
    )
    return _join_nearest(xyz, labels, 1.0)


def _others(xyz: Floats, height: Floats, config: InstanceConfig) -> Ints:
    del height
    return voxel_clusters(xyz, config.other_gap)


def _vegetation(xyz: Floats, height: Floats, config: InstanceConfig) -> Ints:
    """Cluster foliage, then part clusters with several crowns at the dips between their tops."""
    labels = _cluster_by_density(xyz / (1.0, 1.0, config.foliage_layers), config)
    following = 0
    parted = np.full(len(xyz), -1, dtype=np.int64)
    for members in group_indices(labels):
        crowns = split_crowns(xyz[members], height[members], config)
        for crown in group_indices(crowns):
            parts = split_hedge(xyz[members[crown]], height[members[crown]], config)
            crowns[crown] += parts * (int(crowns.max()) + 1)
        parted[members] = crowns + following
        following += int(crowns.max()) + 1
    return np.unique(parted, return_inverse=True)[1].astype(np.int64)


@switchable("hedges_by_steps", one_part)
def split_hedge(xyz: Floats, height: Floats, config: InstanceConfig) -> Ints:
    """Part low, long foliage (N,) where one clipped top ends and another begins."""
    whole = np.zeros(len(xyz), dtype=np.int64)
    if quantile_of(height, 0.98) > config.hedge_top:
        return whole
    sides = box_coordinates(xyz[:, :2])
    length, breadth = np.ptp(sides, axis=0)
    if length < 2 * config.hedges.width or breadth > config.hedge_slender * length:
        return whole
    slot = np.floor((sides[:, 0] - sides[:, 0].min()) / config.hedges.cell).astype(np.int64)
    top = np.zeros(slot.max() + 1)
    np.maximum.at(top, slot, height)
    return part_slots(slot, level_steps(top, config.hedges), config.hedges)


def _cluster_by_density(xyz: Floats, config: InstanceConfig) -> Ints:
    """Cluster at the distance of the sparsest foliage, then each cluster at that of its own density."""
    labels = np.full(len(xyz), -1, dtype=np.int64)
    following = 0
    # A voxel cluster joins points up to about twice its edge apart.
    for members in group_indices(voxel_clusters(xyz, config.foliage_voxel)):
        gap = max(
            config.vegetation_gap,
            config.vegetation_density / np.cbrt(_density(xyz[members], config.density_voxel)),
        )
        own = voxel_clusters(xyz[members], gap / 2)
        labels[members] = own + following
        following += int(own.max()) + 1
    return labels


def _density(xyz: Floats, edge: float) -> float:
    """Median number of points a cubic metre in the occupied voxels of an edge [m]."""
    _, counts = np.unique(voxel_keys(voxel_indices(xyz, edge)), return_counts=True)
    return float(np.median(counts)) / edge**3


def split_crowns(xyz: Floats, height: Floats, config: InstanceConfig) -> Ints:
    """Part one cluster (N,) into crowns: a watershed of its canopy, markers at tops that dips separate.

    Tops are local maxima of the smoothed canopy over ``crown_radius``; two
    basins merge while the saddle between them is less than ``crown_drop``
    below the lower top, unless each stands on a trunk of its own.
    """
    cell = config.crown_cell
    index = np.floor(xyz[:, :2] / cell).astype(np.int64)
    corner = index.min(axis=0) - 1
    index -= corner
    shape = tuple((index.max(axis=0) + 2).tolist())
    if max(shape) * cell < 2 * config.crown_radius:
        return np.zeros(len(xyz), dtype=np.int64)
    canopy = np.zeros(shape)
    np.maximum.at(canopy, (index[:, 0], index[:, 1]), height)
    smooth = ndimage.gaussian_filter(
        ndimage.grey_closing(canopy, size=(3, 3)), config.crown_radius / cell / 3
    )
    basins = _basins(smooth, canopy > 0)
    trunks = np.floor(_trunks(xyz, height, config) / cell).astype(np.int64) - corner
    merged = _merge_shallow(smooth, basins, config.crown_drop, set(basins[tuple(trunks.T)].tolist()) - {-1})
    return np.unique(merged[index[:, 0], index[:, 1]], return_inverse=True)[1].astype(np.int64)


def _no_trunks(*_: object) -> Floats:
    """Return no places of trunks."""
    return np.zeros((0, 2))


@switchable("crowns_by_trunks", _no_trunks)
def _trunks(xyz: Floats, height: Floats, config: InstanceConfig) -> Floats:
    """Middles (T, 2) [m] of the upright, slender parts of foliage (N,) near the ground."""
    low = np.flatnonzero((height > 0.3) & (height < config.trunk_top))
    middles = []
    for group in group_indices(cell_clusters(xyz[low, :2], config.trunk_width / 2)):
        mine = low[group]
        slender = np.ptp(xyz[mine, :2], axis=0).max() < config.trunk_width
        if len(mine) >= 4 and slender and np.ptp(height[mine]) > 0.5 * config.trunk_top:
            middles.append(xyz[mine, :2].mean(axis=0))
    return np.array(middles).reshape(-1, 2)


def _basins(surface: Floats, inside: NDArray[np.bool_]) -> Ints:
    """Label cells by the top that steepest ascent reaches; outside is -1."""
    flat = np.arange(surface.size).reshape(surface.shape)
    best = surface.copy()
    target = flat.copy()
    for d_row, d_column in [(a, b) for a in (-1, 0, 1) for b in (-1, 0, 1) if (a, b) != (0, 0)]:
        shifted = np.roll(surface, (d_row, d_column), axis=(0, 1))
        moved = np.roll(flat, (d_row, d_column), axis=(0, 1))
        higher = shifted > best
        best = np.where(higher, shifted, best)
        target = np.where(higher, moved, target)
    pointer = target.ravel()
    while not np.array_equal(pointer, pointer[pointer]):
        pointer = pointer[pointer]
    return np.where(inside, pointer.reshape(surface.shape), -1)


def _merge_shallow(surface: Floats, basins: Ints, drop: float, rooted: set[int]) -> Ints:
    """Merge basins across saddles, the highest first.

    Not where both tops rise more than ``drop`` above it, or both basins stand on a trunk.
    """
    rooted = set(rooted)
    parent: dict[int, int] = {int(b): int(b) for b in np.unique(basins) if b >= 0}
    top = surface.ravel()

    def root(b: int) -> int:
        while parent[b] != b:
            b = parent[b]
        return b

    for saddle, a, b in _saddles(surface, basins):
        first, second = root(a), root(b)
        if first == second:
            continue
        low, high = sorted((first, second), key=lambda r: (top[r], r))
        if top[low] - saddle < drop and not (low in rooted and high in rooted):
            parent[low] = high
            if low in rooted:
                rooted.add(high)
    lookup = np.full(surface.size, -1, dtype=np.int64)
    for b in parent:
        lookup[b] = root(b)
    return np.where(basins >= 0, lookup[basins], -1)


def _saddles(surface: Floats, basins: Ints) -> list[tuple[float, int, int]]:
    """Highest pass between every two touching basins, highest first."""
    best: dict[tuple[int, int], float] = {}
    sides = ((np.s_[:-1, :], np.s_[1:, :]), (np.s_[:, :-1], np.s_[:, 1:]))
    for here, there in sides:
        a, b = basins[here], basins[there]
        border = (a != b) & (a >= 0) & (b >= 0)
        height = np.minimum(surface[here], surface[there])[border]
        for x, y, z in zip(a[border].tolist(), b[border].tolist(), height.tolist(), strict=True):
            key = (min(x, y), max(x, y))
            best[key] = max(best.get(key, -np.inf), z)
    return sorted(((z, *key) for key, z in best.items()), reverse=True)


def _join_nearest(xyz: Floats, labels: Ints, reach: float) -> Ints:
    """Give unlabelled points the label of the nearest labelled one within reach [m]."""
    known = labels >= 0
    if known.all() or not known.any():
        return labels
    distance, slot = cKDTree(xyz[known]).query(xyz[~known], distance_upper_bound=reach)
    joined = labels.copy()
    found = np.isfinite(distance)
    values = np.full(len(distance), -1, dtype=np.int64)
    values[found] = labels[known][slot[found]]
    joined[~known] = values
    return joined
