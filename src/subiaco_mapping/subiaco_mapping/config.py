"""Configuration of the mapping room: one frozen slice a stage."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from pydantic import Field, field_validator

from subiaco_geo.config import StrictModel
from subiaco_geo.movement import MovementConfig
from subiaco_mapping.absolute_positions.config import ControlConfig, ReferenceConfig
from subiaco_mapping.calibration.config import CalibrationConfig
from subiaco_mapping.health_monitor.config import WatchConfig
from subiaco_mapping.importers.csv_logs import LogsConfig
from subiaco_mapping.loop_closure.config import LoopConfig
from subiaco_mapping.map_quality.config import QualityConfig
from subiaco_mapping.preprocessing.gnss_drivers import DriverName
from subiaco_mapping.topic_names import TopicsConfig

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


class OdometryConfig(StrictModel):
    """Scan to local map (kiss-icp core)."""

    FORMER_NAMES: ClassVar[Mapping[str, str]] = {
        "gicp_voxel": "gicp_voxel",
        "look_distance": "gicp_distance",
        "look_iterations": "gicp_iterations",
        "look_leaf": "gicp_leaf",
    }

    voxel: float = Field(
        1.0,
        gt=0,
        description="Edge of the voxels of the local map [m]; 1.0 was measured best with gyro deskewing",
    )
    max_range: float = Field(100.0, gt=0, description="Radius of the local map [m]")
    max_points_per_voxel: int = Field(
        20, ge=1, description="Largest number of points kept in a voxel of the local map"
    )
    max_iterations: int = Field(50, ge=1, description="Largest number of ICP iterations per scan")
    convergence: float = Field(
        1e-2,
        gt=0,
        description="Norm of the ICP update at which iterations stop [1]; use 5e-4 if refine is off",
    )
    initial_threshold: float = Field(
        2.0, gt=0, description="Kernel width of ICP while the motion is unknown [m]"
    )
    min_threshold: float = Field(0.3, gt=0, description="Smallest kernel width of ICP [m]")
    threshold_memory: float = Field(
        0.8,
        ge=0,
        lt=1,
        description="Fraction of the squared kernel width that is kept from scan to scan; raise it for "
        "slower adaptation",
    )
    gicp_voxel: float = Field(
        1.0, gt=0, description="Edge of the voxels of the Gaussian map for the plane-to-plane refinement [m]"
    )
    gicp_distance: float = Field(
        1.0,
        gt=0,
        description="Largest correspondence distance of the plane-to-plane refinement [m]; smaller while "
        "the motion is predictable",
    )
    gicp_iterations: int = Field(
        10, ge=1, description="Largest number of iterations of the plane-to-plane refinement"
    )
    gicp_leaf: float = Field(
        0.75, gt=0, description="Voxel edge to which a scan is thinned for the plane-to-plane refinement [m]"
    )
    refine: bool = Field(
        True,
        description="Use the pose of the plane-to-plane refinement; otherwise the refinement gives the "
        "covariance only",
    )
    correlation: float = Field(
        30.0,
        ge=1,
        description="Number of points of a scan with one common error; the variance is multiplied by this "
        "factor",
    )
    sigma_rotation: float = Field(
        4e-4, gt=0, description="Smallest rotation standard deviation of one scan [rad]"
    )
    sigma_translation: float = Field(
        0.004, gt=0, description="Smallest translation standard deviation of one scan [m]"
    )
    degenerate_sigma: float = Field(
        0.15,
        gt=0,
        description="Standard deviation of the weakest direction above which a scan is degenerate [m]",
    )
    min_inlier_ratio: float = Field(
        0.3,
        ge=0,
        le=1,
        description="Fraction of matched points of a scan below which its registration has failed",
    )
    max_gap_ns: int = Field(
        2_000_000_000, gt=0, description="Gap between scans above which a new segment begins [ns]"
    )
    max_failures: int = Field(
        5, ge=1, description="Number of consecutive failed scans after which a new segment begins"
    )


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
    max_range: float = Field(70.0, gt=0, description="Range above which points do not enter the map [m]")
    reserve_gb: float = Field(
        2.0,
        ge=0,
        description="Free disk space [GB] below which points of further scans are left out, so that the "
        "map so far can still be written",
    )
    full_density: bool = Field(
        False,
        description="Writes every return too, as classified LAZ tiles with GPS times in the folder "
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


class ManifestConfig(StrictModel):
    """What the manifest flags."""

    max_lost_ratio: float = Field(
        0.01, ge=0, le=1, description="Fraction of lost columns from which a scan is flagged"
    )
    rtk_gap_ns: int = Field(
        2_000_000_000,
        gt=0,
        description="Time without an RTK fixed solution from which the gap is flagged [ns]",
    )
    max_contradicting: float = Field(
        0.5,
        gt=0,
        le=1,
        description="Fraction of the fixes of a sequence outside their stated 99.9 % interval from which "
        "the fixes contradict the map",
    )


class MappingConfig(StrictModel):
    """Everything from bag to map."""

    PUBLIC = (
        "crs",
        "threads",
        "deskewed",
        "topics.metadata",
        "topics.lidar_packets",
        "topics.imu_packets",
        "topics.points",
        "topics.imu",
        "topics.fix",
        "topics.heading",
        "topics.time_reference",
        "topics.gps_fix",
        "topics.nmea_sentence",
        "sensors.base_frame",
        "sensors.lidar_frame",
        "sensors.imu_frame",
        "sensors.gnss_frame",
        "sensors.lidar.translation",
        "sensors.lidar.rotation_deg",
        "sensors.imu.translation",
        "sensors.imu.rotation_deg",
        "sensors.gnss.translation",
        "sensors.override",
        "decode.time_base",
        "decode.time_offset_ns",
        "decode.min_range",
        "decode.max_range",
        "decode.sky_range",
        "deskew.imu_time_offset_ns",
        "gnss.required",
        "gnss.driver",
        "gnss.declared_frame",
        "gnss.epoch",
        "gnss.heights",
        "gnss.geoid_grid",
        "gnss.time_offset_ns",
        "gnss.heading_offset_deg",
        "fusion.leaf",
        "fusion.max_range",
        "fusion.reserve_gb",
        "fusion.full_density",
        "fusion.moving.enabled",
    )

    crs: str = Field(
        "auto",
        description="Projected CRS of the map, an EPSG code or WKT; auto takes the UTM zone of the fixes "
        "on the region's newest datum (in Perth EPSG:7850, GDA2020 / MGA zone 50)",
    )
    threads: int = Field(1, ge=1, description="Number of threads; results are reproducible with 1 only")
    deskewed: bool = Field(False, description="Point clouds are already deskewed and have no point times")
    topics: TopicsConfig = TopicsConfig()
    sensors: SensorsConfig = SensorsConfig()
    decode: DecodeConfig = DecodeConfig()
    deskew: DeskewConfig = DeskewConfig()
    odometry: OdometryConfig = OdometryConfig()
    gnss: GnssConfig = GnssConfig()
    graph: GraphConfig = GraphConfig()
    loops: LoopConfig = LoopConfig()
    control: ControlConfig = ControlConfig()
    reference: ReferenceConfig = ReferenceConfig()
    fusion: FusionConfig = FusionConfig()
    manifest: ManifestConfig = ManifestConfig()
    quality: QualityConfig = QualityConfig()
    watch: WatchConfig = WatchConfig()
    calibration: CalibrationConfig = CalibrationConfig()
    logs: LogsConfig = LogsConfig()
