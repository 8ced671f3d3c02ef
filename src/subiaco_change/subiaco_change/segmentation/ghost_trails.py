"""Ghost trails of moving objects in one map: by counts and times of beams, and by shape (method, part A).

A fused map shows moving vehicles and people as ghost trails above the road. A static object
returns about as many beams as pass it; a moving object occupies a voxel for a moment only, so that
hundreds of beams pass through the voxel for each that returns.

Where beams were not counted, shape decides. A vehicle that moved while it was mapped leaves a swath as wide
as itself and many times as long. The swath is filled from side to side, because the front and the rear of the
vehicle were met at every place along it, and the road beneath was seen as well as the road beside it, before
the vehicle came and after it had left. A standing vehicle is short, hollow, and hides part of the ground
beneath it; a hedge, a wall or a barrier hides all of it.
"""

from __future__ import annotations

import numpy as np
from pydantic import Field
from scipy import ndimage

from subiaco_change.geometry import column_keys, lies_near
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import none_of_them, switchable, zeros_of_them
from subiaco_change.segmentation.clustering import group_indices, voxel_clusters
from subiaco_change.segmentation.features import Features
from subiaco_change.segmentation.ground_model import Mask
from subiaco_change.segmentation.trail_raster import AROUND, TrailShapeConfig, rasterise
from subiaco_change.segmentation.trail_swaths import SURE, find_swaths, thin_trails, with_edges, with_pieces
from subiaco_geo.config import StrictModel
from subiaco_geo.frames import Floats, Ints

_LAYER = NUMBERS.trail_shape.layer
_DOUBTFUL = NUMBERS.trail_shape.doubtful


class TrafficConfig(StrictModel):
    """Evidence of movement: the verdict of mapping; without it, beams that passed for each that returned."""

    probability: float = Field(
        0.9,
        gt=0.5,
        le=1,
        description="Probability of having moved, from the beam times in the map, from which a point "
        "belongs to a ghost trail",
    )
    ratio: float = Field(
        20.0,
        gt=1,
        description="Mean ratio of passes to returns around a point above which the point certainly moved",
    )
    spread_ratio: float = Field(
        7.0,
        gt=1,
        description="Mean ratio of passes to returns above which a point joins a ghost trail that "
        "contains certain points",
    )
    core_share: float = Field(
        0.3, gt=0, le=1, description="Fraction of the points of a ghost trail that must certainly have moved"
    )
    block_share: float = Field(
        0.5,
        gt=0,
        le=1,
        description="Fraction of moving points from which connected planar patches are a ghost trail, not "
        "a building",
    )
    bottom: float = Field(
        0.15,
        ge=0,
        description="Height above ground of the lowest point of a ghost trail [m]; lower points are ground",
    )
    top: float = Field(
        3.8,
        gt=0,
        description="Largest height above ground of a point of a ghost trail [m]; a bus is 3.8 m high",
    )
    reach: float = Field(
        1.0, gt=0, description="Radius in which the ratio of passes to returns is averaged [m]"
    )
    touch: float = Field(
        0.5, gt=0, description="Edge of the voxels in which points of one ghost trail are connected [m]"
    )
    clear: float = Field(
        0.4, gt=0, description="Distance from standing points up to which a point touches them [m]"
    )
    clear_share: float = Field(
        0.15,
        gt=0,
        le=1,
        description="Largest fraction of the points of a ghost trail that touch standing points; more of the "
        "edge of a standing object do",
    )
    edge_length: float = Field(
        12.0,
        gt=0,
        description="Largest length of the edge of a standing object [m]; what is longer may be the trail of "
        "a lorry that passed close to standing objects",
    )


def timed_trails(height: Floats, moved: Floats, free: Mask, config: TrafficConfig) -> Mask:
    """Tell which free points (N,) moved by the verdict of mapping; what lies on the ground is ground."""
    return np.asarray(free & (height > config.bottom) & (moved >= config.probability))


