"""Configuration of the rig's calibration."""

from __future__ import annotations

from pydantic import Field

from subiaco_geo.config import StrictModel


class CalibrationConfig(StrictModel):
    """What is believed beforehand, and how well a parameter must be seen to be changed."""

    passes: int = Field(
        5, ge=1, le=10, description="estimates at most, each on odometry made with the one before"
    )
    prior_rotation_deg: float = Field(5.0, gt=0, le=30, description="of the given IMU rotation [deg]")
    prior_lever: float = Field(0.5, gt=0, description="of the given antenna position, per axis [m]")
    prior_offset: float = Field(0.05, gt=0, description="of the given time offsets [s]")
    search_offset: float = Field(0.3, gt=0, description="time offsets tried first, either way [s]")
    max_rotation_deg: float = Field(0.5, gt=0, description="a larger sigma: axis not observed, kept [deg]")
    max_lever: float = Field(0.05, gt=0, description="a larger sigma: axis not observed, kept [m]")
    max_imu_offset: float = Field(0.003, gt=0, description="a larger sigma: not observed, kept [s]")
    max_gnss_offset: float = Field(0.01, gt=0, description="a larger sigma: not observed, kept [s]")
    window: float = Field(0.5, gt=0, description="half width of an accelerometer window [s]")
    body_window: float = Field(
        2.0, gt=0, description="length over which turns and ways of an INS are held against odometry's [s]"
    )
    stretch: float = Field(20.0, gt=2, description="length over which odometry is held rigid to fixes [s]")
    shared: float = Field(5.0, ge=1, description="fixes that share one error: variance is multiplied by it")
    min_fixes: int = Field(50, ge=10, description="RTK fixed fixes needed for the antenna")
    facade_range: float = Field(30.0, gt=0, description="farther points do not enter facades [m]")
    facade_cell: float = Field(1.0, gt=0, description="cube in which a facade is taken as plane [m]")
    facade_points: int = Field(40, ge=10, description="points that such a cube needs")
    facade_gain: float = Field(
        0.01, ge=0, lt=1, description="share by which facades must thin to be called thinner"
    )
