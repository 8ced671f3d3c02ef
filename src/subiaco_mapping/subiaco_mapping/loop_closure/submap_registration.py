"""Registration of two submaps, and its checks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import small_gicp

from subiaco_geo.frames import Floats
from subiaco_mapping.loop_closure.config import LoopConfig
from subiaco_mapping.method_numbers import NUMBERS

VOXELS = NUMBERS.loop_closure.distribution_voxels
_ROUGH = NUMBERS.loop_closure.coarse_iterations


@dataclass(frozen=True)
class SubmapRegistration:
    """A registration of two submaps.

    Parameters
    ----------
    T_target_source : (4, 4) float64
    covariance : (6, 6) float64
        Rotation [rad], then translation [m], axes of the source.
    overlap : float
        Share of the source that meets a surface of the target.
    residual : float
        Point to plane, RMS of those that do [m].
    sigma : float
        Weakest direction of the translation [m].
    """

    T_target_source: Floats
    covariance: Floats
    overlap: float
    residual: float
    sigma: float

    def refused(self, config: LoopConfig) -> str | None:
        """Return why it must not be believed; None where it may."""
        if self.overlap < config.min_overlap:
            return "overlap"
        if self.residual > config.max_residual:
            return "residual"
        return "degenerate" if self.sigma > config.max_sigma else None


class PreparedSubmap:
    """A submap ready for registration: voxel distributions, tree, normals."""

    def __init__(self, points: Floats, threads: int = 1) -> None:
        self.points = points
        self.cloud = small_gicp.PointCloud(points)
        small_gicp.estimate_normals_covariances(self.cloud, num_neighbors=12, num_threads=threads)
        self.tree = small_gicp.KdTree(self.cloud, num_threads=threads)
        self.voxels: list[Any] = []
        for size in VOXELS:
            voxels = small_gicp.GaussianVoxelMap(size)
            voxels.insert(self.cloud, np.eye(4))
            self.voxels.append(voxels)


def register(
    target: PreparedSubmap, source: PreparedSubmap, guess: Floats, config: LoopConfig
) -> SubmapRegistration:
    """Register two submaps: voxel distributions coarse to fine, then point to plane."""
    pose = guess
    for size, voxels in zip(VOXELS, target.voxels, strict=True):
        result = small_gicp.align(
            voxels, source.cloud, pose, max_correspondence_distance=2 * size, max_iterations=_ROUGH
        )
        pose = np.asarray(result.T_target_source)
    result = small_gicp.align(
        target.cloud,
        source.cloud,
        target.tree,
        pose,
        registration_type="PLANE_ICP",
        max_correspondence_distance=config.inlier_distance,
        max_iterations=15,
    )
    return _judged(result, len(source.points), config)


def _judged(result: Any, count: int, config: LoopConfig) -> SubmapRegistration:
    inliers = max(int(result.num_inliers), 1)
    variance = max(2.0 * float(result.error) / max(inliers - 6, 1), 1e-6)
    information = np.asarray(result.H) / (variance * config.correlation)
    values, vectors = np.linalg.eigh(0.5 * (information + information.T))
    covariance = (vectors / np.maximum(values, 1e-6)) @ vectors.T
    sigma = float(np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1]))
    floors = np.repeat([np.radians(config.sigma_rotation_deg), config.sigma_translation], 3)
    return SubmapRegistration(
        np.asarray(result.T_target_source),
        covariance + np.diag(floors**2),
        inliers / count,
        float(np.sqrt(variance)),
        sigma,
    )
