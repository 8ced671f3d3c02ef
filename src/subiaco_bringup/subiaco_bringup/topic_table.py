"""Topics, services and actions of the graph: one table, from which the reference is generated.

A test starts every node and compares what it publishes, subscribes and offers with this table.
"""

from __future__ import annotations

from dataclasses import dataclass, field

#: Qualities of service. Depths are those of the publisher.
RELIABLE = "reliable, volatile"
LATCHED = "reliable, transient local"
OFFERED = "as offered"  # best effort unless every publisher is reliable


@dataclass(frozen=True)
class TopicRow:
    """One topic, as it is named without namespace and remapping.

    Parameters
    ----------
    name, msg_type : str
    publishers, subscribers : tuple of str
        Nodes of ours; ``driver`` and ``anybody`` stand for others.
    quality : str
        What our publishers offer; for topics of drivers, what our subscriptions ask for.
    frame, rate, meaning : str
    fields : mapping of str to str
        Meaning of the fields that carry more than their type says; of types of ours, the definition says it.
    """

    name: str
    msg_type: str
    publishers: tuple[str, ...]
    subscribers: tuple[str, ...]
    quality: str
    frame: str
    rate: str
    meaning: str
    fields: dict[str, str] = field(default_factory=dict)


_SENSOR_USERS = ("odometry", "monitor", "recorder")
_GNSS_USERS = ("pose_graph", "monitor", "recorder")
_CLOUD_FIELDS = {
    "x, y, z": "float32: coordinates in the local frame `map` [m]",
    "rgb": "colour of the change, packed as viewers expect",
    "change": "uint8: 0 Added, 1 Removed, 2 Increased, 3 Decreased, 4 Unchanged, 254 NotReported,"
    " 255 not decidable",
    "semantic": "uint8: 0 ground, 1 building, 2 vegetation, 3 mobile, 4 other",
    "instance": "int32: `object_id` of the table, -1 without object",
    "confidence": "float32: probability that the label is right, 0 to 1",
    "lod95": "float32: level of detection at 95 % [m]",
}

