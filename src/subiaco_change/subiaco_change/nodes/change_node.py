"""Node: compare two maps on request, publish clouds, table and markers."""

from __future__ import annotations

import logging
from collections.abc import Generator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from pydantic import Field
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.node import Node
from sensor_msgs.msg import NavSatFix, PointCloud2
from visualization_msgs.msg import MarkerArray

from subiaco_change.config import ChangeConfig
from subiaco_change.job import run_change_and
from subiaco_change.nodes.job import Detect, JobCancelledError, JobThread, OnTile, Outcome, Report
from subiaco_change.nodes.messages import change_cloud_message, marker_message, table_message
from subiaco_change.outputs.directory import PageWriter
from subiaco_change.outputs.preview import build_preview
from subiaco_change.request import ChangeRequest
from subiaco_geo.codes import Change
from subiaco_geo.config import StrictModel, merge, validate
from subiaco_geo.errors import InputError, SubiacoError
from subiaco_geo.requests import json_object
from subiaco_geo.settings import departures
from subiaco_geo.trajectories import read_tum
from subiaco_msgs.action import DetectChanges
from subiaco_msgs.msg import ChangeTable
from subiaco_ros.diagnostics import Diagnostics, ProgressReporter
from subiaco_ros.local_frame import frame_at_origin
from subiaco_ros.managed_node import App
from subiaco_ros.messages import origin_message
from subiaco_ros.node_process import wait_until_received
from subiaco_ros.parameters import read_models
from subiaco_ros.qos import latched

LOGGER = logging.getLogger(__name__)

#: Between two looks at a running comparison, for the node's own and for one of a goal [s].
POLL, GOAL_POLL = 0.1, 0.02
#: A cancelled comparison gets so long to reach the end of its stage [s]; its thread holds no process.
_CLOSING = 5.0


class ChangeParameters(StrictModel):
    """Parameters of the change node; everything else is the change configuration."""

    request: str = Field(
        "",
        description="Comparison that the node runs at start, a ChangeRequest as JSON; without it, the node "
        "waits for goals of the action",
    )
    preview_points: int = Field(
        500_000, ge=1, description="Largest number of points of each published cloud, which is thinned evenly"
    )
    map_frame: str = Field("map", description="Frame of the published point clouds")
    exit_at_end: bool = Field(
        False, description="End the node after the comparison that its parameters requested"
    )


def make_request(given: Mapping[str, Any], config: ChangeConfig, source: str) -> ChangeRequest:
    """Return the request of a goal or a parameter; settings that it leaves out are those of the node.

    Raises
    ------
    InputError
        It is no valid request; the message begins with ``source``.
    """
    own = given.get("config", {})
    settings = merge(departures(config), own) if isinstance(own, Mapping) else own
    return validate(ChangeRequest, {**given, "config": settings}, source)


