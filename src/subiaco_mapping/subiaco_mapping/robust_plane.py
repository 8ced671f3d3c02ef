"""Robust plane through the map points around a control point."""

from __future__ import annotations

import numpy as np

from subiaco_geo.frames import Floats

_ROUNDS = 3


def fit_plane(points: Floats, fewest: int, outlier: float, floor: float) -> Floats | None:
    """Fit the plane z = a x + b y + c by least squares, without the points that lie far from the plane.

    Three rounds; each fits the points that the round before kept.

    Parameters
    ----------
    points : (N, 3) float64
        About the place of interest, z up [m].
    fewest : int
        Smallest number of points that a plane is fitted to.
    outlier : float
        Vertical distance from the plane, in robust standard deviations, beyond which a point is removed.
    floor : float
        Smallest median distance from the plane that is assumed [m], so that points without noise are kept.

    Returns
    -------
    (3,) float64 or None
        Slopes a, b and height c [m]; None where too few points are left, or where they lie on a line.
    """
    kept = np.ones(len(points), dtype=bool)
    design = np.column_stack([points[:, :2], np.ones(len(points))])
    plane = np.zeros(3)
    for _ in range(_ROUNDS):
        if np.count_nonzero(kept) < fewest:
            return None
        plane, _, rank, _ = np.linalg.lstsq(design[kept], points[kept, 2], rcond=None)
        if rank < len(plane):
            return None
        off = np.abs(points[:, 2] - design @ plane)
        kept = off <= outlier * 1.4826 * max(float(np.median(off[kept])), floor)
    return np.asarray(plane, dtype=np.float64)
