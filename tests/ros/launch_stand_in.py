"""Launch files without the library ``launch``, which is in no package registry that the set-up uses.

What a launch file asks for is expanded by a stand-in of its classes, and run as ``ros2 launch`` runs it: the
installed executables, each with its own arguments, until one of them ends the launch. Where the real library
is installed, ``tests/nodes/test_launch_library.py`` runs the same files through it.
"""

from __future__ import annotations

import importlib.util
import os
import signal
import subprocess
import sys
import time
import types
from pathlib import Path
from typing import Any

import pytest


class Action:
    """Stands for every class of ``launch``: keeps what it was given."""

    def __init__(self, *given: Any, **named: Any) -> None:
        self.given, self.named = given, named


class Node(Action):
    """Stands for launch_ros.actions.Node."""


class OpaqueFunction(Action):
    """Stands for launch.actions.OpaqueFunction."""


class SetEnvironmentVariable(Action):
    """Stands for launch.actions.SetEnvironmentVariable."""


class RegisterEventHandler(Action):
    """Stands for launch.actions.RegisterEventHandler."""


class EmitEvent(Action):
    """Stands for launch.actions.EmitEvent."""


class Configuration:
    """Stands for LaunchConfiguration; the context is a plain dict."""

    def __init__(self, name: str) -> None:
        self.name = name

    def perform(self, context: dict[str, str]) -> str:
        return context[self.name]


def stand_in(monkeypatch: pytest.MonkeyPatch) -> None:
    """Put a minimal ``launch`` in place, for a test."""
    contents = {
        "launch": {"LaunchDescription": Action},
        "launch.actions": {
            "DeclareLaunchArgument": Action,
            "EmitEvent": EmitEvent,
            "OpaqueFunction": OpaqueFunction,
            "RegisterEventHandler": RegisterEventHandler,
            "SetEnvironmentVariable": SetEnvironmentVariable,
        },
        "launch.substitutions": {"LaunchConfiguration": Configuration},
        "launch.event_handlers": {"OnProcessExit": Action},
        "launch.events": {"Shutdown": Action},
        "launch_ros": {},
        "launch_ros.actions": {"Node": Node},
    }
    for name, members in contents.items():
        module = types.ModuleType(name)
        vars(module).update(members)
        monkeypatch.setitem(sys.modules, name, module)


def description_of(file: Path) -> list[Any]:
    """Return what ``ros2 launch`` is given by a launch file."""
    spec = importlib.util.spec_from_file_location("launched", file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return list(module.generate_launch_description().given[0])


def launched_nodes(file: Path, **arguments: str) -> list[dict[str, Any]]:
    """Expand a launch file as ``ros2 launch`` would, and return what its nodes are given."""
    actions = description_of(file)
    declared = [a for a in actions if type(a) is Action]
    context = {a.given[0]: a.named["default_value"] for a in declared} | arguments
    assert not [name for name, value in context.items() if value is None]
    (expand,) = [a for a in actions if isinstance(a, OpaqueFunction)]
    return [a.named for a in expand.named["function"](context) if isinstance(a, Node)]


class Ended:
    """Stands for the event of a process that has ended, and for a context of a launch that goes on."""

    def __init__(self, code: int = 0, *, shut_down: bool = False) -> None:
        self.returncode, self.is_shutdown = code, shut_down


def ends_of(file: Path, **arguments: str) -> dict[str, Any]:
    """Return what follows from the end of each executable of a launch file."""
    actions = description_of(file)
    context = {a.given[0]: a.named["default_value"] for a in actions if type(a) is Action} | arguments
    (expand,) = [a for a in actions if isinstance(a, OpaqueFunction)]
    handlers = [a.given[0] for a in expand.named["function"](context) if isinstance(a, RegisterEventHandler)]
    return {h.named["target_action"].named["executable"]: h.named["on_exit"] for h in handlers}


def executable_of(node: dict[str, Any]) -> Path:
    """Return the file that ``ros2 run`` and ``ros2 launch`` start."""
    from ament_index_python.packages import get_package_prefix

    package = node["package"]
    return Path(get_package_prefix(package)) / "lib" / package / node["executable"]


class Launch:
    """A launch file at work.

    Parameters
    ----------
    file : Path
    arguments
        Of the launch file.
    """

    def __init__(self, file: Path, **arguments: str) -> None:
        environment = {k: v for k, v in os.environ.items() if k != "_ROS_WHEELS_BOOTSTRAP_COMPLETE"}
        environment |= dict(a.given for a in description_of(file) if isinstance(a, SetEnvironmentVariable))
        ends = ends_of(file, **arguments)
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self.over = False
        self._waiting = ends
        for node in launched_nodes(file, **arguments):
            command = [str(executable_of(node)), *node["arguments"]]
            self.processes[node["executable"]] = subprocess.Popen(
                command, env=environment, start_new_session=True
            )

    def run(self, seconds: float) -> dict[str, int]:
        """Follow the ends of processes until all have ended; return their exit codes."""
        deadline = time.monotonic() + seconds
        try:
            while self._waiting:
                assert time.monotonic() < deadline, f"still running: {', '.join(self._waiting)}"
                for name in [n for n in self._waiting if self.processes[n].poll() is not None]:
                    self._follow(self._waiting.pop(name), self.processes[name].returncode)
                time.sleep(0.05)
        finally:
            self.stop()
        return {name: int(process.returncode) for name, process in self.processes.items()}

    def _follow(self, end: Any, code: int) -> None:
        if any(isinstance(action, EmitEvent) for action in end(Ended(code), Ended(shut_down=self.over))):
            self.over = True
            for process in self.processes.values():
                process.send_signal(signal.SIGINT)

    def stop(self) -> None:
        """Leave nothing running."""
        for number in (signal.SIGINT, signal.SIGKILL):
            for process in self.processes.values():
                process.send_signal(number)
            for process in self.processes.values():
                try:
                    process.wait(timeout=20.0)
                except subprocess.TimeoutExpired:
                    continue
