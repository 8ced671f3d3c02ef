"""Fragments of ghost trails: where few beams met a moving vehicle, its trail falls apart into small pieces.

A piece belongs to a trail that is known if it lies in line with the trail, near it or near a piece that does,
and on ground that was seen. A vehicle that stands at the end of a trail is larger than a piece.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from subiaco_change.method_numbers import NUMBERS
from subiaco_change.segmentation.clustering import group_indices
from subiaco_change.segmentation.ground_model import Mask
from subiaco_change.segmentation.trail_raster import AROUND, Raster, TrailShapeConfig
from subiaco_geo.frames import Floats, Ints

_DIRECTION = NUMBERS.trail_ends.direction_reach
_STRAIGHT = NUMBERS.trail_ends.straightness
_BLOCK = NUMBERS.trail_ends.block
_ROUNDS = NUMBERS.trail_ends.most_pieces


def with_pieces(cells: Floats, raster: Raster, sure: float, config: TrailShapeConfig) -> Floats:
    """Return the probability of cells (rows, columns), with pieces that continue sure trails.

    Parameters
    ----------
    cells : (rows, columns) float64
        Probability that the bodies of cells moved.
    raster : Raster
    sure : float
        Probability from which a cell belongs to a trail; pieces get it.
    config : TrailShapeConfig
    """
    labels, count = _pieces(raster.body & (cells < sure), config)
    known = np.argwhere(cells >= sure).astype(np.float64) * config.cell
    if count == 0 or len(known) == 0:
        return cells
    index = np.argwhere(labels > 0)
    number = labels[tuple(index.T)]
    places = index.astype(np.float64) * config.cell
    open_pieces = _candidates(labels, count, raster, config)
    pieces = {k: places[m] for k, m in enumerate(group_indices(number)) if open_pieces[k]}
    found = cells.copy()
    for _ in range(_ROUNDS):
        tree = cKDTree(known)
        joined = [k for k in sorted(pieces) if _continues(pieces[k], known, tree, config)]
        if not joined:
            break
        found[np.isin(labels, joined)] = sure
        known = np.concatenate([known, *(pieces.pop(k) for k in joined)])
    return found


def _pieces(bodies: Mask, config: TrailShapeConfig) -> tuple[Ints, int]:
    """Give numbers to the pieces (rows, columns) of bodies, without what may be a standing vehicle."""
    groups, count = ndimage.label(bodies, AROUND)
    area = np.bincount(groups.ravel(), minlength=count + 1) * config.cell**2
    extent = [0.0] + [
        config.cell * max(part.stop - part.start for part in found) for found in ndimage.find_objects(groups)
    ]
    vehicle = (area >= config.piece) & (np.array(extent) < config.piece_length)
    edge = max(round(_BLOCK / config.cell), 1)
    row, column = (np.arange(size) // edge for size in bodies.shape)
    block = row[:, None] * (column.max() + 1) + column[None, :]
    key = np.where(bodies & ~vehicle[groups], groups * (block.max() + 1) + block + 1, 0)
    values, labels = np.unique(key, return_inverse=True)
    labels = labels.reshape(key.shape) + int(values[0] > 0)
    return labels.astype(np.int64), int(labels.max())


def _candidates(labels: Ints, count: int, raster: Raster, config: TrailShapeConfig) -> Mask:
    """Tell which pieces (count + 1,) lie on seen ground and are as low as a car."""
    numbers = np.arange(count + 1)
    seen = ndimage.maximum_filter(raster.ground, 3).astype(np.float64)
    on_ground = np.asarray(ndimage.mean(seen, labels, numbers)) >= config.ground
    low = np.asarray(ndimage.maximum(raster.top, labels, numbers)) < config.body_top
    candidates = np.asarray(on_ground & low)
    candidates[0] = False
    return candidates


def _continues(piece: Floats, known: Floats, tree: cKDTree, config: TrailShapeConfig) -> bool:
    """Tell whether a piece (N, 2) lies near known cells of trails (M, 2), in line with them [m]."""
    distance, nearest = tree.query(piece, distance_upper_bound=config.piece_gap)
    if not np.isfinite(distance).any():
        return False
    start = known[nearest[int(np.argmin(distance))]]
    around = known[tree.query_ball_point(start, _DIRECTION)]
    values, axes = np.linalg.eigh(np.cov(around.T)) if len(around) > 2 else (np.ones(2), np.eye(2))
    if values[1] < _STRAIGHT**2 * max(values[0], 1e-9):
        return False
    aside = np.abs((piece - around.mean(axis=0)) @ axes[:, 0])
    return bool(aside.max() <= config.piece_aside)
