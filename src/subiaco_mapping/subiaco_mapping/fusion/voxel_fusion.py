"""Fusion of registered scans: streaming sums per voxel."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numba
import numpy as np
import small_gicp
from numpy.typing import NDArray

from subiaco_geo.clouds import VOXEL_LIMIT, stable_order
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.voxel_table import EMPTY, empty_table, enter_keys, find_slot
from subiaco_mapping.fusion.config import FusionConfig
from subiaco_mapping.preprocessing.scan_spool import SpooledScan

_COLUMNS = 14
_PART = 1 << 14  # points that are added at a time


@numba.njit(cache=True)
def _accumulate(xyz, intensity, sensor, leaf, index, keys, counts, sums, used):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Add points to their voxels, new ones in the next free rows. Returns the number of voxels.

    Columns of ``sums``: offset from the voxel centre (3), its products xx xy xz yy yz zz (6),
    intensity, direction to the sensor (3), distance from it.
    """
    sx, sy, sz = sensor
    for i in range(len(xyz)):
        x, y, z = xyz[i, 0], xyz[i, 1], xyz[i, 2]
        cx, cy, cz = np.floor(x / leaf), np.floor(y / leaf), np.floor(z / leaf)
        key = (
            ((np.int64(cx) + VOXEL_LIMIT) << 42)
            | ((np.int64(cy) + VOXEL_LIMIT) << 21)
            | (np.int64(cz) + VOXEL_LIMIT)
        )
        slot = find_slot(index, key)
        if index[slot, 0] == EMPTY:
            index[slot, 0], index[slot, 1], keys[used] = key, used, key
            used += 1
        row = index[slot, 1]
        dx, dy, dz = x - (cx + 0.5) * leaf, y - (cy + 0.5) * leaf, z - (cz + 0.5) * leaf
        vx, vy, vz = sx - x, sy - y, sz - z
        reach = max(np.sqrt(vx * vx + vy * vy + vz * vz), 1e-6)
        sums[row, 0] += dx
        sums[row, 1] += dy
        sums[row, 2] += dz
        sums[row, 3] += dx * dx
        sums[row, 4] += dx * dy
        sums[row, 5] += dx * dz
        sums[row, 6] += dy * dy
        sums[row, 7] += dy * dz
        sums[row, 8] += dz * dz
        sums[row, 9] += intensity[i]
        sums[row, 10] += vx / reach
        sums[row, 11] += vy / reach
        sums[row, 12] += vz / reach
        sums[row, 13] += reach
        counts[row] += 1
    return used


@dataclass(frozen=True)
class VoxelStatistics:
    """What was seen in every occupied voxel, in key order.

    Parameters
    ----------
    keys : (V,) int64
    n : (V,) uint32
        Points.
    mean : (V, 3) float64
        [m].
    covariance : (V, 3, 3) float64
        Of the points about their mean [m2].
    intensity : (V,) float32
    view : (V, 3) float64
        Mean direction to the sensor, not normalised.
    reach : (V,) float64
        Mean distance from the sensor [m].
    """

    keys: Ints
    n: NDArray[np.uint32]
    mean: Floats
    covariance: Floats
    intensity: NDArray[np.float32]
    view: Floats
    reach: Floats

    def __len__(self) -> int:
        return len(self.keys)

    def select(self, index: NDArray[Any]) -> VoxelStatistics:
        """Return the voxels of a mask or an index array."""
        return VoxelStatistics(**{f.name: getattr(self, f.name)[index] for f in fields(self)})


class VoxelAccumulator:
    """Streaming sums of points per voxel: rows in the order of the first points, which a hash table finds."""

    def __init__(self, leaf: float, capacity: int = 1 << 16) -> None:
        self.leaf = leaf
        self._used = 0
        self._keys = np.zeros(0, dtype=np.int64)
        self._counts = np.zeros(0, dtype=np.uint32)
        self._sums = np.zeros((0, _COLUMNS))
        self._grow(1 << int(np.ceil(np.log2(max(capacity, 1024)))))

    def __len__(self) -> int:
        return self._used

    def _grow(self, size: int) -> None:
        """Make room for more voxels, a power of two; the table stays half empty."""
        for name in ("_keys", "_counts", "_sums"):
            old = getattr(self, name)
            rows = np.zeros((size, *old.shape[1:]), dtype=old.dtype)
            rows[: self._used] = old[: self._used]
            setattr(self, name, rows)
        self._index = empty_table(2 * size)
        enter_keys(self._keys[: self._used], self._index)

    def add(self, xyz: Floats, intensity: NDArray[np.float32], sensor: Floats) -> None:
        """Add points (N, 3) [m] seen from a sensor position (3,)."""
        if len(xyz) == 0:
            return
        if not np.abs(xyz).max() < self.leaf * (VOXEL_LIMIT - 1):  # NaN neither
            raise InputError("fused map: points are not finite or too far from the local origin")
        for start in range(0, len(xyz), _PART):
            part = slice(start, start + _PART)
            while self._used + _PART > len(self._keys):
                self._grow(2 * len(self._keys))
            self._used = _accumulate(
                xyz[part], intensity[part], sensor, self.leaf, self._index, self._keys, self._counts,
                self._sums, self._used,
            )  # fmt: skip

    def sums(self) -> tuple[Ints, NDArray[np.uint32], Floats]:
        """Return keys (V,), sorted, counts (V,) and sums (V, 14) gathered so far."""
        order = stable_order(self._keys[: self._used])
        return self._keys[order], self._counts[order], self._sums[order]

    def clear(self) -> None:
        """Forget everything; the table keeps its size."""
        self._index.fill(EMPTY)
        self._counts[: self._used] = 0
        self._sums[: self._used] = 0.0
        self._used = 0

    def statistics(self) -> VoxelStatistics:
        """Return what was gathered so far."""
        return statistics_of(*self.sums(), self.leaf)


