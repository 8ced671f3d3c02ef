"""Node: odometry, scans and fixes to path, map and map directory."""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from nav_msgs.msg import Odometry
from pydantic import Field
from rclpy.node import Node
from sensor_msgs.msg import Imu, NavSatFix, PointCloud2
from std_msgs.msg import String

from subiaco_geo.atomic import refuse_existing
from subiaco_geo.bag_files import sequence_name
from subiaco_geo.bags import hash_bag
from subiaco_geo.config import StrictModel
from subiaco_geo.errors import InputError, SubiacoError
from subiaco_geo.maps import write_map
from subiaco_geo.simulated import mark_simulated
from subiaco_geo.survey_map import SurveyMap
from subiaco_geo.topics import FIX, HEADING, TF_STATIC
from subiaco_mapping.backend import Backend, MappingBackend, spool_folder
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.fusion.preview import OdometrySegments
from subiaco_mapping.health_monitor.files import extended, read_manifest, with_watched
from subiaco_mapping.measurements import (
    Extrinsics,
)
from subiaco_mapping.nodes.counts import ConsumptionReporter
from subiaco_mapping.nodes.extrinsics import StaticTransforms, sensors_needed
from subiaco_mapping.nodes.flow import ConsumedCounter
from subiaco_mapping.nodes.live_sources import ExtrinsicsWaiter, LiveMap, LiveTimes
from subiaco_mapping.nodes.map_publisher import MapPublisher
from subiaco_mapping.nodes.messages import pose_from_messages, scan_from_messages
from subiaco_mapping.nodes.missed_messages import Arrivals, missed_messages
from subiaco_mapping.nodes.names import (
    CLOUD,
    FACTS,
    ODOMETRY,
    ODOMETRY_END,
    ODOMETRY_SEQUENCE,
    QUALITY,
    SEQUENCE,
    SKY,
)
from subiaco_mapping.preprocessing.conversions import fix_from_msg, heading_from_msg, stamp_ns
from subiaco_mapping.survey_graph.solution import GraphSolution, LiveEstimate
from subiaco_msgs.msg import ReplayCounts, ScanQuality
from subiaco_msgs.srv import Optimize, SaveMap
from subiaco_ros.diagnostics import Diagnostics, ProgressReporter
from subiaco_ros.managed_node import App, Build
from subiaco_ros.node_process import run_node
from subiaco_ros.parameters import DYNAMIC, read_models
from subiaco_ros.qos import latched, overridable, reliable
from subiaco_ros.qos_adaptation import follow_offers
from subiaco_ros.stamp_matching import StampMatcher
from tf2_msgs.msg import TFMessage

LOGGER = logging.getLogger(__name__)

INPUTS = (
    TF_STATIC,
    FIX,
    HEADING,
    ODOMETRY,
    CLOUD,
    SKY,
    QUALITY,
    FACTS,
    ODOMETRY_SEQUENCE,
    ODOMETRY_END,
    SEQUENCE,
)


#: Scans that the middleware keeps while the graph is solved; beyond, scans are lost and counted.
SCAN_DEPTH = 128


class PoseGraphParameters(StrictModel):
    """Parameters of the pose-graph node; everything else is the mapping configuration."""

    odom_frame: str = Field("odom", description="Frame of the odometry poses")
    map_frame: str = Field("map", description="Frame of the map (local east, north, up)")
    earth_frame: str = Field("earth", description="Frame of the earth (earth-centred, earth-fixed)")
    output_directory: str = Field(
        "", description="Map directory that is written at the end; empty writes none"
    )
    overwrite: bool = Field(False, description="Replace an existing map directory")
    bags: tuple[str, ...] = Field((), description="Replayed bags, recorded with their hashes in map.yaml")
    preview_points: int = Field(
        1_000_000,
        gt=0,
        le=1_000_000,
        description="Largest number of points published on map/points at the end",
    )
    exit_at_end: bool = Field(False, description="End the node when the odometry ends")
    live_period: float = Field(
        0.0,
        ge=0,
        description="Time between two updates of path and map during the drive [s]; 0 updates at the end "
        "only",
        json_schema_extra=DYNAMIC,
    )
    live_voxel: float = Field(
        0.4,
        gt=0,
        description="Edge of the voxels of which one point each is published on map/points during the "
        "drive [m]",
    )
    live_points: int = Field(
        300_000,
        gt=0,
        le=1_000_000,
        description="Largest number of points published on map/points during the drive",
    )
    save_on_exit: bool = Field(False, description="Write output_directory also when the node is interrupted")
    watch_manifest: str = Field(
        "", description="File manifest.yaml of the monitor, to which the manifest of the map is added"
    )


