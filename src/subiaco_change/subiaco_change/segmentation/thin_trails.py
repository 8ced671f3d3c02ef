"""Ghost trails of cyclists and people on foot: thin swaths on open ground, thicker than fences and walls.

A fence, a wall or a hedge of that length hides the ground behind it, and a fence is a plane. A person sways,
and hid any place beside the way for a moment only.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree
from scipy.special import expit

from subiaco_change.method_numbers import NUMBERS
from subiaco_change.segmentation.clustering import group_indices
from subiaco_change.segmentation.ground_model import Mask
from subiaco_change.segmentation.trail_raster import AROUND, Raster, TrailShapeConfig, limited
from subiaco_geo.frames import Floats, Ints

_REACH = NUMBERS.thin_trails.thickness_radius
_LEAST = NUMBERS.thin_trails.fewest_points
_SAMPLE = NUMBERS.thin_trails.thickness_places
_WINDOW = NUMBERS.thin_trails.open_window
_OPEN = NUMBERS.thin_trails.open_quantile


def thin_trails(xyz: Floats, index: Ints, raster: Raster, config: TrailShapeConfig) -> Floats:
    """Return the probability (N,) that points (N, 3) of bodies were left by a cyclist or a person on foot.

    Parameters
    ----------
    xyz : (N, 3) float64
        Points of bodies that no vehicle left [m].
    index : (N, 2) int64
        Their cells.
    raster : Raster
    config : TrailShapeConfig
    """
    chance = np.zeros(len(xyz))
    body = np.zeros(raster.ground.shape, dtype=np.bool_)
    body[tuple(index.T)] = True
    labels, _ = ndimage.label(ndimage.binary_closing(body, AROUND), AROUND)
    open_ground = _open_share(raster.ground, config)
    for number, members in enumerate(group_indices(labels[tuple(index.T)].astype(np.int64))):
        length = float(np.hypot(*np.ptp(xyz[members, :2], axis=0))) if len(members) >= _LEAST else 0.0
        if number == 0 or length < config.thin_length - 6.0 * config.thin_length_scale:
            continue
        rim = int(np.ceil(config.beside / config.cell)) + 1
        low, high = index[members].min(axis=0) - rim, index[members].max(axis=0) + rim + 1
        window = (slice(max(low[0], 0), high[0]), slice(max(low[1], 0), high[1]))
        odds = _lit_odds(labels[window] == number, labels[window] > 0, raster, window, open_ground, config)
        if odds <= 0:
            continue
        spread = _thickness(xyz[members, :2])
        if np.median(spread) < config.thickest:
            thick = limited((float(np.median(spread)) - config.thickness) / config.thickness_scale)
            long = limited((length - config.thin_length) / config.thin_length_scale)
            chance[members] = np.where(spread < config.thickest, expit(2.0 * min(odds, thick, long)), 0.0)
    return chance


def _open_share(ground: Mask, config: TrailShapeConfig) -> float:
    """Share of the cells of open ground that hold ground points: how densely ground was seen at all."""
    size = round(_WINDOW / config.cell)
    share = ndimage.uniform_filter(ground.astype(np.float64), size)[ground]
    return float(np.quantile(share, _OPEN)) if len(share) else 1.0


def _lit_odds(
    cells: Mask,
    bodies: Mask,
    raster: Raster,
    window: tuple[slice, slice],
    open_ground: float,
    config: TrailShapeConfig,
) -> float:
    """Log odds of a trail by the ground beside it, its height, and what is over it."""
    away = ndimage.distance_transform_edt(~cells)
    ring = (away > 1.5) & (away * config.cell < config.beside) & ~bodies
    if not ring.any():
        return -6.0
    ground, tops = raster.ground[window], raster.top[window]
    beside = float(ground[ring].mean())
    lit = limited((beside / open_ground - config.lit) / config.ground_scale)
    reached = tops[cells & np.isfinite(tops)]
    tall = limited((float(np.median(reached)) - config.thin_top) / config.thin_top_scale)
    over = limited((config.overhead - float((tops[cells] > config.body_top).mean())) / config.ground_scale)
    return min(lit, tall, over)


def _thickness(xy: Floats) -> Floats:
    """Return the standard deviation (N,) across a swath at its points (N, 2) [m], told at sampled places."""
    some = xy[:: max(len(xy) // _SAMPLE, 1)]
    tree = cKDTree(xy)
    spread = np.zeros(len(some))
    for number, near in enumerate(tree.query_ball_point(some, _REACH)):
        if len(near) > 2:
            spread[number] = np.sqrt(max(float(np.linalg.eigvalsh(np.cov(xy[near].T))[0]), 0.0))
    return np.asarray(spread[cKDTree(some).query(xy)[1]])
