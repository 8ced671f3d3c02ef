"""Node: record the topics of a live vehicle, raw, and say what was lost."""

from __future__ import annotations

import os
import socket
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import rclpy
from pydantic import Field
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from subiaco_geo.config import StrictModel
from subiaco_geo.errors import InputError
from subiaco_mapping.nodes.raw_subscriptions import RawListener
from subiaco_mapping.recording.config import RecordConfig, RecordingConfig
from subiaco_mapping.recording.entries import RecorderStatus
from subiaco_mapping.recording.recorder import Recorder
from subiaco_ros.diagnostics import Diagnostics
from subiaco_ros.node_process import run_node
from subiaco_ros.parameters import read_models
from subiaco_ros.qos_adaptation import LOOK_INTERVAL

REPORT_INTERVAL = 1.0
SAY_INTERVAL = 10.0
#: Seconds after which a recording without LiDAR or GNSS is an alarm.
ALARM_AFTER = 10.0
PATIENCE = 0.005
NICENESS = -10


class RecorderParameters(StrictModel):
    """Parameters of the recorder node."""

    output: str = Field(description="Bag folder that is written")
    resume: bool = Field(False, description="Continue with a new file if the bag folder exists")
    duration: float = Field(
        0.0, ge=0, description="Time after which the recording ends [s]; 0 records until stopped"
    )


class RecorderApp:
    """Listen, report, and end with every file whole.

    Parameters
    ----------
    node : Node
    own : RecorderParameters
    config : RecordConfig
    """

    def __init__(self, node: Node, own: RecorderParameters, config: RecordConfig) -> None:
        self._node = node
        self._config = config
        self.recorder = Recorder(Path(own.output), config, resume=own.resume, facts=self._facts)
        self.listener = RawListener(node, config, self.recorder.add)
        self._diagnostics = Diagnostics(node, "recording", socket.gethostname())
        self._began = self._said = self._drained = time.monotonic()
        self._until = self._said + own.duration if own.duration else None
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        node.create_timer(LOOK_INTERVAL, self.listener.look, clock=steady)
        node.create_timer(REPORT_INTERVAL, self._report, clock=steady)
        self.listener.look()

    @property
    def done(self) -> bool:
        """Whether the time is up; a recording without one is ended from outside."""
        return self._until is not None and time.monotonic() >= self._until

    def step(self) -> float:
        """Take what has arrived; end where the disk has, if the configuration says so."""
        self.listener.drain()
        now = time.monotonic()
        self.recorder.slowest_drain_s = max(self.recorder.slowest_drain_s, now - self._drained)
        self._drained = now
        if self.recorder.stopped and self._config.exit_when_stopped:
            raise InputError(self.recorder.status().reason)
        return PATIENCE

    def close(self) -> None:
        """Take and write what waits, and finish the last file."""
        try:
            self.listener.drain()
        finally:
            status = self.recorder.close()
        text = f"{self.recorder.folder}: {describe(status, self._lost())}"
        if rclpy.ok(context=self._node.context):
            self._node.get_logger().info(text)
        else:  # interrupted: nothing can be published any more
            sys.stderr.write(f"[INFO] {text}\n")
        if status.state == "failed":
            raise InputError(status.reason)

    def _facts(self) -> dict[str, dict[str, int]]:
        return self.listener.facts()

    def _lost(self) -> int:
        return sum(counter.lost for counter in self.listener.counters.values())

    def _report(self) -> None:
        status = self.recorder.status()
        lost = self._lost()
        absent = self._absent()
        problems = [*absent, *status.warnings, *self.listener.complaints()]
        if lost:
            problems.append(f"{lost} messages lost")
        text = describe(status, lost)
        self._diagnostics.report(
            "; ".join(problems) or text,
            self._values(status, lost),
            warn=bool(problems),
            error=self.recorder.stopped or bool(absent),
        )
        if time.monotonic() - self._said >= SAY_INTERVAL:
            self._said = time.monotonic()
            if absent:
                alarm = f"ALARM: {'; '.join(absent)} is being recorded: check driver and ROS_DOMAIN_ID"
                self._node.get_logger().error(alarm)
            self._node.get_logger().info("; ".join([text, *problems]))

    def _absent(self) -> list[str]:
        """Name the essential sensors that have been silent since the start, once it is time for an alarm."""
        if time.monotonic() - self._began < ALARM_AFTER:
            return []
        return self._config.absent({name: counts["received"] for name, counts in self._facts().items()})

    def _values(self, status: RecorderStatus, lost: int) -> dict[str, object]:
        values: dict[str, object] = {
            "state": status.state,
            "file": status.file,
            "files": status.files,
            "messages": status.messages,
            "lost": lost,
            "written_mb": round(status.written_bytes / 1e6, 1),
            "rate_mb_s": round(status.rate_bytes / 1e6, 2),
            "queued_mb": round(status.queued_bytes / 1e6, 2),
            "free_gb": round(status.free_bytes / 1e9, 2),
            "minutes_left": "" if status.minutes_left is None else round(status.minutes_left),
            "slowest_sync_s": round(status.slowest_sync_s, 3),
            "slowest_turn_s": round(status.slowest_turn_s, 3),
            "slowest_drain_s": round(self.recorder.slowest_drain_s, 3),
            "not_published": " ".join(self.listener.missing()),
        }
        for name, facts in self._facts().items():
            values[name] = " ".join(f"{key}={count}" for key, count in facts.items())
        return values


def describe(status: RecorderStatus, lost: int) -> str:
    """Say in one line how a recording stands."""
    left = "" if status.minutes_left is None else f" ({status.minutes_left:.0f} min)"
    return (
        f"{status.state}: {status.messages} messages, {status.written_bytes / 1e9:.2f} GB in "
        f"{status.files} files, {lost or 'none'} lost, {status.free_bytes / 1e9:.0f} GB free{left}"
    )


def build(node: Node) -> RecorderApp:
    """Put the node together from its parameters."""
    own, config = read_models(node, RecorderParameters, RecordingConfig)
    return RecorderApp(node, own, config.record)


def go_first() -> None:
    """Have this process, and the middleware's threads that it will start, served before others where allowed.

    A machine too busy to run the receiving thread for a second loses what the driver does not keep longer.
    """
    with suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, 0, NICENESS)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node."""
    go_first()
    return run_node("recorder", build, argv)


if __name__ == "__main__":
    sys.exit(main())
