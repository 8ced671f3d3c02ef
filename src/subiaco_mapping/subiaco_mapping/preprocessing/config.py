"""Settings of the preprocessing: sensors, decoding, deskewing."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from subiaco_geo.config import StrictModel

Triple = tuple[float, float, float]


class FramePose(StrictModel):
    """Pose of a sensor frame in ``base_link``."""

    translation: Triple = Field((0.0, 0.0, 0.0), description="Sensor position x y z in base_link [m]")
    rotation_deg: Triple = Field(
        (0.0, 0.0, 0.0),
        description="Sensor rotation roll pitch yaw about the fixed axes x y z of base_link [deg]",
    )


class SensorsConfig(StrictModel):
    """Where the sensors sit; ``/tf_static`` of the bag wins unless ``override``."""

    base_frame: str = Field("base_link", description="Name of the vehicle frame")
    lidar_frame: str = Field("lidar_link", description="Name of the LiDAR sensor frame (Ouster: os_sensor)")
    imu_frame: str = Field("imu_link", description="Name of the IMU frame")
    gnss_frame: str = Field(
        "gnss_link", description="Name of the frame at the phase centre of the GNSS antenna"
    )
    lidar: FramePose | None = Field(
        None, description="Pose of the LiDAR in base_link, used where /tf_static lacks it"
    )
    imu: FramePose | None = Field(
        None, description="Pose of the IMU in base_link, used where /tf_static lacks it"
    )
    gnss: FramePose | None = Field(
        None, description="Position of the GNSS antenna in base_link, used where /tf_static lacks it"
    )
    override: bool = Field(
        False, description="Use the configured sensor poses instead of those of /tf_static"
    )


class DecodeConfig(StrictModel):
    """Packets to scans."""

    time_base: Literal["utc", "tai", "gps"] = Field("utc", description="Time scale of the LiDAR clock")
    leap_seconds: int = Field(
        37, ge=0, le=60, description="Offset TAI - UTC [s], used for the time bases tai and gps"
    )
    time_offset_ns: int = Field(0, description="Time added to the stamp of every LiDAR column [ns]")
    min_range: float = Field(
        1.0,
        ge=0,
        description="Range below which returns are dropped, for instance from the vehicle itself [m]",
    )
    max_range: float = Field(100.0, gt=0, description="Range above which returns are dropped [m]")
    sky_range: float = Field(
        40.0,
        ge=0,
        le=100.0,
        description="Range up to which beams without return are free space [m]; 0 disables the use of "
        "beams without return",
    )
    reorder_packets: int = Field(
        8, ge=0, description="Number of packets of a newer frame after which an open frame is closed"
    )
    stamp_tolerance_ns: int = Field(
        20_000_000,
        gt=0,
        description="Distance of a column stamp from the fitted line above which the stamp is replaced [ns]",
    )


class DeskewConfig(StrictModel):
    """Motion inside a scan."""

    gyro_bias: Triple = Field(
        (0.0, 0.0, 0.0), description="Bias subtracted from the gyro in the IMU frame [rad/s]"
    )
    estimate_bias: bool = Field(True, description="Estimate the gyro bias while the vehicle is stationary")
    standing_gyro: float = Field(
        0.01,
        gt=0,
        description="Standard deviation of the gyro below which the vehicle may be stationary [rad/s]",
    )
    standing_speed: float = Field(
        0.1, gt=0, description="Odometry speed below which the vehicle may be stationary [m/s]"
    )
    standing_accel: float = Field(
        0.15,
        gt=0,
        description="Standard deviation of the accelerometer below which the vehicle may be stationary "
        "[m/s2]",
    )
    imu_time_offset_ns: int = Field(0, description="Time added to the stamp of every IMU sample [ns]")
    max_imu_gap_ns: int = Field(
        100_000_000, gt=0, description="Gap between IMU samples above which IMU data are missing [ns]"
    )
    registration_sigma: float = Field(
        0.015,
        gt=0,
        description="Standard deviation of the odometry position of one scan in the velocity filter [m]",
    )
    force_noise: float = Field(
        0.05, gt=0, description="Accelerometer noise in the velocity filter [m/s2/sqrt(s)]"
    )
    rest_drift: float = Field(
        0.03,
        gt=0,
        description="Drift of gravity and accelerometer bias in the velocity filter [m/s2/sqrt(s)]",
    )
    rest_sigma: float = Field(
        0.3,
        gt=0,
        description="Standard deviation of gravity and bias below which the accelerometer is used for "
        "deskewing [m/s2]",
    )
    imu_wait_ns: int = Field(
        1_000_000_000,
        gt=0,
        description="Stream time for which a scan waits for IMU data before proceeding without [ns]",
    )
