"""Configuration of loop closing."""

from __future__ import annotations

from pydantic import Field

from subiaco_geo.config import StrictModel


class LoopConfig(StrictModel):
    """Submaps, proposals, verification."""

    enabled: bool = Field(True, description="Close loops within and between sequences")
    submap_length: float = Field(10.0, gt=0, description="Driven distance covered by one submap [m]")
    scan_spacing: float = Field(
        1.5, ge=0, description="Driven distance between two scans that enter a submap [m]"
    )
    radius: float = Field(
        40.0, gt=5, description="Range above which points of a scan do not enter a submap [m]"
    )
    leaf: float = Field(0.5, gt=0, description="Edge of the voxels of a submap [m]")
    min_way: float = Field(
        50.0,
        gt=0,
        description="Driven distance between two visits of a place in one sequence that can close a loop [m]",
    )
    near: float = Field(
        8.0,
        gt=0,
        description="Distance between submaps, in addition to 3 standard deviations of the estimate, "
        "below which loops are searched [m]",
    )
    max_distance: float = Field(
        0.6,
        gt=0,
        lt=2,
        description="Largest descriptor distance (1 - correlation) of two submaps that are proposed as a "
        "loop [1]",
    )
    descriptor_matches: int = Field(
        2, ge=0, description="Largest number of loops proposed by the descriptor of a submap"
    )
    inlier_distance: float = Field(
        0.5, gt=0, description="Largest correspondence distance at the last level of a loop registration [m]"
    )
    min_overlap: float = Field(
        0.65,
        gt=0,
        le=1,
        description="Fraction of the points of a submap that must match a surface of the other submap",
    )
    max_residual: float = Field(
        0.12,
        gt=0,
        description="Largest root mean square point-to-plane distance of the matched points of a loop [m]",
    )
    max_sigma: float = Field(
        0.1,
        gt=0,
        description="Largest standard deviation of a loop registration in its weakest direction [m]",
    )
    correlation: float = Field(
        100.0,
        ge=1,
        description="Number of points of a submap with one common error; the variance is multiplied by "
        "this factor",
    )
    sigma_translation: float = Field(
        0.02, gt=0, description="Smallest translation standard deviation of a loop [m]"
    )
    sigma_rotation_deg: float = Field(
        0.05, gt=0, description="Smallest rotation standard deviation of a loop [deg]"
    )
    gate: float = Field(
        28.0,
        gt=0,
        description="Largest chi-square distance (6 degrees of freedom) between the current estimate and "
        "a loop [1]",
    )
    min_joining: int = Field(
        3, ge=2, description="Number of consistent loops that georeference a sequence without GNSS"
    )
