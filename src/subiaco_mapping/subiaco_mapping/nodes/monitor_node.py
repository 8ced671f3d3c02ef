"""Node: watch a live vehicle (or a replay) and say what is wrong."""

from __future__ import annotations

import json
import shutil
import socket
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from nav_msgs.msg import Odometry
from pydantic import Field
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import Imu, NavSatFix, PointCloud2, TimeReference
from std_msgs.msg import String
from visualization_msgs.msg import MarkerArray

from ouster_sensor_msgs.msg import PacketMsg
from subiaco_geo.config import StrictModel
from subiaco_geo.crs import EnuFrame
from subiaco_geo.errors import InputError
from subiaco_geo.topics import FIX, IMU, LIDAR_PACKETS, METADATA, POINTS
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.health_monitor.config import PPS_WORDS
from subiaco_mapping.health_monitor.dop import dop_of_gps_fix, dop_of_nmea
from subiaco_mapping.health_monitor.files import SurveyFiles
from subiaco_mapping.health_monitor.monitor import Monitor, OdometryNote
from subiaco_mapping.health_monitor.routes import read_route
from subiaco_mapping.health_monitor.snapshot import Snapshot, take_snapshot
from subiaco_mapping.nodes.markers import street_markers
from subiaco_mapping.nodes.names import ODOMETRY, QUALITY
from subiaco_mapping.preprocessing.conversions import fix_from_msg, imu_from_msg, stamp_ns
from subiaco_mapping.recording.losses import header_stamp_ns
from subiaco_mapping.topic_names import GPS_FIX, NMEA_SENTENCE, TIME_REFERENCE
from subiaco_msgs.msg import ScanQuality
from subiaco_ros.diagnostics import NO_HARDWARE, lidar_identity, status_prefix
from subiaco_ros.managed_node import App
from subiaco_ros.node_process import run_node
from subiaco_ros.parameters import read_models
from subiaco_ros.qos import latched
from subiaco_ros.qos_adaptation import OfferedSubscription, Wanted, follow_offers
from subiaco_ros.stamp_matching import StampMatcher
from subiaco_ros.supervision import supervisor_channel
from subiaco_ros.topic_names import DIAGNOSTICS

TICK_INTERVAL = 0.1
STATUS_INTERVAL = 0.5
MARKER_INTERVAL = 2.0
FILE_INTERVAL = 5.0
#: Status of the recorder; that of the monitor's own namespace counts, and one that records for all of them.
RECORDER = "recorder: recording"
PATIENCE = 0.05
_MOST_WAIT_NS = 10_000_000_000
#: A simulated clock that goes back by more was set back; by less, its messages came out of order [ns].
_LOOP_NS = 500_000_000


class MonitorParameters(StrictModel):
    """Parameters of the monitor node; everything else is the mapping configuration."""

    output_directory: str = Field(
        "", description="Directory for manifest.yaml and quality.geojson; empty writes no files"
    )
    sequence: str = Field("live", description="Name of the drive in the manifest")
    route: str = Field("", description="File of the planned route: GeoJSON, or CSV with lat and lon")
    disk_path: str = Field(
        "", description="Folder on the disk whose free space is monitored; empty takes output_directory"
    )
    map_frame: str = Field("map", description="Frame of the published markers")
    pps_words: tuple[str, ...] = Field(
        PPS_WORDS,
        description="Words in the name of a status on /diagnostics that reports the lock on the PPS signal",
    )


