"""Topic names of drivers, mapped to ours."""

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
    """Where the vehicle's drivers publish; empty is our own name.

    A name without a leading slash lies in the namespace of the graph, as the topics of a driver of one of
    several LiDARs do; one with it is the same for all graphs, as those of the vehicle's only receiver are.
    """

    metadata: str = Field(
        "", description="Topic of the LiDAR metadata as JSON (std_msgs/String); empty for /ouster/metadata"
    )
    lidar_packets: str = Field(
        "",
        description="Topic of the LiDAR packets (ouster_sensor_msgs/PacketMsg); default "
        "/ouster/lidar_packets",
    )
    imu_packets: str = Field(
        "",
        description="Topic of the LiDAR's IMU packets (ouster_sensor_msgs/PacketMsg); default "
        "/ouster/imu_packets",
    )
    points: str = Field(
        "",
        description="Topic of clouds with point times (sensor_msgs/PointCloud2); empty for /lidar/points",
    )
    imu: str = Field("", description="Topic of the IMU (sensor_msgs/Imu); empty for /imu/data")
    fix: str = Field("", description="Topic of the GNSS fixes (sensor_msgs/NavSatFix); empty for /gnss/fix")
    heading: str = Field(
        "", description="Topic of the dual-antenna heading (sensor_msgs/Imu); empty for /gnss/heading"
    )
    time_reference: str = Field(
        "",
        description="Topic of PPS time stamps, one per pulse (sensor_msgs/TimeReference); default "
        "/gnss/time_reference",
    )
    gps_fix: str = Field(
        "", description="Topic of dilutions of precision (gps_msgs/GPSFix); empty for /gnss/gps_fix"
    )
    nmea_sentence: str = Field(
        "",
        description="Topic of NMEA sentences with dilutions of precision (nmea_msgs/Sentence); default "
        "/gnss/nmea_sentence",
    )

    def remappings(self) -> tuple[tuple[str, str], ...]:
        """Return pairs of our name and the driver's, where they differ."""
        given = {ours: str(getattr(self, name)) for name, ours in _OURS.items()}
        return tuple((ours, theirs) for ours, theirs in given.items() if theirs and theirs != ours)

    def bag_names(self) -> dict[str, str]:
        """Return the driver's name in a bag to ours, where they differ."""
        return {f"/{theirs.lstrip('/')}": ours for ours, theirs in self.remappings()}