TOPICS: tuple[TopicRow, ...] = (
    TopicRow(
        "/ouster/metadata",
        "std_msgs/msg/String",
        ("driver", "replay"),
        _SENSOR_USERS,
        OFFERED,
        "",
        "once",
        "Metadata of the LiDAR: the JSON of the sensor's SDK.",
    ),
    TopicRow(
        "/ouster/lidar_packets",
        "ouster_sensor_msgs/msg/PacketMsg",
        ("driver", "replay"),
        _SENSOR_USERS,
        OFFERED,
        "lidar_link",
        "640 or 1,280 Hz",
        "LiDAR packets as the sensor sends them. Their time is the column time in the packet.",
        {"buf": "bytes of one UDP packet"},
    ),
    TopicRow(
        "/ouster/imu_packets",
        "ouster_sensor_msgs/msg/PacketMsg",
        ("driver", "replay"),
        ("recorder",),
        OFFERED,
        "imu_link",
        "100 Hz",
        "IMU packets of the LiDAR; recorded, not used for mapping.",
        {"buf": "bytes of one UDP packet"},
    ),
    TopicRow(
        "/lidar/points",
        "sensor_msgs/msg/PointCloud2",
        ("driver", "replay"),
        _SENSOR_USERS,
        OFFERED,
        "lidar_link",
        "10 or 20 Hz",
        "Clouds of any LiDAR, instead of packets.",
        {"t, time, timestamp ...": "time of each point; needed unless `deskewed` is set"},
    ),
    TopicRow(
        "/imu/data",
        "sensor_msgs/msg/Imu",
        ("driver", "replay"),
        _SENSOR_USERS,
        OFFERED,
        "imu_link",
        "100 Hz",
        "Angular velocity [rad/s] and specific force [m/s2] of the IMU; the orientation is not used.",
    ),
    TopicRow(
        "/gnss/fix",
        "sensor_msgs/msg/NavSatFix",
        ("driver", "replay"),
        _GNSS_USERS,
        OFFERED,
        "gnss_link",
        "1 to 20 Hz",
        "Position of the antenna: degrees, ellipsoidal height [m].",
        {
            "status.status": "meaning differs by driver, see `gnss.driver`; -1 and -2 are no fix",
            "position_covariance": "[m2], row major, east, north, up",
        },
    ),
    TopicRow(
        "/gnss/heading",
        "sensor_msgs/msg/Imu",
        ("driver", "replay"),
        ("pose_graph", "recorder"),
        OFFERED,
        "gnss_link",
        "1 to 20 Hz",
        "Heading of the antenna baseline.",
        {"orientation": "yaw, counter-clockwise from east (REP 103)", "orientation_covariance": "[rad2]"},
    ),
    TopicRow(
        "/gnss/time_reference",
        "sensor_msgs/msg/TimeReference",
        ("driver",),
        ("monitor", "recorder"),
        OFFERED,
        "",
        "1 Hz",
        "One message for each pulse of the receiver.",
    ),
    TopicRow(
        "/tf_static",
        "tf2_msgs/msg/TFMessage",
        ("driver", "replay", "pose_graph"),
        ("odometry", "pose_graph", "recorder"),
        LATCHED,
        "base_link; earth",
        "once",
        "Where the sensors sit, from drivers or the bag; `earth -> map` (ECEF to local) from the pose graph.",
    ),
    TopicRow(
        "/tf",
        "tf2_msgs/msg/TFMessage",
        ("odometry", "pose_graph"),
        ("anybody",),
        RELIABLE,
        "odom; map",
        "one each for each scan",
        "`odom -> base_link` of the odometry; `map -> odom` of the pose graph, identity until a solution.",
    ),
    TopicRow(
        "/odometry",
        "nav_msgs/msg/Odometry",
        ("odometry",),
        ("pose_graph", "monitor"),
        RELIABLE,
        "odom -> base_link",
        "one for each scan",
        "Pose and velocity of the vehicle at the last column of the scan.",
        {
            "pose.covariance": "row major, x y z [m2] then rotation about fixed axes of odom [rad2]",
            "twist": "velocity in base_link, mean since the previous scan [m/s, rad/s]",
            "twist.covariance": "1e6 on the diagonal where the velocity is not known",
        },
    ),
    TopicRow(
        "/odometry/quality",
        "subiaco_msgs/msg/ScanQuality",
        ("odometry",),
        ("pose_graph", "monitor"),
        RELIABLE,
        "lidar_link",
        "one for each scan",
        "How the scan was deskewed and registered.",
    ),
    TopicRow(
        "/odometry/facts",
        "std_msgs/msg/String",
        ("odometry",),
        ("pose_graph",),
        LATCHED,
        "",
        "1 Hz live, once for each sequence of a replay",
        "JSON: counts that the manifest of the map keeps.",
    ),
    TopicRow(
        "/points_deskewed",
        "sensor_msgs/msg/PointCloud2",
        ("odometry",),
        ("pose_graph",),
        RELIABLE,
        "lidar_link",
        "one for each scan",
        "Returns of one scan, free of the vehicle's motion, at the time of the last column.",
        {
            "x, y, z": "float32: coordinates in lidar_link [m]",
            "intensity": "float32: as the sensor gives it",
            "kind": "uint8: 0 strongest return, 1 second return",
        },
    ),
    TopicRow(
        "/points_sky",
        "sensor_msgs/msg/PointCloud2",
        ("odometry",),
        ("pose_graph",),
        RELIABLE,
        "lidar_link",
        "one for each scan",
        "Ends of beams that met nothing: up to there the air is empty. They are no surfaces.",
        {"x, y, z": "float32: end of the beam in lidar_link [m], at `decode.sky_range`"},
    ),
    TopicRow(
        "/path",
        "nav_msgs/msg/Path",
        ("pose_graph",),
        ("anybody",),
        LATCHED,
        "map",
        "at solutions; 1.4 Hz live",
        "Poses of lidar_link, at most 5,000, evenly thinned.",
    ),
    TopicRow(
        "/map/points",
        "sensor_msgs/msg/PointCloud2",
        ("pose_graph",),
        ("anybody",),
        LATCHED,
        "map",
        "at the end; 1.4 Hz live",
        "Preview of the map, at most `preview_points`; the map itself is in files.",
        {"x, y, z": "float32: local east, north, up [m]", "intensity": "float32: mean; at the end only"},
    ),
    TopicRow(
        "/map/origin",
        "sensor_msgs/msg/NavSatFix",
        ("pose_graph",),
        ("monitor",),
        LATCHED,
        "map",
        "at solutions",
        "Origin of the local frame `map`: degrees, ellipsoidal height [m].",
    ),
    TopicRow(
        "/quality/markers",
        "visualization_msgs/msg/MarkerArray",
        ("monitor",),
        ("anybody",),
        LATCHED,
        "map",
        "0.5 Hz",
        "Driven streets as coloured lines: green, amber, red.",
    ),
    TopicRow(
        "/quality/geojson",
        "std_msgs/msg/String",
        ("monitor",),
        ("anybody",),
        LATCHED,
        "",
        "0.5 Hz",
        "Driven and planned streets as GeoJSON, with light and reasons.",
    ),
    TopicRow(
        "/change/before",
        "sensor_msgs/msg/PointCloud2",
        ("change",),
        ("anybody",),
        LATCHED,
        "map",
        "once",
        "Labelled points of the earlier survey, in the frame of the later one.",
        _CLOUD_FIELDS,
    ),
    TopicRow(
        "/change/after",
        "sensor_msgs/msg/PointCloud2",
        ("change",),
        ("anybody",),
        LATCHED,
        "map",
        "once",
        "Labelled points of the later survey.",
        _CLOUD_FIELDS,
    ),
    TopicRow(
        "/change/origin",
        "sensor_msgs/msg/NavSatFix",
        ("change",),
        ("anybody",),
        LATCHED,
        "map",
        "once",
        "Origin of the frame `map` of the clouds and markers of change: degrees, ellipsoidal height [m].",
    ),
    TopicRow(
        "/change/table",
        "subiaco_msgs/msg/ChangeTable",
        ("change",),
        ("anybody",),
        LATCHED,
        "map",
        "once",
        "The whole change table.",
    ),
    TopicRow(
        "/change/markers",
        "visualization_msgs/msg/MarkerArray",
        ("change",),
        ("anybody",),
        LATCHED,
        "map",
        "once",
        "A box (`objects`) and a text (`labels`) for each changed object.",
    ),
    TopicRow(
        "/progress",
        "diagnostic_msgs/msg/DiagnosticStatus",
        ("replay", "pose_graph", "change"),
        ("anybody",),
        LATCHED,
        "",
        "every 2 %",
        "Stage and fraction of the work of a node.",
        {"name": "node", "message": "stage", "values[fraction]": "0 to 1"},
    ),
    TopicRow(
        "/diagnostics",
        "diagnostic_msgs/msg/DiagnosticArray",
        ("odometry", "pose_graph", "monitor", "recorder", "change", "driver"),
        ("monitor", "recorder"),
        RELIABLE,
        "",
        "1 Hz, and at once when a level or message changes",
        "Statuses named `NODE: TASK`. The name is absolute: namespaces share the topic.",
        {"status.hardware_id": "product and serial number of the LiDAR, host of the disk, or `none`"},
    ),
    TopicRow(
        "/clock",
        "rosgraph_msgs/msg/Clock",
        ("replay",),
        ("anybody",),
        RELIABLE,
        "",
        "100 Hz of log time",
        "Log time of the bag; the name is absolute.",
    ),
    TopicRow(
        "/replay/sequence",
        "subiaco_msgs/msg/ReplayCounts",
        ("replay",),
        ("odometry", "pose_graph"),
        LATCHED,
        "",
        "once for each bag",
        "A bag begins: its name, and how many messages each topic has.",
    ),
    TopicRow(
        "/replay/consumed",
        "subiaco_msgs/msg/ReplayCounts",
        ("odometry", "pose_graph"),
        ("replay", "odometry"),
        LATCHED,
        "",
        "every 16 messages, at least every 20 ms while there is news",
        "How many messages of each topic a node has taken since it started.",
    ),
    TopicRow(
        "/replay/end",
        "subiaco_msgs/msg/ReplayCounts",
        ("replay",),
        ("odometry",),
        LATCHED,
        "",
        "once",
        "All bags are played: how many messages of each topic were sent.",
    ),
    TopicRow(
        "/odometry/sequence",
        "subiaco_msgs/msg/ReplayCounts",
        ("odometry",),
        ("pose_graph",),
        LATCHED,
        "",
        "once for each bag",
        "The odometry begins a bag: how many messages it has sent before.",
    ),
    TopicRow(
        "/odometry/end",
        "subiaco_msgs/msg/ReplayCounts",
        ("odometry",),
        ("pose_graph",),
        LATCHED,
        "",
        "once",
        "The odometry has sent everything: how many messages of each topic.",
    ),
)


@dataclass(frozen=True)
class ServiceRow:
    """One service or action."""

    name: str
    kind: str
    node: str
    meaning: str


SERVICES: tuple[ServiceRow, ...] = (
    ServiceRow(
        "/pose_graph/optimize", "subiaco_msgs/srv/Optimize", "pose_graph", "Solves with everything so far."
    ),
    ServiceRow(
        "/pose_graph/save_map", "subiaco_msgs/srv/SaveMap", "pose_graph", "Solves, fuses, writes a map."
    ),
    ServiceRow(
        "/change/detect",
        "subiaco_msgs/action/DetectChanges",
        "change",
        "Compares two maps; progress as feedback.",
    ),
)