class PoseGraphApp:
    """Put messages of one stamp together, feed the back end, publish what it finds.

    Parameters
    ----------
    node : Node
    own : PoseGraphParameters
    config : MappingConfig
    backend : Backend
    """

    def __init__(self, node: Node, own: PoseGraphParameters, config: MappingConfig, backend: Backend) -> None:
        self._own = own
        self._config = config
        self._backend = backend
        self._transforms = StaticTransforms(config.sensors, (own.map_frame,))
        self._extrinsics: Extrinsics | None = None
        self._matcher = StampMatcher((ODOMETRY, QUALITY, CLOUD, SKY))
        self._announced: ReplayCounts | None = None
        self._marker: tuple[str, ReplayCounts] | None = None
        self._sequence = "live"
        self._start = ExtrinsicsWaiter(("gnss",))
        self._times = LiveTimes()
        self._chain = OdometrySegments()
        self._scans = 0
        self._arrivals = Arrivals()
        self._odometry_arrivals: dict[str, dict[str, int]] = {}
        self._ending = self._finished = False
        self._progress = ProgressReporter(node)
        self._diagnostics = Diagnostics(node, "solution")
        self._map = MapPublisher(node, own.map_frame, own.odom_frame, own.earth_frame, own.preview_points)
        self._live = self._make_live(own.live_period) if own.live_period > 0 else None
        self._reporter = ConsumptionReporter(node, ConsumedCounter(INPUTS))
        self._create_subscriptions(node)
        node.create_service(Optimize, "pose_graph/optimize", self._on_optimize)
        node.create_service(SaveMap, "pose_graph/save_map", self._on_save_map)

    def reconfigure(self, values: Mapping[str, Any]) -> None:
        """Update path and map at another interval."""
        period = float(values.get("live_period", self._own.live_period))
        if self._live is not None:
            self._live.set_period(period)
        elif period > 0:
            self._live = self._make_live(period)

    def _make_live(self, period: float) -> LiveMap:
        own = self._own
        return LiveMap(
            self._map,
            self._backend.optimize,
            self._publish_solution,
            period=period,
            voxel=own.live_voxel,
            points=own.live_points,
        )

    def _create_subscriptions(self, node: Node) -> None:
        handlers: tuple[tuple[Any, str, Callable[[Any], object], Any], ...] = (
            (TFMessage, TF_STATIC, self._on_tf_static, latched(100)),
            (Odometry, ODOMETRY, lambda m: self._on_part(ODOMETRY, m), reliable(SCAN_DEPTH)),
            (ScanQuality, QUALITY, lambda m: self._on_part(QUALITY, m), reliable(SCAN_DEPTH)),
            (PointCloud2, CLOUD, lambda m: self._on_part(CLOUD, m), reliable(SCAN_DEPTH)),
            (PointCloud2, SKY, lambda m: self._on_part(SKY, m), reliable(SCAN_DEPTH)),
            (String, FACTS, self._on_facts, latched(32)),
        )
        sensors: tuple[tuple[Any, str, Callable[[Any], object]], ...] = (
            (NavSatFix, FIX, self._on_fix),
            (Imu, HEADING, self._on_heading),
        )
        follow_offers(node, [(k, t, self._counting(t, h), 1000, False) for k, t, h in sensors])
        for kind, topic, handler, profile in handlers:
            node.create_subscription(
                kind,
                topic.lstrip("/"),
                self._counting(topic, handler),
                profile,
                qos_overriding_options=overridable(),
            )
        for topic in (ODOMETRY_SEQUENCE, ODOMETRY_END):
            node.create_subscription(ReplayCounts, topic.lstrip("/"), self._marking(topic), latched(1))
        node.create_subscription(ReplayCounts, SEQUENCE.lstrip("/"), self._on_announced, latched(1))

    def _counting(
        self, topic: str, handler: Callable[[Any], object]
    ) -> Callable[[Any, Mapping[str, Any]], None]:
        def counted(message: Any) -> None:
            if handler(message) is not False:
                self._reporter.consumed(topic)
            self._settle_marker()

        return self._arrivals.counted(topic, counted)

    def _marking(self, topic: str) -> Callable[[ReplayCounts], None]:
        def marked(message: ReplayCounts) -> None:
            self._marker = (topic, message)
            self._settle_marker()

        return marked

    @property
    def done(self) -> bool:
        """Whether everything has been taken, solved and written."""
        return self._finished and self._own.exit_at_end

    def step(self) -> float:
        """Finish when the end has come; the counts go out before the long work begins."""
        if self._ending and not self._finished:
            self._reporter.flush()
            self._finish()
            self._finished = True
        if self._live is not None and not self._finished:
            self._live.step()
        return 0.1

    def close(self) -> None:
        """Leave a whole map behind a live survey that was ended."""
        if not (self._own.save_on_exit and self._own.output_directory and self._scans) or self._finished:
            return
        self._finished = True
        LOGGER.info("ending: writing the map of %d scans", self._scans)
        directory = Path(self._own.output_directory)
        write_map(directory, self._built(directory, self._own.overwrite), overwrite=self._own.overwrite)

    def _on_announced(self, message: ReplayCounts) -> None:
        self._announced = message
        self._settle_marker()

    def _settle_marker(self) -> None:
        """Act on a marker of the odometry once everything that it counts has been taken."""
        if self._marker is None:
            return
        topic, marker = self._marker
        taken = self._reporter.counts
        if any(taken[name] < count for name, count in zip(marker.topics, marker.counts, strict=True)):
            return
        if topic == ODOMETRY_END:
            self._ending = True
        elif self._announced is None or self._announced.source != marker.source:
            return
        else:
            self._begin(marker.source)
            self._reporter.consumed(SEQUENCE)
        self._marker = None
        self._reporter.consumed(topic)

    def _begin(self, name: str) -> None:
        self._ending = self._finished = False  # a node that stays is given another replay
        self._sequence = name
        self._extrinsics = None
        self._map.begin_sequence()
        self._transforms = StaticTransforms(self._config.sensors, (self._own.map_frame,))

    def _started(self) -> Extrinsics | None:
        """Return the extrinsics of the sequence; its first data starts it in the back end.

        On live topics None until it is known where the sensors sit.
        """
        if self._extrinsics is None:
            if self._announced is None:
                self._extrinsics = self._start.extrinsics(self._transforms)
            else:
                self._extrinsics = self._transforms.extrinsics(sensors_needed(self._announced.topics))
            if self._extrinsics is not None:
                self._backend.start_sequence(self._sequence, self._extrinsics)
        return self._extrinsics

    def _on_tf_static(self, message: TFMessage) -> bool:
        return self._transforms.add(message)

    def _takes(self, topic: str, message: NavSatFix | Imu) -> bool:
        """Whether a measurement enters the graph: the extrinsics are known, and no loop brings it again."""
        stamp = stamp_ns(message.header.stamp)
        again = self._announced is None and self._times.is_repeated(topic, stamp)
        if self._started() is None or again:
            self._arrivals.leave_out(topic)
            return False
        return True

    def _on_fix(self, message: NavSatFix) -> None:
        if self._takes(FIX, message):
            self._backend.on_fix(fix_from_msg(message, self._config.gnss))

    def _on_heading(self, message: Imu) -> None:
        if self._takes(HEADING, message):
            self._backend.on_heading(heading_from_msg(message))

    def _on_facts(self, message: String) -> None:
        if self._started() is not None:
            facts = json.loads(message.data)
            self._odometry_arrivals = facts.get("arrivals_odometry", {})
            self._backend.add_facts(**facts)

    def _on_part(self, kind: str, message: Any) -> None:
        found = self._matcher.add(kind, stamp_ns(message.header.stamp), message)
        if found is None:
            return
        extrinsics = self._started()
        if extrinsics is None:
            self._arrivals.leave_out(ODOMETRY)
            return
        odometry, quality, cloud, sky = found
        pose = pose_from_messages(odometry, quality, extrinsics.T_base_lidar)
        if self._announced is None:
            segment, T_odom_lidar = self._chain.take(pose.segment, pose.T_odom_lidar)
            pose = replace(pose, segment=segment, T_odom_lidar=T_odom_lidar)
            if not self._times.is_newer(ODOMETRY, pose.stamp_ns):
                self._arrivals.leave_out(ODOMETRY)
                self._map.publish_odom_frame(pose.stamp_ns, self._chain.T_chain_odom)
                return
        scan = scan_from_messages(cloud, sky, quality)
        self._backend.on_odometry(pose, scan)
        self._map.publish_odom_frame(pose.stamp_ns, self._chain.T_chain_odom)
        self._scans += 1
        if self._live is not None:
            self._live.add(pose.stamp_ns, pose.T_odom_lidar, scan)

    def _publish_solution(self, solution: GraphSolution | LiveEstimate) -> None:
        self._map.publish_solution(solution)
        used = sum(sequence.fixes_used for sequence in solution.sequences)
        poses = sum(len(sequence.stamps_ns) for sequence in solution.sequences)
        lost = self._arrivals.lost
        self._diagnostics.report("solved", {"poses": poses, "fixes": used, "lost": lost}, warn=lost > 0)

    def _built(self, directory: Path, overwrite: bool) -> SurveyMap:
        refuse_existing(directory, overwrite)
        inputs = {sequence_name(Path(bag)): hash_bag(Path(bag)) for bag in self._own.bags}
        if self._announced is None:
            arrivals = self._arrivals.facts()
            self._backend.add_facts(arrivals_pose_graph=arrivals, scans_in_part=self._matcher.dropped)
            if missed := missed_messages({**self._odometry_arrivals, **arrivals}):
                LOGGER.warning("live: messages are missing: %s", missed)
        survey = self._backend.build_map(self._progress, inputs)
        survey = mark_simulated(survey, map(Path, self._own.bags))
        if not self._own.watch_manifest:
            return self._backend.with_quality(with_watched(survey, self._own.bags), self._progress)
        watched = read_manifest(Path(self._own.watch_manifest))
        survey = replace(survey, manifest=extended(survey.manifest, watched))
        return self._backend.with_quality(survey, self._progress)

    def _save(self, directory: Path, *, overwrite: bool) -> SurveyMap:
        survey = self._built(directory, overwrite)
        self._publish_solution(self._backend.optimize())
        self._map.publish_map(survey, self._backend.optimize())
        write_map(directory, survey, overwrite=overwrite)
        LOGGER.info("map of %d points from %d scans: %s", len(survey.cloud), self._scans, directory)
        return survey

    def _finish(self) -> None:
        if self._matcher.dropped:
            raise SubiacoError(f"{self._matcher.dropped} scans arrived in part: the transport lost messages")
        if self._own.output_directory:
            self._save(Path(self._own.output_directory), overwrite=self._own.overwrite)
        else:
            self._publish_solution(self._backend.optimize())
        if self._own.exit_at_end:
            self._map.wait_until_received()

    def _on_optimize(self, _request: Any, response: Any) -> Any:
        try:
            solution = self._backend.optimize()
        except SubiacoError as error:
            response.success, response.message = False, str(error)
            return response
        self._publish_solution(solution)
        response.success, response.message = True, solution.reason or "georeferenced"
        response.poses = sum(len(sequence.stamps_ns) for sequence in solution.sequences)
        response.fixes = sum(sequence.fixes_used for sequence in solution.sequences)
        return response

    def _on_save_map(self, request: Any, response: Any) -> Any:
        try:
            if not request.directory:
                raise InputError("save_map: directory is empty; say where the map goes")
            self._save(Path(request.directory), overwrite=request.overwrite)
        except SubiacoError as error:
            response.success, response.message = False, str(error)
        else:
            response.success, response.message = True, request.directory
        return response


@contextmanager
def building() -> Iterator[Build]:
    """Yield what builds the node; the deskewed scans lie beside the map until the end."""
    with ExitStack() as stack:

        def build(node: Node) -> App:
            own, config = read_models(node, PoseGraphParameters, MappingConfig)
            spool = stack.enter_context(spool_folder(own.output_directory))
            return PoseGraphApp(node, own, config, MappingBackend(config, Extrinsics(), spool))

        yield build


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node."""
    with building() as build:
        return run_node("pose_graph", build, argv)


if __name__ == "__main__":
    sys.exit(main())
