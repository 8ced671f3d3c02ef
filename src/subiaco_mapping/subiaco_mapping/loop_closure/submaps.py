"""Submaps: the scans of some metres of road, thinned, on disk until they are compared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import small_gicp

from subiaco_geo.frames import Floats, invert_pose
from subiaco_mapping.loop_closure.config import LoopConfig
from subiaco_mapping.measurements import DeskewedScan, OdometryPose
from subiaco_mapping.pose_graph.upright_walls import WallPieces, wall_pieces


@dataclass(frozen=True)
class Submap:
    """Points of some metres of road in ``lidar_link`` of the scan ``anchor``, in ``path``."""

    anchor: int
    way: float  # driven until the anchor [m]
    path: Path

    def points(self) -> Floats:
        """Read the points (N, 3) [m]."""
        return np.asarray(np.load(self.path), dtype=np.float64)

    @cached_property
    def wall_pieces(self) -> WallPieces:
        """Flat pieces of the size of a wall; found once."""
        return wall_pieces(self.points())


class SubmapBuilder:
    """Collect registered scans of one sequence into submaps.

    Parameters
    ----------
    config : LoopConfig
    folder : Path
        Where the points go.
    """

    def __init__(self, config: LoopConfig, folder: Path) -> None:
        self._config, self._folder = config, folder
        self.done: list[Submap] = []
        self._count = 0
        self._way = 0.0
        self._last: OdometryPose | None = None
        self._start()

    def _start(self) -> None:
        self._begin = self._way
        self._taken = -np.inf
        self._parts: list[tuple[int, float, Floats, Floats]] = []  # scan, way, pose, points

    def _path(self, number: int) -> Path:
        return self._folder / f"{number:05d}.npy"

    def restore(self, anchors: Sequence[int], ways: Sequence[float]) -> None:
        """Take the submaps of a finished sequence, whose points are written already."""
        pairs = zip(anchors, ways, strict=True)
        self.done = [Submap(anchor, way, self._path(k)) for k, (anchor, way) in enumerate(pairs)]

    def add(self, pose: OdometryPose, scan: DeskewedScan) -> None:
        """Take the next scan."""
        index, self._count = self._count, self._count + 1
        if self._last is not None:
            step = pose.T_odom_lidar[:3, 3] - self._last.T_odom_lidar[:3, 3]
            self._way += float(np.linalg.norm(step))
            if pose.segment != self._last.segment:
                self._start()
        self._last = pose
        if not pose.predicted and self._way - self._taken >= self._config.scan_spacing:
            self._taken = self._way
            near = scan.xyz[(scan.xyz**2).sum(axis=1) < self._config.radius**2]
            thin = small_gicp.voxelgrid_sampling(near, self._config.leaf).points()[:, :3]
            self._parts.append((index, self._way, pose.T_odom_lidar, thin))
        if self._way - self._begin >= self._config.submap_length and self._parts:
            self._finish()
            self._start()

    def _finish(self) -> None:
        index, way, anchor, _ = self._parts[len(self._parts) // 2]
        moved = []
        for _, _, pose, points in self._parts:
            T_anchor_scan = invert_pose(anchor) @ pose
            moved.append(points @ T_anchor_scan[:3, :3].T + T_anchor_scan[:3, 3])
        cloud = small_gicp.voxelgrid_sampling(np.concatenate(moved), self._config.leaf)
        self._folder.mkdir(parents=True, exist_ok=True)
        path = self._path(len(self.done))
        np.save(path, cloud.points()[:, :3].astype(np.float32))
        self.done.append(Submap(index, way, path))
