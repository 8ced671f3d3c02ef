"""Configuration of the mapping room: one frozen slice a stage."""

from __future__ import annotations

from pydantic import Field

from subiaco_geo.config import StrictModel
from subiaco_mapping.absolute_positions.config import ControlConfig, ReferenceConfig
from subiaco_mapping.calibration.config import CalibrationConfig
from subiaco_mapping.fusion.config import FusionConfig
from subiaco_mapping.health_monitor.config import WatchConfig
from subiaco_mapping.importers.csv_logs import LogsConfig
from subiaco_mapping.loop_closure.config import LoopConfig
from subiaco_mapping.map_quality.config import MapQualityConfig
from subiaco_mapping.odometry.config import OdometryConfig
from subiaco_mapping.pose_graph.config import GnssConfig, GraphConfig
from subiaco_mapping.preprocessing.config import DecodeConfig, DeskewConfig, SensorsConfig
from subiaco_mapping.topic_names import TopicsConfig


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
    quality: MapQualityConfig = MapQualityConfig()
    watch: WatchConfig = WatchConfig()
    calibration: CalibrationConfig = CalibrationConfig()
    logs: LogsConfig = LogsConfig()
