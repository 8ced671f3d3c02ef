"""Finishing of the fused map, tile by tile."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.clouds import PointCloud, within_box
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, transform_points
from subiaco_geo.movement import stood, verdicts
from subiaco_geo.visibility import NO_VERDICT, SURELY_MOVED, TimeRecord, VisibilityGrid
from subiaco_mapping.fusion.config import FusionConfig
from subiaco_mapping.fusion.dynamic_objects import fragment_shares, height_above_floor, moved_probability
from subiaco_mapping.fusion.full_density import DensityTiles, FullDensity
from subiaco_mapping.fusion.outliers import beam_spacing, isolated_points
from subiaco_mapping.fusion.projection import Projection
from subiaco_mapping.fusion.voxel_fusion import (
    VoxelStatistics,
    oriented_normals,
    visibility_beams,
    within,
)
from subiaco_mapping.fusion.voxel_tiles import (
    DiskColumns,
    Recent,
    VisibilityTiles,
    VoxelTiles,
    tile_corner,
    tiles_around,
)
from subiaco_mapping.method_numbers import NUMBERS
from subiaco_mapping.preprocessing.scan_spool import SpooledScan

_SHOWN = NUMBERS.fusion.beam_sample
_TURN_NS = 100_000_000  # between scans without stamps
_FAR = 10_000.0  # a map that begins farther from zero gets an origin of its own [m]


class _Clock:
    """Numbers the time windows (length [ns]) of scans from 1; without stamps scans come ten a second."""

    def __init__(self, length_ns: int) -> None:
        self._length_ns = length_ns
        self._last_ns: int | None = None
        self.start_ns = 0

    def window(self, stamp_ns: int | None) -> int:
        """Return the window of the next scan."""
        if stamp_ns is None:
            stamp_ns = 0 if self._last_ns is None else self._last_ns + _TURN_NS
        if self._last_ns is None:
            self.start_ns = stamp_ns
        self._last_ns = stamp_ns
        return (stamp_ns - self.start_ns) // self._length_ns + 1


@dataclass(frozen=True)
class FinishedMap:
    """Static points, second returns, moving objects, visibility layer; arrays mapped from disk."""

    cloud: PointCloud
    last: PointCloud | None
    moving: PointCloud | None
    visibility: VisibilityGrid


class MapFusion:
    """Take scans at their solved poses; memory holds what was touched last.

    Voxels lie on whole multiples of the leaf in the CRS of the map, so that maps of one place have the same
    voxels in every epoch, and no voxel of 0.25 m belongs to two cells of a grid of 0.5 m.

    Parameters
    ----------
    folder : Path
        For what does not fit; may be removed once the map is written.
    config : FusionConfig
    projection : Projection
    start : (3,) float64
        Local position of the first scan [m].
    density : FullDensity, optional
        Where every return is written too.
    """

    def __init__(
        self,
        folder: Path,
        config: FusionConfig,
        projection: Projection,
        start: Floats,
        density: FullDensity | None = None,
    ) -> None:
        self._folder, self._config, self._crs = folder, config, projection.crs
        world = projection.points(start[None])[0]
        self._origin = np.round(world, -2) if np.abs(world).max() > _FAR else np.zeros(3)
        edge = max(1, round(config.tile / config.leaf))
        self._reach = min(config.tile_overlap, edge * config.leaf)
        self._edge = edge
        most, voxel = config.active_voxels, config.visibility_voxel
        coarse = max(1, round(config.tile / voxel))
        self._first = VoxelTiles(folder / "first", config.leaf, edge, most)
        self._last = VoxelTiles(folder / "last", config.leaf, edge, most)
        corner = np.floor(world / 100.0) * 100.0
        least = config.moving.least_beams
        self._beams = VisibilityTiles(folder / "visibility", corner, voxel, coarse, 2 * most, least)
        self._clock = _Clock(round(config.moving.window * 1e9))
        self._scans = 0
        self._classify = None if density is None else density.classify
        self._density = (
            None
            if density is None
            else DensityTiles(density, folder / "density", config.leaf, edge, self._crs, self._origin)
        )
        self._statistics = Recent(self._usable)
        self._spacing = 0.0
        self._fragments: list[Floats] = []

    def add(
        self,
        scan: SpooledScan,
        pose: Floats,
        matrix: Floats,
        offset: Floats,
        stamp_ns: int | None = None,
        source: int = 1,
    ) -> None:
        """Add a scan; scans come in the order of their stamps.

        Parameters
        ----------
        scan : SpooledScan
        pose : (4, 4) float64
            ``T_local_lidar``.
        matrix : (3, 3) float64
        offset : (3,) float64
            World coordinates around the scan are ``matrix @ local + offset`` [m].
        stamp_ns : int, optional
            Without a stamp, the scan is a tenth of a second later than the scan before.
        source : int
            Number of the recording, from 1.
        """
        in_map = np.eye(4)
        in_map[:3, :3], in_map[:3, 3] = matrix @ pose[:3, :3], matrix @ pose[:3, 3] + offset - self._origin
        eye = in_map[:3, 3]
        if self._density is not None:
            self._density.add(scan, in_map, stamp_ns or 0, source)
        if self._scans % _SHOWN == 0:  # of several sensors the coarsest counts
            self._spacing = max(self._spacing, beam_spacing(scan.xyz, self._config.outlier_neighbours))
        near, last = (
            np.flatnonzero(within(found, self._config.max_range)) for found in (scan.xyz, scan.last_xyz)
        )
        xyz = transform_points(in_map, scan.xyz.take(near, axis=0))  # faster than by a mask
        self._first.add(xyz, scan.intensity[near], eye)
        self._last.add(transform_points(in_map, scan.last_xyz[last]), scan.last_intensity[last], eye)
        beams, returned = visibility_beams(scan, pose, self._config, self._scans)
        ends = transform_points(in_map, beams) + self._origin
        starts, hits = np.broadcast_to(eye + self._origin, ends.shape), xyz + self._origin
        self._beams.add(starts, ends, returned, hits, self._clock.window(stamp_ns))
        self._scans += 1

    def finish(
        self, threads: int, report: Callable[[float], None], recordings: dict[int, str] | None = None
    ) -> FinishedMap:
        """Remove outliers and moving objects, compute normals; ``recordings`` by number, for their returns.

        Raises
        ------
        InputError
            Fewer than 10 voxels are left.
        """
        for store in (self._first, self._last, self._beams):
            store.flush()
            store.free()
        self._layer = self._judged()
        tiles = self._first.tiles
        still, moving = DiskColumns(self._folder / "map"), DiskColumns(self._folder / "moving")
        for done, tile in enumerate(tiles):
            self._finish_tile(tile, threads, still, moving)
            report(done / len(tiles))
        self._record_fragments()
        cloud = self._cloud(still)
        if self._density is not None:
            self._density.finish(recordings or {})
        if cloud is None or len(cloud) < 10:
            raise InputError(
                f"fused map: {0 if cloud is None else len(cloud)} points are left; check range limits and "
                "extrinsics"
            )
        return FinishedMap(cloud, self._last_returns(), self._cloud(moving), self._layer)

    def _judged(self) -> VisibilityGrid:
        """Return the visibility layer with the verdict on every voxel."""
        (grid, looks), config = self._beams.grid(), self._config.moving
        moving = verdicts(grid.keys, looks, config)
        times = TimeRecord(config.window, self._clock.start_ns, looks)
        return replace(grid, moving=moving, times=times)

    def _record_fragments(self) -> None:
        """Write the probability of fragments of moving objects to their voxels of the visibility layer."""
        verdict = self._layer.moving
        if verdict is None or not self._fragments:
            return
        slot, found = self._layer.slots(np.concatenate(self._fragments))
        hit = slot[found]
        lifted = np.uint8(round(NUMBERS.fusion.fragment_moved * SURELY_MOVED))
        verdict[hit] = np.where(verdict[hit] == NO_VERDICT, NO_VERDICT, np.maximum(verdict[hit], lifted))

    def _usable(self, tile: int) -> VoxelStatistics:
        found = self._first.statistics(tile)
        usable = found.n >= self._config.min_points
        return found if usable.all() else found.select(usable)

    def _around(self, tile: int) -> tuple[Floats, Floats, Floats]:
        """Return places (N, 3), directions to the sensor (N, 3) and distances from it (N,) of voxels.

        The voxels of a tile come first, then those of its neighbours within reach.
        """
        low = tile_corner(tile, self._edge) * self._config.leaf - self._reach
        high = low + self._edge * self._config.leaf + 2 * self._reach
        present = set(self._first.tiles)
        own = self._statistics(tile)
        parts = [(own.mean, own.view, own.reach)]
        for other in tiles_around(tile):
            if other != tile and other in present:
                found = self._statistics(other)
                near = np.flatnonzero(within_box(found.mean[:, :2], low, high))
                parts.append((found.mean.take(near, axis=0), found.view[near], found.reach[near]))
        mean, view, reach = (np.concatenate(columns) for columns in zip(*parts, strict=True))
        return mean, view, reach

    def _moved(self, xyz: Floats) -> NDArray[np.float32]:
        """Return the probability (N,) that the points moved; NaN where nothing is known."""
        found = self._layer.moved(xyz + self._origin)
        assert found is not None  # the layer was made with times
        return found

    def _stood(self, xyz: Floats) -> NDArray[np.bool_]:
        """Tell at which places (N, 3) something stood."""
        slot, found = self._layer.slots(xyz + self._origin)
        assert self._layer.times is not None  # the layer was made with times
        found[found] = stood(self._layer.times.looks.select(slot[found]), self._config.moving)
        return found

    def _finish_tile(self, tile: int, threads: int, still: DiskColumns, moving: DiskColumns) -> None:
        """Write what of a tile moved, and what stays with its normals."""
        (xyz, view, reach), found, config = self._around(tile), self._statistics(tile), self._config
        own = len(found)
        above = height_above_floor(xyz)
        probability = moved_probability(xyz, above, self._moved, config.visibility_voxel)
        probability[above < config.moving.floor] = 0.0
        moved = config.moving.enabled & (np.nan_to_num(probability) >= config.moving.sure)
        shares = fragment_shares(xyz, above, moved, self._stood, config.visibility_voxel)
        fragment = shares >= NUMBERS.fusion.fragment_share
        probability[fragment] = np.fmax(probability[fragment], NUMBERS.fusion.fragment_moved)
        self._fragments.append(xyz[:own][fragment[:own]] + self._origin)
        self._write(moving, found.select(np.flatnonzero(moved[:own])))
        isolated = isolated_points(xyz, reach, self._spacing, config, threads)
        keep = np.flatnonzero(~moved & ~isolated)
        kept = keep[: np.searchsorted(keep, own)]  # of the tile itself
        if self._density is not None:
            self._finish_density(tile, found, xyz, isolated & ~moved, moved, probability)
        if len(kept):
            xyz, view = xyz.take(keep, axis=0), view.take(keep, axis=0)
            normals = oriented_normals(xyz, view, config.normal_neighbours, threads)[: len(kept)]
            self._write(still, found.select(kept), normals, moving=probability[kept])

    def _finish_density(
        self,
        tile: int,
        found: VoxelStatistics,
        xyz: Floats,
        removed: NDArray[np.bool_],
        moved: NDArray[np.bool_],
        probability: NDArray[np.float32],
    ) -> None:
        """Write the returns of a tile with the classes of its voxels, the first of ``xyz`` (N, 3)."""
        assert self._density is not None
        own = len(found)
        kept, semantic = np.flatnonzero(~(removed | moved)), None
        inside = int((kept < own).sum())
        if self._classify is not None and inside:
            cloud = PointCloud(xyz[kept], self._origin, self._crs)
            semantic = self._classify(cloud, np.nan_to_num(probability[kept]).astype(np.float64))[:inside]
        classes = self._density.classes(found.keys, removed[:own], moved[:own], semantic)
        self._density.finish_tile(tile, classes)

    def _write(
        self,
        columns: DiskColumns,
        found: VoxelStatistics,
        normals: Floats | None = None,
        **fields: NDArray[Any],
    ) -> None:
        if len(found) == 0:
            return
        named: dict[str, NDArray[Any]] = {"intensity": found.intensity, "n": found.n, **fields}
        if normals is not None:
            variance = np.einsum("ni,nij,nj->n", normals, found.covariance, normals)
            named["normals"] = normals
            named["spread"] = np.sqrt(np.maximum(variance, 0.0)).astype(np.float32)
        columns.append(xyz=found.mean, **named)

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
        return PointCloud(xyz, self._origin, self._crs, arrays)
