"""Facades, roofs, and the small parts that hang on them (method, part C3)."""

from __future__ import annotations

import numpy as np
from pydantic import Field
from scipy import ndimage
from scipy.spatial import cKDTree

from subiaco_change.semantics.clustering import group_reduce, voxel_clusters
from subiaco_change.semantics.features import Features
from subiaco_change.semantics.ground import Mask
from subiaco_change.semantics.planes import Patches, planar_patches
from subiaco_geo.config import StrictModel
from subiaco_geo.frames import Floats


class BuildingConfig(StrictModel):
    """Which planes are buildings, and what belongs to them; heights are above the local ground model."""

    max_linearity: float = Field(
        0.92, gt=0, lt=1, description="linearity of a point that may join a patch; lines have no normal"
    )
    plane_angle_deg: float = Field(10.0, gt=0, description="angle between coplanar neighbours [deg], paper")
    plane_offset: float = Field(0.08, gt=0, description="distance to the neighbour's plane [m], paper")
    plane_area: float = Field(6.0, gt=0, description="planar area of a facade or roof [m2], paper")
    wire_height: float = Field(4.0, gt=0, description="lowest wire or palm frond [m]")
    wire_linearity: float = Field(
        0.42, gt=0, lt=1, description="mean linearity from which a patch so high is a bundle of lines"
    )
    wire_roughness: float = Field(0.045, gt=0, description="largest roughness of a point of wires [m]")
    wire_length: float = Field(4.0, gt=0, description="shortest run of wires seen from above [m]")
    wire_touch: float = Field(0.4, gt=0, description="voxel in which points of wires touch [m]")
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
        0.7, ge=0, description="reach of a building over rough points: edges look like foliage [m]"
    )


def building_core(
    xyz: Floats, height: Floats, features: Features, free: Mask, config: BuildingConfig
) -> Mask:
    """Tell which free points (N,) lie in a planar patch that is a facade or a roof."""
    smooth = features.roughness < config.plane_offset
    candidate = free & smooth & (features.linearity < config.max_linearity)
    patches = planar_patches(xyz, features, candidate, config.plane_angle_deg, config.plane_offset)
    inside = patches.label >= 0
    core = np.zeros(len(xyz), dtype=bool)
    core[inside] = _building_patches(patches, features, height, config)[patches.label[inside]]
    return core


def _building_patches(patches: Patches, features: Features, height: Floats, config: BuildingConfig) -> Mask:
    """Tell which smooth patches (hips and gables chain into one) are facades or roofs."""
    inside = patches.label >= 0
    own = patches.label[inside]

    def reduced(values: Floats, how: str) -> Floats:
        return group_reduce(own, values[inside], len(patches.area), how)

    upright = reduced(np.abs(features.normals[:, 2]), "median") < config.facade_slope
    facade = upright & (reduced(height, "maximum") > config.facade_top)
    roof = ~upright & (reduced(height, "median") > config.roof_height)
    lines = reduced(features.linearity, "mean") > config.wire_linearity
    lines &= reduced(height, "minimum") > config.wire_height
    return np.asarray((patches.area > config.plane_area) & ~lines & (facade | roof))


def within_roofs(xyz: Floats, core: Mask, features: Features, free: Mask, config: BuildingConfig) -> Mask:
    """Tell which free points lie in the footprint of a roof, not far above it: chimneys, dormers, walls."""
    roof = core & (np.abs(features.normals[:, 2]) > config.roof_level)
    if not roof.any():
        return roof
    cell = np.floor(xyz[:, :2] / config.roof_cell).astype(np.int64)
    cell -= cell.min(axis=0) - 2
    top = np.full(tuple((cell.max(axis=0) + 3).tolist()), -np.inf)
    np.maximum.at(top, tuple(cell[roof].T), xyz[roof, 2])
    top = ndimage.grey_closing(top, size=(3, 3))
    return np.asarray(free & (xyz[:, 2] < top[tuple(cell.T)] + config.chimney))


def attach_parts(xyz: Floats, core: Mask, free: Mask, foliage: Mask, config: BuildingConfig) -> Mask:
    """Add the free points within reach of the core: gutters, sills, chimneys; rough ones from less far."""
    attached = core.copy()
    loose = np.flatnonzero(free & ~core)
    if core.any() and len(loose):
        distance = cKDTree(xyz[core]).query(xyz[loose], distance_upper_bound=config.attach)[0]
        reach = np.where(foliage[loose], config.edge, config.attach)
        attached[loose[distance < reach]] = True
    return attached


def find_wires(xyz: Floats, height: Floats, roughness: Floats, hard: Mask, config: BuildingConfig) -> Mask:
    """Tell which hard points are wires, high, thin and long: no part of the crowns around them."""
    thin = np.flatnonzero(hard & (height > config.wire_height) & (roughness < config.wire_roughness))
    wires = np.zeros(len(xyz), dtype=bool)
    if len(thin) == 0:
        return wires
    run = voxel_clusters(xyz[thin], config.wire_touch)
    count = int(run.max()) + 1
    lows, highs = (
        np.stack([group_reduce(run, xyz[thin, axis], count, how) for axis in (0, 1)])
        for how in ("minimum", "maximum")
    )
    wires[thin[np.hypot(*(highs - lows))[run] > config.wire_length]] = True
    return wires
