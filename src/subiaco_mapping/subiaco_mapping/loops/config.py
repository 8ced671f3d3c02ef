"""Configuration of loop closing."""

from __future__ import annotations

from pydantic import Field

from subiaco_geo.config import StrictModel


class LoopConfig(StrictModel):
    """Submaps, proposals, verification."""

    enabled: bool = Field(True, description="close loops within and between sequences")
    submap_length: float = Field(10.0, gt=0, description="way in one submap [m]")
    scan_spacing: float = Field(1.5, ge=0, description="way between two scans that enter a submap [m]")
    radius: float = Field(40.0, gt=5, description="points farther from their scan stay out [m]")
    leaf: float = Field(0.5, gt=0, description="voxel of a submap [m]")
    min_way: float = Field(50.0, gt=0, description="way between two visits of a place in one sequence [m]")
    near: float = Field(
        8.0,
        gt=0,
        description="submaps this near, besides 3 sigma of the estimate, are compared [m]",
    )
    max_distance: float = Field(
        0.6, gt=0, lt=2, description="descriptors this alike propose a place (1 - correlation)"
    )
    descriptor_matches: int = Field(2, ge=0, description="most proposals of the descriptor a submap")
    inlier_distance: float = Field(0.5, gt=0, description="largest correspondence at the last level [m]")
    min_overlap: float = Field(0.65, gt=0, le=1, description="share of points that must meet a surface")
    max_residual: float = Field(0.12, gt=0, description="point to plane, RMS of those that do [m]")
    max_sigma: float = Field(0.1, gt=0, description="weakest direction of the registration [m]")
    correlation: float = Field(100.0, ge=1, description="points that share one error")
    sigma_translation: float = Field(0.02, gt=0, description="floor of a loop [m]")
    sigma_rotation_deg: float = Field(0.05, gt=0, description="floor of a loop [deg]")
    gate: float = Field(
        28.0, gt=0, description="chi-square of 6 degrees of freedom, present estimate to loop"
    )
    min_joining: int = Field(3, ge=2, description="consistent loops that place a sequence without GNSS")
