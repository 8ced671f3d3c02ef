"""Settings of the pose graph and of the GNSS fixes in it."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, field_validator

from subiaco_geo.config import StrictModel
from subiaco_mapping.preprocessing.gnss_drivers import DriverName


class GnssConfig(StrictModel):
    """Fixes to priors."""

    required: bool = Field(False, description="Refuse a bag that GNSS cannot georeference")
    driver: DriverName = Field(
        "subiaco",
        description="Driver that defines the fix status: subiaco (2 fixed, 1 float, 0 single), ublox, "
        "nmea, septentrio, or covariance (any other)",
    )
    fixed_below: float = Field(
        0.1,
        gt=0,
        description="Stated standard deviation below which a fix is RTK fixed where the status does not "
        "say [m]",
    )
    float_below: float = Field(
        1.5,
        gt=0,
        description="Stated standard deviation below which a fix is RTK float where the status does not "
        "say [m]",
    )
    declared_frame: str = Field(
        "map",
        description="Geodetic system of the fixes, that of the RTK base: map for the datum of the map's "
        "CRS, or a name or code that PROJ knows (GDA2020, ETRS89, ITRF2014, EPSG:7843)",
    )
    epoch: float | None = Field(
        None,
        description="Decimal year of the survey [years], required where the geodetic system of the fixes "
        "moves with the plates",
    )
    heights: Literal["ellipsoidal", "geoid"] = Field(
        "ellipsoidal",
        description="Reference surface of the altitudes of the fixes; geoid (or AHD) needs geoid_grid",
    )
    geoid_grid: str = Field(
        "",
        description="File of geoid undulations that PROJ reads (.gtx or .tif), such as AUSGeoid2020 for AHD",
    )
    sigma_fixed: float = Field(
        0.015, gt=0, description="Smallest horizontal standard deviation of an RTK fixed fix [m]"
    )
    sigma_float: float = Field(
        0.4, gt=0, description="Smallest horizontal standard deviation of an RTK float fix [m]"
    )
    sigma_single: float = Field(
        2.0, gt=0, description="Smallest horizontal standard deviation of a single fix [m]"
    )
    vertical_factor: float = Field(
        1.5,
        gt=0,
        description="Ratio of the smallest vertical to the smallest horizontal standard deviation of a fix",
    )
    time_offset_ns: int = Field(0, description="Time added to the stamp of every GNSS fix [ns]")
    max_pose_gap_ns: int = Field(
        500_000_000, gt=0, description="Gap between scans above which fixes inside the gap are not used [ns]"
    )
    correlation_time: float = Field(
        20.0,
        ge=0,
        description="Correlation time of the slow part of the GNSS error (atmosphere, multipath) [s]; 0 "
        "treats all error as white noise",
    )
    correlated_share: float = Field(
        0.6,
        ge=0,
        le=1,
        description="Fraction of the variance of a fix that varies slowly instead of from fix to fix",
    )
    epoch_gap_ns: int = Field(
        2_000_000_000,
        gt=0,
        description="Gap between fixes above which the slow GNSS error restarts [ns]; a change of "
        "status has the same effect",
    )
    kernel: float = Field(
        3.0, gt=0, description="Width of the Cauchy kernel of the whitened GNSS error, in standard deviations"
    )
    heading: bool = Field(True, description="Use /gnss/heading where recorded")
    heading_offset_deg: float = Field(
        0.0,
        ge=-360,
        le=360,
        description="Heading of the antenna baseline minus heading of base_link, counter-clockwise [deg]",
    )
    heading_sigma_deg: float = Field(
        0.2, gt=0, description="Standard deviation added in quadrature to that of every heading [deg]"
    )
    min_fixes: int = Field(10, ge=3, description="Number of fixes required to georeference a sequence")
    min_length: float = Field(
        20.0,
        gt=0,
        description="Driven distance that the fixes of a sequence must span to georeference the sequence [m]",
    )

    @field_validator("heights", mode="before")
    @classmethod
    def _australian_heights_are_geoid_heights(cls, value: Any) -> Any:
        return "geoid" if value == "AHD" else value


class GraphConfig(StrictModel):
    """Pose graph."""

    max_iterations: int = Field(50, ge=1, description="Largest number of Levenberg-Marquardt iterations")
    sigma_gravity: float = Field(
        0.01, gt=0, description="Standard deviation of the attitude from one accelerometer window [rad]"
    )
    sigma_accelerometer_bias: float = Field(
        0.1, gt=0, description="Standard deviation of the accelerometer bias of a recording [m/s2]"
    )
    sigma_wall: float = Field(
        0.02, gt=0, description="Standard deviation of the lean of a wall from the vertical [rad]"
    )
    walls: bool = Field(True, description="Level the map also by walls, which are taken to be vertical")
    gravity_window_ns: int = Field(
        1_000_000_000, gt=0, description="Length of an accelerometer window for the attitude [ns]"
    )
    drift_share: float = Field(
        0.1,
        gt=0,
        le=1,
        description="Fraction of the variance of a registration that later scans inherit; the rest is "
        "independent noise",
    )
    loop_kernel: float = Field(
        2.0,
        gt=0,
        description="Width of the Cauchy kernel of the whitened error of a loop closure, in standard "
        "deviations",
    )
    covariance_stride: int = Field(
        10, ge=1, description="Number of poses between two computed pose covariances"
    )
    segment_sigma_translation: float = Field(
        20.0, gt=0, description="Translation standard deviation between two odometry segments [m]"
    )
    segment_sigma_rotation: float = Field(
        0.5, gt=0, description="Rotation standard deviation between two odometry segments [rad]"
    )
