"""Scans at their poses to one finished map, tile by tile."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.clouds import PointCloud
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, transform_points
from subiaco_geo.visibility import VisibilityGrid
from subiaco_mapping.config import FusionConfig
from subiaco_mapping.fusion import VoxelStatistics, oriented_normals, walked_beams
from subiaco_mapping.moving import REFERENCE_BEAMS, moving_points, on_the_floor, turn_keys
from subiaco_mapping.outliers import beam_spacing, lonely_points
from subiaco_mapping.projection import Projection
from subiaco_mapping.spool import SpooledScan
from subiaco_mapping.tiles import (
    DiskColumns,
    Recent,
    TurnTiles,
    VisibilityTiles,
    VoxelTiles,
    tile_corner,
    tiles_around,
)

_SHOWN = 100  # one scan in so many shows how far its beams are apart
_FAR = 10_000.0  # a map that begins farther from zero gets an origin of its own [m]


@dataclass(frozen=True)
class FinishedMap:
    """Static points, second returns, what moved, and the visibility layer; arrays mapped from disk."""

    cloud: PointCloud
    last: PointCloud | None
    moving: PointCloud | None
    visibility: VisibilityGrid


class MapFusion:
    """Take scans at their solved poses; memory holds what was touched last.

    Parameters
    ----------
    folder : Path
        For what does not fit; may be removed once the map is written.
    config : FusionConfig
    projection : Projection
    start : (3,) float64
        Local position of the first scan [m].
    """

    def __init__(self, folder: Path, config: FusionConfig, projection: Projection, start: Floats) -> None:
        self._folder, self._config, self._projection = folder, config, projection
        world = projection.points(start[None])[0]
        self._origin = np.round(world, -2) if np.abs(world).max() > _FAR else np.zeros(3)
        edge = max(1, round(config.tile / config.leaf))
        self._reach = min(config.tile_overlap, edge * config.leaf)
        self._edge = edge
        most, voxel = config.active_voxels, config.visibility_voxel
        coarse = max(1, round(config.tile / voxel))
        self._first = VoxelTiles(folder / "first", config.leaf, edge, most)
        self._last = VoxelTiles(folder / "last", config.leaf, edge, most)
        self._turns = TurnTiles(folder / "turns", voxel, coarse, most)
        corner = np.floor(world / 100.0) * 100.0
        self._beams = VisibilityTiles(folder / "visibility", corner, voxel, coarse, 4 * most)
        self._walked, self._scans = 0, 0
        self._statistics = Recent(self._usable)
        self._spacing = 0.0

    def add(self, scan: SpooledScan, pose: Floats, matrix: Floats, offset: Floats) -> None:
        """Add a scan at ``T_local_lidar``; ``world = matrix @ local + offset`` around it."""
        if self._scans % _SHOWN == 0:  # of several sensors the coarsest counts
            self._spacing = max(self._spacing, beam_spacing(scan.xyz, self._config.outlier_neighbours))
        xyz = transform_points(pose, scan.xyz)
        self._first.add(xyz, scan.intensity, pose[:3, 3])
        self._last.add(transform_points(pose, scan.last_xyz), scan.last_intensity, pose[:3, 3])
        self._turns.add(turn_keys(xyz, self._config.visibility_voxel))
        beams, returned = walked_beams(scan, pose, self._config)
        ends = transform_points(pose, beams) @ matrix.T + offset
        origin = matrix @ pose[:3, 3] + offset
        self._beams.add(np.broadcast_to(origin, ends.shape), ends, returned)
        self._walked += len(ends)
        self._scans += 1

    def finish(self, threads: int, report: Callable[[float], None]) -> FinishedMap:
        """Take out outliers and what moved, find normals.

        Raises
        ------
        InputError
            Fewer than 10 voxels are left.
        """
        for store in (self._first, self._last, self._turns, self._beams):
            store.flush()
        self._first.free()
        self._last.free()
        tiles = self._first.tiles
        still, moving = DiskColumns(self._folder / "map"), DiskColumns(self._folder / "moving")
        for done, tile in enumerate(tiles):
            self._finish_tile(tile, threads, still, moving)
            report(done / len(tiles))
        cloud = self._cloud(still)
        if cloud is None or len(cloud) < 10:
            raise InputError(
                f"fused map: {0 if cloud is None else len(cloud)} points are left; check range limits and "
                "extrinsics"
            )
        return FinishedMap(cloud, self._last_returns(), self._cloud(moving), self._beams.grid())

    def _usable(self, tile: int) -> VoxelStatistics:
        found = self._first.statistics(tile)
        return found.select(found.n >= self._config.min_points)

    def _around(self, tile: int) -> tuple[VoxelStatistics, int]:
        """Return the voxels of a tile, how many those are, and behind them its neighbours' within reach."""
        low = tile_corner(tile, self._edge) * self._config.leaf - self._reach
        high = low + self._edge * self._config.leaf + 2 * self._reach
        present = set(self._first.tiles)
        own = self._statistics(tile)
        parts = [own]
        for other in tiles_around(tile):
            if other != tile and other in present:
                found = self._statistics(other)
                xy = found.mean[:, :2]
                near = np.asarray(((xy >= low) & (xy <= high)).all(axis=1))
                parts.append(found.select(near))
        return VoxelStatistics.joined(parts), len(own)

    def _passed(self, xyz: Floats) -> Floats:
        """Return beams passed (N,) for each turn that returned something."""
        if not self._config.moving.enabled:
            return np.zeros(len(xyz))
        passes = self._beams.passes(self._projection.points(xyz)).astype(np.float64)
        scale = min(REFERENCE_BEAMS * self._scans / max(self._walked, 1), 1.0)
        return np.asarray(passes * scale / np.maximum(self._turns.turns(xyz), 1))

    def _finish_tile(self, tile: int, threads: int, still: DiskColumns, moving: DiskColumns) -> None:
        """Write what of a tile moved, and what stays with its normals."""
        (found, own), config = self._around(tile), self._config
        xyz = found.mean
        moved = moving_points(xyz, self._passed(xyz), config.moving) & ~on_the_floor(xyz, config.moving.floor)
        self._write(moving, found.select(np.flatnonzero(moved[:own])))
        keep = ~moved & ~lonely_points(xyz, found.reach, self._spacing, config, threads)
        found, own = found.select(keep), int(keep[:own].sum())
        if own:
            count = config.normal_neighbours
            normals = oriented_normals(found.mean, found.view, count, threads)[:own]
            self._write(still, found.select(np.arange(own)), normals)

    def _write(self, columns: DiskColumns, found: VoxelStatistics, normals: Floats | None = None) -> None:
        if len(found) == 0:
            return
        named: dict[str, NDArray[Any]] = {"intensity": found.intensity, "n": found.n}
        if normals is not None:
            variance = np.einsum("ni,nij,nj->n", normals, found.covariance, normals)
            named["normals"] = self._projection.directions(found.mean, normals)
            named["spread"] = np.sqrt(np.maximum(variance, 0.0)).astype(np.float32)
        columns.append(xyz=self._projection.points(found.mean) - self._origin, **named)

    def _last_returns(self) -> PointCloud | None:
        columns = DiskColumns(self._folder / "last_returns")
        for tile in self._last.tiles:
            self._write(columns, self._last.statistics(tile))
        return self._cloud(columns)

    def _cloud(self, columns: DiskColumns) -> PointCloud | None:
        arrays = columns.arrays()
        if not arrays:
            return None
        xyz = arrays.pop("xyz")
        return PointCloud(xyz, self._origin, self._projection.crs, arrays)
