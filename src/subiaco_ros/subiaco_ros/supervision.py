"""What a node process tells the supervisor that started it: progress, status, and why it ends.

The supervisor hands every node the writing end of a pipe, whose number the environment variable ``CHANNEL``
states. Each line is a JSON object with one report: ``progress``, ``status`` or ``error``. The pipe works from
the start of the process to its end, before and after there is a ROS context; topics tell everybody else.
"""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

#: Environment variable that holds the file descriptor of the channel.
CHANNEL = "SUBIACO_REPORT_CHANNEL"


@dataclass(frozen=True)
class NodeProgress:
    """How far a node has come: the stage, and the fraction of it that is done."""

    stage: str
    fraction: float


class SupervisorChannel:
    """The node's end of the channel; without a supervisor, nothing is sent.

    Parameters
    ----------
    descriptor : int, optional
        Writing end of the pipe.
    """

    def __init__(self, descriptor: int | None) -> None:
        self._descriptor = descriptor
        self._lock = threading.Lock()
        if descriptor is not None:
            os.set_inheritable(descriptor, False)  # workers of this process are not asked

    @property
    def supervised(self) -> bool:
        """Whether a supervisor listens."""
        return self._descriptor is not None

    def progress(self, progress: NodeProgress) -> None:
        """Tell how far the node has come."""
        self._send({"progress": asdict(progress)})

    def status(self, status: Mapping[str, Any]) -> None:
        """Tell what the node sees, for a screen."""
        self._send({"status": dict(status)})

    def error(self, text: str) -> None:
        """Tell in one line why the node ends."""
        self._send({"error": text})

    def _send(self, report: Mapping[str, Any]) -> None:
        line = json.dumps(report).encode() + b"\n"
        with self._lock:
            while line and self._descriptor is not None:
                try:
                    line = line[os.write(self._descriptor, line) :]
                except OSError:  # the supervisor has gone
                    self._descriptor = None


_CHANNELS: dict[str, SupervisorChannel] = {}


def supervisor_channel() -> SupervisorChannel:
    """Return this process's channel to its supervisor."""
    number = os.environ.get(CHANNEL, "")
    if number not in _CHANNELS:
        _CHANNELS[number] = SupervisorChannel(int(number) if number else None)
    return _CHANNELS[number]


@dataclass(frozen=True)
class ReportListener:
    """What a supervisor does with the reports of a node.

    Parameters
    ----------
    on_progress, on_status, on_error : callable
    """

    on_progress: Callable[[NodeProgress], None]
    on_status: Callable[[dict[str, Any]], None]
    on_error: Callable[[str], None]

    def read(self, descriptor: int) -> None:
        """Take reports until the node has closed its end of the channel; close ours."""
        with os.fdopen(descriptor, encoding="utf-8", errors="replace") as lines:
            for line in lines:
                if line.endswith("\n"):  # else the node was killed while it wrote
                    self._take(json.loads(line))

    def _take(self, report: Mapping[str, Any]) -> None:
        if "progress" in report:
            self.on_progress(NodeProgress(**report["progress"]))
        if "status" in report:
            self.on_status(report["status"])
        if "error" in report:
            self.on_error(report["error"])