class StreamTime:
    """Two times of now: one that never jumps, and the host's clock.

    With ``use_sim_time`` both are that of the replay, 0 until it speaks. Where a bag is played in a loop,
    they go on from its end.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self.simulated = bool(node.get_parameter("use_sim_time").value)
        self._offset_ns = time.time_ns() - time.monotonic_ns()
        self._played_ns = self._newest_ns = 0

    def __call__(self) -> tuple[int, int]:
        """Return ``(now_ns, arrival_ns)``."""
        if self.simulated:
            now_ns = self._replayed(int(self._node.get_clock().now().nanoseconds))
            return now_ns, now_ns
        return time.monotonic_ns() + self._offset_ns, time.time_ns()

    def _replayed(self, clock_ns: int) -> int:
        """Return the time of a replay, which does not go back."""
        if clock_ns and clock_ns + self._played_ns < self._newest_ns - _LOOP_NS:
            self._played_ns = self._newest_ns - clock_ns
            self._node.get_logger().warning("/clock went back: a bag that is played in a loop")
        self._newest_ns = max(self._newest_ns, clock_ns + self._played_ns if clock_ns else 0)
        return self._newest_ns


class MonitorApp:
    """Hand messages to the watch, publish and write what it says.

    Parameters
    ----------
    node : Node
    own : MonitorParameters
    monitor : Monitor
    files : SurveyFiles or None
    times : callable
        Returns ``(now_ns, arrival_ns)``.
    free : callable
        Returns the free space of the disk [bytes].
    """

    done = False

    def __init__(
        self,
        node: Node,
        own: MonitorParameters,
        monitor: Monitor,
        files: SurveyFiles | None,
        times: Callable[[], tuple[int, int]],
        free: Callable[[], float],
    ) -> None:
        self._node = node
        self._own = own
        self._monitor = monitor
        self._files = files
        self._times = times
        self._free = free
        self._origin: EnuFrame | None = None
        self._received_ns = 0
        self._shown: set[tuple[str, str, int, bool]] = set()
        self._simulated = bool(node.get_parameter("use_sim_time").value)
        self._matcher = StampMatcher((ODOMETRY, QUALITY))
        self._channel = supervisor_channel()
        self._prefix = status_prefix(node)
        self._hardware = dict.fromkeys(("lidar", "disk"), NO_HARDWARE)
        self._hardware["disk"] = socket.gethostname()
        self._diagnostics = node.create_publisher(DiagnosticArray, DIAGNOSTICS, 10)
        self._markers = node.create_publisher(MarkerArray, "quality/markers", latched(1))
        self._geojson = node.create_publisher(String, "quality/geojson", latched(1))
        self._subscriptions = self._make_subscriptions()
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        for interval, handler in (
            (TICK_INTERVAL, self._tick),
            (STATUS_INTERVAL, self._publish),
            (MARKER_INTERVAL, self._publish_streets),
            (FILE_INTERVAL, self._write),
        ):
            node.create_timer(interval, handler, clock=steady)

    def step(self) -> float:
        """Take the packets that have arrived; at the executor's pace a busy machine would fall behind."""
        self._subscriptions[LIDAR_PACKETS].drain()
        return PATIENCE

    def close(self) -> None:
        """Leave complete files."""
        self._write()

    def _make_subscriptions(self) -> dict[str, OfferedSubscription]:
        wanted: list[Wanted] = [
            (PacketMsg, LIDAR_PACKETS, self._on_packet, 2048, True),
            (String, METADATA, self._on_metadata, 1, False),
            (PointCloud2, POINTS, self._on_points, 8, True),
            (Imu, IMU, self._on_imu, 512, False),
            (NavSatFix, FIX, self._on_fix, 64, False),
            (TimeReference, TIME_REFERENCE, self._on_time_reference, 16, False),
            (Odometry, ODOMETRY, lambda m: self._on_part(ODOMETRY, m), 32, False),
            (ScanQuality, QUALITY, lambda m: self._on_part(QUALITY, m), 32, False),
            (NavSatFix, "/map/origin", self._on_origin, 1, False),
            (DiagnosticArray, DIAGNOSTICS, self._on_diagnostics, 64, False),
        ]
        for kind, topic, handler in (
            ("gps_msgs.msg:GPSFix", GPS_FIX, self._on_gps_fix),
            ("nmea_msgs.msg:Sentence", NMEA_SENTENCE, self._on_sentence),
        ):
            found = _optional(kind)
            if found is not None:
                wanted.append((found, topic, handler, 64, False))
        timed = [
            (kind, topic, handler if topic == METADATA else self._timed(handler), depth, raw)
            for kind, topic, handler, depth, raw in wanted
        ]
        return follow_offers(self._node, timed, polled=(LIDAR_PACKETS,))

    def _timed(self, handler: Callable[[Any], None]) -> Callable[[Any, Any], None]:
        """Let a handler know when its message reached this host, however long it waited for us.

        Before a replay has told its time, nothing can be said of when a message came.
        """

        def on_message(message: Any, info: Any) -> None:
            if self._simulated and not self._times()[0]:
                return
            self._received_ns = int(info["received_timestamp"])
            handler(message)
            self._received_ns = 0

        return on_message

    def _when(self) -> tuple[int, int]:
        """Return ``(now_ns, arrival_ns)`` of the message being handled."""
        now_ns, arrival_ns = self._times()
        waited = arrival_ns - self._received_ns
        if self._received_ns and not self._simulated and 0 <= waited < _MOST_WAIT_NS:
            return now_ns - waited, arrival_ns - waited
        return now_ns, arrival_ns

    def _tick(self) -> None:
        now_ns = self._times()[0]
        if now_ns > 0:
            self._monitor.on_offer(self._subscriptions[LIDAR_PACKETS].reliable, now_ns)
            self._monitor.on_disk(self._free(), now_ns)
        stretches = {(s.name, s.source, s.start_ns, s.end_ns is None) for s in self._monitor.flags}
        if stretches != self._shown:  # what is new is said at once
            self._shown = stretches
            self._publish()

    def _on_metadata(self, message: String) -> None:
        self._monitor.on_metadata(message.data)
        self._hardware["lidar"] = lidar_identity(message.data)

    def _on_packet(self, raw: bytes) -> None:
        self._monitor.on_packet(raw, *self._when())

    def _on_points(self, raw: bytes) -> None:
        stamp = header_stamp_ns(raw)
        if stamp is not None:
            self._monitor.on_points(stamp, *self._when())

    def _on_imu(self, message: Imu) -> None:
        self._monitor.on_imu(imu_from_msg(message), *self._when())

    def _on_fix(self, message: NavSatFix) -> None:
        self._monitor.on_fix(fix_from_msg(message, self._monitor.config.gnss), *self._when())

    def _on_time_reference(self, _message: TimeReference) -> None:
        self._monitor.on_time_reference(self._when()[0])

    def _on_gps_fix(self, message: Any) -> None:
        self._monitor.on_dop(*dop_of_gps_fix(message), self._when()[0])

    def _on_sentence(self, message: Any) -> None:
        found = dop_of_nmea(message.sentence)
        if found is not None:
            self._monitor.on_dop(*found, self._when()[0])

    def _on_origin(self, message: NavSatFix) -> None:
        self._origin = EnuFrame(message.latitude, message.longitude, message.altitude)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        own = self._node.get_namespace().strip("/").lower()
        for status in message.status:
            name = status.name.lower()
            if name in (RECORDER, f"{own}/{RECORDER}"):
                stopped = status.level == DiagnosticStatus.ERROR
                self._monitor.on_recorder(stopped, status.message, self._when()[0])
            if not name.startswith(self._prefix.lower()) and any(
                word in name for word in self._own.pps_words
            ):
                locked = status.level == DiagnosticStatus.OK
                self._monitor.on_pps_lock(locked, f"{status.name}: {status.message}", self._when()[0])

    def _on_part(self, kind: str, message: Any) -> None:
        found = self._matcher.add(kind, stamp_ns(message.header.stamp), message)
        if found is None:
            return
        odometry, quality = found
        position = odometry.pose.pose.position
        note = OdometryNote(
            np.array([position.x, position.y, position.z]),
            quality.degenerate,
            quality.predicted,
            quality.segment,
            quality.columns,
            quality.lost_columns,
        )
        self._monitor.on_odometry(note, self._when()[0])

    def _publish(self) -> None:
        snapshot = take_snapshot(
            self._monitor, float("nan") if self._files is None else self._files.remaining
        )
        stamp = self._node.get_clock().now().to_msg()
        self._diagnostics.publish(diagnostic_array(snapshot, stamp, self._prefix, self._hardware))
        self._channel.status(snapshot.as_dict())

    def _publish_streets(self) -> None:
        frame = self._monitor.positions.frame
        if frame is None:
            return
        collection = self._monitor.streets.geojson(frame)
        self._geojson.publish(String(data=json.dumps(collection)))
        if self._origin is not None:
            self._markers.publish(street_markers(collection, self._origin, self._own.map_frame))

    def _write(self) -> None:
        if self._files is not None and self._monitor.start_ns is not None:
            self._files.write(self._monitor)


