"""Alignment of two levelled submaps of unknown position by correlation from above.

The turn is known to some degrees (descriptor); the shift comes from the correlation of points above
the ground, by FFT, for a few turns about it.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from subiaco_geo.frames import Floats, make_pose
from subiaco_mapping.method_numbers import NUMBERS

CELL = NUMBERS.loop_closure.overlay_cell
_SIZE = NUMBERS.loop_closure.overlay_size
_LARGEST_DEG = NUMBERS.loop_closure.overlay_turn_deg
_STEP_DEG = NUMBERS.loop_closure.overlay_turn_step_deg
_TURNS_DEG = np.arange(-_LARGEST_DEG, _LARGEST_DEG + _STEP_DEG / 2, _STEP_DEG)
_STANDING = NUMBERS.loop_closure.overlay_height


def ground_height(points: Floats) -> float:
    """Return the height of the ground around the origin of levelled points (N, 3) [m]."""
    near = points[np.hypot(points[:, 0], points[:, 1]) < 8.0]
    return float(np.percentile(near[:, 2], 10)) if len(near) else float(points[:, 2].min())


def _seen_from_above(points: Floats, floor: float) -> Floats:
    standing = points[points[:, 2] > floor + _STANDING]
    cells = np.floor(standing[:, :2] / CELL).astype(np.int64) + _SIZE // 2
    inside = ((cells >= 0) & (cells < _SIZE)).all(axis=1)
    image = np.zeros((_SIZE, _SIZE))
    np.add.at(image, tuple(cells[inside].T), 1.0)
    return np.asarray(gaussian_filter(np.minimum(image, 3.0), 1.0))


def overlay(target: Floats, source: Floats, yaw: float) -> Floats:
    """Return the pose (4, 4) that lays levelled ``source`` (N, 3) over ``target`` (M, 3), yaw roughly known.

    Its height is that of the ground under both origins.
    """
    floors = ground_height(target), ground_height(source)
    spectrum = np.fft.rfft2(_seen_from_above(target, floors[0]))
    best, found = -np.inf, np.eye(4)
    for turn in yaw + np.radians(_TURNS_DEG):
        rotation = Rotation.from_rotvec([0.0, 0.0, turn]).as_matrix()
        image = _seen_from_above(source @ rotation.T, floors[1])
        match = np.fft.irfft2(spectrum * np.fft.rfft2(image).conj(), s=image.shape)
        peak = int(match.argmax())
        if match.flat[peak] > best:
            best = float(match.flat[peak])
            shift = np.array(np.unravel_index(peak, match.shape), dtype=np.float64)
            shift = (shift + _SIZE // 2) % _SIZE - _SIZE // 2
            found = make_pose(rotation, [*(shift * CELL), floors[0] - floors[1]])
    return found
