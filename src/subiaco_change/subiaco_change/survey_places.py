"""Where the sensor of a bare street survey was: along its way the ground has the most points.

Beams meet the ground at ever flatter angles, so that the points of one sweep thin out with the distance. Seen
from a street the densest strip of ground is the carriageway that was driven. Of a cloud whose points were
thinned to one density, or measured from above, none stands out for certain, and nothing is said.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.spatial import cKDTree

from subiaco_change.method_numbers import NUMBERS
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.free_space.expected_visibility import places_apart

_CELL = NUMBERS.survey_places.cell
_GROUND = NUMBERS.survey_places.ground_height
_RADIUS = NUMBERS.survey_places.mean_radius
_COMPARED = NUMBERS.survey_places.compared_radius
_DENSEST = NUMBERS.survey_places.densest_share
_CAP = NUMBERS.survey_places.cap_percentile
_FILLED = NUMBERS.survey_places.filled_share
_ROUNDS = NUMBERS.survey_places.rounds
_APART = NUMBERS.survey_places.apart
_GAP = NUMBERS.survey_places.gap
_GAP_DENSITY = NUMBERS.survey_places.gap_density
_LEAST = NUMBERS.survey_places.least_places
_BESIDE = NUMBERS.survey_places.beside
_FINE = NUMBERS.survey_places.fineness
_BESIDE_DENSITY = NUMBERS.survey_places.beside_density
_SENSOR = NUMBERS.survey_places.sensor_height


@dataclass(frozen=True)
class GroundDensity:
    """Points of a cloud on the ground of a tile, by cells of ``survey_places.cell``.

    Parameters
    ----------
    cell : (M, 2) int64
        Column and row of a cell in the world.
    points : (M,) int64
        Points of the cloud on the ground there, before they were thinned.
    thinned : (M,) int64
        What was left of them at the working leaf.
    level : (M,) float64
        Mean height of the ground there [m].
    """

    cell: Ints
    points: Ints
    thinned: Ints
    level: Floats


@dataclass(frozen=True)
class SensorPlaces:
    """Places ``xyz`` (K, 3) where the sensor of an epoch probably was, in no order [m, world]."""

    xyz: Floats


def ground_density(xyz: Floats, height: Floats, count: Ints) -> GroundDensity:
    """Count the points on the ground by cells.

    Parameters
    ----------
    xyz : (N, 3) float64
        Thinned points [m, world].
    height : (N,) float64
        Above the ground model [m].
    count : (N,) int
        Points of the cloud that each thinned point stands for.
    """
    low = np.abs(height) < _GROUND
    cell, slot = np.unique(np.floor(xyz[low, :2] / _CELL).astype(np.int64), axis=0, return_inverse=True)
    slot = slot.ravel()
    points = np.bincount(slot, count[low], len(cell)).astype(np.int64)
    thinned = np.bincount(slot, minlength=len(cell))
    return GroundDensity(
        cell.reshape(-1, 2), points, thinned, np.bincount(slot, xyz[low, 2], len(cell)) / thinned
    )


def survey_places(parts: Sequence[GroundDensity]) -> Floats:
    """Return places (K, 3) where the sensor probably was; none where the ground does not tell [m, world].

    Parameters
    ----------
    parts : sequence of GroundDensity
        Of all tiles of the epoch.
    """
    cell = np.concatenate([np.zeros((0, 2), np.int64), *(part.cell for part in parts)])
    if len(cell) == 0:
        return np.zeros((0, 3))
    points = np.concatenate([part.points for part in parts]).astype(np.float64)
    first = cell.min(axis=0)
    at, shape = tuple((cell - first).T), tuple((cell.max(axis=0) - first + 1).tolist())
    dense = np.zeros(shape)
    np.add.at(dense, at, points)
    cap = float(np.percentile(points, _CAP))  # where a vehicle waited it left far more points than on its way
    dense = np.minimum(dense, cap)
    weights = _disc(_RADIUS) / _disc(_RADIUS).sum()
    mean = ndimage.convolve(dense, weights, mode="constant")
    densest = ndimage.maximum_filter(mean, footprint=_disc(_COMPARED), mode="constant")
    strip = np.argwhere((mean >= _DENSEST * densest) & (dense >= _FILLED * cap))
    middle = _middle(strip.astype(np.float64) + 0.5)
    plan = _closed(middle[places_apart(middle, _APART / _CELL)], mean)
    centre = cell - first + 0.5
    thinned = np.concatenate([part.thinned for part in parts])
    if len(plan) < _LEAST or not _stands_out(cKDTree(plan).query(centre)[0] * _CELL, points, thinned):
        return np.zeros((0, 3))
    level = np.concatenate([part.level for part in parts])[cKDTree(centre).query(plan)[1]]
    return np.column_stack([(plan + first) * _CELL, level + _SENSOR])


def _disc(radius: float) -> NDArray[np.bool_]:
    """Return the cells (S, S) of a disc of a radius [m]."""
    reach = int(radius / _CELL)
    across = np.arange(-reach, reach + 1)
    return np.asarray(across[:, None] ** 2 + across**2 <= reach**2)


def _middle(strip: Floats) -> Floats:
    """Draw the cells (M, 2) of a strip together, across it, to its middle."""
    for _ in range(_ROUNDS):
        near = cKDTree(strip).query_ball_point(strip, _RADIUS / _CELL)
        strip = np.array([_on_axis(place, strip[around]) for place, around in zip(strip, near, strict=True)])
    return strip


def _on_axis(place: Floats, around: Floats) -> Floats:
    """Return the point (2,) of the main axis of places (M, 2) that is nearest to one of them (2,)."""
    centre = around.mean(axis=0)
    axis = np.linalg.eigh((around - centre).T @ (around - centre))[1][:, 1]
    return np.asarray(centre + ((place - centre) @ axis) * axis)


def _closed(line: Floats, mean: Floats) -> Floats:
    """Add places to a line (M, 2), in cells, in gaps where the ground is about as dense."""
    if len(line) < 2:
        return line
    index = cKDTree(line)
    near = index.sparse_distance_matrix(index, _GAP / _CELL, output_type="coo_matrix")
    tree = minimum_spanning_tree(near).tocoo()
    lines = [line]
    for one, other, length in zip(tree.row.tolist(), tree.col.tolist(), tree.data.tolist(), strict=True):
        share = np.linspace(0.0, 1.0, int(length * _CELL / _APART) + 1)[1:-1, None]
        places = (1.0 - share) * line[one] + share * line[other]
        ends = _values(mean, line[[one, other]])
        if (_values(mean, places) >= _GAP_DENSITY * ends.min()).all():
            lines.append(places)
    return np.concatenate(lines)


def _values(raster: Floats, places: Floats) -> Floats:
    """Return the cells of a raster at places (M, 2), in cells."""
    column, row = np.clip(places.astype(np.int64), 0, np.array(raster.shape) - 1).T
    return np.asarray(raster[column, row])


def _stands_out(distance: Floats, points: Floats, thinned: Ints) -> bool:
    """Tell whether the ground at the places of the sensor is denser than beside them, whatever thinned it.

    ``distance`` (M,) of the cells from the places [m]; of their ground ``points`` (M,) before and ``thinned``
    (M,) after thinning.
    """
    beside, at = (distance >= _BESIDE[0]) & (distance < _BESIDE[1]), distance < _CELL
    if not beside.any() or points[at].sum() < _FINE * max(thinned[at].sum(), 1):
        return False
    return bool(np.median(points[beside]) <= _BESIDE_DENSITY * np.median(points[at]))
