"""What a drive could see past things that are put in its way."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from subiaco_change.injection.config import SightConfig
from subiaco_change.semantics.ground import Mask
from subiaco_geo.clouds import voxel_indices, voxel_keys
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.raywalk import stop_at_surfaces

_MARGIN = 0.5  # a line that ends so near a point has reached it [m]
_SKIP = 0.5  # nothing stops a line so near its start [m]


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

    def lines(self, points: Floats) -> tuple[Ints, Floats]:
        """Return which point each line looks at (L,), and where it starts (L, 3)."""
        views = min(self.config.views, len(self.poses))
        ranks = np.arange(1, views + 1)
        distance, pose = cKDTree(self.poses).query(
            points, k=ranks, distance_upper_bound=self.config.max_range
        )
        point, view = np.nonzero(np.isfinite(distance))
        return point, self.poses[pose[point, view]]

    def hidden(self, points: Floats, blockers: Floats) -> Mask:
        """Tell which points (N, 3) no pose sees any more past blockers (B, 3)."""
        hidden = np.zeros(len(points), dtype=bool)
        centre = blockers[:, :2].mean(axis=0)
        radius = float(np.linalg.norm(blockers[:, :2] - centre, axis=1).max()) + 1.0
        near = np.flatnonzero(np.linalg.norm(points[:, :2] - centre, axis=1) < self.config.max_range + radius)
        point, starts = self.lines(points[near])
        passing = _passes(starts[:, :2], points[near][point, :2], centre) < radius
        free = np.bincount(point[~passing], minlength=len(near)) > 0
        looked = np.bincount(point, minlength=len(near)) > 0
        ask = passing & ~free[point]
        reached = self._reached(starts[ask], points[near][point[ask]], blockers)
        free |= np.bincount(point[ask][reached], minlength=len(near)) > 0
        hidden[near] = looked & ~free
        return hidden

    def seen(self, points: Floats, surfaces: Floats) -> Mask:
        """Tell which points (N, 3) some pose sees past surfaces (S, 3), the points' own among them."""
        point, starts = self.lines(points)
        reached = self._reached(starts, points[point], surfaces)
        return np.asarray(np.bincount(point[reached], minlength=len(points)) > 0)

    def _reached(self, starts: Floats, targets: Floats, surfaces: Floats) -> Mask:
        if len(starts) == 0:
            return np.empty(0, dtype=bool)
        voxel = self.config.voxel
        origin = np.floor(np.minimum(surfaces.min(axis=0), starts.min(axis=0))) - 2 * voxel
        keys, place = np.unique(voxel_keys(voxel_indices(surfaces - origin, voxel)), return_inverse=True)
        spans = np.tile([np.inf, -np.inf], (len(keys), 1))
        np.minimum.at(spans[:, 0], place, surfaces[:, 2])
        np.maximum.at(spans[:, 1], place, surfaces[:, 2])
        spans += np.array([-voxel / 2, voxel / 2])
        ends = stop_at_surfaces(starts, targets, keys, origin, voxel, skip=_SKIP, spans=spans)
        return np.asarray(np.linalg.norm(ends - targets, axis=1) < _MARGIN)


def _passes(starts: Floats, ends: Floats, centre: Floats) -> Floats:
    """Distance [m] in plan from a point to segments (L, 2)."""
    way = ends - starts
    length2 = np.maximum(np.einsum("ij,ij->i", way, way), 1e-12)
    share = np.clip(np.einsum("ij,ij->i", centre - starts, way) / length2, 0.0, 1.0)
    return np.asarray(np.linalg.norm(starts + share[:, None] * way - centre, axis=1))
