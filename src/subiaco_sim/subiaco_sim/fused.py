"""The fast path: fused maps straight from the ray-cast points at their true poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.cloud_io import write_cloud
from subiaco_geo.clouds import from_world
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.raywalk import VisibilityAccumulator
from subiaco_geo.visibility import save_visibility
from subiaco_sim.collect import MeanPoints
from subiaco_sim.drives import MAP_CRS, WORLD, Drive, ScanPoints
from subiaco_sim.labels import Labels
from subiaco_sim.lidar import SimulatedScan

VISIBILITY_VOXEL = 0.5
_EVERY = 4  # beams walked for the visibility layer: one in so many


class MapFuser:
    """Averages the points of a drive on the working leaf and walks its beams."""

    def __init__(self, leaf: float, drive: Drive) -> None:
        self._points = MeanPoints(leaf)
        start = drive.lidar_poses(drive.scan_end_ns()[:1])[0, :3, 3]
        self._origin = np.round(WORLD.points_to_map(start[None], MAP_CRS)[0], -1)
        self._beams = VisibilityAccumulator(self._origin, VISIBILITY_VOXEL)

    def add(self, scan: SimulatedScan, points: ScanPoints) -> None:
        """Add one scan."""
        self._points.add(points.xyz, points.reflectivity, points.object_id)
        found = scan.first.range_mm > 0
        column = np.nonzero(found)[1][::_EVERY]
        starts = scan.T_enu_lidar[column, :3, 3]
        ends = points.xyz[::_EVERY]
        both = WORLD.points_to_map(np.concatenate([starts, ends]), MAP_CRS)
        self._beams.add(both[: len(starts)], both[len(starts) :])

    def result(self) -> tuple[Floats, Floats, Ints, Ints]:
        """Return mean points (N, 3) in ENU, intensity, object ids and counts."""
        return self._points.result()

    def write(
        self,
        directory: Path,
        labels: Labels,
        fused: tuple[Floats, Floats, Ints, Ints],
        change: NDArray[np.uint8],
    ) -> None:
        """Write map.ply with truth fields, and visibility.npz."""
        xyz, intensity, object_id, count = fused
        cloud = from_world(
            WORLD.points_to_map(xyz, MAP_CRS),
            MAP_CRS,
            intensity=intensity.astype(np.float32),
            n=count.astype(np.uint32),
            object=object_id.astype(np.int32),
            true_class=labels.semantic[object_id].astype(np.uint8),
            true_change=change,
        )
        write_cloud(directory / "map.ply", cloud)
        save_visibility(directory / "visibility.npz", self._beams.grid())
