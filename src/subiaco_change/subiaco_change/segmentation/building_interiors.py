"""What was seen through windows and doors: points behind facades, which look like plants.

Curtains, furniture and rear walls scatter as leaves do. From everywhere on the survey path a wall stands
before them, and beams reached them through its openings. A plant in a garden is seen past the house, or
over its fence.
"""

from __future__ import annotations

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
_HIDDEN = NUMBERS.building_interiors.hidden
_LOWEST = NUMBERS.building_interiors.lowest_wall
_LEVELS = 62  # heights of one metre that a number of 64 bits can hold


@switchable("building_interiors", none_of_them)
def inside_facades(xyz: Floats, height: Floats, facade: Mask, free: Mask, sensor: Floats) -> Mask:
    """Tell which free points lie inside buildings.

    Parameters
    ----------
    xyz : (N, 3) float64
        Local, z up [m].
    height : (N,) float64
        Above the ground [m].
    facade : (N,) bool
        Points of the walls of buildings.
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
    highest = np.zeros(shape, dtype=np.int64)
    np.maximum.at(highest, tuple(cell[tall, :2].T), cell[tall, 2])
    # openings are lower than a storey, and above the top of a wall is the sky
    walls |= ((walls << 1) | (walls >> 1)) & ((np.int64(2) << highest) - 1)
    key = (cell[some, 0] * shape[1] + cell[some, 1]) * _LEVELS + cell[some, 2]
    places, place = np.unique(key, return_inverse=True)
    column, level = np.divmod(places, _LEVELS)
    start = np.column_stack([*np.divmod(column, shape[1]), level]) + 0.5
    eyes = (sensor - low) / (_CELL, _CELL, 1.0)
    hidden, looked = _hidden(start, eyes, walls, LOOKED_FROM / _CELL, round(_NEAR / _CELL))
    found[some] = ((looked > 0) & (hidden >= _HIDDEN * looked))[place]
    return found


@numba.njit(cache=True)
def _hidden(start: Floats, eyes: Floats, walls: Ints, sight: float, near: int) -> tuple[Ints, Ints]:
    """Count for each place (P, 3) the sensor places (K, 3) behind a wall, and all within sight, in cells."""
    hidden = np.zeros(len(start), np.int64)
    looked = np.zeros(len(start), np.int64)
    for p in range(len(start)):
        for k in range(len(eyes)):
            dx, dy = eyes[k, 0] - start[p, 0], eyes[k, 1] - start[p, 1]
            far = np.sqrt(dx * dx + dy * dy)
            if far > sight or far < 1.0:
                continue
            looked[p] += 1
            rise = (eyes[k, 2] - start[p, 2]) / far
            for step in range(near, int(far)):
                i = int(np.floor(start[p, 0] + dx / far * step))
                j = int(np.floor(start[p, 1] + dy / far * step))
                if i < 0 or j < 0 or i >= walls.shape[0] or j >= walls.shape[1]:
                    continue
                level = int(np.floor(start[p, 2] + rise * step))
                if 0 <= level < 62 and (walls[i, j] >> level) & 1:
                    hidden[p] += 1
                    break
    return hidden, looked
