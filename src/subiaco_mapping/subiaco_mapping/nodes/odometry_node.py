"""Node: packets (or clouds) and IMU to odometry and deskewed scans."""

from __future__ import annotations

import json
import logging
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Protocol

from nav_msgs.msg import Odometry
from pydantic import Field
from rclpy.node import Node
from sensor_msgs.msg import Imu, PointCloud2
from std_msgs.msg import String

from ouster_sensor_msgs.msg import PacketMsg
from subiaco_geo.bags import packet_from_cdr
from subiaco_geo.config import StrictModel
from subiaco_geo.frames import invert_pose
from subiaco_geo.topics import IMU, LIDAR_PACKETS, METADATA, POINTS, TF_STATIC
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.fusion.preview import OdometrySegments
from subiaco_mapping.measurements import Extrinsics, ImuSample, OdometryPose, Scan
from subiaco_mapping.nodes.counts import ConsumptionReporter, counts_message, listen_to_consumers
from subiaco_mapping.nodes.covariance import PoseCovariance, base_velocity
from subiaco_mapping.nodes.extrinsics import StaticTransforms, sensors_needed
from subiaco_mapping.nodes.flow import ConsumedCounter, FlowControl
from subiaco_mapping.nodes.live_sources import ExtrinsicsWaiter, ListenerWaiter
from subiaco_mapping.nodes.messages import odometry_message, quality_message, scan_message, sky_message
from subiaco_mapping.nodes.missed_messages import Arrivals
from subiaco_mapping.nodes.names import (
    CLOUD,
    END,
    FACTS,
    ODOMETRY,
    ODOMETRY_END,
    ODOMETRY_SEQUENCE,
    QUALITY,
    SEQUENCE,
    SKY,
)
from subiaco_mapping.odometry.frontend import FrontendOutput, OdometryFrontend
from subiaco_mapping.preprocessing.cloud_sky import SkyOfClouds
from subiaco_mapping.preprocessing.conversions import imu_from_msg, scan_from_points
from subiaco_msgs.msg import ReplayCounts, ScanQuality
from subiaco_ros.diagnostics import Diagnostics, lidar_identity
from subiaco_ros.managed_node import App
from subiaco_ros.messages import transform_message
from subiaco_ros.node_process import run_node
from subiaco_ros.parameters import read_models
from subiaco_ros.qos import latched, overridable, reliable
from subiaco_ros.qos_adaptation import Wanted, follow_offers
from tf2_msgs.msg import TFMessage

LOGGER = logging.getLogger(__name__)

OUTPUTS = (ODOMETRY, CLOUD, SKY, QUALITY, FACTS, ODOMETRY_SEQUENCE, ODOMETRY_END)
INPUTS = (METADATA, TF_STATIC, LIDAR_PACKETS, POINTS, IMU, SEQUENCE, END)

#: Most deskewed scans that a consumer may be behind before the replay is slowed down.
SCAN_WINDOW = 4

#: What the middleware keeps while a scan is registered; fastrtps keeps no more, whatever is asked for.
#: At 2048x10 four seconds of packets (165 MB), at 512x10 sixteen.
_SENSOR_DEPTH = 5000
_CLOUD_DEPTH = 64

#: Messages of a sensor taken in one turn, and how long is waited for other callbacks where none had come [s].
_TURN, _PATIENCE = 64, 0.005

#: Scans that lie further before those that were registered are no late ones: time went back [ns].
_WENT_BACK_NS = 500_000_000

#: Between two reports of the facts of a live drive, which has no end that could be waited for [s].
_FACTS_INTERVAL = 1.0


class OdometryParameters(StrictModel):
    """Parameters of the odometry node; everything else is the mapping configuration."""

    odom_frame: str = Field("odom", description="Frame of the odometry poses")
    consumers: tuple[str, ...] = Field((), description="Nodes whose message counts the odometry waits for")
    listeners: tuple[str, ...] = Field(
        (), description="Nodes that have to listen before a live odometry begins; it waits 10 s at most"
    )
    exit_at_end: bool = Field(False, description="End the node when the replay ends")


