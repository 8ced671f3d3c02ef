"""Settings of the fusion: moving objects, voxels, outliers, tiles."""

from __future__ import annotations

from pydantic import Field

from subiaco_geo.config import StrictModel
from subiaco_geo.movement import MovementConfig


class MovingConfig(MovementConfig):
    """Removal of moving objects from the map into a side cloud; see :mod:`subiaco_geo.movement`."""

    enabled: bool = Field(
        True, description="Remove points of moving objects from the map; the points are flagged in any case"
    )
    floor: float = Field(
        0.15,
        ge=0,
        description="Height above the lowest surrounding point up to which points stay in the map [m], "
        "because road and vehicles share voxels",
    )


class FusionConfig(StrictModel):
    """Scans to the map."""

    leaf: float = Field(
        0.25, gt=0, description="Edge of the voxels of the map [m]; smaller voxels give more points"
    )
    max_range: float = Field(
        70.0,
        gt=0,
        description="Range above which points do not enter the map [m]; beams that went further show free "
        "space up to this range",
    )
    reserve_gb: float = Field(
        2.0,
        ge=0,
        description="Free disk space [GB] below which points of further scans are left out, so that the "
        "map so far can still be written",
    )
    full_density: bool = Field(
        False,
        description="Write every return too, as classified LAZ tiles with GPS times in the folder "
        "full_density of the map; needs about 40 bytes of disk a return while the map is made",
    )
    min_points: int = Field(1, ge=1, description="Number of points that a voxel of the map needs")
    outlier_neighbours: int = Field(
        3,
        ge=0,
        description="Number of neighbours within outlier_spacings that a point needs to stay in the map; "
        "0 disables the outlier removal",
    )
    outlier_spacings: float = Field(
        3.0,
        gt=0,
        description="Radius of the outlier removal as a multiple of the beam spacing at the range of the "
        "point, two voxels at least",
    )
    normal_neighbours: int = Field(
        15, ge=5, description="Number of neighbours from which a normal is estimated"
    )
    visibility_voxel: float = Field(0.5, gt=0, description="Edge of the voxels of the visibility layer [m]")
    visibility_stride: int = Field(
        8,
        ge=1,
        description="Number of beams of which one is traced through the visibility layer; 8 suffices for "
        "voxels of 0.5 m",
    )
    sky_elevation_deg: float = Field(
        3.0,
        ge=0,
        lt=90,
        description="Elevation angle above which beams without return count as free space [deg]",
    )
    height_tile: float = Field(20.0, gt=0, description="Edge of the tiles of the height table [m]")
    tile: float = Field(80.0, ge=10, description="Edge of the tiles in which the map is finished [m]")
    tile_overlap: float = Field(
        10.0,
        ge=0,
        description="Width of the surroundings that are processed together with a tile [m], one tile at most",
    )
    active_voxels: int = Field(
        1_200_000,
        ge=1,
        description="Number of map voxels kept in memory before they are written to disk; four times as "
        "many for the visibility layer",
    )
    moving: MovingConfig = MovingConfig()
