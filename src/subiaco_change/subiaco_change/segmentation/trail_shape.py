"""Ghost trails of moving vehicles in a cloud without counts and times of beams, detected by shape.

A vehicle that moved while it was mapped leaves a swath as wide as itself and many times as long. The swath
is filled from side to side, because the front and the rear of the vehicle were met at every place along it,
and the road beneath was seen as well as the road beside it, before the vehicle came and after it had left.
A standing vehicle is short, hollow, and hides part of the ground beneath it; a hedge, a wall or a barrier
hides all of it.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from subiaco_change.method_numbers import NUMBERS
from subiaco_change.segmentation.thin_trails import thin_trails
from subiaco_change.segmentation.trail_ends import with_pieces
from subiaco_change.segmentation.trail_raster import AROUND, TrailShapeConfig, rasterise
from subiaco_change.segmentation.trail_swaths import SURE, find_swaths, with_edges
from subiaco_geo.frames import Floats, Ints

_LAYER = NUMBERS.trail_shape.layer
_DOUBTFUL = NUMBERS.trail_shape.doubtful


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
