"""What a drive could see past things that are put in its way."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from subiaco_change.injection.config import SightConfig
from subiaco_change.semantics.ground import Mask
from subiaco_geo.clouds import voxel_indices, voxel_keys
from subiaco_geo.frames import Floats
from subiaco_geo.raywalk import stop_at_surfaces

_MARGIN = 0.5  # a line that ends so near a point has reached it [m]
_SKIP = 0.5  # nothing stops a line so near its start [m]


@dataclass(frozen=True)
class Lines:
    """Lines of sight: which pose looks at which point, (L,) int32 each; ``count`` points are looked at."""

    point: NDArray[np.int32]
    pose: NDArray[np.int32]
    count: int

    def hidden(self, blocked: Mask) -> Mask:
        """Tell which points (count,) were looked at and are not, once these lines (L,) are blocked."""
        looked = np.bincount(self.point, minlength=self.count) > 0
        return np.asarray(looked & (np.bincount(self.point[~blocked], minlength=self.count) == 0))


@dataclass(frozen=True)
class Sight:
    """Places from which a drive looked around.

    Parameters
    ----------
    poses : (M, 3) float64
        Positions of the sensor, local frame of the map [m].
    config : SightConfig
    """

    poses: Floats
    config: SightConfig

    @classmethod
    def of_drive(cls, positions: Floats, config: SightConfig) -> Sight:
        """Take positions (M, 3) in order of time, one every ``pose_spacing``."""
        way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))])
        _, first = np.unique(np.floor(way / config.pose_spacing), return_index=True)
        return cls(positions[first], config)

    def lines(self, points: Floats) -> Lines:
        """Return the lines from the nearest poses to points (N, 3)."""
        views = min(self.config.views, len(self.poses))
        ranks = np.arange(1, views + 1)
        distance, pose = cKDTree(self.poses).query(
            points, k=ranks, distance_upper_bound=self.config.max_range
        )
        point, view = np.nonzero(np.isfinite(distance))
        return Lines(point.astype(np.int32), pose[point, view].astype(np.int32), len(points))

    def blocked(self, lines: Lines, points: Floats, blockers: Floats) -> Mask:
        """Tell which lines (L,) to points (N, 3) end at blockers (B, 3)."""
        centre = blockers[:, :2].mean(axis=0)
        radius = float(np.linalg.norm(blockers[:, :2] - centre, axis=1).max()) + 1.0
        heights = blockers[:, 2].min() - 0.5, blockers[:, 2].max() + 0.5
        shares = _shares(self.poses, points, lines.pose, lines.point, centre, radius, *heights)
        ask = np.flatnonzero(shares[:, 1] > shares[:, 0])
        starts, targets = self.poses[lines.pose[ask]], points[lines.point[ask]]
        entry, leave = (starts + shares[ask, i, None] * (targets - starts) for i in (0, 1))
        ends = self._stopped(entry, leave, blockers, skip=0.0)
        free = (np.linalg.norm(ends - leave, axis=1) < 1e-6) | (
            np.linalg.norm(ends - targets, axis=1) < _MARGIN
        )
        blocked = np.zeros(len(lines.point), dtype=bool)
        blocked[ask] = ~free
        return blocked

    def hidden(self, points: Floats, blockers: Floats) -> Mask:
        """Tell which points (N, 3) no pose sees any more past blockers (B, 3)."""
        lines = self.lines(points)
        return lines.hidden(self.blocked(lines, points, blockers))

    def seen(self, points: Floats, surfaces: Floats) -> Mask:
        """Tell which points (N, 3) some pose sees past surfaces (S, 3), the points' own among them."""
        lines = self.lines(points)
        starts, ends = self.poses[lines.pose], points[lines.point]
        low = np.minimum(starts.min(axis=0), ends.min(axis=0))[:2] - 1.0 if len(starts) else np.zeros(2)
        high = np.maximum(starts.max(axis=0), ends.max(axis=0))[:2] + 1.0 if len(starts) else np.zeros(2)
        near = surfaces[((surfaces[:, :2] > low) & (surfaces[:, :2] < high)).all(axis=1)]
        reached = np.linalg.norm(self._stopped(starts, ends, near, skip=_SKIP) - ends, axis=1) < _MARGIN
        return np.asarray(np.bincount(lines.point[reached], minlength=len(points)) > 0)

    def _stopped(self, starts: Floats, ends: Floats, surfaces: Floats, skip: float) -> Floats:
        """Return where lines (L, 3) -> (L, 3) end at surfaces (S, 3)."""
        if len(starts) == 0 or len(surfaces) == 0:
            return ends
        voxel = self.config.voxel
        origin = np.floor(np.minimum(surfaces.min(axis=0), starts.min(axis=0))) - 2 * voxel
        keys, place = np.unique(voxel_keys(voxel_indices(surfaces - origin, voxel)), return_inverse=True)
        spans = np.tile([np.inf, -np.inf], (len(keys), 1))
        np.minimum.at(spans[:, 0], place, surfaces[:, 2])
        np.maximum.at(spans[:, 1], place, surfaces[:, 2])
        spans += np.array([-voxel / 2, voxel / 2])
        return stop_at_surfaces(starts, ends, keys, origin, voxel, skip=skip, spans=spans)


@numba.njit(cache=True)
def _shares(
    poses: Floats,
    points: Floats,
    pose: NDArray[np.int32],
    point: NDArray[np.int32],
    centre: Floats,
    radius: float,
    low: float,
    high: float,
) -> NDArray[np.float32]:
    """Return which part (L, 2) of every line runs through an upright cylinder, from 0 to 1; none: 0, 0."""
    found = np.zeros((len(pose), 2), dtype=np.float32)
    for i in range(len(pose)):
        start, end = poses[pose[i]], points[point[i]]
        wx, wy, wz = end[0] - start[0], end[1] - start[1], end[2] - start[2]
        cx, cy = centre[0] - start[0], centre[1] - start[1]
        length2 = max(wx * wx + wy * wy, 1e-12)
        middle = (cx * wx + cy * wy) / length2
        aside2 = (middle * wx - cx) ** 2 + (middle * wy - cy) ** 2
        if aside2 >= radius * radius:
            continue
        half = np.sqrt((radius * radius - aside2) / length2)
        first, last = max(middle - half, 0.0), min(middle + half, 1.0)
        if last <= first:
            continue
        z0, z1 = start[2] + first * wz, start[2] + last * wz
        if max(z0, z1) > low and min(z0, z1) < high:
            found[i, 0], found[i, 1] = first, last
    return found
