"""Configuration of control points and of a reference cloud."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field

from subiaco_geo.config import StrictModel


class ControlConfig(StrictModel):
    """Surveyed control points that constrain the pose graph."""

    file: Path | None = Field(
        None,
        description="CSV of control points: name, east, north, height and, where known, sigma_h, sigma_v, "
        "role (control or check), and map_east, map_north, map_height of the mark in a map without control",
    )
    crs: str | None = Field(None, description="CRS of the control points; unset: the CRS of the map")
    geoid_grid: Path | None = Field(
        None,
        description="Geoid model (.gtx, .tif) of the heights of the control points, where these are above a "
        "geoid (AHD); unset: heights above the ellipsoid",
    )
    hold_out_every: int = Field(
        3,
        ge=2,
        description="Number of control points of which one is held out as a check point, where the file "
        "states no roles and has at least four points",
    )
    sigma_horizontal: float = Field(
        0.02, gt=0, description="Horizontal standard deviation of a point for which the file states none [m]"
    )
    sigma_vertical: float = Field(
        0.015, gt=0, description="Vertical standard deviation of a point for which the file states none [m]"
    )
    sigma_pick: float = Field(
        0.04, gt=0, description="Standard deviation with which a person finds a mark in the map [m]"
    )
    sigma_surface: float = Field(
        0.01, gt=0, description="Standard deviation of the height of the ground in a submap [m]"
    )
    reach: float = Field(
        20.0,
        gt=0,
        description="Largest distance between a control point and a submap that is tied to it [m]",
    )
    submaps: int = Field(4, ge=1, description="Number of nearest submaps that are tied to a control point")
    radius: float = Field(
        1.5,
        gt=0.5,
        description="Radius around a control point within which points of a submap represent the ground [m]",
    )
    max_offset: float = Field(
        2.0,
        gt=0,
        description="Largest distance between a control point and the map before the correction; a point "
        "farther off is refused [m]",
    )
    min_for_offset: int = Field(
        3,
        ge=1,
        description="Number of control points from which a common offset of all GNSS fixes is estimated "
        "(wrong base station or antenna height)",
    )
    offset_sigma: float = Field(
        1.0, gt=0, description="Standard deviation of the common offset of the GNSS fixes beforehand [m]"
    )
    kernel: float = Field(
        3.0, gt=0, description="Scale of the robust kernel of control points in standard deviations"
    )


class ReferenceConfig(StrictModel):
    """A cloud of known position to which submaps are registered as soft priors."""

    cloud: Path | None = Field(
        None,
        description="Map directory or cloud (airborne, terrestrial, an earlier epoch) with a CRS; heights "
        "above the ellipsoid",
    )
    geoid_grid: Path | None = Field(
        None,
        description="Geoid model (.gtx, .tif) of the heights of the reference, where above a geoid (AHD)",
    )
    sigma: float = Field(
        0.1, gt=0, description="Standard deviation of the position of the reference as a whole [m]"
    )
    sigma_place: float = Field(
        0.05, gt=0, description="Smallest standard deviation of the registration of one submap [m]"
    )
    radius: float = Field(
        45.0, gt=10, description="Radius around a submap within which points of the reference are used [m]"
    )
    leaf: float = Field(0.5, gt=0, description="Edge of the voxels to which the reference is thinned [m]")
    min_overlap: float = Field(
        0.4,
        gt=0,
        le=1,
        description="Fraction of the points of a submap that must match a surface of the reference",
    )
    max_residual: float = Field(
        0.15,
        gt=0,
        description="Largest root mean square point-to-plane distance of the matched points [m]",
    )
    gate: float = Field(
        28.0,
        gt=0,
        description="Largest chi-square distance (6 degrees of freedom) between the map before the "
        "correction and a registration to the reference [1]",
    )
    kernel: float = Field(
        2.0, gt=0, description="Scale of the robust kernel of the priors in standard deviations"
    )
