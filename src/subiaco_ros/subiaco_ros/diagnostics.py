"""Progress in the log and the status of a node on ``diagnostics``."""

from __future__ import annotations

from collections.abc import Mapping

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node


class ProgressLog:
    """Log ``progress: STAGE NN %`` in steps, the form that the supervisor reads."""

    def __init__(self, node: Node, step: float = 0.02) -> None:
        self._logger = node.get_logger()
        self._step = step
        self._last = ("", -1.0)

    def __call__(self, stage: str, fraction: float) -> None:
        """Note that a stage stands at a fraction 0..1."""
        last_stage, last = self._last
        if stage != last_stage or fraction - last >= self._step or (fraction >= 1.0 > last):
            self._last = (stage, fraction)
            text = f"progress: {stage} {100 * fraction:.0f} %"
            self._logger.info(text)


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