class Frontend(Protocol):
    """The step that this node wraps; ``behind_ns`` is how far its newest scan lies before the one before."""

    behind_ns: int

    def set_metadata(self, metadata: str) -> None:
        """Give the sensor's metadata, where it was not known at the start."""

    def on_packet(self, buf: bytes | memoryview) -> list[FrontendOutput]:
        """Take one packet."""

    def on_points(self, scan: Scan) -> list[FrontendOutput]:
        """Take one cloud."""

    def on_imu(self, sample: ImuSample) -> list[FrontendOutput]:
        """Take one IMU sample."""

    def finish(self) -> list[FrontendOutput]:
        """Close the stream."""

    def facts(self) -> dict[str, Any]:
        """Return what the manifest should hold about the sequence."""


#: Makes a front end for one sequence.
MakeFrontend = Callable[[Extrinsics, "str | None"], Frontend]


class OdometryApp:
    """Convert, step, publish.

    Parameters
    ----------
    node : Node
    own : OdometryParameters
    config : MappingConfig
    make_frontend : callable
        Called once a sequence, when its first data arrives.
    """

    def __init__(
        self, node: Node, own: OdometryParameters, config: MappingConfig, make_frontend: MakeFrontend
    ) -> None:
        self._own = own
        self._config = config
        self._make_frontend = make_frontend
        self._transforms = StaticTransforms(config.sensors)
        self._metadata: str | None = None
        self._announced: frozenset[str] = frozenset()
        self._frontend: Frontend | None = None
        self._sky = SkyOfClouds()
        self._extrinsics = Extrinsics()
        self._covariance: PoseCovariance | None = None
        self._last_pose: OdometryPose | None = None
        self._ended = False
        self._start = ExtrinsicsWaiter(("imu",))
        self._run = 0
        self._arrivals = Arrivals()
        self._facts_at = 0.0
        self._facts = ""
        self.flow = FlowControl(own.consumers, dict.fromkeys(OUTPUTS, SCAN_WINDOW))
        self._diagnostics = Diagnostics(node, "registration")
        self._create_publishers(node)
        self._listeners = ListenerWaiter(partial(self._not_listening, node))
        self._reporter = ConsumptionReporter(node, ConsumedCounter(INPUTS), self._downstream_has_room)
        listen_to_consumers(node, self.flow, self._reporter.flush)
        self._create_subscriptions(node)

    def _create_publishers(self, node: Node) -> None:
        frame_types = {ODOMETRY: Odometry, CLOUD: PointCloud2, SKY: PointCloud2, QUALITY: ScanQuality}
        self._publishers = {
            topic: node.create_publisher(kind, topic.lstrip("/"), reliable(32))
            for topic, kind in frame_types.items()
        }
        for topic in (ODOMETRY_SEQUENCE, ODOMETRY_END):
            self._publishers[topic] = node.create_publisher(ReplayCounts, topic.lstrip("/"), latched(1))
        # latched: the first report comes before other nodes have found this one
        self._publishers[FACTS] = node.create_publisher(String, FACTS.lstrip("/"), latched(32))
        self._tf = node.create_publisher(TFMessage, "tf", reliable(100))

    def _not_listening(self, node: Node) -> list[str]:
        """Return the listeners that are not matched: all take poses and quality, one at least the scans."""
        awaited = list(self._own.listeners)
        if not awaited:
            return []
        matched = {topic: self._matched(node, topic) for topic in (ODOMETRY, QUALITY, CLOUD, SKY)}
        if not (matched[CLOUD] and matched[SKY]):
            return awaited
        return [name for name in awaited if name not in matched[ODOMETRY] & matched[QUALITY]]

    def _matched(self, node: Node, topic: str) -> set[str]:
        """Return which listeners take a topic of ours, none while one of them is found but not matched."""
        publisher = self._publishers[topic]
        ends = node.get_subscriptions_info_by_topic(publisher.topic_name)
        named = {end.node_name for end in ends} & set(self._own.listeners)
        return named if publisher.get_subscription_count() >= len(named) else set()

    def _create_subscriptions(self, node: Node) -> None:
        sensors: tuple[tuple[Any, str, Callable[[Any], object], int, bool], ...] = (
            (Imu, IMU, self._on_imu, _SENSOR_DEPTH, False),
            (PointCloud2, POINTS, self._on_points, _CLOUD_DEPTH, False),
            (PacketMsg, LIDAR_PACKETS, self._on_packet, _SENSOR_DEPTH, True),
        )
        wanted = [
            (kind, topic, self._arrivals.counted(topic, self._counting(topic, handler)), depth, raw)
            for kind, topic, handler, depth, raw in sensors
        ]
        self._drains = self._polled(node, wanted)
        follow_offers(node, [(String, METADATA, self._counting(METADATA, self._on_metadata), 1, False)])
        handlers: tuple[tuple[Any, str, Callable[[Any], object], Any], ...] = (
            (TFMessage, TF_STATIC, self._on_tf_static, latched(100)),
            (ReplayCounts, SEQUENCE, self._on_sequence, latched(1)),
            (ReplayCounts, END, self._on_end, latched(1)),
        )
        for kind, topic, on_message, profile in handlers:
            node.create_subscription(
                kind,
                topic.lstrip("/"),
                self._counting(topic, on_message),
                profile,
                qos_overriding_options=overridable(),
            )

    @staticmethod
    def _polled(node: Node, wanted: Sequence[Wanted]) -> list[Callable[[], int]]:
        """Subscribe to the sensors as they are offered; return what takes the messages of each."""
        offered = follow_offers(node, wanted, {topic for _, topic, *_ in wanted})
        return [partial(subscription.drain, _TURN) for subscription in offered.values()]

    def _counting(self, topic: str, handler: Callable[[Any], object]) -> Callable[[Any], None]:
        def counted(message: Any) -> None:
            if handler(message) is not False:
                self._reporter.consumed(topic)

        return counted

    def _downstream_has_room(self) -> bool:
        return self.flow.ready and all(self.flow.may_publish(topic) for topic in OUTPUTS)

    @property
    def done(self) -> bool:
        """Whether the replay has ended and our consumers have everything."""
        return self._own.exit_at_end and self._ended and self.flow.settled

    def step(self) -> float:
        """Take what the sensors sent; say now and then how a live drive stands: it may end at any moment."""
        if not self._listeners.over:
            return _PATIENCE
        taken = sum(take() for take in self._drains)
        live = self._frontend is not None and not self._announced
        if live and time.monotonic() >= self._facts_at:
            self._facts_at = time.monotonic() + _FACTS_INTERVAL
            self._send_facts({"arrivals_odometry": self._arrivals.facts()})
        return 0.0 if taken else _PATIENCE

    def _on_metadata(self, message: String) -> None:
        self._metadata = message.data
        self._diagnostics.hardware_id = lidar_identity(message.data)
        if self._frontend is not None:
            self._frontend.set_metadata(message.data)

    def _on_tf_static(self, message: TFMessage) -> bool:
        return self._transforms.add(message)

    def _on_packet(self, raw: bytes) -> None:
        if not self._announced and self._metadata is None:
            self._start.waiting_for(f"{METADATA}: the driver has not sent the sensor's metadata yet")
            self._arrivals.leave_out(LIDAR_PACKETS)
            return
        frontend = self._sequence_frontend(LIDAR_PACKETS)
        if frontend is not None:
            self._publish(frontend.on_packet(packet_from_cdr(raw)))
            self._follow_time(frontend, LIDAR_PACKETS)

    def _on_points(self, message: PointCloud2) -> None:
        if LIDAR_PACKETS in self._announced:
            return
        frontend = self._sequence_frontend(POINTS)
        if frontend is not None:
            self._publish(frontend.on_points(scan_from_points(message, self._config, self._sky)))
            self._follow_time(frontend, POINTS)

    def _on_imu(self, message: Imu) -> None:
        frontend = self._sequence_frontend(IMU)
        if frontend is not None:
            self._publish(frontend.on_imu(imu_from_msg(message)))

    def _follow_time(self, frontend: Frontend, topic: str) -> None:
        """Begin again where the time of live scans went back: else none would be newer for as long."""
        if self._announced or frontend.behind_ns <= _WENT_BACK_NS:
            return
        LOGGER.warning(
            "%s: time went back by %.1f s (a clock that was set, or a bag that is played in a loop); the "
            "odometry begins again", topic, frontend.behind_ns * 1e-9,
        )  # fmt: skip
        self._finish_sequence()

    def _on_sequence(self, message: ReplayCounts) -> None:
        self._finish_sequence()
        self._transforms = StaticTransforms(self._config.sensors)
        self._metadata = None
        self._announced = frozenset(message.topics)
        self._send(ODOMETRY_SEQUENCE, counts_message(message.source, self._output_counts()))

    def _on_end(self, _message: ReplayCounts) -> None:
        self._finish_sequence()
        counts = self._output_counts()
        self._send(ODOMETRY_END, counts_message("odometry", counts))
        self._ended = True
        LOGGER.info("odometry of %d scans done", counts[ODOMETRY])

    def _output_counts(self) -> dict[str, int]:
        return {topic: self.flow.totals[topic] for topic in (ODOMETRY, CLOUD, SKY, QUALITY, FACTS)}

    def _sequence_frontend(self, topic: str) -> Frontend | None:
        """Return the front end of the sequence; on live topics None until the sensors' places are known."""
        if self._frontend is None:
            if self._announced:
                extrinsics = self._transforms.extrinsics(sensors_needed(self._announced))
            else:
                known = self._start.extrinsics(self._transforms)
                if known is None:
                    self._arrivals.leave_out(topic)
                    return None
                begun = OdometrySegments.RUN * int(time.time() % 2_000_000)
                extrinsics, self._run = known, max(begun, self._run + OdometrySegments.RUN)
            self._extrinsics = extrinsics
            self._covariance, self._last_pose = PoseCovariance(self._extrinsics.T_base_lidar), None
            self._frontend = self._make_frontend(self._extrinsics, self._metadata)
        return self._frontend

    def _finish_sequence(self) -> None:
        if self._frontend is not None:
            self._publish(self._frontend.finish())
            self._facts = ""  # the end of a sequence says them, whatever was said before
            self._send_facts({})
            self._frontend = None

    def _send_facts(self, more: Mapping[str, Any]) -> None:
        """Send what has changed since it was sent last."""
        if self._frontend is None:
            return
        text = json.dumps({**self._frontend.facts(), **more})
        if text != self._facts:
            self._facts = text
            self._send(FACTS, String(data=text))

    def _publish(self, outputs: list[FrontendOutput]) -> None:
        for output in outputs:
            self._publish_one(output)

    def _publish_one(self, output: FrontendOutput) -> None:
        assert self._covariance is not None
        if self._run:  # segments of a restarted live odometry differ from those before
            output = replace(output, pose=replace(output.pose, segment=output.pose.segment + self._run))
        sensors, odom = self._config.sensors, self._own.odom_frame
        message = odometry_message(
            output.pose,
            self._extrinsics.T_base_lidar,
            self._covariance.step(output.pose),
            odom,
            sensors.base_frame,
            base_velocity(self._last_pose, output.pose, self._extrinsics.T_base_lidar),
        )
        self._last_pose = output.pose
        self._send(QUALITY, quality_message(output.pose, output.scan, sensors.lidar_frame))
        self._send(ODOMETRY, message)
        self._send(CLOUD, scan_message(output.scan, sensors.lidar_frame))
        self._send(SKY, sky_message(output.scan, sensors.lidar_frame))
        T_odom_base = output.pose.T_odom_lidar @ invert_pose(self._extrinsics.T_base_lidar)
        moving = transform_message(T_odom_base, odom, sensors.base_frame, output.pose.stamp_ns)
        self._tf.publish(TFMessage(transforms=[moving]))
        self._report(output)

    def _send(self, topic: str, message: Any) -> None:
        self._publishers[topic].publish(message)
        self.flow.published(topic)

    def _report(self, output: FrontendOutput) -> None:
        pose, scan = output.pose, output.scan
        values = {
            "scans": self.flow.totals[ODOMETRY],
            "inliers": pose.inliers,
            "residual_rmse": f"{pose.residual_rmse:.3f}",
            "segment": pose.segment,
            "deskew": scan.mode,
            "lost_columns": scan.lost_columns,
        }
        poor = pose.degenerate or pose.predicted
        self._diagnostics.report("degenerate" if poor else "odometry", values, warn=poor)


def build(node: Node) -> App:
    """Put the node together from its parameters."""
    own, config = read_models(node, OdometryParameters, MappingConfig)

    def make_frontend(extrinsics: Extrinsics, metadata: str | None) -> Frontend:
        return OdometryFrontend(config, extrinsics, metadata)

    return OdometryApp(node, own, config, make_frontend)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run_node("odometry", build, argv)


if __name__ == "__main__":
    sys.exit(main())
