"""Node: compare two maps on request, publish clouds, table and markers."""

from __future__ import annotations

import logging
from collections.abc import Generator
from pathlib import Path
from typing import Any

from pydantic import Field
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.node import Node
from sensor_msgs.msg import NavSatFix, PointCloud2
from visualization_msgs.msg import MarkerArray

from subiaco_change.config import ChangeConfig
from subiaco_change.job import run_change_and
from subiaco_change.nodes.job import Detect, Job, JobCancelledError, Outcome, Report
from subiaco_change.nodes.messages import change_cloud_message, marker_message, table_message
from subiaco_change.outputs.directory import PageWriter
from subiaco_change.records import TiledResult
from subiaco_change.request import ChangeRequest
from subiaco_geo.config import StrictModel
from subiaco_geo.errors import InputError, SubiacoError
from subiaco_geo.trajectories import read_tum
from subiaco_msgs.action import DetectChanges
from subiaco_msgs.msg import ChangeTable
from subiaco_ros.diagnostics import Diagnostics, ProgressLog
from subiaco_ros.local_frame import frame_at_origin
from subiaco_ros.messages import origin_message
from subiaco_ros.node_process import App, wait_until_received
from subiaco_ros.parameters import read_models
from subiaco_ros.qos import latched

LOGGER = logging.getLogger(__name__)

POLL = 0.1


class ChangeParameters(StrictModel):
    """Parameters of the change node; everything else is the change configuration."""

    before: str = Field(
        "",
        description="Map directory of the earlier survey to compare at start; empty waits for action goals",
    )
    after: str = Field("", description="Map directory of the later survey to compare at start")
    output: str = Field("", description="Directory to which the change result is written")
    overwrite: bool = Field(False, description="Replace an existing change directory")
    map_frame: str = Field("map", description="Frame of the published point clouds")
    exit_at_end: bool = Field(
        False, description="End the node after the comparison that its parameters requested"
    )

    def request(self) -> ChangeRequest | None:
        """Return the comparison that the parameters ask for, if they do."""
        given = (self.before, self.after, self.output)
        if not any(given):
            return None
        if not all(given):
            raise InputError("change node: parameters before, after and output go together; one is missing")
        return ChangeRequest.of(
            before=self.before, after=self.after, output=self.output, overwrite=self.overwrite
        )


class _NextSpin:
    """Awaited by a coroutine to hand control back to the executor once."""

    def __await__(self) -> Generator[None, None, None]:
        yield


class ChangeApp:
    """Take goals, run them one at a time, publish the results.

    Parameters
    ----------
    node : Node
    own : ChangeParameters
    detect : callable
        The library step: request and report to outcome.
    """

    def __init__(self, node: Node, own: ChangeParameters, detect: Detect) -> None:
        self._own = own
        self._detect = detect
        self._request = own.request()
        self._job: Job | None = None
        self._own_job: Job | None = None
        self._finished = False
        self._progress = ProgressLog(node)
        self._diagnostics = Diagnostics(node)
        self._publishers = {
            name: node.create_publisher(kind, name, latched(1))
            for name, kind in {
                "change/before": PointCloud2,
                "change/after": PointCloud2,
                "change/table": ChangeTable,
                "change/markers": MarkerArray,
                "map/origin": NavSatFix,
            }.items()
        }
        self._server = ActionServer(
            node,
            DetectChanges,
            "change/detect",
            execute_callback=self._execute,
            goal_callback=self._on_goal,
            cancel_callback=lambda _goal: CancelResponse.ACCEPT,
        )

    @property
    def done(self) -> bool:
        """Whether the comparison given by parameters is done and the node need not stay."""
        return self._finished and self._own.exit_at_end

    def step(self) -> float:
        """Start and watch the comparison given by parameters."""
        if self._request is not None:
            self._job = self._own_job = Job(self._request, self._detect)
            self._request = None
        elif self._own_job is not None:
            self._watch(self._own_job)
        return POLL

    def _watch(self, job: Job) -> None:
        self._progress(job.stage, job.fraction)
        if not job.finished:
            return
        self._job = self._own_job = None
        self._publish(job.get(), job.request.output)
        self._finished = True
        if self._own.exit_at_end:
            wait_until_received(self._publishers.values())

    def _on_goal(self, _goal: Any) -> GoalResponse:
        if self._job is None and self._request is None:
            return GoalResponse.ACCEPT
        LOGGER.warning("a comparison is running; the new goal was rejected")
        return GoalResponse.REJECT

    async def _execute(self, handle: Any) -> DetectChanges.Result:
        goal = handle.request
        request = ChangeRequest.of(
            before=goal.before, after=goal.after, output=goal.output, overwrite=goal.overwrite
        )
        job = self._job = Job(request, self._detect)
        while not job.finished:
            if handle.is_cancel_requested:
                job.cancel()
            handle.publish_feedback(DetectChanges.Feedback(stage=job.stage, fraction=float(job.fraction)))
            self._progress(job.stage, job.fraction)
            await _NextSpin()
        self._job = None
        return self._conclude(handle, job)

    def _conclude(self, handle: Any, job: Job) -> DetectChanges.Result:
        try:
            table = self._publish(job.get(), job.request.output)
        except JobCancelledError:
            handle.canceled()
            return DetectChanges.Result(success=False, message="cancelled; nothing was written")
        except SubiacoError as error:
            LOGGER.error("%s", error)
            handle.abort()
            return DetectChanges.Result(success=False, message=str(error))
        handle.succeed()
        return DetectChanges.Result(success=True, message=str(job.request.output), table=table)

    def _publish(self, outcome: Outcome, directory: Path) -> ChangeTable:
        result, end_ns, frame_id = outcome.result, outcome.end_ns, self._own.map_frame
        frame = frame_at_origin(result.after)
        send = {name: publisher.publish for name, publisher in self._publishers.items()}
        if frame.enu is not None:
            enu = frame.enu
            send["map/origin"](origin_message(enu.latitude_deg, enu.longitude_deg, enu.height, frame_id))
        send["change/before"](change_cloud_message(result.before, frame, frame_id, end_ns))
        send["change/after"](change_cloud_message(result.after, frame, frame_id, end_ns))
        send["change/markers"](marker_message(result, frame, frame_id, end_ns))
        table = table_message(result, directory, end_ns, frame_id)
        send["change/table"](table)
        counts = dict(zip(table.labels, table.counts, strict=True))
        self._diagnostics.report("compared", counts)
        LOGGER.info(
            "%d objects: %s", len(table.records), ", ".join(f"{n} {label}" for label, n in counts.items())
        )
        return table


def survey_end_ns(path: Path) -> int:
    """Return when the survey of a map directory ended, 0 where the map does not say."""
    trajectory = path / "trajectory.tum"
    return int(read_tum(trajectory).times_ns[-1]) if trajectory.is_file() else 0


def make_detect(config: ChangeConfig, write_pages: PageWriter) -> Detect:
    """Bind the library's step to a configuration and to what writes the pages."""

    def detect(request: ChangeRequest, report: Report) -> Outcome:
        report("reading maps", 0.0)
        return Outcome(
            run_change_and(
                request.model_copy(update={"config": config}),
                TiledResult.whole,
                report,
                write_pages=write_pages,
            ),
            survey_end_ns(request.after),
        )

    return detect


def build(node: Node, write_pages: PageWriter) -> App:
    """Put the node together from its parameters."""
    own, config = read_models(node, ChangeParameters, ChangeConfig)
    return ChangeApp(node, own, make_detect(config, write_pages))
