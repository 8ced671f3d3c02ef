"""Progress and status of a node: on topics for everybody, through the channel for its supervisor."""

from __future__ import annotations

from collections.abc import Mapping

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from subiaco_ros.qos import latched
from subiaco_ros.supervision import Progress, supervisor_channel


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
        self._channel.progress(Progress(stage, fraction))
        if not self._channel.supervised:
            text = f"{stage}: {100 * fraction:.0f} %"
            self._node.get_logger().info(text)
        if self._node.context.ok():  # it ends before the last files are written
            values = [KeyValue(key="fraction", value=f"{fraction:.4f}")]
            self._publisher.publish(
                DiagnosticStatus(name=self._node.get_name(), message=stage, values=values)
            )


class Diagnostics:
    """Publish one status of a node on ``diagnostics``."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._publisher = node.create_publisher(DiagnosticArray, "diagnostics", 10)

    def report(
        self, message: str, values: Mapping[str, object], *, warn: bool = False, error: bool = False
    ) -> None:
        """Publish a status line with values."""
        calm = DiagnosticStatus.WARN if warn else DiagnosticStatus.OK
        status = DiagnosticStatus(
            level=DiagnosticStatus.ERROR if error else calm,
            name=self._node.get_name(),
            message=message,
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
        )
        array = DiagnosticArray(status=[status])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(array)
