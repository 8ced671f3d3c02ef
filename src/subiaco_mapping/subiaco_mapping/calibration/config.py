"""Configuration of the rig's calibration."""

from __future__ import annotations

from pydantic import Field

from subiaco_geo.config import StrictModel


class CalibrationConfig(StrictModel):
    """What is believed beforehand, and how well a parameter must be seen to be changed."""

    passes: int = Field(
        5,
        ge=1,
        le=10,
        description="Largest number of calibration passes, each with odometry from the previous estimate",
    )
    prior_rotation_deg: float = Field(
        5.0, gt=0, le=30, description="Standard deviation of the given IMU rotation [deg]"
    )
    prior_lever: float = Field(
        0.5, gt=0, description="Standard deviation of the given antenna position per axis [m]"
    )
    prior_offset: float = Field(0.05, gt=0, description="Standard deviation of the given time offsets [s]")
    search_offset: float = Field(
        0.3, gt=0, description="Largest time offset, positive or negative, of the first search [s]"
    )
    max_rotation_deg: float = Field(
        0.5,
        gt=0,
        description="Standard deviation above which a rotation axis is not observed and keeps its given "
        "value [deg]",
    )
    max_lever: float = Field(
        0.05,
        gt=0,
        description="Standard deviation above which an axis of the antenna position keeps its given value "
        "[m]",
    )
    max_imu_offset: float = Field(
        0.003,
        gt=0,
        description="Standard deviation above which the IMU time offset keeps its given value [s]",
    )
    max_gnss_offset: float = Field(
        0.01,
        gt=0,
        description="Standard deviation above which the GNSS time offset keeps its given value [s]",
    )
    window: float = Field(0.5, gt=0, description="Half width of an accelerometer averaging window [s]")
    body_window: float = Field(
        2.0,
        gt=0,
        description="Length over which rotations and displacements of an INS are compared with odometry [s]",
    )
    stretch: float = Field(
        20.0, gt=2, description="Length of the odometry segments that are aligned rigidly with GNSS fixes [s]"
    )
    shared: float = Field(
        5.0,
        ge=1,
        description="Number of consecutive fixes with one common error; the variance is multiplied by "
        "this factor",
    )
    min_fixes: int = Field(
        50, ge=10, description="Number of RTK fixed fixes required to calibrate the antenna position"
    )
    facade_range: float = Field(
        30.0, gt=0, description="Distance from the LiDAR up to which points are used for facades [m]"
    )
    facade_cell: float = Field(
        1.0, gt=0, description="Edge of the cubes in which a facade is approximated by a plane [m]"
    )
    facade_points: int = Field(40, ge=10, description="Number of points that a cube with a facade needs")
    facade_gain: float = Field(
        0.01,
        ge=0,
        lt=1,
        description="Fraction by which the thickness of facades must change to be reported as thinner or "
        "thicker",
    )
