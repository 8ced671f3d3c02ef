"""Footprints of buildings as their walls run: right angles in the direction of the building, the area kept.

A footprint of the method is a union of cells along the grid of the map. For the files, the staircase of every
building is replaced by the simplest of some rectilinear outlines that still covers the same place.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import affinity
from shapely.geometry import MultiPolygon, Polygon

from subiaco_geo.frames import Floats

_TOLERANCES = (0.4, 0.75, 1.1)  # simplifications before edges are classed [m]: below, about, above two cells
_LEAST_OVERLAP = 0.8  # IoU with the cells below which an outline is not taken
_CORNER = 0.01  # IoU that a further corner must be worth
_SMALLEST_HOLE = 2.0  # courtyards below this are gaps between points [m2]


def regular_outline(footprint: MultiPolygon) -> MultiPolygon:
    """Return a footprint [m] with right angles and the same area, part by part.

    Notes
    -----
    For several directions (length-weighted direction of the simplified edges, modulo 90 degrees, and the
    smallest rotated rectangle) and tolerances, edges are classed as along or across, runs of one class are
    merged at their weighted mean position, and corners are the intersections. The rectangle around the part
    is a candidate too. The candidate with the best overlap (IoU) less a charge for every corner is scaled
    about its centroid to the area of the part. A part that no candidate covers with an IoU of 0.8 keeps its
    cells, and so does a footprint whose parts would overlap.
    """
    regular = MultiPolygon([_regular_part(part) for part in footprint.geoms])
    return regular if regular.is_valid else footprint


def _regular_part(part: Polygon) -> Polygon:
    if len(part.exterior.coords) <= 5 and not part.interiors:
        return part
    best, best_score = part, -np.inf
    for candidate in _candidates(part):
        overlap = part.intersection(candidate).area / part.union(candidate).area
        score = overlap - _CORNER * len(candidate.exterior.coords)
        if overlap >= _LEAST_OVERLAP and score > best_score:
            best, best_score = candidate, score
    return best


def _candidates(part: Polygon) -> Iterator[Polygon]:
    """Yield outlines of the area of a part; all are valid."""
    centre = part.centroid
    for angle in sorted({*(_direction(part, t) for t in _TOLERANCES[:2]), _rectangle_direction(part)}):
        turned = affinity.rotate(part, -angle, origin=centre, use_radians=True)
        for outline in _rectilinear(turned):
            if not outline.is_valid or outline.area == 0.0:
                continue
            factor = float(np.sqrt(part.area / outline.area))
            scaled = affinity.scale(outline, factor, factor, origin=outline.centroid)
            yield affinity.rotate(scaled, angle, origin=centre, use_radians=True)


def _direction(part: Polygon, tolerance: float) -> float:
    """Direction of the edges modulo 90 degrees [rad], long ones with more weight."""
    edges = np.diff(np.asarray(part.exterior.simplify(tolerance).coords)[:, :2], axis=0)
    squared = (edges**2).sum(axis=1)
    angles = np.arctan2(edges[:, 1], edges[:, 0])
    return round(float(np.angle(np.sum(squared * np.exp(4j * angles)))) / 4.0, 6)


def _rectangle_direction(part: Polygon) -> float:
    corners = np.asarray(shapely.minimum_rotated_rectangle(part).exterior.coords)
    edge = corners[1] - corners[0]
    return round(float(np.angle(np.exp(4j * np.arctan2(edge[1], edge[0])))) / 4.0, 6)


def _rectilinear(turned: Polygon) -> Iterator[Polygon]:
    """Yield outlines along the axes of a part that was turned onto them."""
    yield shapely.box(*turned.bounds)
    for tolerance in _TOLERANCES:
        ring = _merged_ring(np.asarray(turned.exterior.simplify(tolerance).coords)[:-1, :2])
        if ring is None:
            continue
        outline = Polygon(ring)
        for hole in turned.interiors:
            inner = _merged_ring(np.asarray(hole.simplify(tolerance).coords)[:-1, :2])
            if inner is not None and Polygon(hole).area >= _SMALLEST_HOLE and outline.is_valid:
                outline = outline.difference(Polygon(inner).buffer(0))
        if isinstance(outline, Polygon):
            yield outline


def _merged_ring(corners: Floats) -> NDArray[np.float64] | None:
    """Class edges as along x or y, merge runs of one class, and return the corners where they meet."""
    edges = np.roll(corners, -1, axis=0) - corners
    along = np.abs(edges[:, 0]) >= np.abs(edges[:, 1])
    if len(corners) < 4 or along.all() or not along.any():
        return None
    first = int(np.flatnonzero(along != np.roll(along, 1))[0])
    corners, edges, along = np.roll(corners, -first, 0), np.roll(edges, -first, 0), np.roll(along, -first)
    run = np.r_[0, np.cumsum(along[1:] != along[:-1])]
    if run[-1] < 3:
        return None
    length = np.hypot(edges[:, 0], edges[:, 1])
    middle = corners + edges / 2.0
    across = np.where(along, middle[:, 1], middle[:, 0])  # the coordinate that an edge along an axis keeps
    place = np.bincount(run, across * length) / np.bincount(run, length)
    is_along = along[np.r_[0, np.flatnonzero(np.diff(run)) + 1]]
    following = np.roll(place, -1)
    x, y = np.where(is_along, following, place), np.where(is_along, place, following)
    return np.stack([x, y], axis=1)
