"""Settings of the odometry."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from pydantic import Field

from subiaco_geo.config import StrictModel


class OdometryConfig(StrictModel):
    """Scan to local map (kiss-icp core)."""

    FORMER_NAMES: ClassVar[Mapping[str, str]] = {
        "gicp_voxel": "gicp_voxel",
        "look_distance": "gicp_distance",
        "look_iterations": "gicp_iterations",
        "look_leaf": "gicp_leaf",
    }

    voxel: float = Field(
        1.0,
        gt=0,
        description="Edge of the voxels of the local map [m]; 1.0 was measured best with gyro deskewing",
    )
    max_range: float = Field(100.0, gt=0, description="Radius of the local map [m]")
    max_points_per_voxel: int = Field(
        20, ge=1, description="Largest number of points kept in a voxel of the local map"
    )
    max_iterations: int = Field(50, ge=1, description="Largest number of ICP iterations per scan")
    convergence: float = Field(
        1e-2,
        gt=0,
        description="Norm of the ICP update at which iterations stop [1]; use 5e-4 if refine is off",
    )
    initial_threshold: float = Field(
        2.0, gt=0, description="Kernel width of ICP while the motion is unknown [m]"
    )
    min_threshold: float = Field(0.3, gt=0, description="Smallest kernel width of ICP [m]")
    threshold_memory: float = Field(
        0.8,
        ge=0,
        lt=1,
        description="Fraction of the squared kernel width that is kept from scan to scan; raise it for "
        "slower adaptation",
    )
    gicp_voxel: float = Field(
        1.0, gt=0, description="Edge of the voxels of the Gaussian map for the plane-to-plane refinement [m]"
    )
    gicp_distance: float = Field(
        1.0,
        gt=0,
        description="Largest correspondence distance of the plane-to-plane refinement [m]; smaller while "
        "the motion is predictable",
    )
    gicp_iterations: int = Field(
        10, ge=1, description="Largest number of iterations of the plane-to-plane refinement"
    )
    gicp_leaf: float = Field(
        0.75, gt=0, description="Voxel edge to which a scan is thinned for the plane-to-plane refinement [m]"
    )
    refine: bool = Field(
        True,
        description="Use the pose of the plane-to-plane refinement; otherwise the refinement gives the "
        "covariance only",
    )
    correlation: float = Field(
        30.0,
        ge=1,
        description="Number of points of a scan with one common error; the variance is multiplied by this "
        "factor",
    )
    sigma_rotation: float = Field(
        4e-4, gt=0, description="Smallest rotation standard deviation of one scan [rad]"
    )
    sigma_translation: float = Field(
        0.004, gt=0, description="Smallest translation standard deviation of one scan [m]"
    )
    degenerate_sigma: float = Field(
        0.15,
        gt=0,
        description="Standard deviation of the weakest direction above which a scan is degenerate [m]",
    )
    min_inlier_ratio: float = Field(
        0.3,
        ge=0,
        le=1,
        description="Fraction of matched points of a scan below which its registration has failed",
    )
    max_gap_ns: int = Field(
        2_000_000_000, gt=0, description="Gap between scans above which a new segment begins [ns]"
    )
    max_failures: int = Field(
        5, ge=1, description="Number of consecutive failed scans after which a new segment begins"
    )
