"""Wires and poles: straight and slender objects, found at the scale where they are longer than wide.

At the scale of the eigen-features a bundle of wires is as rough as a crown, and a pole is one point a
layer. So wires are looked for among means of cells over a few metres, poles among columns of layers;
both are followed along their own line into the crowns that they pass through.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.spatial import cKDTree

from subiaco_change.geometry import tree_for_few
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import none_of_them, switchable
from subiaco_change.segmentation.clustering import cell_clusters, connect, group_indices, voxel_means
from subiaco_change.segmentation.ground_model import Mask
from subiaco_geo.config import StrictModel
from subiaco_geo.frames import Floats, Ints

_MAYBE = NUMBERS.wires_and_poles.near_share
_AROUND = NUMBERS.wires_and_poles.cells_around


class LineConfig(StrictModel):
    """What a wire and a pole are; heights are above the local ground model."""

    wire_height: float = Field(3.0, gt=0, description="Smallest height above ground of a wire [m]")
    wire_cell: float = Field(
        0.4, gt=0, description="Edge of the voxels whose mean point represents a bundle of wires [m]"
    )
    wire_far: float = Field(
        0.5,
        gt=0,
        description="Mean distance to the neighbours above which a voxel is sparse enough to be a wire [m]",
    )
    wire_reach: float = Field(
        0.9, gt=0, description="Radius in which the neighbours of a wire must form a single line [m]"
    )
    wire_thick: float = Field(
        0.12, gt=0, description="Largest standard deviation of points across a wire [m]"
    )
    wire_link: float = Field(
        1.6, gt=0, description="Largest distance between consecutive pieces that are joined to one wire [m]"
    )
    wire_aside: float = Field(
        0.2,
        gt=0,
        description="Largest distance of a piece from the line of the adjoining piece of a wire [m]",
    )
    wire_length: float = Field(5.0, gt=0, description="Shortest horizontal length of a wire [m]")
    wire_straight: float = Field(
        0.25,
        gt=0,
        description="Largest root mean square distance of a wire from a straight line, seen from above [m]",
    )
    wire_level: float = Field(0.35, gt=0, description="Steepest slope of a wire [m/m]")
    wire_width: float = Field(
        0.25,
        gt=0,
        description="Distance from the fitted curve of a wire within which points belong to the wire [m]",
    )
    wire_gap: float = Field(3.0, gt=0, description="Longest gap across which a wire is followed [m]")
    pole_layer: float = Field(
        0.5, gt=0, description="Height of the layers in which the clearance around a pole is measured [m]"
    )
    pole_touch: float = Field(
        0.3,
        gt=0,
        description="Edge of the cells, seen from above, in which clear layers are connected to one pole [m]",
    )
    pole_width: float = Field(0.3, gt=0, description="Half width of a pole with its attachments [m]")
    pole_ring: float = Field(
        0.9, gt=0, description="Radius around a pole in which few other points may lie [m]"
    )
    pole_clear: float = Field(
        0.7,
        gt=0,
        le=1,
        description="Smallest fraction of the points within pole_ring of a layer that belong to the pole",
    )
    pole_length: float = Field(
        4.0, gt=0, description="Smallest length over which a pole has clearance around it [m]"
    )
    pole_top: float = Field(5.0, gt=0, description="Height above ground that a pole must exceed [m]")
    pole_straight: float = Field(
        0.13, gt=0, description="Largest root mean square distance of the points of a pole from its axis [m]"
    )
    pole_lean: float = Field(
        0.15, gt=0, description="Largest inclination of the axis of a pole against the vertical [m/m]"
    )
    pole_foot: float = Field(
        3.0,
        gt=0,
        description="Largest height above ground of the lowest point of a pole [m]; edges of roofs hang "
        "higher",
    )
    pole_planar: float = Field(
        0.3, gt=0, le=1, description="Largest fraction of the points of a pole that lie in walls or roofs"
    )
    pole_apart: float = Field(
        2.5,
        gt=0,
        description="Smallest distance between two poles [m]; closer ones are columns of one sparsely "
        "mapped wall",
    )
    pole_filled: float = Field(
        0.7, gt=0, le=1, description="Smallest fraction of the layers of a pole that contain points"
    )


def find_lines(
    xyz: Floats, height: Floats, reach: Floats, free: Mask, planar: Mask, config: LineConfig
) -> Mask:
    """Tell which free points (N,) are of wires and poles.

    Parameters
    ----------
    xyz, height : (N, 3), (N,) float64 [m]
    reach : (N,) float
        Distance of the neighbours that eigenvalue features use [m]: dense places contain no wire.
    free : (N,) bool
        Neither ground nor known to be of something else.
    planar : (N,) bool
        Walls and roofs: seen sparsely their edges and columns stand as clear as poles.
    config : LineConfig
    """
    wires = find_wires(xyz, height, reach, free, config)
    return wires | find_poles(xyz, height, free & ~wires, planar, config)


@switchable("wires", none_of_them)
def find_wires(xyz: Floats, height: Floats, reach: Floats, free: Mask, config: LineConfig) -> Mask:
    """Tell which free points (N,) are wires: high, long, level and thin, each line of a bundle by itself."""
    found = np.zeros(len(xyz), dtype=bool)
    high = np.flatnonzero(free & (height > config.wire_height))
    if len(high) < 8:
        return found
    middle, cell = voxel_means(xyz[high], config.wire_cell)
    sparse = np.bincount(cell, reach[high]) > config.wire_far * np.bincount(cell)
    thin, direction = _thin(middle, np.flatnonzero(sparse), config)
    for run in group_indices(_joined(middle[thin], direction, config)):
        line = _line(middle[thin[run]], config)
        if line is not None:
            found[high[_follow(xyz[high], np.isin(cell, thin[run]), line, config)]] = True
    return found


def _thin(middle: Floats, asked: Ints, config: LineConfig) -> tuple[Ints, Floats]:
    """Which cell means (T,) of those asked have neighbours along a line alone, and its direction (T, 3)."""
    k = min(10, len(middle))
    distance, index = cKDTree(middle).query(middle[asked], k=k, distance_upper_bound=config.wire_reach)
    weight = np.isfinite(distance)
    step = np.where(weight[..., None], middle[np.where(weight, index, 0)] - middle[asked][:, None], 0.0)
    count = weight.sum(axis=1)
    mean = step.sum(axis=1) / count[:, None]
    moment = np.einsum("mki,mkj->mij", step, step) / count[:, None, None]
    values, vectors = np.linalg.eigh(moment - mean[:, :, None] * mean[:, None])
    across, along = np.sqrt(np.maximum(values[:, 1], 0)), np.sqrt(np.maximum(values[:, 2], 0))
    level = np.abs(vectors[:, 2, 2]) < config.wire_level / np.hypot(1.0, config.wire_level)
    thin = (count >= 3) & (across < config.wire_thick) & (along > 0.3 * config.wire_reach) & level
    return asked[thin], vectors[thin][:, :, 2]


def _joined(points: Floats, direction: Floats, config: LineConfig) -> Ints:
    """Label points (T, 3) by the line that they share: near each other, and each on the other's line."""
    pairs = cKDTree(points).query_pairs(config.wire_link, output_type="ndarray")
    step = points[pairs[:, 1]] - points[pairs[:, 0]]
    aside = [
        np.linalg.norm(np.cross(step, direction[pairs[:, end]]), axis=1) < config.wire_aside for end in (0, 1)
    ]
    return connect(len(points), pairs[aside[0] & aside[1]])


