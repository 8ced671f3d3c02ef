"""Building class: facades, roofs, and the small parts attached to them (method, part C3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import Field
from scipy import ndimage
from scipy.spatial import cKDTree

from subiaco_change.segmentation.clustering import group_reduce, voxel_clusters
from subiaco_change.segmentation.features import FeatureConfig, Features, compute_features
from subiaco_change.segmentation.ground_model import Mask
from subiaco_change.segmentation.planar_patches import Patches, planar_patches
from subiaco_geo.clouds import voxel_indices, voxel_keys
from subiaco_geo.config import StrictModel
from subiaco_geo.frames import Floats, Ints


class BuildingConfig(StrictModel):
    """Which planes are buildings, and what belongs to them; heights are above the local ground model."""

    max_linearity: float = Field(
        0.92,
        gt=0,
        lt=1,
        description="Largest linearity of a point that may join a planar patch [1]; points along lines "
        "have no normal",
    )
    plane_angle_deg: float = Field(
        10.0,
        gt=0,
        description="Largest angle between the normals of neighbouring points of one planar patch [deg] "
        "(paper)",
    )
    plane_offset: float = Field(
        0.08,
        gt=0,
        description="Largest distance of a point from its neighbour's plane within one planar patch [m] "
        "(paper)",
    )
    plane_area: float = Field(
        6.0,
        gt=0,
        description="Smallest area of a planar patch that is a facade or a roof by itself [m2] (paper)",
    )
    plane_cell: float = Field(
        0.5, gt=0, description="Edge of the cells in which the area of a planar patch is counted [m]"
    )
    wire_height: float = Field(
        4.0,
        gt=0,
        description="Height above ground above which linear points and patches can be wires or palm "
        "fronds [m]",
    )
    wire_linearity: float = Field(
        0.42, gt=0, lt=1, description="Mean linearity above which a planar patch can be a bundle of wires [1]"
    )
    wire_level: float = Field(
        0.97,
        gt=0,
        lt=1,
        description="Vertical component of a patch normal above which a bundle of wires hangs level [1]; "
        "roofs are pitched",
    )
    wire_inner: float = Field(
        0.4,
        gt=0,
        le=1,
        description="Fraction of the cells of a patch with four occupied neighbours; below it, the patch "
        "may be wires",
    )
    wire_rise: float = Field(
        1.0,
        gt=0,
        description="Largest standard deviation of the heights in a bundle of wires [m]; sparse facades "
        "have more",
    )
    frond_linearity: float = Field(
        0.36,
        gt=0,
        lt=1,
        description="Mean linearity above which a rough, bent patch consists of palm fronds [1]",
    )
    frond_bend: float = Field(
        0.1,
        gt=0,
        description="Root mean square distance from its plane above which a patch can consist of palm "
        "fronds [m]",
    )
    frond_roughness: float = Field(
        0.04,
        gt=0,
        description="Median roughness above which a patch can be palm fronds or foliage instead of a roof "
        "[m]",
    )
    wire_roughness: float = Field(
        0.045, gt=0, description="Largest roughness of a point that belongs to a wire [m]"
    )
    wire_length: float = Field(4.0, gt=0, description="Shortest horizontal extent of a run of wires [m]")
    wire_touch: float = Field(
        0.4,
        gt=0,
        description="Edge of the voxels in which points of wires are connected into one component [m]",
    )
    leafy_scatter: float = Field(
        0.18,
        gt=0,
        lt=1,
        description="Mean sqrt(l3 / l1) above which a small planar patch is the side of a hedge, not a "
        "wall [1]",
    )
    leafy_bend: float = Field(
        0.2,
        gt=0,
        description="Root mean square distance from its plane above which a rough, inclined patch is "
        "foliage, not a roof [m]",
    )
    leafy_area: float = Field(
        25.0,
        gt=0,
        description="Area of a planar patch from which scattered points no longer make the patch foliage "
        "[m2]",
    )
    facade_slope: float = Field(
        0.25,
        gt=0,
        description="Largest vertical component of the normal of a facade [1] (paper); raise it to accept "
        "inclined walls",
    )
    thick: FeatureConfig = FeatureConfig(neighbours=24, radius=1.5)
    thick_cell: float = Field(
        0.5,
        gt=0,
        description="Edge of the voxels in which a wall that was mapped as several sheets is averaged to "
        "one [m]",
    )
    thick_roughness: float = Field(
        0.16,
        gt=0,
        description="Largest roughness, over a radius of 1.5 m, of a wall that was mapped as several "
        "sheets [m]",
    )
    thick_offset: float = Field(
        0.25,
        gt=0,
        description="Largest distance between neighbouring voxel means of a wall that was mapped as "
        "several sheets [m]",
    )
    thick_area: float = Field(
        12.0, gt=0, description="Smallest area of a wall that was mapped as several sheets [m2]"
    )
    facade_width: float = Field(
        0.15,
        gt=0,
        description="Smallest standard deviation of points along a facade [m]; the face of a pole has less",
    )
    facade_top: float = Field(
        2.3,
        gt=0,
        description="Height above ground that a facade must reach [m]; lower walls become class other",
    )
    eaves: float = Field(
        0.35,
        ge=0,
        description="Distance below facade_top at which a wall may end if rough eaves continue above the "
        "wall [m]",
    )
    facade_share: float = Field(
        0.3,
        ge=0,
        le=1,
        description="Fraction of the points of a facade that must lie where a wall reaches facade_top",
    )
    part_area: float = Field(
        2.0,
        gt=0,
        description="Smallest area of a planar patch that joins a larger facade or roof near it [m2]",
    )
    roof_height: float = Field(
        2.0,
        gt=0,
        description="Median height above ground above which any planar patch that is not upright is a "
        "roof [m] (method C3)",
    )
    roof_level: float = Field(
        0.5, gt=0, lt=1, description="Smallest vertical component of the normal of a roof point [1]"
    )
    roof_cell: float = Field(0.5, gt=0, description="Edge of the cells of the footprint of roofs [m]")
    chimney: float = Field(
        1.2, ge=0, description="Height above a roof up to which points belong to the building [m]"
    )
    under_gap: float = Field(
        0.3,
        gt=0,
        description="Clearance below a roof above which an object under the roof, a car for instance, is "
        "separate [m]",
    )
    under_share: float = Field(
        0.5,
        gt=0,
        le=1,
        description="Largest fraction of the points of an object under a roof that may have roof posts "
        "above them",
    )
    under_points: int = Field(
        15, gt=0, description="Smallest number of points of a separate object under a roof"
    )
    touch: float = Field(
        0.25,
        gt=0,
        description="Edge of the voxels in which points of one object at a building are connected [m]",
    )
    attach: float = Field(
        1.0,
        ge=0,
        description="Distance from a building within which smooth small parts join the building [m]",
    )
    edge: float = Field(
        0.7,
        ge=0,
        description="Distance from a building within which points that look like foliage join the "
        "building [m]",
    )
    contact: float = Field(
        0.5,
        ge=0,
        description="Distance from a building within which points of fences and plants that extend "
        "farther join it [m]",
    )


@dataclass(frozen=True)
class BuildingPlanes:
    """Planes of points (N,).

    ``core`` tells facades and roofs, ``part`` (int, or -1) numbers smaller planes like them,
    ``fronds`` tells high planes that are rough and made of lines: crowns of palms.
    """

    core: Mask
    part: Ints
    fronds: Mask


def building_planes(
    xyz: Floats, height: Floats, features: Features, free: Mask, config: BuildingConfig
) -> BuildingPlanes:
    """Find the planar patches among free points (N,) that are facades and roofs, or may be parts of them."""
    smooth = features.roughness < config.plane_offset
    candidate = free & smooth & (features.linearity < config.max_linearity)
    patches = planar_patches(
        xyz, features, candidate, config.plane_angle_deg, config.plane_offset, config.plane_cell
    )
    high = _up_to_eaves(xyz, height, features, candidate, free, config)
    building, fronds = _kinds(patches, features, height, high, config)
    area = np.where(building, patches.area, 0.0)
    mine = (patches.label >= 0) & (high | (np.abs(features.normals[:, 2]) >= config.facade_slope))
    own = np.append(area, 0.0)[patches.label]
    part = mine & (own > config.part_area) & (own <= config.plane_area)
    return BuildingPlanes(
        mine & (own > config.plane_area),
        np.where(part, patches.label, -1),
        np.append(fronds, False)[patches.label],
    )


def thick_walls(xyz: Floats, height: Floats, free: Mask, config: BuildingConfig) -> Mask:
    """Find walls among free points (N,) that stand in more than one sheet: a bent map saw them twice.

    Too rough for planes of neighbours 0.6 m around, they are thin for their size seen from farther off:
    in cells of 0.5 m, over 1.5 m. Crowns are three times as thick, hedges end below a facade's top.
    """
    walls = np.zeros(len(xyz), dtype=bool)
    members = np.flatnonzero(free & (height > config.under_gap))
    if len(members) < 4:
        return walls
    _, cell = np.unique(voxel_keys(voxel_indices(xyz[members], config.thick_cell)), return_inverse=True)
    count = np.bincount(cell)
    middle = np.stack([np.bincount(cell, xyz[members, i]) / count for i in range(3)], axis=1)
    shape = compute_features(middle, config.thick)
    upright = np.abs(shape.normals[:, 2]) < config.facade_slope
    sheet = upright & (shape.roughness < config.thick_roughness) & (shape.linearity < config.max_linearity)
    patches = planar_patches(
        middle, shape, sheet, config.plane_angle_deg, config.thick_offset, config.thick_cell
    )
    inside = patches.label >= 0
    top = group_reduce(
        patches.label[inside],
        (np.bincount(cell, height[members]) / count)[inside],
        len(patches.area),
        "maximum",
    )
    wall = (patches.area > config.thick_area) & (top > config.facade_top)
    walls[members] = np.append(wall, False)[patches.label][cell]
    return walls


def join_parts(xyz: Floats, planes: BuildingPlanes, free: Mask, config: BuildingConfig) -> Mask:
    """Add to the free points (N,) of the core the parts that come near it, directly or through others."""
    core = planes.core & free
    part = (planes.part >= 0) & free
    edge = core
    while edge.any() and part.any():
        loose = np.flatnonzero(part)
        near = cKDTree(xyz[edge]).query(xyz[loose], distance_upper_bound=config.attach)[0] < config.attach
        edge = part & np.isin(planes.part, planes.part[loose[near]])
        core = core | edge
        part &= ~edge
    return core


def _up_to_eaves(
    xyz: Floats, height: Floats, features: Features, smooth: Mask, free: Mask, config: BuildingConfig
) -> Mask:
    """Tell which points (N,) have a wall above or beside them that is as high as a facade.

    A fence or gate in line with a wall joins its patch, but stays low all along. A wall below
    eaves ends in their rough edge, so that it may be lower by that where something goes on above.
    """
    upright = smooth & (np.abs(features.normals[:, 2]) < config.facade_slope)
    cell = np.floor(xyz[:, :2] / config.roof_cell).astype(np.int64)
    cell -= cell.min(axis=0)
    wall, above = np.full((2, *(cell.max(axis=0) + 1).tolist()), -np.inf)
    np.maximum.at(wall, tuple(cell[upright].T), height[upright])
    eaves = free & (height > config.facade_top) & (height < config.facade_top + config.eaves)
    above[tuple(cell[eaves].T)] = 1.0
    wall = ndimage.maximum_filter(wall, 3)
    reaches = (wall > config.facade_top) | ((wall > config.facade_top - config.eaves) & (above > 0))
    return np.asarray(reaches[tuple(cell.T)])


def _kinds(
    patches: Patches, features: Features, height: Floats, high: Mask, config: BuildingConfig
) -> tuple[Mask, Mask]:
    """Tell which smooth patches (hips and gables chain into one) are facades or roofs, and which fronds."""
    inside = patches.label >= 0
    own = patches.label[inside]

    def reduced(values: Floats, how: str) -> Floats:
        return group_reduce(own, values[inside], len(patches.area), how)

    upright = reduced(np.abs(features.normals[:, 2]), "median") < config.facade_slope
    facade = upright & (reduced(high.astype(np.float64), "mean") > config.facade_share)
    roof = ~upright & (reduced(height, "median") > config.roof_height)
    linear, lowest = reduced(features.linearity, "mean"), reduced(height, "minimum")
    level = np.abs(patches.normal[:, 2]) > config.wire_level
    narrow = patches.inner < config.wire_inner * patches.area
    wires = (linear > config.wire_linearity) & (level | narrow) & (patches.rise < config.wire_rise)
    rough = reduced(features.roughness, "median") > config.frond_roughness
    bent = ~upright & (patches.residual > config.frond_bend) & (lowest > config.roof_height)
    fronds = bent & rough & (linear > config.frond_linearity)
    leafy = (reduced(np.sqrt(features.scatter), "mean") > config.leafy_scatter) & (
        patches.area < config.leafy_area
    )
    slopes = ~upright & rough & (patches.residual > config.leafy_bend)
    fronds |= slopes
    facade &= patches.width > config.facade_width
    building = (facade | roof) & ~fronds & ~leafy & ~(wires & (lowest > config.wire_height))
    return np.asarray(building), np.asarray(fronds & (patches.area > config.part_area))


def within_roofs(
    xyz: Floats, core: Mask, features: Features, free: Mask, config: BuildingConfig
) -> tuple[Mask, Mask]:
    """Tell which free points are in the footprint of a roof, not far above it: chimneys, dormers, walls.

    Objects below a roof with a clearance above them that are no walls are kept apart: cars, fences.
    """
    level = np.abs(features.normals[:, 2])
    roof, facade = core & (level > config.roof_level), core & (level < config.facade_slope)
    if not roof.any():
        return roof, roof
    cell = np.floor(xyz[:, :2] / config.roof_cell).astype(np.int64)
    cell -= cell.min(axis=0) - 2
    shape = tuple((cell.max(axis=0) + 3).tolist())
    top, eaves, wall = np.full(shape, -np.inf), np.full(shape, np.inf), np.zeros(shape, dtype=bool)
    np.maximum.at(top, tuple(cell[roof].T), xyz[roof, 2])
    np.minimum.at(eaves, tuple(cell[roof].T), xyz[roof, 2])
    wall[tuple(cell[facade].T)] = True
    top, eaves = ndimage.grey_closing(top, size=(3, 3)), ndimage.minimum_filter(eaves, size=3)
    own = tuple(cell.T)
    inside = free & (xyz[:, 2] < top[own] + config.chimney)
    loose = inside & ~core & ~wall[own]
    clear = eaves[own] - xyz[:, 2] > config.under_gap
    hanging = np.zeros(shape, dtype=bool)
    hanging[tuple(cell[loose & ~clear].T)] = True
    apart = np.zeros(len(xyz), dtype=bool)
    # Things that end there as they are, or once the posts of the roof are cut at that height.
    for under, blocked, share in ((loose, ~clear, 0.0), (loose & clear, hanging[own], config.under_share)):
        mine = np.flatnonzero(under)
        apart[mine] |= _stands_apart(xyz[mine], blocked[mine], share, config)
    return inside & ~apart, apart


def _stands_apart(xyz: Floats, blocked: Mask, share: float, config: BuildingConfig) -> Mask:
    """Tell which points (N,) are of things of which at most a share is blocked."""
    if len(xyz) == 0:
        return np.zeros(0, dtype=bool)
    thing = voxel_clusters(xyz, config.touch)
    size = np.bincount(thing)
    free = (np.bincount(thing, blocked) <= share * size) & (size >= config.under_points)
    return np.asarray(free[thing])


def attach_parts(xyz: Floats, core: Mask, free: Mask, foliage: Mask, config: BuildingConfig) -> Mask:
    """Add the free points within reach of the core: gutters, sills, chimneys; rough ones from less far.

    Of things that mostly lie beyond that reach (fences, plants) only what touches is added.
    """
    attached = core.copy()
    loose = np.flatnonzero(free & ~core)
    if not core.any() or len(loose) == 0:
        return attached
    distance = cKDTree(xyz[core]).query(xyz[loose], distance_upper_bound=config.attach)[0]
    soft = foliage[loose]
    near = distance < np.where(soft, config.edge, config.attach)
    thing = voxel_clusters(xyz[loose[~soft]], config.touch)
    part = np.bincount(thing, near[~soft]) > 0.5 * np.bincount(thing)
    near[~soft] &= part[thing] | (distance[~soft] < config.contact)
    attached[loose[near]] = True
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
