"""Arrangement of the kernel points of a kernel point convolution (Thomas et al. 2019)."""

from __future__ import annotations

from functools import cache

import numpy as np

from subiaco_geo.frames import Floats

_STEPS, _RATE = 2000, 0.01


@cache
def _arrange(count: int) -> Floats:
    rng = np.random.default_rng(count)
    points = rng.normal(size=(count, 3))
    points[0] = 0.0
    for _ in range(_STEPS):
        apart = points[:, None] - points[None]
        distance = np.linalg.norm(apart, axis=2) + np.eye(count)
        push = (apart / distance[:, :, None] ** 3).sum(axis=1)
        move = _RATE * (push - 2.0 * points)
        length = np.linalg.norm(move, axis=1, keepdims=True)
        points += move * np.minimum(1.0, 0.05 / np.maximum(length, 1e-12))
        points[0] = 0.0
    return points / np.linalg.norm(points[1:], axis=1).mean()


def kernel_points(count: int, extent: float) -> Floats:
    """Return kernel points (count, 3): one in the middle, the others repelling each other around it.

    Parameters
    ----------
    count : int
    extent : float
        Mean distance of the others from the middle [m].

    Returns
    -------
    (count, 3) float64
        The same for every layer of one extent.
    """
    return _arrange(count) * extent