def _line(points: Floats, config: LineConfig) -> tuple[Floats, Floats] | None:
    """Middle (2,) and direction (2,) in plan of a run of points (M, 3) that is a wire, else None."""
    middle = points[:, :2].mean(axis=0)
    _, spread, axes = np.linalg.svd(points[:, :2] - middle, full_matrices=False)
    if len(points) < 5 or spread[1] / np.sqrt(len(points)) > config.wire_straight:
        return None
    u = (points[:, :2] - middle) @ axes[0]
    return (middle, axes[0]) if np.ptp(u) > config.wire_length else None


def _follow(xyz: Floats, seed: Mask, line: tuple[Floats, Floats], config: LineConfig) -> NDArray[np.int64]:
    """Points (M,) along a wire and beyond its ends, as far as they go on without a gap."""
    middle, direction = line
    step = xyz[:, :2] - middle
    u, v = step @ direction, step @ np.array([-direction[1], direction[0]])
    mine = seed.copy()
    for _ in range(8):
        low, high = u[mine].min() - config.wire_gap, u[mine].max() + config.wire_gap
        sag = np.polyfit(u[mine], xyz[mine, 2], 2)
        side = np.polyfit(u[mine], v[mine], 1)
        near = (u > low) & (u < high) & (np.abs(v - np.polyval(side, u)) < config.wire_width)
        near &= np.abs(xyz[:, 2] - np.polyval(sag, u)) < config.wire_width
        if not (near & ~mine).any():
            break
        mine |= near
    return np.flatnonzero(mine)


@switchable("poles", none_of_them)
def find_poles(xyz: Floats, height: Floats, free: Mask, planar: Mask, config: LineConfig) -> Mask:
    """Tell which free points (N,) are poles: upright, straight, and clear around most of their length.

    A trunk is clear too, but ends in its crown; a pole stands clear at its top, or over more of its
    length than a trunk does, and goes on straight through a crown.
    """
    found = np.zeros(len(xyz), dtype=bool)
    members = np.flatnonzero(free & (height > 0.3))
    if len(members) < 8:
        return found
    clear = members[_clear(xyz[members], height[members], config)]
    if len(clear) == 0:
        return found
    tree = tree_for_few(xyz[members, :2])
    bodies, places = [], []
    for group in group_indices(cell_clusters(xyz[clear, :2], config.pole_touch)):
        own = clear[group]
        tall = len(own) >= 8 and np.ptp(height[own]) > config.pole_length - config.pole_layer
        line = _axis(xyz[own], height[own], config) if tall else None
        if line is None:
            continue
        axis, on = line
        reach = config.pole_width + config.pole_lean * float(np.ptp(height[own]))
        near = members[np.array(tree.query_ball_point(np.median(xyz[own[on], :2], axis=0), reach), np.int64)]
        body = near[_aside(xyz[near], axis) < config.pole_width]
        if planar[body].mean() < config.pole_planar and _is_pole(height[body], height[own[on]], config):
            bodies.append(body)
            places.append(np.median(xyz[body, :2], axis=0))
    for body, single in zip(bodies, _apart(np.reshape(places, (-1, 2)), config), strict=True):
        found[body] |= single
    return found


