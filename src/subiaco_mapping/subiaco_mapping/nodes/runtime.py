"""What every node process needs: parameters, quality of service, logging, start and stop."""

from __future__ import annotations

import logging
import os
import signal
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Protocol, TypeVar, runtime_checkable

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy._rclpy_pybind11 import RCLError
from rclpy.duration import Duration
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

from subiaco_geo.config import StrictModel, merge, validate
from subiaco_geo.errors import InputError, SubiacoError
from subiaco_mapping.nodes.parameters import describe_parameters

INTERRUPTED = 130
_SUPERVISOR = "SUBIACO_SUPERVISOR"  # the process that started this one

#: Parameters that ROS itself declares.
_ROS_OWN = ("use_sim_time", "qos_overrides", "start_type_description_service")

#: Loggers whose information is shown; of other libraries only warnings.
_OURS = ("__main__", "subiaco_geo", "subiaco_mapping", "subiaco_change")

Model = TypeVar("Model", bound=StrictModel)


class App(Protocol):
    """The working part of a node process."""

    @property
    def done(self) -> bool:
        """Whether the process may end with success."""

    def step(self) -> float:
        """Do what is not a callback; return the seconds that may be spent waiting for callbacks."""


@runtime_checkable
class Closing(Protocol):
    """An app that must put something away, however its process ends."""

    def close(self) -> None:
        """Put it away; SubiacoError where it cannot be."""


def reliable(depth: int) -> QoSProfile:
    """Return the profile of data that must not be lost."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.VOLATILE,
    )


def latched(depth: int = 1) -> QoSProfile:
    """Return the profile of data that late subscribers must still receive."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL,
    )


def overridable() -> QoSOverridingOptions:
    """Let ``qos_overrides`` parameters fit a subscription to what a driver offers."""
    return QoSOverridingOptions.with_default_policies()


def nested(flat: Mapping[str, Any]) -> dict[str, Any]:
    """Turn ``{"a.b": 1}`` into ``{"a": {"b": 1}}``; lists become tuples' equals, plain lists."""
    values: dict[str, Any] = {}
    for name, value in flat.items():
        branch: Any = list(value) if hasattr(value, "tolist") or isinstance(value, (list, tuple)) else value
        for part in reversed(name.split(".")):
            branch = {part: branch}
        values = merge(values, branch)
    return values


def node_values(node: Node) -> dict[str, Any]:
    """Return the parameters given to a node, nested, without those that ROS declares itself."""
    found = node.get_parameters_by_prefix("").items()
    given = {name: parameter.value for name, parameter in found if parameter.value is not None}
    return {name: value for name, value in nested(given).items() if name not in _ROS_OWN}


def read_models(node: Node, own: type[Model], config: type[StrictModel] | None = None) -> tuple[Model, Any]:
    """Split a node's parameters into its own model and the library's configuration.

    Returns
    -------
    own : Model
    config : StrictModel or None
        The very model that the command line loads from the same files.

    Raises
    ------
    InputError
        A parameter is unknown or out of bounds; the message names it.
    """
    values = node_values(node)
    mine = {name: value for name, value in values.items() if name in own.model_fields}
    rest = {name: value for name, value in values.items() if name not in own.model_fields}
    source = f"parameters of {node.get_name()}"
    found = validate(own, mine if config is not None else {**mine, **rest}, source)
    describe_parameters(node, found)
    if config is None:
        return found, None
    settings = validate(config, rest, source)
    describe_parameters(node, settings)
    return found, settings


class _RosLogHandler(logging.Handler):
    """Hand the library's log records to the node's logger, so that they reach /rosout too."""

    def __init__(self, node: Node) -> None:
        super().__init__()
        self._logger = node.get_logger()

    def emit(self, record: logging.LogRecord) -> None:
        """Log one record at the matching severity."""
        text = self.format(record)
        if record.levelno >= logging.ERROR:
            self._logger.error(text)
        elif record.levelno >= logging.WARNING:
            self._logger.warning(text)
        elif record.levelno >= logging.INFO:
            self._logger.info(text)
        else:
            self._logger.debug(text)


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


def wait_until_received(publishers: Iterable[Publisher], timeout: float = 5.0) -> None:
    """Wait until matched subscribers have everything, before a node goes."""
    deadline = time.monotonic() + timeout
    for publisher in publishers:
        left = max(0.0, deadline - time.monotonic())
        publisher.wait_for_all_acked(Duration(seconds=left))


def _orphaned() -> bool:
    """Whether the supervisor that started this process is gone."""
    supervisor = os.environ.get(_SUPERVISOR)
    return supervisor is not None and os.getppid() != int(supervisor)


def _spin(executor: SingleThreadedExecutor, app: App) -> None:
    """Run callbacks and steps in one thread until the app is done."""
    while not app.done:
        executor.spin_once(timeout_sec=app.step())
        if _orphaned():
            raise ExternalShutdownException


def _attach_logging(node: Node) -> None:
    root = logging.getLogger()
    root.handlers = [_RosLogHandler(node)]
    root.setLevel(logging.WARNING)
    for name in _OURS:
        logging.getLogger(name).setLevel(logging.INFO)


def run_node(name: str, build: Callable[[Node], App], argv: Sequence[str] | None = None) -> int:
    """Run one node process from start to end and return its exit code.

    Exit codes are those of the command line: 0 done, 2 bad input, 3 a
    registration that failed, 130 interrupted; an unexpected fault is a
    traceback and 1. Without our supervisor, under ``ros2 launch`` and ``ros2 run``, an
    interruption is the usual end and gives 0: any other code is an error there.
    """
    interrupted = INTERRUPTED if _SUPERVISOR in os.environ else 0
    try:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})  # see the supervisor: imports are done
        rclpy.init(args=list(sys.argv if argv is None else [name, *argv]))
    except KeyboardInterrupt:
        return interrupted
    except (RCLError, ParameterException, RuntimeError) as error:
        sys.stderr.write(f"[FATAL] {name}: {' '.join(str(error).split())}\n")
        return InputError.exit_code
    try:
        node = Node(name, automatically_declare_parameters_from_overrides=True)
        _attach_logging(node)
        return _run(node, build)
    except (ExternalShutdownException, KeyboardInterrupt):
        return interrupted
    except SubiacoError as error:  # at the end: interrupted, there is no node any more that could log it
        sys.stderr.write(f"[FATAL] {error}\n")
        return error.exit_code
    except (RuntimeError, ImportError):  # an RCLError, or what a call that the end cut short makes of itself
        if rclpy.ok():
            raise
        return interrupted
    finally:
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # a second one changes nothing
        logging.getLogger().handlers = []
        rclpy.try_shutdown()


def _run(node: Node, build: Callable[[Node], App]) -> int:
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    app: App | None = None
    try:
        app = build(node)
        _spin(executor, app)
    except SubiacoError as error:
        node.get_logger().fatal(str(error))
        return error.exit_code
    finally:
        if isinstance(app, Closing):
            app.close()
        executor.shutdown(timeout_sec=1.0)
    return 0
