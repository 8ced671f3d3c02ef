"""Names that drivers give to the topics: a vehicle's differ from ours."""

from __future__ import annotations

from pydantic import Field

from subiaco_geo.config import StrictModel
from subiaco_geo.topics import FIX, HEADING, IMU, IMU_PACKETS, LIDAR_PACKETS, METADATA, POINTS

TIME_REFERENCE = "/gnss/time_reference"
GPS_FIX = "/gnss/gps_fix"
NMEA_SENTENCE = "/gnss/nmea_sentence"

_OURS = {
    "metadata": METADATA,
    "lidar_packets": LIDAR_PACKETS,
    "imu_packets": IMU_PACKETS,
    "points": POINTS,
    "imu": IMU,
    "fix": FIX,
    "heading": HEADING,
    "time_reference": TIME_REFERENCE,
    "gps_fix": GPS_FIX,
    "nmea_sentence": NMEA_SENTENCE,
}


class TopicsConfig(StrictModel):
    """Where the vehicle's drivers publish; empty is our own name."""

    metadata: str = Field("", description="std_msgs/String, the LiDAR's JSON; ours: /ouster/metadata")
    lidar_packets: str = Field("", description="ouster_sensor_msgs/PacketMsg; ours: /ouster/lidar_packets")
    imu_packets: str = Field("", description="ouster_sensor_msgs/PacketMsg; ours: /ouster/imu_packets")
    points: str = Field("", description="sensor_msgs/PointCloud2 with times; ours: /lidar/points")
    imu: str = Field("", description="sensor_msgs/Imu; ours: /imu/data")
    fix: str = Field("", description="sensor_msgs/NavSatFix; ours: /gnss/fix")
    heading: str = Field("", description="sensor_msgs/Imu of a dual antenna; ours: /gnss/heading")
    time_reference: str = Field(
        "", description="sensor_msgs/TimeReference, one a pulse; ours: /gnss/time_reference"
    )
    gps_fix: str = Field("", description="gps_msgs/GPSFix, for its DOP; ours: /gnss/gps_fix")
    nmea_sentence: str = Field("", description="nmea_msgs/Sentence, likewise; ours: /gnss/nmea_sentence")

    def remappings(self) -> tuple[tuple[str, str], ...]:
        """Return pairs of our name and the driver's, where they differ."""
        given = {ours: str(getattr(self, name)) for name, ours in _OURS.items()}
        return tuple((ours, theirs) for ours, theirs in given.items() if theirs and theirs != ours)
