"""Building class: planar patches, facades, roofs, and the small parts attached to them (method, part C3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from subiaco_change.method_rules.switches import none_of_them, rule_mask, switchable
from subiaco_change.segmentation.clustering import connect, group_reduce, voxel_clusters, voxel_means
from subiaco_change.segmentation.config import BuildingConfig
from subiaco_change.segmentation.features import Features, compute_features
from subiaco_change.segmentation.ground_model import Mask
from subiaco_geo.frames import Floats, Ints


@dataclass(frozen=True)
class BuildingPlanes:
    """Planes of points (N,).

    ``core`` tells facades and roofs, ``part`` (int, or -1) numbers smaller planes like them,
    ``fronds`` tells high planes that are rough and made of lines: crowns of palms. ``low`` tells upright
    planes that end below a facade: fences, garden walls, and sides of vehicles.
    """

    core: Mask
    part: Ints
    fronds: Mask
    low: Mask


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
    building, fronds, low = _kinds(patches, features, height, high, config)
    area = np.where(building, patches.area, 0.0)
    mine = (patches.label >= 0) & (high | (np.abs(features.normals[:, 2]) >= config.facade_slope))
    own = np.append(area, 0.0)[patches.label]
    part = mine & (own > config.part_area) & (own <= config.plane_area)
    return BuildingPlanes(
        mine & (own > config.plane_area),
        np.where(part, patches.label, -1),
        np.append(fronds, False)[patches.label],
        np.append(low, False)[patches.label],
    )


@switchable("thick_walls", none_of_them)
def thick_walls(xyz: Floats, height: Floats, free: Mask, config: BuildingConfig) -> Mask:
    """Find walls among free points (N,) that stand in more than one sheet: a bent map saw them twice.

    Too rough for planes of neighbours 0.6 m around, they are thin for their size seen from farther off:
    in cells of 0.5 m, over 1.5 m. Crowns are three times as thick, hedges end below a facade's top.
    """
    walls = np.zeros(len(xyz), dtype=bool)
    members = np.flatnonzero(free & (height > config.under_gap))
    if len(members) < 4:
        return walls
    middle, cell = voxel_means(xyz[members], config.thick_cell)
    shape = compute_features(middle, config.thick)
    upright = np.abs(shape.normals[:, 2]) < config.facade_slope
    sheet = upright & (shape.roughness < config.thick_roughness) & (shape.linearity < config.max_linearity)
    patches = planar_patches(
        middle, shape, sheet, config.plane_angle_deg, config.thick_offset, config.thick_cell
    )
    inside = patches.label >= 0
    top = group_reduce(
        patches.label[inside],
        (np.bincount(cell, height[members]) / np.bincount(cell))[inside],
        len(patches.area),
        "maximum",
    )
    wall = (patches.area > config.thick_area) & (top > config.facade_top)
    walls[members] = np.append(wall, False)[patches.label][cell]
    return walls


def _core_alone(_: Floats, planes: BuildingPlanes, free: Mask, *__: object) -> Mask:
    """Return the free points of facades and roofs without parts."""
    return planes.core & free


@switchable("facade_parts", _core_alone)
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
    reaches = wall > config.facade_top
    reaches |= rule_mask("rough_eaves", (wall > config.facade_top - config.eaves) & (above > 0) & ~reaches)
    return np.asarray(reaches[tuple(cell.T)])


def _kinds(
    patches: Patches, features: Features, height: Floats, high: Mask, config: BuildingConfig
) -> tuple[Mask, Mask, Mask]:
    """Tell which smooth patches are facades or roofs, which fronds, and which low walls.

    Hips and gables chain into one patch.
    """
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
    wires = rule_mask("wire_patches", wires & (lowest > config.wire_height))
    rough = reduced(features.roughness, "median") > config.frond_roughness
    bent = ~upright & (patches.residual > config.frond_bend) & (lowest > config.roof_height)
    fronds = rule_mask("palm_fronds", bent & rough & (linear > config.frond_linearity))
    leafy = reduced(np.sqrt(features.scatter), "mean") > config.leafy_scatter
    leafy = rule_mask("leafy_patches", leafy & (patches.area < config.leafy_area))
    fronds |= rule_mask("leafy_slopes", ~upright & rough & (patches.residual > config.leafy_bend))
    building = (facade | roof) & ~fronds & ~leafy & ~wires
    large = patches.area > config.part_area
    low = upright & ~facade & ~leafy & ~wires
    return np.asarray(building), np.asarray(fronds & large), np.asarray(low & large)


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


@switchable("objects_under_roofs", none_of_them)
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


@switchable("thin_runs", none_of_them)
def thin_runs(xyz: Floats, height: Floats, roughness: Floats, hard: Mask, config: BuildingConfig) -> Mask:
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


_HALF_PLANE = 1 << 14  # cells on either side of a patch's centre


@dataclass(frozen=True)
class Patches:
    """Planar patches of a cloud.

    ``label`` (N,) is -1 for points of none; ``normal`` (P, 3), ``centre``
    (P, 3) [m], ``area`` (P,) [m2] of occupied cells in the plane, ``inner``
    (P,) [m2] of those whose four neighbours are occupied too (none in a bundle of wires), and
    ``residual`` (P,) the root mean square distance to the plane [m]. ``rise`` (P,) is the standard
    deviation of the heights once their slope along the patch is taken out [m]: little for a bundle of
    wires, however steep or long.
    """

    label: Ints
    normal: Floats
    centre: Floats
    area: Floats
    inner: Floats
    residual: Floats
    rise: Floats


def planar_patches(
    xyz: Floats, features: Features, candidate: Mask, angle_deg: float, offset: float, cell: float
) -> Patches:
    """Join neighbouring candidate points whose normals agree and that lie in each other's plane.

    Parameters
    ----------
    xyz : (N, 3) float64 [m]
    features : Features
    candidate : (N,) bool
    angle_deg : float
        Largest angle between the normals of neighbours [deg].
    offset : float
        Largest distance of a neighbour from the tangent plane [m].
    cell : float
        Edge of the cells in which areas are counted [m].
    """
    edges = _smooth_edges(xyz, features, candidate, angle_deg, offset)
    component = connect(len(xyz), edges)
    sizes = np.bincount(component)
    keep = candidate & (sizes[component] >= 4)
    label = np.full(len(xyz), -1, dtype=np.int64)
    _, label[keep] = np.unique(component[keep], return_inverse=True)
    return _measure(xyz, label, cell)


def _smooth_edges(xyz: Floats, features: Features, candidate: Mask, angle_deg: float, offset: float) -> Ints:
    columns = features.neighbours[:, 1:9]
    source = np.repeat(np.flatnonzero(candidate), columns.shape[1])
    target = columns[candidate].ravel().astype(np.int64)
    inside = candidate[target]
    source, target = source[inside], target[inside]
    normals = features.normals
    aligned = np.abs(np.einsum("ij,ij->i", normals[source], normals[target])) > np.cos(np.radians(angle_deg))
    source, target = source[aligned], target[aligned]
    step = np.abs(np.einsum("ij,ij->i", normals[source], xyz[target] - xyz[source]))
    near = step < offset
    return np.stack([source[near], target[near]], axis=1)


def _measure(xyz: Floats, label: Ints, cell: float) -> Patches:
    inside = label >= 0
    points, own = xyz[inside], label[inside]
    count = int(own.max(initial=-1)) + 1
    sizes = np.maximum(np.bincount(own, minlength=count), 1)
    centre = np.stack([np.bincount(own, points[:, i], count) / sizes for i in range(3)], axis=1)
    delta = points - centre[own]
    covariance = np.empty((count, 3, 3))
    for i in range(3):
        for j in range(3):
            covariance[:, i, j] = np.bincount(own, delta[:, i] * delta[:, j], count) / sizes
    values, vectors = np.linalg.eigh(covariance)
    normal = vectors[:, :, 0]
    residual = np.sqrt(np.maximum(values[:, 0], 0.0))
    area, inner = _plane_area(delta, own, normal, cell)
    return Patches(label, normal, centre, area, inner, residual, _rise(covariance, normal))


def _rise(covariance: Floats, normal: Floats) -> Floats:
    """Return the standard deviations (P,) of heights about a line along each plane [m]."""
    along = np.stack([-normal[:, 1], normal[:, 0]], axis=1)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    spread = np.einsum("pi,pij,pj->p", along, covariance[:, :2, :2], along)
    slope = np.einsum("pi,pi->p", along, covariance[:, :2, 2])
    return np.sqrt(np.maximum(covariance[:, 2, 2] - slope**2 / np.maximum(spread, 1e-12), 0.0))


def _plane_area(delta: Floats, own: Ints, normal: Floats, cell: float) -> tuple[Floats, Floats]:
    """Area [m2] of the occupied cells of every patch in its own plane, and of those inside it."""
    flat = np.abs(normal[:, 2]) > 0.95
    reference = np.where(flat[:, None], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    u = np.cross(reference, normal)
    u /= np.maximum(np.linalg.norm(u, axis=1, keepdims=True), 1e-12)
    v = np.cross(normal, u)
    column, row = (
        np.floor(np.einsum("ij,ij->i", delta, axis[own]) / cell).astype(np.int64) for axis in (u, v)
    )
    half = _HALF_PLANE
    keys = np.unique(
        (own * 2 * half + np.clip(column, 1 - half, half - 2) + half) * 2 * half
        + np.clip(row, 1 - half, half - 2)
        + half
    )
    inside = np.ones(len(keys), dtype=bool)
    for step in (1, -1, 2 * half, -2 * half):
        slot = np.minimum(np.searchsorted(keys, keys + step), len(keys) - 1)
        inside &= keys[slot] == keys + step
    patch = keys // (4 * half * half)
    count = len(normal)
    return (
        np.asarray(np.bincount(patch, minlength=count) * cell**2, dtype=np.float64),
        np.asarray(np.bincount(patch, inside, minlength=count) * cell**2, dtype=np.float64),
    )