@switchable("trails_by_counts", none_of_them)
def moving_points(
    xyz: Floats, height: Floats, features: Features, passed: Floats, free: Mask, config: TrafficConfig
) -> Mask:
    """Tell which free points (N,) belong to trails.

    Most beams also cross the voxels at the edge of a roof without a return, but other points of the roof lie
    beside them. A trail keeps a distance from standing objects; only a long one may pass close to them. What
    goes on above the height of vehicles is a tree.

    Parameters
    ----------
    xyz : (N, 3) float64 [m]
    height : (N,) float64
        Above the ground model [m].
    features : Features
        Neighbours and their distances are used.
    passed : (N,) float
        Beams that passed through the voxel of a point for each that returned from it.
    free : (N,) bool
    config : TrafficConfig
    """
    low = free & (height > config.bottom) & (height < config.top)
    members = np.flatnonzero(low)
    mean = _local_mean(np.log(np.maximum(passed, 0.1)), low, features, members, config.reach)
    often = mean > np.log(config.spread_ratio)
    often[often] = ~_beside_crowns(xyz, height, members[often], free, config)
    open_ = members[often]
    moving = np.zeros(len(xyz), dtype=bool)
    if len(open_) == 0:
        return moving
    sure = (mean > np.log(config.ratio))[often]
    trail = voxel_clusters(xyz[open_], config.touch)
    standing = free & (height > config.bottom)
    standing[open_] = False
    touching = lies_near(xyz[open_], xyz[standing], config.clear)
    sure_share, touching_share = (np.bincount(trail, w) / np.bincount(trail) for w in (sure, touching))
    length = np.array([np.hypot(*np.ptp(xyz[open_[g], :2], axis=0)) for g in group_indices(trail)])
    is_edge = (touching_share > config.clear_share) & (length <= config.edge_length)
    kept = (sure_share > config.core_share) & ~is_edge
    moving[open_[kept[trail]]] = True
    return moving


def _beside_crowns(xyz: Floats, height: Floats, members: Ints, free: Mask, config: TrafficConfig) -> Mask:
    """Tell which of some points (M,) lie in or beside columns that go on above the height of vehicles.

    Of the thin lower part of a crown most beams meet nothing, as they do where a vehicle was for a moment.
    """
    step = 2 * config.touch
    around = np.flatnonzero(free & (height >= config.top - step) & (height < config.top + step))
    column, over = column_keys(xyz[around], config.touch), height[around] >= config.top
    crown = around[over & np.isin(column, column[~over])]
    return lies_near(xyz[members, :2], xyz[crown, :2], step)


@switchable("still_blocks", none_of_them)
def still_blocks(xyz: Floats, core: Mask, moving: Mask, config: TrafficConfig) -> Mask:
    """Tell which points of walls and roofs (N,) stand still: most of their block was not seen through."""
    members = np.flatnonzero(core)
    still = np.zeros(len(xyz), dtype=bool)
    if len(members):
        block = voxel_clusters(xyz[members], config.touch)
        share = np.bincount(block, moving[members]) / np.bincount(block)
        still[members[share[block] < config.block_share]] = True
    return still


def _local_mean(values: Floats, among: Mask, features: Features, members: Ints, reach: float) -> Floats:
    """Mean (M,) of the values (N,) of those neighbours of members (M,) that are in a mask and in reach."""
    neighbours = features.neighbours[members]
    weight = among[neighbours] & (features.distances[members] < reach)
    return np.asarray((values[neighbours] * weight).sum(axis=1) / np.maximum(weight.sum(axis=1), 1))


@switchable("trails_by_shape", zeros_of_them)
def trail_probability(xyz: Floats, height: Floats, config: TrailShapeConfig) -> Floats:
    """Return the probability (N,) that points (N, 3) were left by a moving vehicle.

    Parameters
    ----------
    xyz : (N, 3) float64
        Upright local frame, with some 50 m of surroundings: the length of a trail tells most [m].
    height : (N,) float64
        Above ground [m].
    config : TrailShapeConfig
    """
    chance = np.zeros(len(xyz))
    body = (height > config.bottom) & (height < config.body_top)
    if not body.any():
        return chance
    raster = rasterise(xyz, height, config)
    cells, wide = find_swaths(raster, config)
    cells = with_pieces(with_edges(cells, wide, raster.body, config), raster, SURE, config)
    found = _upward(height, cells, raster.index, config)
    thin = np.flatnonzero(body & (found < _DOUBTFUL))
    found[thin] = np.maximum(found[thin], thin_trails(xyz[thin], raster.index[thin], raster, config))
    return found


def _upward(height: Floats, cells: Floats, index: Ints, config: TrailShapeConfig) -> Floats:
    """Give points (N,) the probability of their cells, upward as far as they hang together."""
    chance = np.where((height > config.bottom) & (height < config.body_top), cells[tuple(index.T)], 0.0)
    reached = chance > 0
    layers = int(np.ceil((config.top - config.body_top) / _LAYER))
    for layer in range(layers):
        low = config.body_top + layer * _LAYER
        below = np.zeros(cells.shape)
        held = reached & (height >= low - _LAYER) & (height < low)
        np.maximum.at(below, tuple(index[held].T), chance[held])
        below = ndimage.grey_dilation(below, footprint=AROUND)
        here = (height >= low) & (height < min(low + _LAYER, config.top))
        chance[here] = below[tuple(index[here].T)]
        reached |= here & (chance > 0)
    low_edge = (height > 0.5 * config.bottom) & (height <= config.bottom)
    chance[low_edge] = cells[tuple(index[low_edge].T)]
    return chance
