"""The fast path: fused maps straight from the ray-cast points at their true poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion

from subiaco_geo.cloud_io import write_cloud
from subiaco_geo.clouds import from_world
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.visibility import save_visibility
from subiaco_geo.voxel_traversal import VisibilityAccumulator
from subiaco_sim.collect import MeanPoints
from subiaco_sim.drives import MAP_CRS, WORLD, Drive, ScanPoints
from subiaco_sim.labels import Labels
from subiaco_sim.lidar import Beams, SimulatedScan
from subiaco_sim.map_errors import MapWarp

VISIBILITY_VOXEL = 0.5
_SKY_RANGE = 40.0  # so far a beam that met nothing proves empty air [m]
_SKY_ELEVATION = np.radians(5.0)  # lower beams may have been swallowed by what they met
_EVERY = 4  # beams walked for the visibility layer: one in so many


class MapFuser:
    """Averages the points of a drive on the working leaf and walks its beams.

    ``building`` tells of every object id whether it is one: those may stand twice.
    """

    def __init__(
        self, leaf: float, drive: Drive, warp: MapWarp, beams: Beams, building: NDArray[np.bool_]
    ) -> None:
        self._points = MeanPoints(leaf)
        self._warp = warp
        self._rays = beams
        self._building = building
        self._doubled = round(drive.scans * (1 - warp.config.duplicates) / 2)
        self._scans = drive.scans
        start = drive.lidar_poses(drive.scan_end_ns()[:1])[0, :3, 3]
        self._origin = np.round(self._mapped(start[None])[0], -1)
        self._beams = VisibilityAccumulator(self._origin, VISIBILITY_VOXEL)

    def _mapped(self, xyz: Floats) -> Floats:
        return WORLD.points_to_map(self._warp.apply(xyz), MAP_CRS)

    def add(self, scan: SimulatedScan, points: ScanPoints) -> None:
        """Add one scan."""
        self._points.add(points.xyz, points.reflectivity, points.object_id)
        self._add_doubles(scan.frame_id, points)
        column = np.nonzero(scan.first.range_mm > 0)[1][::_EVERY]
        sky_row, sky_column = np.nonzero(_sky(scan))
        sky_row, sky_column = sky_row[:: 4 * _EVERY], sky_column[:: 4 * _EVERY]
        eyes = scan.T_enu_lidar[np.concatenate([column, sky_column]), :3, 3]
        turn = scan.T_enu_lidar[sky_column, :3, :3]
        way = np.einsum("nij,nj->ni", turn, self._rays.direction[sky_row, sky_column])
        upward = way[:, 2] > np.sin(_SKY_ELEVATION)
        far = eyes[len(column) :] + _SKY_RANGE * way
        keep = np.concatenate([np.ones(len(column), dtype=np.bool_), upward])
        ends = np.concatenate([points.xyz[::_EVERY], far])[keep]
        both = self._mapped(np.concatenate([eyes[keep], ends]))
        returned = np.arange(len(ends)) < len(column)
        self._beams.add(both[: len(ends)], both[len(ends) :], returned)

    def _add_doubles(self, scan: int, points: ScanPoints) -> None:
        """Let the facades of the middle of the drive stand twice, as after a loop that did not close."""
        if self._warp.config.duplicates <= 0 or not self._doubled <= scan < self._scans - self._doubled:
            return
        facade = self._building[points.object_id]
        aside = self._warp.config.duplicate_offset * np.array([0.8, 0.6, 0.0])
        self._points.add(points.xyz[facade] + aside, points.reflectivity[facade], points.object_id[facade])

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
            self._mapped(xyz),
            MAP_CRS,
            intensity=intensity.astype(np.float32),
            n=count.astype(np.uint32),
            object=object_id.astype(np.int32),
            true_class=labels.semantic[object_id].astype(np.uint8),
            true_change=change,
        )
        write_cloud(directory / "map.ply", cloud)
        save_visibility(directory / "visibility.npz", self._beams.grid())


def _sky(scan: SimulatedScan) -> NDArray[np.bool_]:
    """Return the beams (rows, columns) that met nothing, nor did any beside them."""
    return np.asarray(binary_erosion(scan.first.range_mm == 0, np.ones((3, 3)), border_value=1))
