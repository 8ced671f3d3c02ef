"""Field of view and useful range of a sensor that no map describes, from its cloud and its poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.frames import Floats, Ints
from subiaco_geo.free_space.azimuth_sector import Arcs, estimate_blind_arcs, path_poses
from subiaco_geo.free_space.depth_images import UNKNOWN, DepthImages, Depths, ImageGrid
from subiaco_geo.free_space.expected_visibility import ExpectedVisibilityConfig
from subiaco_geo.free_space.numbers import FREE_SPACE
from subiaco_geo.free_space.sensor_view import SensorView, spin_headings

_ANGLES = np.radians(
    np.arange(0.0, 90.25, FREE_SPACE.elevation_step_deg)
)  # edges of the cells of a histogram of elevations
_STEP = FREE_SPACE.range_step
_EVERY = FREE_SPACE.elevations_per_range
_MOST = FREE_SPACE.view_points
_EDGE = FREE_SPACE.view_edge
_EDGE_TREND = FREE_SPACE.view_edge_trend
_EDGE_POINTS = FREE_SPACE.view_edge_points
_GRAZING = FREE_SPACE.grazing_slack


@dataclass(frozen=True)
class ViewHistogram:
    """What the points of a part of an epoch need of its sensor.

    Parameters
    ----------
    above : (180,) int64
        Points above the sensor by the lowest elevation from which a close pose meets them unhidden.
    ranges : (18, R) int64
        Points by the distance to the nearest pose that meets them below an elevation, every 5 deg of it.
    """

    above: NDArray[np.int64]
    ranges: NDArray[np.int64]


def view_histogram(world: Floats, images: DepthImages, config: ExpectedVisibilityConfig) -> ViewHistogram:
    """Count what points (N, 3) [m, world] need of the sensor whose poses saw them.

    A point was seen by some pose. If the lowest elevation at which any pose meets it unhidden is e, then
    the field of view reaches up to e at least; points that only steep looks reach tell where it ends.
    """
    points = world[:: max(len(world) // _MOST, 1)]
    bins = int(np.ceil(config.max_range / _STEP))
    limits = _ANGLES[_EVERY::_EVERY]
    lowest = np.full(len(points), np.inf)
    nearest = np.full((len(limits), len(points)), np.inf)
    for eye, axis, image in zip(images.eyes, images.axes, images.images, strict=True):
        met, distance, elevation = _met(points, eye, axis, image, images.grid, config)
        close = distance <= config.view_range
        lowest[met[close]] = np.minimum(lowest[met[close]], elevation[close])
        for limit, least in zip(limits, nearest, strict=True):
            below = met[elevation <= limit]
            least[below] = np.minimum(least[below], distance[elevation <= limit])
    ranges = [np.histogram(least[np.isfinite(least)], bins, (0.0, config.max_range))[0] for least in nearest]
    above = np.histogram(lowest[np.isfinite(lowest)], _ANGLES)[0]
    return ViewHistogram(above.astype(np.int64), np.array(ranges, dtype=np.int64))


def _met(
    points: Floats,
    eye: Floats,
    axis: Floats,
    image: Depths,
    grid: ImageGrid,
    config: ExpectedVisibilityConfig,
) -> tuple[Ints, Floats, Floats]:
    """Points that a pose meets unhidden: which, how far [m], and at what elevation in its own axes [rad]."""
    way = points - eye
    distance = np.linalg.norm(way, axis=1)
    near = np.flatnonzero((distance < config.max_range) & (distance > 2.0 * config.min_range))
    way, r = way[near], distance[near]
    row = np.floor((np.arcsin(way[:, 2] / r) - grid.low) / grid.cell).astype(np.int64)
    column = np.floor((np.arctan2(way[:, 1], way[:, 0]) + np.pi) / grid.cell).astype(np.int64)
    inside = (row >= 0) & (row < grid.rows)
    depth = image[np.clip(row, 0, grid.rows - 1), column % grid.columns]
    slack = config.behind + _GRAZING * grid.cell * r
    met = inside & (depth != UNKNOWN) & (r <= 0.01 * depth + slack)
    return near[met], r[met], np.arcsin(np.clip((way[met] @ axis) / r[met], -1.0, 1.0))


def estimate_view(parts: Sequence[ViewHistogram], config: ExpectedVisibilityConfig) -> SensorView:
    """Estimate the sensor from the parts of an epoch; all that the images show where there are no points."""
    low = float(np.radians(config.assumed_low_deg))
    high, reach = float(np.radians(config.image_high_deg)), config.max_range
    above = np.sum([part.above for part in parts], axis=0) if parts else np.zeros(1, dtype=np.int64)
    if above.sum() > 0:
        cell = 1 + min(_quantile(above, config.view_quantile), edge_of_view(above))
        high = float(_ANGLES[cell])
        ranges = np.sum([part.ranges for part in parts], axis=0)
        own = ranges[min(max(-(-cell // _EVERY) - 1, 0), len(ranges) - 1)]
        if own.sum() > 0:
            reach = min(_STEP * (1 + _quantile(own, config.range_quantile)), reach)
    return SensorView(low, high, float(reach))


def blind_arcs(poses: Floats, columns: Floats, useful_range: float) -> Arcs:
    """Estimate the azimuths into which the sensor of an epoch never looked.

    Parameters
    ----------
    poses : (K, 4, 4) float64
        Of the whole epoch [m, world].
    columns : (M, 2) float64
        Horizontal positions that hold points [m, world].
    useful_range : float
        Of the sensor [m].
    """
    chosen = poses[path_poses(poses[:, :3, 3])]
    return estimate_blind_arcs(chosen[:, :2, 3], spin_headings(chosen[:, :3, :3]), columns, useful_range)


def with_blind_arcs(
    view: SensorView, poses: Floats, columns: Floats, config: ExpectedVisibilityConfig
) -> SensorView:
    """Return the view of an epoch with its blind azimuths: those it states, else :func:`blind_arcs`.

    Parameters
    ----------
    view : SensorView
    poses : (K, 4, 4) float64
        Of the whole epoch [m, world].
    columns : (M, 2) float64
        Horizontal positions that hold points [m, world].
    config : ExpectedVisibilityConfig
    """
    if view.blind is not None:
        return view
    return replace(view, blind=blind_arcs(poses, columns, min(view.useful_range, config.max_range)))


def edge_of_view(above: NDArray[np.int64]) -> int:
    """Return the cell of a histogram of elevations beyond which hardly any point lies; the last without such.

    Poses are a sample and images are coarse, so that some points seem to need a higher view than the sensor
    has. At the end of the view the number of points falls from one step to the next. Where high objects
    become rare, it falls over many steps.

    Parameters
    ----------
    above : (N,) int64
        Number of points in every step of the elevation.
    """
    last = len(above) - 1
    pairs = above[:-1] + above[1:]
    cells = np.arange(4, last - 1)
    if len(cells) == 0:
        return last
    under, before, beyond = pairs[cells - 2], pairs[cells - 4], pairs[cells + 1]
    known = (under >= _EDGE_POINTS) & (before <= _EDGE_TREND * under)
    fall = under / np.maximum(beyond, 1)
    known &= fall >= _EDGE
    clearest = int(np.argmax(np.where(known, under * np.log(np.maximum(fall, 1.0)), 0.0)))
    return int(cells[clearest]) if known[clearest] else last


def _quantile(counts: NDArray[np.int64], share: float) -> int:
    """Return the cell of a histogram in which the cumulated share reaches this."""
    total = np.cumsum(counts)
    return int(np.searchsorted(total, share * total[-1]))
