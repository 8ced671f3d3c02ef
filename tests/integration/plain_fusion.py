"""Fusion of scans into a map in one piece, without tiles and without moving objects, to compare maps with."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.clouds import PointCloud, from_world
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, transform_points
from subiaco_mapping.fusion.config import FusionConfig
from subiaco_mapping.fusion.outliers import isolated_points
from subiaco_mapping.fusion.voxel_fusion import VoxelAccumulator, oriented_normals


def add_scan(
    accumulator: VoxelAccumulator, xyz: Floats, intensity: NDArray[np.float32], T_local_lidar: Floats
) -> None:
    """Add one deskewed scan (N, 3) in ``lidar_link`` from its pose."""
    accumulator.add(transform_points(T_local_lidar, xyz), intensity, T_local_lidar[:3, 3])


def fused_cloud(
    accumulator: VoxelAccumulator,
    config: FusionConfig,
    threads: int,
    project: Callable[[Floats], Floats],
    rotate: Callable[[Floats, Floats], Floats],
    crs: str | None,
    spacing: float = 0.0,
) -> PointCloud:
    """Finish the map.

    Parameters
    ----------
    accumulator : VoxelAccumulator
    config : FusionConfig
    threads : int
    project : callable
        Local points (N, 3) to the map's world coordinates.
    rotate : callable
        Local points and directions (N, 3) to directions in map axes.
    crs : str or None
    spacing : float
        Of the beams, see :func:`subiaco_mapping.fusion.outliers.beam_spacing` [rad].

    Returns
    -------
    PointCloud
        With intensity, normals, ``n`` and ``spread``: the standard deviation of a voxel's points
        along its normal [m], 0 where ``n`` is 1.

    Raises
    ------
    InputError
        Fewer than 10 voxels are left.
    """
    found = accumulator.statistics()
    found = found.select(found.n >= config.min_points)
    found = found.select(~isolated_points(found.mean, found.reach, spacing, config, threads))
    if len(found) < 10:
        raise InputError(f"fused map: {len(found)} points are left; check range limits and extrinsics")
    normals = oriented_normals(found.mean, found.view, config.normal_neighbours, threads)
    variance = np.einsum("ni,nij,nj->n", normals, found.covariance, normals)
    return from_world(
        project(found.mean),
        crs,
        intensity=found.intensity,
        normals=rotate(found.mean, normals),
        n=found.n,
        spread=np.sqrt(np.maximum(variance, 0.0)).astype(np.float32),
    )
