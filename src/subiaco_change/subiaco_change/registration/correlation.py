"""Correlation of what rises above the ground: the horizontal pose of sparse clouds.

Where points lie a metre apart, the nearest point of the other epoch is a neighbour on the scan pattern
rather than the same leaf. A fit to nearest points is then drawn to a pose at which the two patterns
interlock, up to a point spacing off, and all its blocks agree. A kernel as wide as the spacing sees no
pattern: the sum over all pairs of points (kernel correlation, Tsin and Kanade 2004) has its peak where
crowns lie on crowns.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter

from subiaco_change.geometry import ColumnIndex, build_index, column_range, first_above
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.registration.displaced_starts import PoseSpread
from subiaco_change.registration.plausibility import blocks_of
from subiaco_geo.clouds import unique_cells
from subiaco_geo.frames import Floats, transform_points

_KERNEL = NUMBERS.correlation.kernel
_REACH = NUMBERS.correlation.reach
_RISE = NUMBERS.correlation.rise
_POINTS = NUMBERS.correlation.points
_FEWEST = NUMBERS.correlation.fewest
_GROUPS = NUMBERS.correlation.groups
_ITERATIONS = NUMBERS.correlation.iterations
_STEP = NUMBERS.correlation.longest_step


@dataclass(frozen=True)
class Correlation:
    """Pose at the peak of the correlation, and how surely the peak stands there.

    Parameters
    ----------
    pose : (4, 4) float64
        The start pose, moved by east, north, up and yaw.
    motion : (4,) float64
        That motion about the centre of ``spread`` [m, rad].
    spread : PoseSpread
        Of the motion, from groups of blocks that were correlated separately.
    """

    pose: Floats
    motion: Floats
    spread: PoseSpread


def rising(xyz: Floats, spacing: float) -> NDArray[np.bool_]:
    """Tell which points (N, 3) rise above the lowest points around by more than a spacing [m] explains."""
    cell = 3.0 * spacing
    cells, member = unique_cells(np.floor(xyz[:, :2] / cell).astype(np.int64))
    corner = cells.min(axis=0)
    ij = cells - corner
    lowest = np.full(len(cells), np.inf)
    np.minimum.at(lowest, member, xyz[:, 2])
    ground = np.full(ij.max(axis=0) + 1, np.inf)
    ground[ij[:, 0], ij[:, 1]] = lowest
    ground = minimum_filter(ground, 3, mode="nearest")
    return np.asarray(xyz[:, 2] - ground[ij[:, 0], ij[:, 1]][member] > _RISE * max(spacing, 1.0))


@numba.njit(cache=True)
def _sums(
    points: Floats, starts: NDArray[np.int64], shape: NDArray[np.int64], corner: Floats, cell: float,
    places: Floats, arms: Floats, kernel: float, reach: float, first: Floats, second: Floats, plain: Floats,
) -> float:  # fmt: skip
    """Sum the kernel over pairs, with its gradient (4,) and Hessians (4, 4) by east, north, up, yaw."""
    total = 0.0
    jac = np.zeros(4)
    for n in range(len(places)):
        x, y, z = places[n, 0], places[n, 1], places[n, 2]
        ax, ay = arms[n, 0], arms[n, 1]
        i0, i1 = column_range(x - reach, x + reach, corner[0], cell, shape[0])
        j0, j1 = column_range(y - reach, y + reach, corner[1], cell, shape[1])
        for i in range(i0, i1 + 1):
            for j in range(j0, j1 + 1):
                column = i * shape[1] + j
                start, end = starts[column], starts[column + 1]
                for k in range(first_above(points, start, end, z - reach), end):
                    ez = points[k, 2] - z
                    if ez > reach:
                        break
                    ex, ey = points[k, 0] - x, points[k, 1] - y
                    squared = ex * ex + ey * ey + ez * ez
                    if squared > reach * reach:
                        continue
                    weight = np.exp(-0.5 * squared / (kernel * kernel))
                    total += weight
                    jac[0], jac[1], jac[2], jac[3] = ex, ey, ez, ax * ey - ay * ex
                    for a in range(4):
                        first[a] += weight * jac[a]
                        for b in range(a + 1):
                            second[a, b] += weight * jac[a] * jac[b]
                    plain[0, 0] += weight
                    plain[3, 0] -= weight * ay
                    plain[3, 1] += weight * ax
                    plain[3, 3] += weight * (ax * ax + ay * ay)
    return total


def _climb(index: ColumnIndex, xyz: Floats, centre: Floats, kernel: float) -> Floats | None:
    """Return the motion (4,) of points (N, 3) about a centre to the peak nearby; None without one."""
    motion = np.zeros(4)
    arms0 = xyz - centre
    length = max(float(np.sqrt(np.mean(np.sum(arms0[:, :2] ** 2, axis=1)))), kernel)
    scale = np.array([1.0, 1.0, 1.0, length])
    reach = _REACH * kernel
    for _ in range(_ITERATIONS):
        turn = transform_points(_motion_pose(motion, centre), xyz)
        arms = turn - centre - motion[:3]
        first, second, plain = np.zeros(4), np.zeros((4, 4)), np.zeros((4, 4))
        total = _sums(
            index.xyz, index.starts, index.shape, index.corner, index.cell, turn, arms, kernel, reach,
            first, second, plain,
        )  # fmt: skip
        if total <= 0.0:
            return None
        plain[1, 1] = plain[2, 2] = plain[0, 0]
        plain = np.tril(plain) + np.tril(plain, -1).T
        second = np.tril(second) + np.tril(second, -1).T
        gradient = first / scale
        curved = (plain - second / kernel**2) / np.outer(scale, scale)
        values, vectors = np.linalg.eigh(curved)
        # away from the peak the curvature has the wrong sign: there a mean-shift step climbs
        values = np.where(values > 0.05 * total, values, 0.5 * total)
        step = vectors @ ((vectors.T @ gradient) / values)
        size = float(np.linalg.norm(step))
        step *= min(1.0, _STEP * kernel / max(size, 1e-12))
        motion = motion + step / scale
        if size < 1e-3 * kernel:
            return motion
    return None


def _motion_pose(motion: Floats, centre: Floats) -> Floats:
    """Pose (4, 4) that turns about the vertical through a centre, and shifts."""
    c, s = np.cos(motion[3]), np.sin(motion[3])
    step = np.eye(4)
    step[:2, :2] = [[c, -s], [s, c]]
    step[:3, 3] = centre + motion[:3] - step[:3, :3] @ centre
    return step


def correlate(
    before: Floats, after: Floats, pose: Floats, spacing: float, block: float, seed: int
) -> Correlation | None:
    """Find the peak of the correlation of two clouds (N, 3), (M, 3) near a pose ``T_after_before``.

    Parameters
    ----------
    before, after : float64
        Points of both epochs, evenly thinned [m].
    pose : (4, 4) float64
    spacing : float
        Of the sparser cloud [m]; the kernel follows it.
    block : float
        Edge of the blocks that are drawn into groups for the covariance [m].
    seed : int

    Returns
    -------
    Correlation or None
        None where too little rises above the ground, or no peak is near.
    """
    kernel = _KERNEL * spacing
    standing = [transform_points(pose, before[rising(before, spacing)]), after[rising(after, spacing)]]
    if min(len(part) for part in standing) < _FEWEST:
        return None
    moving, still = standing
    moving = moving[:: -(-len(moving) // _POINTS)]
    index = build_index(still, _REACH * kernel)
    centre = moving.mean(axis=0)
    motion = _climb(index, moving, centre, kernel)
    if motion is None:
        return None
    peak = _motion_pose(motion, centre)
    placed = transform_points(peak, moving)
    about = centre + motion[:3]
    names, member = blocks_of(placed, block, 2.0 * kernel, _GROUPS)
    group = np.random.default_rng(seed).permutation(len(names))[member] % _GROUPS
    parts = [placed[group == k] for k in range(_GROUPS)]
    found = [_climb(index, part, about, kernel) for part in parts if len(part) >= _FEWEST // _GROUPS]
    spread = np.array([own for own in found if own is not None])
    if len(spread) < _GROUPS // 2 + 1:
        return None
    free, covariance = np.array([3, 4, 2]), np.zeros((6, 6))  # the height is left to the ground
    covariance[np.ix_(free, free)] = np.cov(spread[:, [0, 1, 3]].T) / len(spread)
    return Correlation(peak @ pose, motion, PoseSpread(covariance, about))