def _apart(places: Floats, config: LineConfig) -> Mask:
    """Tell which poles (P, 2) stand apart; side by side they are columns of one wall, seen sparsely."""
    if len(places) == 0:
        return np.zeros(0, dtype=bool)
    tree = cKDTree(places)
    near, same = (
        tree.query_ball_point(places, reach, return_length=True)
        for reach in (config.pole_apart, 2 * config.pole_width)
    )
    return np.asarray(near == same)


def _clear(xyz: Floats, height: Floats, config: LineConfig) -> Mask:
    """Tell which points (N,) have, in their layer, most of what is near within a pole's width."""
    index = np.floor(xyz[:, :2] / config.pole_width).astype(np.int64)
    index -= index.min(axis=0) - _AROUND
    row = int(index[:, 1].max()) + 1 + _AROUND
    rows = (np.floor(height / config.pole_layer).astype(np.int64)) * (int(index[:, 0].max()) + 1 + _AROUND)
    keys, cell, count = np.unique(
        (rows + index[:, 0]) * row + index[:, 1], return_inverse=True, return_counts=True
    )
    own, near = (_count_around(keys, count, row, reach) for reach in (1, _AROUND))
    clear = np.asarray((own >= _MAYBE * near)[cell])
    layer = np.floor(height / config.pole_layer)
    places = np.column_stack([xyz[:, :2], layer * 100.0])  # layers apart, so that a ball is a disc in one
    tree, asked = tree_for_few(places), places[clear]
    narrow = tree.query_ball_point(asked, config.pole_width, return_length=True)
    wide = tree.query_ball_point(asked, config.pole_ring, return_length=True)
    clear[clear] = narrow >= config.pole_clear * wide
    return clear


@numba.njit(cache=True)
def _count_around(keys: Ints, count: Ints, row: int, reach: int) -> Ints:
    """Points (M,) in the square of cells around each of the sorted cells (M,), in its layer."""
    total = np.zeros(len(keys), dtype=np.int64)
    before = np.zeros(len(keys) + 1, dtype=np.int64)
    before[1:] = np.cumsum(count)
    for step in range(-reach, reach + 1):
        low = high = 0  # keys and wanted keys rise together
        for here in range(len(keys)):
            wanted = keys[here] + step * row
            while low < len(keys) and keys[low] < wanted - reach:
                low += 1
            while high < len(keys) and keys[high] <= wanted + reach:
                high += 1
            total[here] += before[high] - before[low]
    return total


def _axis(xyz: Floats, height: Floats, config: LineConfig) -> tuple[Floats, Mask] | None:
    """Upright line as slopes and offsets (2, 2) of x(z), y(z) and which of points (M, 3) are on it.

    None where they do not stand straight over a pole's clear length.
    """
    axis = np.stack([[0.0, 0.0], np.median(xyz[:, :2], axis=0)])
    for reach in (3.0, 1.5, 1.0):
        on = _aside(xyz, axis) < reach * config.pole_width
        if np.count_nonzero(on) < 8:
            return None
        axis = np.polyfit(xyz[on, 2], xyz[on, :2], 1)
    on = _aside(xyz, axis) < config.pole_width
    layers = np.unique(np.floor(height[on] / config.pole_layer))
    straight = np.sqrt(np.mean(_aside(xyz[on], axis) ** 2)) < config.pole_straight
    upright = np.abs(axis[0]).max() < config.pole_lean
    long = len(layers) * config.pole_layer >= config.pole_length
    return (axis, on) if straight and upright and long else None


def _aside(xyz: Floats, axis: Floats) -> Floats:
    """Distance (M,) of points (M, 3) from an upright line in plan [m]."""
    return np.asarray(np.linalg.norm(xyz[:, :2] - (xyz[:, 2:] * axis[0] + axis[1]), axis=1))


def _is_pole(body: Floats, clear: Floats, config: LineConfig) -> bool:
    """Tell a pole by the heights of all its points and of those that stand clear."""
    layers = np.unique(np.floor(body / config.pole_layer))
    top = float(body.max())
    filled = len(layers) >= config.pole_filled * (layers.max() - layers.min() + 1)
    stands_clear = np.count_nonzero(clear > top - 2.0) >= 2 and float(clear.max()) > top - 1.0
    stands = float(body.min()) < config.pole_foot and top > config.pole_top
    return bool(filled and stands and stands_clear)
