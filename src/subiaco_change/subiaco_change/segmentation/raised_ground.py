"""Raised ground: fill, platforms and beds that end in a step, lower than anything that stands on wheels.

A ground filter takes what ends in a step all around for an object. What is level, smooth and wide, and at
most some decimetres above the ground beside it, is ground that was raised.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import none_of_them, switchable
from subiaco_change.segmentation.features import Features
from subiaco_change.segmentation.ground_model import Mask
from subiaco_change.segmentation.trail_raster import AROUND
from subiaco_geo.frames import Floats

_CELL = NUMBERS.raised_ground.cell
_LOW, _HIGH = NUMBERS.raised_ground.heights
_LEVEL = NUMBERS.raised_ground.level
_SMOOTH = NUMBERS.raised_ground.roughness
_WIDE = round(NUMBERS.raised_ground.width / _CELL)
_AREA = NUMBERS.raised_ground.area
_NEAR = NUMBERS.raised_ground.same_level


@switchable("raised_ground", none_of_them)
def raised_ground(xyz: Floats, height: Floats, features: Features) -> Mask:
    """Tell which points (N, 3) lie on raised ground.

    Parameters
    ----------
    xyz : (N, 3) float64
        Upright local frame [m].
    height : (N,) float64
        Above the ground model [m].
    features : Features
        Normals and roughness of the points are used.
    """
    found = np.zeros(len(xyz), dtype=bool)
    low = np.flatnonzero((height > _LOW) & (height < _HIGH))
    is_flat = (np.abs(features.normals[low, 2]) > _LEVEL) & (features.roughness[low] < _SMOOTH)
    if not is_flat.any():
        return found
    corner = np.floor(xyz[low, :2].min(axis=0) / _CELL).astype(np.int64)
    index = np.floor(xyz[low, :2] / _CELL).astype(np.int64) - corner
    number, total = np.zeros((2, *(index.max(axis=0) + 1)))
    np.add.at(number, tuple(index[is_flat].T), 1.0)
    np.add.at(total, tuple(index[is_flat].T), height[low[is_flat]])
    wide = ndimage.binary_opening(number > 0, np.ones((_WIDE, _WIDE)))
    labels, count = ndimage.label(wide, AROUND)
    area = np.bincount(labels.ravel(), minlength=count + 1) * _CELL**2
    kept = (area >= _AREA)[labels] & wide
    number, total = (
        ndimage.convolve(np.where(kept, v, 0.0), AROUND, mode="constant") for v in (number, total)
    )
    with np.errstate(invalid="ignore"):
        usual = (total / number)[tuple(index.T)]
        found[low[np.abs(height[low] - usual) < _NEAR]] = True
    return found