def request_of_goal(goal: Any, config: ChangeConfig) -> ChangeRequest:
    """Return the request of a goal: its JSON, with the fields that are given beside it."""
    given = json_object(goal.request_json, "goal: request_json")
    beside = {name: getattr(goal, name) for name in ("before", "after", "output", "overwrite")}
    given |= {name: value for name, value in beside.items() if value}
    return make_request(given, config, "goal")


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
    config : ChangeConfig
        Settings of requests that do not say otherwise.
    detect : callable
        The library step: request and report to outcome.
    """

    def __init__(self, node: Node, own: ChangeParameters, config: ChangeConfig, detect: Detect) -> None:
        self._own, self._config = own, config
        self._detect = detect
        self._request: ChangeRequest | None = None
        if own.request:
            source = "change node: parameter request"
            self._request = make_request(json_object(own.request, source), config, source)
        self._job: JobThread | None = None
        self._own_job: JobThread | None = None
        self._goal: Any = None
        self._finished = False
        self._progress = ProgressReporter(node)
        self._diagnostics = Diagnostics(node, "comparison")
        self._publishers = {
            name: node.create_publisher(kind, name, latched(1))
            for name, kind in {
                "change/before": PointCloud2,
                "change/after": PointCloud2,
                "change/table": ChangeTable,
                "change/markers": MarkerArray,
                "change/origin": NavSatFix,
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

    def close(self) -> None:
        """End a comparison that runs; its goal fails, and nothing is written."""
        job, goal = self._job, self._goal
        self._job = self._own_job = self._goal = None
        if job is None:
            return
        job.cancel()
        if goal is not None and goal.is_active:
            goal.abort()
        job.wait(_CLOSING)

    def step(self) -> float:
        """Start and watch the comparison given by parameters."""
        if self._request is not None:
            self._job = self._own_job = JobThread(self._request, self._detect)
            self._request = None
        elif self._own_job is not None:
            self._watch(self._own_job)
        return POLL

    def _watch(self, job: JobThread) -> None:
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
        try:
            request = request_of_goal(handle.request, self._config)
        except InputError as error:
            return _refused(handle, error)
        job = self._job = JobThread(request, self._detect)
        self._goal = handle
        while not job.finished:
            if self._goal is not handle:  # closed meanwhile
                return DetectChanges.Result(success=False, message="the node was cleaned up or shut down")
            if handle.is_cancel_requested:
                job.cancel()
            told = DetectChanges.Feedback(stage=job.stage, fraction=float(job.fraction), tile=job.tile)
            handle.publish_feedback(told)
            self._progress(job.stage, job.fraction)
            job.wait(GOAL_POLL)  # the executor resumes a coroutine at once: it would only spin
            await _NextSpin()
        self._job = self._goal = None
        return self._conclude(handle, job)

    def _conclude(self, handle: Any, job: JobThread) -> DetectChanges.Result:
        try:
            table = self._publish(job.get(), job.request.output)
        except JobCancelledError:
            handle.canceled()
            return DetectChanges.Result(success=False, message="cancelled; nothing was written")
        except SubiacoError as error:
            return _refused(handle, error)
        handle.succeed()
        return DetectChanges.Result(success=True, message=str(job.request.output), table=table)

    def _publish(self, outcome: Outcome, directory: Path) -> ChangeTable:
        preview, end_ns, frame_id = outcome.preview, outcome.end_ns, self._own.map_frame
        frame = frame_at_origin(preview.after)
        send = {name: publisher.publish for name, publisher in self._publishers.items()}
        if frame.enu is not None:
            enu = frame.enu
            send["change/origin"](origin_message(enu.latitude_deg, enu.longitude_deg, enu.height, frame_id))
        send["change/before"](change_cloud_message(preview.before, frame, frame_id, end_ns))
        send["change/after"](change_cloud_message(preview.after, frame, frame_id, end_ns))
        send["change/markers"](marker_message(preview, frame, frame_id, end_ns))
        table = table_message(preview, directory, frame, frame_id, end_ns)
        send["change/table"](table)
        counts = {Change(code).label: n for code, n in zip(table.changes, table.counts, strict=True)}
        self._diagnostics.report("compared", counts)
        LOGGER.info(
            "%d objects: %s", len(table.records), ", ".join(f"{n} {label}" for label, n in counts.items())
        )
        return table


def _refused(handle: Any, error: SubiacoError) -> DetectChanges.Result:
    """End a goal with the reason why it failed."""
    LOGGER.error("%s", error)
    handle.abort()
    return DetectChanges.Result(success=False, message=str(error))


def survey_end_ns(path: Path) -> int:
    """Return when the survey of a map directory ended, 0 where the map does not say."""
    trajectory = path / "trajectory.tum"
    return int(read_tum(trajectory).times_ns[-1]) if trajectory.is_file() else 0


def make_detect(write_pages: PageWriter, preview_points: int) -> Detect:
    """Bind the library's step to what writes the pages, and to the size of the preview."""

    def detect(request: ChangeRequest, report: Report, on_tile: OnTile) -> Outcome:
        report("reading maps", 0.0)
        preview = run_change_and(
            request, partial(build_preview, most=preview_points), report,
            on_tile=on_tile, write_pages=write_pages,
        )  # fmt: skip
        return Outcome(preview, survey_end_ns(request.after))

    return detect


def build(node: Node, write_pages: PageWriter) -> App:
    """Put the node together from its parameters."""
    own, config = read_models(node, ChangeParameters, ChangeConfig)
    return ChangeApp(node, own, config, make_detect(write_pages, own.preview_points))