def _optional(name: str) -> Any:
    """Return a message class of a package that may not be installed."""
    module, _, kind = name.partition(":")
    try:
        return getattr(import_module(module), kind)
    except ImportError:
        return None


def diagnostic_array(
    snapshot: Snapshot, stamp: Any, prefix: str, hardware: Mapping[str, str]
) -> DiagnosticArray:
    """Build the message of a snapshot: one status a line, and one for the street.

    Parameters
    ----------
    prefix : str
        How the names begin.
    hardware : mapping
        Identity of the hardware by line.
    """
    levels = (DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR, DiagnosticStatus.STALE)
    array = DiagnosticArray()
    array.header.stamp = stamp
    for line in snapshot.lines:
        values = [KeyValue(key=key, value=value) for key, value in line.values.items()]
        array.status.append(
            DiagnosticStatus(
                level=levels[line.level],
                name=prefix + line.name,
                message=line.message,
                hardware_id=hardware.get(line.name, NO_HARDWARE),
                values=values,
            )
        )
    level = {"red": 2, "amber": 1}.get(snapshot.light, 0)
    counts = [KeyValue(key=key, value=str(value)) for key, value in snapshot.counts.items()]
    words = snapshot.light + (": " + ", ".join(snapshot.reasons) if snapshot.reasons else "")
    street = DiagnosticStatus(
        level=levels[level], name=prefix + "street", message=words, hardware_id=NO_HARDWARE, values=counts
    )
    array.status.append(street)
    return array


def build(node: Node) -> App:
    """Put the node together from its parameters."""
    own, config = read_models(node, MonitorParameters, MappingConfig)
    directory = Path(own.output_directory) if own.output_directory else None
    routes = read_route(Path(own.route)) if own.route else []
    if directory is None and routes:
        raise InputError("route: needs output_directory, where quality.geojson goes")
    files = None if directory is None else SurveyFiles(directory, own.sequence, routes)
    disk = Path(own.disk_path) if own.disk_path else directory
    times = StreamTime(node)
    monitor = Monitor(config, host_clock=not times.simulated)
    return MonitorApp(node, own, monitor, files, times, lambda: free_space(disk))


def free_space(path: Path | None) -> float:
    """Return the free space of the disk that holds a path, which need not exist yet; NaN without one."""
    if path is None:
        return float("nan")
    standing = next(place for place in (path.absolute(), *path.absolute().parents) if place.exists())
    return float(shutil.disk_usage(standing).free)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run_node("monitor", build, argv)


if __name__ == "__main__":
    sys.exit(main())
