"""Names and types of the recorded topics: the one place where they are spelled."""

from __future__ import annotations

METADATA = "/ouster/metadata"
LIDAR_PACKETS = "/ouster/lidar_packets"
IMU_PACKETS = "/ouster/imu_packets"
FIX = "/gnss/fix"
HEADING = "/gnss/heading"
IMU = "/imu/data"
TF_STATIC = "/tf_static"
POINTS = "/lidar/points"

PACKET_TYPE = "ouster_sensor_msgs/msg/PacketMsg"

#: Clouds of Livox with a time for each point, by the package of each generation of its driver.
LIVOX_TYPES: frozenset[str] = frozenset(
    f"{package}/msg/CustomMsg" for package in ("livox_ros_driver2", "livox_ros_driver", "livox_interfaces")
)

#: Message type of every topic that a survey bag may hold.
MESSAGE_TYPES: dict[str, str] = {
    METADATA: "std_msgs/msg/String",
    LIDAR_PACKETS: PACKET_TYPE,
    IMU_PACKETS: PACKET_TYPE,
    FIX: "sensor_msgs/msg/NavSatFix",
    HEADING: "sensor_msgs/msg/Imu",
    IMU: "sensor_msgs/msg/Imu",
    TF_STATIC: "tf2_msgs/msg/TFMessage",
    POINTS: "sensor_msgs/msg/PointCloud2",
}

#: Topics that a late subscriber must still receive (reliable, transient local).
LATCHED: frozenset[str] = frozenset({METADATA, TF_STATIC})


def types_of(topic: str) -> frozenset[str]:
    """Return the message types that can be read from a topic of ours."""
    return LIVOX_TYPES | {MESSAGE_TYPES[topic]} if topic == POINTS else frozenset({MESSAGE_TYPES[topic]})
