"""What was seen through windows and doors: points behind facades, which look like plants.

Curtains, furniture and rear walls scatter as leaves do. From everywhere on the survey path a wall stands
before them, from some of these places no farther away than a room is deep, and beams reached them through
its openings. A plant in a garden is seen past the house, or over its fence; of a plant behind the house, the
facade is farther away.
"""

from __future__ import annotations

from functools import reduce

import numba
import numpy as np

from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import none_of_them, switchable
from subiaco_change.segmentation.ground_model import Mask
from subiaco_geo.frames import Floats, Ints

_CELL = NUMBERS.building_interiors.cell
#: Distance of the places of the sensor that matter to a point, and between two of them [m].
LOOKED_FROM = NUMBERS.building_interiors.sight
SENSOR_STEP = NUMBERS.building_interiors.sensor_step
_NEAR = NUMBERS.building_interiors.before_point
_DEEP = NUMBERS.building_interiors.deepest
_ROOM = NUMBERS.building_interiors.close
_HIDDEN = NUMBERS.building_interiors.hidden
_LOWEST = NUMBERS.building_interiors.lowest_wall
_OPENING = round(NUMBERS.building_interiors.opening / _CELL)
_DIRECTIONS = 16  # of walls, seen from above
_LEVELS = 62  # heights of one metre that a number of 64 bits can hold


@switchable("building_interiors", none_of_them)
def inside_facades(
    xyz: Floats, height: Floats, building: Mask, facade: Mask, free: Mask, sensor: Floats
) -> Mask:
    """Tell which free points lie inside buildings.

    Parameters
    ----------
    xyz : (N, 3) float64
        Local, z up [m].
    height : (N,) float64
        Above the ground [m].
    building, facade : (N,) bool
        Points of buildings, and those of their walls.
    free : (N,) bool
        Points to decide about.
    sensor : (K, 3) float64
        Places of the sensor [m]; without any, nothing is decided.

    Returns
    -------
    (N,) bool
    """
    found = np.zeros(len(xyz), dtype=bool)
    some = np.flatnonzero(free)
    if len(some) == 0 or len(sensor) == 0 or not facade.any():
        return found
    low = xyz.min(axis=0)
    cell = np.floor((xyz - low) / (_CELL, _CELL, 1.0)).astype(np.int64)
    cell[:, 2] = np.minimum(cell[:, 2], _LEVELS - 1)
    shape = tuple((cell[:, :2].max(axis=0) + 1).tolist())
    top = np.zeros(shape)
    np.maximum.at(top, tuple(cell[facade, :2].T), height[facade])
    tall = facade & (top[tuple(cell[:, :2].T)] >= _LOWEST)
    walls = np.zeros(shape, dtype=np.int64)
    bits = np.left_shift(np.int64(1), cell[tall, 2])
    np.bitwise_or.at(walls, tuple(cell[tall, :2].T), bits)
    # openings are lower than a storey, and above the top of a wall is the sky
    walls |= ((walls << 1) | (walls >> 1)) & _up_to(cell[tall], shape)
    walls |= _across_openings(walls) & _up_to(cell[building & (height >= _LOWEST)], shape)
    key = (cell[some, 0] * shape[1] + cell[some, 1]) * _LEVELS + cell[some, 2]
    places, place = np.unique(key, return_inverse=True)
    column, level = np.divmod(places, _LEVELS)
    start = np.column_stack([*np.divmod(column, shape[1]), level]) + 0.5
    eyes = (sensor - low) / (_CELL, _CELL, 1.0)
    reach = LOOKED_FROM / _CELL, round(_NEAR / _CELL), round(_DEEP / _CELL)
    hidden = _are_hidden(start, eyes, walls, reach, 1.0 - _HIDDEN, _ROOM)
    found[some] = hidden[place]
    return found


def _across_openings(walls: Ints) -> Ints:
    """Levels (I, J) of walls with the openings between walls of one line, in any direction."""
    half = _OPENING // 2
    padded = np.pad(walls, half)
    closed = padded.copy()
    for angle in np.arange(_DIRECTIONS) * np.pi / _DIRECTIONS:
        along = np.outer(np.arange(-half, half + 1), (np.cos(angle), np.sin(angle)))
        ways = np.round(along).astype(int).tolist()
        wide = reduce(np.bitwise_or, (np.roll(padded, way, axis=(0, 1)) for way in ways))
        closed |= reduce(np.bitwise_and, (np.roll(wide, way, axis=(0, 1)) for way in ways))
    return closed[half:-half, half:-half]


def _up_to(cell: Ints, shape: tuple[int, ...]) -> Ints:
    """Levels (I, J) up to the highest of cells (M, 3) in every column, none in a column without any."""
    count = np.zeros(shape, dtype=np.int64)
    np.maximum.at(count, tuple(cell[:, :2].T), cell[:, 2] + 1)
    return (np.int64(1) << count) - 1


@numba.njit(cache=True)
def _are_hidden(
    start: Floats, eyes: Floats, walls: Ints, reach: tuple[float, int, int], most: float, close: float
) -> Mask:
    """Tell which places (P, 3) at most a share of the eyes (K, 3) in sight see past walls, all in cells.

    ``reach``: of sight, and the distances from a place where the search for walls begins, and up to which a
    wall is close. It must be close as seen from the share ``close`` of the eyes.
    """
    sight, first, deep = reach
    hidden = np.zeros(len(start), np.bool_)
    far = np.empty(len(eyes))
    for p in range(len(start)):
        looked = 0
        for k in range(len(eyes)):
            far[k] = np.hypot(eyes[k, 0] - start[p, 0], eyes[k, 1] - start[p, 1])
            looked += 1.0 <= far[k] <= sight
        left, near = int(np.floor(most * looked + 1e-9)), 0
        for k in range(len(eyes)):
            if left < 0:
                break
            if 1.0 <= far[k] <= sight:
                distance = _wall_before(start[p], eyes[k], far[k], walls, first)
                left -= distance < 0
                near += 0 <= distance <= deep
        hidden[p] = looked > 0 and left >= 0 and near >= close * looked
    return hidden


@numba.njit(cache=True)
def _wall_before(place: Floats, eye: Floats, far: float, walls: Ints, first: int) -> int:
    """Return the distance from a place (3,) of the first wall on the way to an eye (3,), -1 for none."""
    step = (eye - place) / far
    for number in range(first, int(far)):
        i, j = int(np.floor(place[0] + step[0] * number)), int(np.floor(place[1] + step[1] * number))
        level = int(np.floor(place[2] + step[2] * number))
        inside = 0 <= i < walls.shape[0] and 0 <= j < walls.shape[1] and 0 <= level < 62
        if inside and (walls[i, j] >> level) & 1:
            return number
    return -1
