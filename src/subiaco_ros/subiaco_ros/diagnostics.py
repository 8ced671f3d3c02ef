"""Progress and status of a node: on topics for everybody, through the channel for its supervisor."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from subiaco_ros.qos import latched
from subiaco_ros.supervision import NodeProgress, supervisor_channel
from subiaco_ros.topic_names import DIAGNOSTICS

#: Between two publications of a status that has not changed [s].
PERIOD = 1.0

#: Hardware of a status that is about software alone, as ``diagnostic_updater`` writes it.
NO_HARDWARE = "none"


class ProgressReporter:
    """Report progress in steps: on the latched topic ``progress``, and to the supervisor of the process.

    A process without a supervisor says it in its log, for whoever started it.

    Parameters
    ----------
    node : Node
    step : float
        Fraction by which progress has grown before it is reported again.
    """

    def __init__(self, node: Node, step: float = 0.02) -> None:
        self._node = node
        self._publisher = node.create_publisher(DiagnosticStatus, "progress", latched(1))
        self._channel = supervisor_channel()
        self._step = step
        self._last = ("", -1.0)

    def __call__(self, stage: str, fraction: float) -> None:
        """Note that a stage stands at a fraction 0..1."""
        last_stage, last = self._last
        if stage != last_stage or fraction - last >= self._step or (fraction >= 1.0 > last):
            self._last = (stage, fraction)
            self._report(stage, fraction)

    def _report(self, stage: str, fraction: float) -> None:
        self._channel.progress(NodeProgress(stage, fraction))
        if not self._channel.supervised:
            text = f"{stage}: {100 * fraction:.0f} %"
            self._node.get_logger().info(text)
        if self._node.context.ok():  # it ends before the last files are written
            values = [KeyValue(key="fraction", value=f"{fraction:.4f}")]
            self._publisher.publish(
                DiagnosticStatus(name=self._node.get_name(), message=stage, values=values)
            )


class Diagnostics:
    """The status of one task of a node on ``/diagnostics``, as ``diagnostic_updater`` publishes it.

    The status is named ``NODE: TASK``. It is published once a second, and at once where its level or its
    message changes; an aggregator takes a node that stops publishing for stale.

    Parameters
    ----------
    node : Node
    task : str
        What the status is about.
    hardware_id : str
        Serial number or host of the hardware that the status is about.
    """

    def __init__(self, node: Node, task: str, hardware_id: str = NO_HARDWARE) -> None:
        self._node = node
        self._name = f"{status_prefix(node)}{task}"
        self.hardware_id = hardware_id
        self._status: DiagnosticStatus | None = None
        self._published = 0.0
        self._publisher = node.create_publisher(DiagnosticArray, DIAGNOSTICS, 10)
        node.create_timer(PERIOD / 2, self._renew, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def report(
        self, message: str, values: Mapping[str, object], *, warn: bool = False, error: bool = False
    ) -> None:
        """Take how the task stands, with values."""
        calm = DiagnosticStatus.WARN if warn else DiagnosticStatus.OK
        status = DiagnosticStatus(
            level=DiagnosticStatus.ERROR if error else calm,
            name=self._name,
            message=message,
            hardware_id=self.hardware_id,
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
        )
        before, self._status = self._status, status
        if before is None or (before.level, before.message) != (status.level, status.message):
            self._publish()

    def _renew(self) -> None:
        if time.monotonic() - self._published >= PERIOD:
            self._publish()

    def _publish(self) -> None:
        if self._status is None:
            return
        self._published = time.monotonic()
        array = DiagnosticArray(status=[self._status])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(array)


def status_prefix(node: Node) -> str:
    """Return how the names of the statuses of a node begin, e.g. ``front/odometry: ``."""
    return f"{node.get_fully_qualified_name().lstrip('/')}: "


def lidar_identity(metadata: str) -> str:
    """Return product and serial number of an Ouster sensor from its metadata (JSON)."""
    try:
        found = json.loads(metadata)
    except ValueError:
        return NO_HARDWARE
    described = found.get("sensor_info", found) if isinstance(found, dict) else {}
    words = [str(described.get(key, "")) for key in ("prod_line", "prod_sn")]
    return " ".join(word for word in words if word) or NO_HARDWARE