def statistics_of(keys: Ints, counts: NDArray[np.uint32], sums: Floats, leaf: float) -> VoxelStatistics:
    """Turn keys (V,), counts (V,) and sums (V, 14) of voxels into statistics."""
    mean, covariance, share = _moments(keys, counts, sums, leaf)
    return VoxelStatistics(
        keys=keys,
        n=counts,
        mean=mean,
        covariance=covariance,
        intensity=share[:, 0].astype(np.float32),
        view=share[:, 1:4],
        reach=share[:, 4],
    )


@numba.njit(cache=True, error_model="numpy")
def _moments(
    keys: Ints, counts: NDArray[np.uint32], sums: Floats, leaf: float
) -> tuple[Floats, Floats, Floats]:
    """Return mean (V, 3) and covariance (V, 3, 3) of the points of voxels, and other mean values (V, 5)."""
    size = len(keys)
    mean, covariance, share = np.empty((size, 3)), np.empty((size, 3, 3)), np.empty((size, 5))
    for v in range(size):
        count, column = np.float64(counts[v]), 3
        for axis in range(3):
            index = ((keys[v] >> (42 - 21 * axis)) & ((1 << 21) - 1)) - VOXEL_LIMIT
            mean[v, axis] = (index + 0.5) * leaf + sums[v, axis] / count
        for i in range(3):
            for j in range(i, 3):
                apart = sums[v, column] / count - (sums[v, i] / count) * (sums[v, j] / count)
                covariance[v, i, j] = covariance[v, j, i] = apart
                column += 1
        for k in range(5):
            share[v, k] = sums[v, 9 + k] / count
    return mean, covariance, share


def oriented_normals(xyz: Floats, view: Floats, neighbours: int, threads: int) -> Floats:
    """Return unit normals (N, 3) that look towards the sensor; needs 5 points."""
    cloud = small_gicp.PointCloud(np.ascontiguousarray(xyz))
    small_gicp.estimate_normals(cloud, num_neighbors=neighbours, num_threads=threads)
    normals = np.asarray(cloud.normals())[:, :3].copy()
    normals[(normals * view).sum(axis=1) < 0] *= -1
    return normals


def within(xyz: Floats, max_range: float) -> NDArray[np.bool_]:
    """Mark sensor points (N, 3) within a range [m]."""
    x, y, z = xyz.T
    return np.asarray(x * x + y * y + z * z <= max_range**2)


def visibility_beams(
    scan: SpooledScan, T_local_lidar: Floats, config: FusionConfig, number: int = 0
) -> tuple[Floats, NDArray[np.bool_]]:
    """Choose the beams of a scan that the visibility layer traces.

    Consecutive scans start at different beams. A fixed start would trace the same rings in every scan,
    because the stride divides the number of rings, and nothing between those rings.

    Beams are followed as far as points enter the map. Farther away they would show the gaps of a hedge free
    whose leaves the map does not hold.

    Parameters
    ----------
    scan : SpooledScan
    T_local_lidar : (4, 4) float64
        The local frame's z is up.
    config : FusionConfig
    number : int
        Of the scan in its map.

    Returns
    -------
    ends : (N, 3) float64
        In ``lidar_link`` [m], none farther than ``max_range`` of the configuration.
    returned : (N,) bool
        False where the beam met nothing up to its end.
    """
    stride = config.visibility_stride
    hits, sky = scan.xyz[number % stride :: stride], scan.sky_xyz
    rise = sky @ T_local_lidar[2, :3]
    above = rise > np.sin(np.radians(config.sky_elevation_deg)) * np.linalg.norm(sky, axis=1)
    ends = np.concatenate([hits, sky[above]])
    beyond = ~within(ends, config.max_range)
    ends[beyond] *= config.max_range / np.linalg.norm(ends[beyond], axis=1, keepdims=True)
    return ends, (np.arange(len(ends)) < len(hits)) & ~beyond
