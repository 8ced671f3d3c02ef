"""Smallest rectangles around points seen from above."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.clouds import extent_of, within_box
from subiaco_geo.frames import Floats


def _box(xy: Floats) -> tuple[Floats, Floats]:
    """Coordinates (N, 2) of points along the sides of their smallest rectangle, and its axes (2, 2)."""
    angles = np.radians(np.arange(0, 90, 3.0))
    centred = xy - xy.mean(axis=0)
    towards = [np.stack([np.cos(angles), np.sin(angles)]), np.stack([-np.sin(angles), np.cos(angles)])]
    u, v = centred @ towards[0], centred @ towards[1]
    sides = np.stack([np.ptp(u, axis=0), np.ptp(v, axis=0)])
    best = int(np.argmin(sides[0] * sides[1]))
    order = [0, 1] if sides[0, best] >= sides[1, best] else [1, 0]
    along, axes = ([pair[i][:, best] for i in order] for pair in ((u, v), towards))
    return np.stack(along, axis=1), np.stack(axes, axis=1)


def box_coordinates(xy: Floats) -> Floats:
    """Turn points (N, 2) to the long and short side of their smallest rectangle, tried every 3 deg."""
    return _box(xy)[0]


def in_box_of(points: Floats, places: Floats, margin: float) -> NDArray[np.bool_]:
    """Tell which places (M, 2) lie in the smallest rectangle of points (N, 2), wider by a margin [m]."""
    turned, axes = _box(points)
    low, high = extent_of(turned)
    return within_box((places - points.mean(axis=0)) @ axes, low - margin, high + margin)


def box_sides(xy: Floats) -> tuple[float, float]:
    """Long and short side [m] of that rectangle."""
    long, short = np.ptp(box_coordinates(xy), axis=0).tolist()
    return long, short


def wall_coordinates(xy: Floats, cell: float = 0.25) -> Floats:
    """Turn points (N, 2) to the longer and shorter side of their walls, which need not fill a rectangle.

    Of directions every 3 deg, that in which the points fall into the fewest strips of a width [m].
    """
    return np.asarray((xy - xy.mean(axis=0)) @ longer_axis_first(xy, cell))


def longer_axis_first(xy: Floats, cell: float = 0.25) -> Floats:
    """Rotation (2, 2) whose columns are the directions of the longer and of the shorter side of walls."""
    axes = wall_axes(xy, cell)
    along, across = np.ptp(xy @ axes, axis=0)
    return axes if along >= across else axes[:, ::-1]


def wall_axes(xy: Floats, cell: float = 0.25) -> Floats:
    """Rotation (2, 2) whose columns are the directions of the walls that points (N, 2) are of."""
    centred = xy - xy.mean(axis=0)
    best, found = -1.0, np.eye(2)
    for angle in np.radians(np.arange(0, 90, 3.0)):
        axes = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        uv = centred @ axes
        strips = np.floor((uv - extent_of(uv)[0]) / cell).astype(np.int64)
        score = float(sum((np.bincount(strip).astype(np.float64) ** 2).sum() for strip in strips.T))
        if score > best:
            best, found = score, axes
    return found
