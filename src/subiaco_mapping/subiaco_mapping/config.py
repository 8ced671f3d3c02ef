"""Configuration of the mapping room: one frozen slice a stage."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, field_validator

from subiaco_geo.config import StrictModel
from subiaco_geo.movement import MovementConfig
from subiaco_mapping.calibration.config import CalibrationConfig
from subiaco_mapping.drivers import DriverName
from subiaco_mapping.logs import LogsConfig
from subiaco_mapping.loops.config import LoopConfig
from subiaco_mapping.quality.config import QualityConfig
from subiaco_mapping.topic_names import TopicsConfig
from subiaco_mapping.watch.config import WatchConfig

Triple = tuple[float, float, float]


class FramePose(StrictModel):
    """Pose of a sensor frame in ``base_link``."""

    translation: Triple = Field((0.0, 0.0, 0.0), description="x y z in base_link [m]")
    rotation_deg: Triple = Field((0.0, 0.0, 0.0), description="roll pitch yaw, fixed axes x y z [deg]")


class SensorsConfig(StrictModel):
    """Where the sensors sit; ``/tf_static`` of the bag wins unless ``override``."""

    base_frame: str = Field("base_link", description="vehicle frame")
    lidar_frame: str = Field("lidar_link", description="the Ouster sensor frame (os_sensor)")
    imu_frame: str = Field("imu_link", description="IMU frame")
    gnss_frame: str = Field("gnss_link", description="antenna phase centre")
    lidar: FramePose | None = Field(None, description="T_base_lidar where /tf_static lacks it")
    imu: FramePose | None = Field(None, description="T_base_imu where /tf_static lacks it")
    gnss: FramePose | None = Field(None, description="antenna in base_link where /tf_static lacks it")
    override: bool = Field(False, description="the poses given here win over /tf_static")


class DecodeConfig(StrictModel):
    """Packets to scans."""

    time_base: Literal["utc", "tai", "gps"] = Field("utc", description="what the sensor's clock counts")
    leap_seconds: int = Field(37, ge=0, le=60, description="TAI - UTC [s], used for tai and gps")
    time_offset_ns: int = Field(0, description="added to every column time [ns]")
    min_range: float = Field(1.0, ge=0, description="nearer returns are dropped (the car itself) [m]")
    max_range: float = Field(100.0, gt=0, description="farther returns are dropped [m]")
    sky_range: float = Field(
        40.0,
        ge=0,
        le=100.0,
        description="beams that met nothing prove empty air up to here; 0: never [m]",
    )
    reorder_packets: int = Field(8, ge=0, description="packets of a newer frame before an open one is closed")
    stamp_tolerance_ns: int = Field(
        20_000_000, gt=0, description="a column time farther from the line is replaced [ns]"
    )


class DeskewConfig(StrictModel):
    """Motion inside a scan."""

    gyro_bias: Triple = Field((0.0, 0.0, 0.0), description="subtracted from the gyro, IMU frame [rad/s]")
    estimate_bias: bool = Field(True, description="average the gyro while the vehicle stands")
    standing_gyro: float = Field(0.01, gt=0, description="gyro spread below which it may be standing [rad/s]")
    standing_speed: float = Field(0.1, gt=0, description="odometry speed likewise [m/s]")
    standing_accel: float = Field(0.15, gt=0, description="accelerometer spread likewise [m/s2]")
    imu_time_offset_ns: int = Field(0, description="added to every IMU stamp [ns]")
    max_imu_gap_ns: int = Field(
        100_000_000, gt=0, description="a longer hole in the IMU is missing data [ns]"
    )
    registration_sigma: float = Field(
        0.015, gt=0, description="odometry's error of one scan, to the velocity filter [m]"
    )
    force_noise: float = Field(0.05, gt=0, description="accelerometer to the filter [m/s2 a root second]")
    rest_drift: float = Field(
        0.03, gt=0, description="how fast gravity and bias, as read at rest, may wander [m/s2 a root second]"
    )
    rest_sigma: float = Field(0.3, gt=0, description="the accelerometer is used once they are so sure [m/s2]")
    imu_wait_ns: int = Field(
        1_000_000_000, gt=0, description="stream time a scan waits for the IMU before doing without [ns]"
    )


class OdometryConfig(StrictModel):
    """Scan to local map (kiss-icp core)."""

    voxel: float = Field(1.0, gt=0, description="local map voxel [m] (measured best with gyro deskew)")
    max_range: float = Field(100.0, gt=0, description="radius of the local map [m]")
    max_points_per_voxel: int = Field(20, ge=1, description="points kept in a local map voxel")
    max_iterations: int = Field(50, ge=1, description="ICP iterations")
    convergence: float = Field(
        1e-2, gt=0, description="norm of the last ICP update; 5e-4 where the second look does not refine"
    )
    initial_threshold: float = Field(2.0, gt=0, description="kernel width while the motion is unknown [m]")
    min_threshold: float = Field(0.3, gt=0, description="smallest kernel width [m]")
    threshold_memory: float = Field(0.8, ge=0, lt=1, description="share of the old kernel width kept a scan")
    look_voxel: float = Field(1.0, gt=0, description="voxel of the second look's Gaussian map [m]")
    look_distance: float = Field(
        1.0,
        gt=0,
        description="largest correspondence of the second look; less while the motion is foreseen [m]",
    )
    look_iterations: int = Field(10, ge=1, description="iterations of the second look")
    look_leaf: float = Field(0.75, gt=0, description="points of the second look are so far apart [m]")
    refine: bool = Field(True, description="the second look's plane-to-plane pose is the pose")
    correlation: float = Field(
        30.0, ge=1, description="points that share one error: variance is multiplied by it"
    )
    sigma_rotation: float = Field(4e-4, gt=0, description="floor a scan [rad]")
    sigma_translation: float = Field(0.004, gt=0, description="floor a scan [m]")
    degenerate_sigma: float = Field(0.15, gt=0, description="a weaker direction is degenerate [m]")
    min_inlier_ratio: float = Field(0.3, ge=0, le=1, description="fewer matched keypoints is a failure")
    max_gap_ns: int = Field(2_000_000_000, gt=0, description="a longer gap starts a new segment [ns]")
    max_failures: int = Field(5, ge=1, description="failed scans in a row before a new segment")


class GnssConfig(StrictModel):
    """Fixes to priors."""

    required: bool = Field(False, description="refuse a bag that GNSS cannot place")
    driver: DriverName = Field(
        "subiaco",
        description="what a status means: subiaco (2 fixed, 1 float, 0 single), ublox, nmea, septentrio, or "
        "covariance (any other)",
    )
    fixed_below: float = Field(
        0.1, gt=0, description="where the status cannot tell: a smaller stated sigma is RTK fixed [m]"
    )
    float_below: float = Field(
        1.5, gt=0, description="where the status cannot tell: a smaller stated sigma is RTK float [m]"
    )
    declared_frame: str = Field(
        "map",
        description="geodetic system of the fixes, that of the RTK base: map for the datum of the map's CRS, "
        "or a name or code that PROJ knows (GDA2020, ETRS89, ITRF2014, EPSG:7843)",
    )
    epoch: float | None = Field(
        None,
        description="decimal year of the survey, needed where the system of the fixes moves with the plates",
    )
    heights: Literal["ellipsoidal", "geoid"] = Field(
        "ellipsoidal",
        description="surface above which the fixes' altitudes are given; geoid (or AHD) needs geoid_grid",
    )
    geoid_grid: str = Field(
        "",
        description="file of geoid undulations that PROJ reads, .gtx or .tif, such as AUSGeoid2020 for AHD",
    )
    sigma_fixed: float = Field(0.015, gt=0, description="floor for status 2 [m]")
    sigma_float: float = Field(0.4, gt=0, description="floor for status 1 [m]")
    sigma_single: float = Field(2.0, gt=0, description="floor for status 0 [m]")
    vertical_factor: float = Field(1.5, gt=0, description="vertical floor over horizontal floor")
    time_offset_ns: int = Field(0, description="added to every fix stamp [ns]")
    max_pose_gap_ns: int = Field(500_000_000, gt=0, description="no prior inside a longer gap of scans [ns]")
    correlation_time: float = Field(
        20.0, ge=0, description="of the slow part of a fix's error (atmosphere, multipath); 0: white [s]"
    )
    correlated_share: float = Field(
        0.6, ge=0, le=1, description="share of a fix's variance that is slow, not new with every fix"
    )
    epoch_gap_ns: int = Field(
        2_000_000_000, gt=0, description="after a longer gap, or another status, slow errors start anew [ns]"
    )
    kernel: float = Field(3.0, gt=0, description="Cauchy kernel on the whitened fix error [sigma]")
    heading: bool = Field(True, description="use /gnss/heading where it is recorded")
    heading_offset_deg: float = Field(
        0.0, ge=-360, le=360, description="heading of the antenna baseline less that of base_link, ccw [deg]"
    )
    heading_sigma_deg: float = Field(0.2, gt=0, description="floor of a heading, in quadrature [deg]")
    min_fixes: int = Field(10, ge=3, description="fixes needed to place a sequence")
    min_length: float = Field(20.0, gt=0, description="way they must span [m]")

    @field_validator("heights", mode="before")
    @classmethod
    def _australian_heights_are_geoid_heights(cls, value: Any) -> Any:
        return "geoid" if value == "AHD" else value


class GraphConfig(StrictModel):
    """Pose graph."""

    max_iterations: int = Field(50, ge=1, description="Levenberg-Marquardt iterations")
    sigma_gravity: float = Field(0.01, gt=0, description="attitude from one window of accelerometer [rad]")
    gravity_window_ns: int = Field(1_000_000_000, gt=0, description="length of such a window [ns]")
    drift_share: float = Field(
        0.1,
        gt=0,
        le=1,
        description="share of a registration's variance that the chain hands on; rest: jitter",
    )
    loop_kernel: float = Field(2.0, gt=0, description="Cauchy kernel on the whitened error of a loop [sigma]")
    covariance_stride: int = Field(10, ge=1, description="poses between two marginal covariances")
    segment_sigma_translation: float = Field(20.0, gt=0, description="between two segments [m]")
    segment_sigma_rotation: float = Field(0.5, gt=0, description="between two segments [rad]")


class MovingConfig(MovementConfig):
    """What moved leaves the map, for a side cloud; see :mod:`subiaco_geo.movement`."""

    enabled: bool = Field(
        True, description="whether points of moving objects leave the map; they are flagged in any case"
    )
    floor: float = Field(
        0.15,
        ge=0,
        description="points no higher than this above the lowest point around stay in the map: the road "
        "shares voxels with the vehicles on it [m]",
    )


class FusionConfig(StrictModel):
    """Scans to the map."""

    leaf: float = Field(0.25, gt=0, description="map voxel [m]")
    max_range: float = Field(70.0, gt=0, description="farther points do not enter the map [m]")
    reserve_gb: float = Field(
        2.0,
        ge=0,
        description="Free space of the disk [GB] below which the points of further scans are left out, so "
        "that the map of those before can still be written.",
    )
    min_points: int = Field(1, ge=1, description="points a map voxel needs")
    outlier_neighbours: int = Field(
        3, ge=0, description="others that a point needs near it to stay; 0 leaves the test out"
    )
    outlier_spacings: float = Field(
        3.0,
        gt=0,
        description="near is so many beam spacings at the range from which the point was seen, "
        "and two leaves at least [1]",
    )
    normal_neighbours: int = Field(15, ge=5, description="neighbours of a normal")
    visibility_voxel: float = Field(0.5, gt=0, description="voxel of the visibility layer [m]")
    visibility_stride: int = Field(8, ge=1, description="one beam in so many is walked; 0.5 m needs no more")
    sky_elevation_deg: float = Field(
        3.0, ge=0, lt=90, description="beams that met nothing count above this elevation only [deg]"
    )
    height_tile: float = Field(20.0, gt=0, description="tile of the height table [m]")
    tile: float = Field(80.0, ge=10, description="tile in which the map is finished [m]")
    tile_overlap: float = Field(10.0, ge=0, description="seen of its neighbours; at most a tile [m]")
    active_voxels: int = Field(
        1_200_000,
        ge=1,
        description="map voxels in memory before they go to disk (four times so many of "
        "the visibility layer)",
    )
    moving: MovingConfig = MovingConfig()


class ManifestConfig(StrictModel):
    """What the manifest flags."""

    max_lost_ratio: float = Field(
        0.01, ge=0, le=1, description="share of lost columns from which a scan is flagged"
    )
    rtk_gap_ns: int = Field(
        2_000_000_000, gt=0, description="longer without a fixed solution is flagged [ns]"
    )
    max_contradicting: float = Field(
        0.5,
        gt=0,
        le=1,
        description="share of a sequence's fixes outside 99.9 % of what they state, from which "
        "they contradict the map",
    )


class MappingConfig(StrictModel):
    """Everything from bag to map."""

    crs: str = Field(
        "auto",
        description="projected CRS of the map, an EPSG code or WKT; auto takes the UTM zone of the fixes on "
        "the region's newest datum (in Perth EPSG:7850, GDA2020 / MGA zone 50)",
    )
    threads: int = Field(1, ge=1, description="1 is deterministic")
    deskewed: bool = Field(False, description="point clouds come without point times, already deskewed")
    topics: TopicsConfig = TopicsConfig()
    sensors: SensorsConfig = SensorsConfig()
    decode: DecodeConfig = DecodeConfig()
    deskew: DeskewConfig = DeskewConfig()
    odometry: OdometryConfig = OdometryConfig()
    gnss: GnssConfig = GnssConfig()
    graph: GraphConfig = GraphConfig()
    loops: LoopConfig = LoopConfig()
    fusion: FusionConfig = FusionConfig()
    manifest: ManifestConfig = ManifestConfig()
    quality: QualityConfig = QualityConfig()
    watch: WatchConfig = WatchConfig()
    calibration: CalibrationConfig = CalibrationConfig()
    logs: LogsConfig = LogsConfig()
