"""Thresholds of the health monitor."""

from __future__ import annotations

from pydantic import Field

from subiaco_geo.config import StrictModel

_SECOND = 1_000_000_000
#: A status on /diagnostics whose name holds one of these tells a driver's lock on the pulse.
PPS_WORDS = ("pps", "sync pulse", "time pulse")


class StreamLimits(StrictModel):
    """How long a topic may be silent, and how fast it should be."""

    lidar_silent_ns: int = Field(
        _SECOND // 2,
        gt=0,
        description="Time without LiDAR packet or point cloud after which the LiDAR is silent [ns]",
    )
    imu_silent_ns: int = Field(
        _SECOND // 4, gt=0, description="Time without IMU sample after which the IMU is silent [ns]"
    )
    gnss_silent_ns: int = Field(
        1_500_000_000, gt=0, description="Time without fix message after which GNSS is silent [ns]"
    )
    odometry_silent_ns: int = Field(
        1_500_000_000,
        gt=0,
        description="Time without odometry pose, while the LiDAR sends, after which odometry is silent [ns]",
    )
    min_rate: float = Field(
        0.8,
        ge=0,
        le=1,
        description="Fraction of its usual rate below which a topic is slow; 0 disables the check",
    )
    max_lost: float = Field(
        0.01, ge=0, le=1, description="Largest fraction of LiDAR packets that may be lost within a second"
    )


class ClockLimits(StrictModel):
    """Stamps against the host's clock, and of the sensors against each other."""

    step: float = Field(
        0.05, gt=0, description="Jump of message stamps against arrival times that is a clock step [s]"
    )
    max_offset: float = Field(0.5, gt=0, description="Largest delay of arrival after the message stamp [s]")
    max_ahead: float = Field(
        0.05, gt=0, description="Largest time by which a message stamp may be ahead of arrival [s]"
    )
    max_disagreement: float = Field(
        0.35,
        gt=0,
        description="Largest difference between the clock offsets of the sensors, driver delays included [s]",
    )
    max_drift: float = Field(
        0.005,
        gt=0,
        description="Largest drift of the clock of a sensor against the others since the start [s]",
    )
    settle: float = Field(
        10.0,
        gt=0,
        description="Time after the start over which the reference for the clock drift is taken [s]",
    )
    pps_silent_ns: int = Field(
        1_500_000_000,
        gt=0,
        description="Time without time reference after which PPS is lost, if there was one before [ns]",
    )


class GnssLimits(StrictModel):
    """What a fix should be."""

    rtk_gap_ns: int = Field(
        2 * _SECOND, gt=0, description="Time without an RTK fixed solution from which the gap is flagged [ns]"
    )
    max_sigma: float = Field(
        0.1, gt=0, description="Largest horizontal standard deviation stated by the GNSS driver [m]"
    )
    max_hdop: float = Field(3.0, gt=0, description="Largest horizontal dilution of precision [1]")
    max_pdop: float = Field(5.0, gt=0, description="Largest position dilution of precision [1]")


class ImuLimits(StrictModel):
    """What an IMU sample should be."""

    gravity_tolerance: float = Field(
        1.5,
        gt=0,
        description="Largest difference of the mean specific force over a second from gravity [m/s2]",
    )
    max_gyro: float = Field(5.0, gt=0, description="Largest plausible angular rate of the vehicle [rad/s]")
    stuck_ns: int = Field(
        300_000_000, gt=0, description="Time with identical IMU samples after which the sensor is stuck [ns]"
    )


class DiskLimits(StrictModel):
    """Room where the recording goes."""

    low: float = Field(
        20e9, ge=0, description="Free disk space below which the disk is reported as low [bytes]"
    )
    full: float = Field(
        2e9, ge=0, description="Free disk space below which no new drive should begin [bytes]"
    )
    low_minutes: float = Field(
        10.0,
        ge=0,
        description="Remaining recording time at the current rate below which the disk is reported as low "
        "[min]",
    )


class StreetQualityConfig(StrictModel):
    """The light of every street segment."""

    segment_length: float = Field(
        25.0, gt=0, description="Driven distance of a segment that gets one colour [m]"
    )
    same_street: float = Field(
        8.0, gt=0, description="Distance of a drive from a place within which the place counts as driven [m]"
    )
    min_share: float = Field(
        0.2,
        ge=0,
        le=1,
        description="Fraction of the time of a segment that a fault must last to colour the segment",
    )
    route_step: float = Field(
        25.0, gt=0, description="Length of the pieces into which a planned route is divided [m]"
    )
    red: tuple[str, ...] = Field(
        (
            "lidar_silent", "packet_loss", "unregistered", "clock_step", "clock_disagreement", "not_utc",
            "odometry_silent",
        ),
        description="Flags that make a segment red, so that the segment should be driven again")  # fmt: skip
    amber: tuple[str, ...] = Field(
        (
            "without_rtk_fixed", "gnss_silent", "imu_silent", "imu_bad", "pps_lost", "clock_drift",
            "clock_offset", "degenerate", "poor_dop", "lidar_slow", "imu_slow", "gnss_slow", "segment_start",
        ),
        description="Flags that make a segment amber: usable, but to be inspected")  # fmt: skip


class WatchConfig(StrictModel):
    """Everything that the watch compares with."""

    streams: StreamLimits = StreamLimits()
    clocks: ClockLimits = ClockLimits()
    gnss: GnssLimits = GnssLimits()
    imu: ImuLimits = ImuLimits()
    disk: DiskLimits = DiskLimits()
    quality: StreetQualityConfig = StreetQualityConfig()
    join_ns: int = Field(
        2 * _SECOND, ge=0, description="Gap between two occurrences of one flag below which they are one [ns]"
    )
