"""Thresholds of the watch: from when something is said about a survey."""

from __future__ import annotations

from pydantic import Field

from subiaco_geo.config import StrictModel

_SECOND = 1_000_000_000
#: A status on /diagnostics whose name holds one of these tells a driver's lock on the pulse.
PPS_WORDS = ("pps", "sync pulse", "time pulse")


class StreamLimits(StrictModel):
    """How long a topic may be silent, and how fast it should be."""

    lidar_silent_ns: int = Field(_SECOND // 2, gt=0, description="no packet or cloud for longer [ns]")
    imu_silent_ns: int = Field(_SECOND // 4, gt=0, description="no IMU sample for longer [ns]")
    gnss_silent_ns: int = Field(1_500_000_000, gt=0, description="no fix message for longer [ns]")
    odometry_silent_ns: int = Field(
        1_500_000_000, gt=0, description="no pose for longer while the LiDAR sends [ns]"
    )
    min_rate: float = Field(
        0.8, ge=0, le=1, description="share of its usual rate below which a topic is slow; 0: never"
    )
    max_lost: float = Field(0.01, ge=0, le=1, description="share of LiDAR packets lost within a second")


class ClockLimits(StrictModel):
    """Stamps against the host's clock, and of the sensors against each other."""

    step: float = Field(0.05, gt=0, description="jump of stamps against arrival that is a clock step [s]")
    max_offset: float = Field(0.5, gt=0, description="arrival after the stamp, at most [s]")
    max_ahead: float = Field(0.05, gt=0, description="stamp ahead of arrival, at most [s]")
    max_disagreement: float = Field(
        0.35, gt=0, description="between the sensors, delays of their drivers included [s]"
    )
    max_drift: float = Field(
        0.005, gt=0, description="of one sensor's clock against the others since the start [s]"
    )
    settle: float = Field(10.0, gt=0, description="time over which the starting point of drift is taken [s]")
    pps_silent_ns: int = Field(
        1_500_000_000, gt=0, description="no time reference for longer, once there was one: PPS lost [ns]"
    )


class GnssLimits(StrictModel):
    """What a fix should be."""

    rtk_gap_ns: int = Field(2 * _SECOND, gt=0, description="longer without a fixed solution is flagged [ns]")
    max_sigma: float = Field(0.1, gt=0, description="horizontal standard deviation stated by the driver [m]")
    max_hdop: float = Field(3.0, gt=0, description="horizontal dilution of precision")
    max_pdop: float = Field(5.0, gt=0, description="position dilution of precision")


class ImuLimits(StrictModel):
    """What an IMU sample should be."""

    gravity_tolerance: float = Field(
        1.5, gt=0, description="mean specific force over a second may differ from gravity by [m/s2]"
    )
    max_gyro: float = Field(5.0, gt=0, description="a car never turns faster [rad/s]")
    stuck_ns: int = Field(
        300_000_000, gt=0, description="the very same sample for longer is a stuck sensor [ns]"
    )


class DiskLimits(StrictModel):
    """Room where the recording goes."""

    low: float = Field(20e9, ge=0, description="free space below which the disk is low [bytes]")
    full: float = Field(2e9, ge=0, description="free space below which nothing more should be begun [bytes]")
    low_minutes: float = Field(10.0, ge=0, description="time left at the present rate of filling [min]")


class QualityConfig(StrictModel):
    """The light of every street segment."""

    segment_length: float = Field(25.0, gt=0, description="way driven in a segment [m]")
    same_street: float = Field(8.0, gt=0, description="a drive this near to a place has been there [m]")
    min_share: float = Field(
        0.2, ge=0, le=1, description="share of a segment's time that a fault must last to colour it"
    )
    route_step: float = Field(25.0, gt=0, description="length of the pieces of a planned route [m]")
    red: tuple[str, ...] = Field(
        (
            "lidar_silent", "packet_loss", "unregistered", "clock_step", "clock_disagreement", "not_utc",
            "odometry_silent",
        ),
        description="flags that make a segment red: drive it again",
    )  # fmt: skip
    amber: tuple[str, ...] = Field(
        (
            "without_rtk_fixed", "gnss_silent", "imu_silent", "imu_bad", "pps_lost", "clock_drift",
            "clock_offset", "degenerate", "poor_dop", "lidar_slow", "imu_slow", "gnss_slow", "segment_start",
        ),
        description="flags that make it amber: usable, look at it",
    )  # fmt: skip


class WatchConfig(StrictModel):
    """Everything that the watch compares with."""

    streams: StreamLimits = StreamLimits()
    clocks: ClockLimits = ClockLimits()
    gnss: GnssLimits = GnssLimits()
    imu: ImuLimits = ImuLimits()
    disk: DiskLimits = DiskLimits()
    quality: QualityConfig = QualityConfig()
    join_ns: int = Field(
        2 * _SECOND, ge=0, description="two stretches of one flag nearer than this are one [ns]"
    )
