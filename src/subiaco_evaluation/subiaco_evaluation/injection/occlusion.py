"""Occlusion by injected objects: what a drive could see past them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from subiaco_change.segmentation.ground_model import Mask
from subiaco_evaluation.injection.config import SightConfig
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.free_space.depth_images import DepthImages, ImageGrid, Surfaces, render
from subiaco_geo.free_space.expected_visibility import sample_poses

_BEHIND = 0.5  # so far behind the front of a surface a point still is on it [m]
_NEAREST = 0.5  # nothing hides a point so near the sensor [m]
_STEEPEST = 75.0  # elevation up to which surfaces hide, up and down [deg]


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
        return cls(positions[sample_poses(positions, config.pose_spacing)], config)

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
        centre = blockers.mean(axis=0)
        reach = self.config.max_range + float(np.linalg.norm(blockers - centre, axis=1).max())
        near = np.flatnonzero(np.linalg.norm(self.poses - centre, axis=1) < reach)
        return self._hides(near, blockers, lines, points)

    def hidden(self, points: Floats, blockers: Floats) -> Mask:
        """Tell which points (N, 3) no pose sees any more past blockers (B, 3)."""
        lines = self.lines(points)
        return lines.hidden(self.blocked(lines, points, blockers))

    def seen(self, points: Floats, surfaces: Floats) -> Mask:
        """Tell which points (N, 3) some pose sees past surfaces (S, 3), the points' own among them."""
        lines = self.lines(points)
        used = np.unique(lines.pose).astype(np.int64)
        ends = np.concatenate([points, self.poses[used]])
        low, high = ends.min(axis=0)[:2] - 1.0, ends.max(axis=0)[:2] + 1.0
        near = surfaces[((surfaces[:, :2] > low) & (surfaces[:, :2] < high)).all(axis=1)]
        hidden = self._hides(used, near, lines, points)
        return np.asarray(np.bincount(lines.point[~hidden], minlength=len(points)) > 0)

    def _hides(self, poses: Ints, surfaces: Floats, lines: Lines, points: Floats) -> Mask:
        """Tell which lines (L,) from some of the poses (K,) to points (N, 3) end at surfaces (S, 3)."""
        config, eyes = self.config, self.poses[poses]
        grid = ImageGrid.covering(config.cell_deg, -_STEEPEST, _STEEPEST)
        shown = Surfaces(0.5 * config.width, _NEAREST, config.max_range, 0.0)
        upright = np.tile([0.0, 0.0, 1.0], (len(eyes), 1))
        images = DepthImages(eyes, upright, render(surfaces, eyes, grid, shown), grid)
        image = np.full(len(self.poses), -1, dtype=np.int64)
        image[poses] = np.arange(len(poses))
        return images.hides(points, lines.point, image[lines.pose], _BEHIND)
