"""A node process from start to end: logging, the loop of callbacks and steps, interruption, exit code."""

from __future__ import annotations

import importlib
import logging
import os
import signal
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass

import rclpy
from rclpy._rclpy_pybind11 import RCLError
from rclpy.duration import Duration
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher

from subiaco_geo.errors import InputError, SubiacoError
from subiaco_ros.managed_node import Build, ManagedNode
from subiaco_ros.supervision import supervisor_channel

INTERRUPTED = 130
_SUPERVISOR = "SUBIACO_SUPERVISOR"  # the process that started this one

#: Loggers whose information is shown; of other libraries only warnings.
_OURS = ("__main__", "subiaco_geo", "subiaco_ros", "subiaco_mapping", "subiaco_change", "subiaco_report")


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


def _spin(executor: SingleThreadedExecutor, nodes: Sequence[ManagedNode]) -> None:
    """Run callbacks and steps in one thread until all nodes may end."""
    while working := [node for node in nodes if not node.finished]:
        executor.spin_once(timeout_sec=min([node.step() for node in working]))
        if _orphaned():
            raise ExternalShutdownException


def _attach_logging(node: Node) -> None:
    root = logging.getLogger()
    root.handlers = [_RosLogHandler(node)]
    root.setLevel(logging.WARNING)
    for name in _OURS:
        logging.getLogger(name).setLevel(logging.INFO)


def run_node(name: str, build: Build, argv: Sequence[str] | None = None) -> int:
    """Run one lifecycle node as a process from start to end and return its exit code.

    The node configures and activates itself unless its parameter ``autostart`` is false.

    Exit codes are those of the command line: 0 done, 2 bad input, 3 a
    registration that failed, 130 interrupted; an unexpected fault is a
    traceback and 1. Without our supervisor, under ``ros2 launch`` and ``ros2 run``, an
    interruption is the usual end and gives 0: any other code is an error there.
    """
    return _run_process(name, lambda: [ManagedNode(name, build)], argv)


@dataclass(frozen=True)
class ComposedNode:
    """One of several nodes that share a process.

    Parameters
    ----------
    name : str
    build : callable
    arguments : tuple of str
        What its own process would be given: ``--ros-args`` with remappings and a file of parameters.
    """

    name: str
    build: Build
    arguments: tuple[str, ...]


def run_nodes(name: str, nodes: Sequence[ComposedNode]) -> int:
    """Run several lifecycle nodes in one process, context and thread, and return its exit code.

    They share the interpreter and its libraries, and wait for each other: nothing runs while one of them
    works. The process ends when all may end, or one has failed; exit codes are those of :func:`run_node`.
    """

    def make() -> list[ManagedNode]:
        options = ({"cli_args": list(n.arguments), "use_global_arguments": False} for n in nodes)
        return [ManagedNode(n.name, n.build, **given) for n, given in zip(nodes, options, strict=True)]

    return _run_process(name, make, [])


def _run_process(name: str, make: Callable[[], list[ManagedNode]], argv: Sequence[str] | None) -> int:
    interrupted = INTERRUPTED if _SUPERVISOR in os.environ else 0
    try:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})  # see the supervisor: imports are done
        rclpy.init(args=list(sys.argv if argv is None else [name, *argv]))
    except KeyboardInterrupt:
        return interrupted
    except (RCLError, ParameterException, RuntimeError) as error:
        return _refused(f"{name}: {' '.join(str(error).split())}", InputError.exit_code)
    try:
        nodes = make()
        _attach_logging(nodes[-1])
        return _run(nodes)
    except (ExternalShutdownException, KeyboardInterrupt):
        return interrupted
    except SubiacoError as error:  # at the end: interrupted, there is no node any more that could log it
        return _refused(str(error), error.exit_code)
    except (RuntimeError, ImportError):  # an RCLError, or what a call that the end cut short makes of itself
        if rclpy.ok():
            raise
        return interrupted
    finally:
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # a second one changes nothing
        logging.getLogger().handlers = []
        with suppress(RCLError):  # the handler of a signal may end the context between look and call
            rclpy.try_shutdown()


def _refused(reason: str, code: int) -> int:
    """Say why the process ends where no node can log it; return its exit code."""
    sys.stderr.write(f"[FATAL] {reason}\n")
    supervisor_channel().error(reason)
    return code


def _run(nodes: Sequence[ManagedNode]) -> int:
    executor = SingleThreadedExecutor()
    for node in nodes:
        executor.add_node(node)
    try:
        for node in nodes:
            node.start()
        _spin(executor, nodes)
    except SubiacoError as error:
        nodes[-1].get_logger().fatal(str(error))
        supervisor_channel().error(str(error))
        return error.exit_code
    finally:
        with ExitStack() as stack:  # each is put away, whatever becomes of the others
            stack.callback(executor.shutdown, timeout_sec=1.0)
            for node in reversed(nodes):
                stack.callback(node.put_away)
    return 0


def start(module: str) -> int:
    """Import the module of a node with SIGINT blocked, and run it; a pending one arrives then."""
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    return int(importlib.import_module(module).main())
