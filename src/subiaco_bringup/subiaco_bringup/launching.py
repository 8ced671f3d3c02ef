"""The graph description as ``ros2 launch`` takes it, for installations that have ``launch``."""

from __future__ import annotations

import os
import shlex
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, get_origin

from subiaco_bringup.environment import dds_defaults
from subiaco_bringup.graph import GraphSpec, NodeSpec, deployed, with_foxglove
from subiaco_bringup.supervisor import MOST_RESTARTS, RESTART_DELAY, SETTLING
from subiaco_geo.errors import InputError, RegistrationError, SubiacoError
from subiaco_geo.requests import Request

Arguments = dict[str, str]


def split_words(text: str) -> list[str]:
    """Split the value of a launch argument into words, quotes kept together."""
    return shlex.split(text)


def split_paths(text: str) -> list[Path]:
    """Split the value of a launch argument into paths."""
    return [Path(word) for word in split_words(text)]


#: Arguments of every launch file.
COMMON_ARGUMENTS = (
    ("namespace", "", "namespace of all nodes and topics, e.g. one for each LiDAR"),
    ("use_sim_time", "", "true follows /clock; empty does what the graph needs"),
    ("autostart", "true", "false leaves configure and activate to 'ros2 lifecycle set'"),
    ("foxglove_port", "", "port on which Foxglove can connect from this computer; empty serves nothing"),
)


def is_true(text: str) -> bool:
    """Read a launch argument that is true or false.

    Raises
    ------
    InputError
        It is neither.
    """
    if text.lower() not in ("true", "false"):
        raise InputError(f"launch argument {text}: expected true or false")
    return text.lower() == "true"


def as_deployed(graph: GraphSpec, values: Arguments) -> GraphSpec:
    """Apply the arguments that every launch file has."""
    if values["foxglove_port"]:
        graph = with_foxglove(graph, int(values["foxglove_port"]))
    return deployed(
        graph,
        namespace=values["namespace"],
        autostart=is_true(values["autostart"]),
        use_sim_time=is_true(values["use_sim_time"]) if values["use_sim_time"] else None,
    )


def request_arguments(
    model: type[Request], names: Iterable[str] | None = None
) -> tuple[tuple[str, str | None, str], ...]:
    """Return the launch arguments of a request: its options by their names, then ``config`` and ``set``.

    Parameters
    ----------
    model : type of Request
    names : iterable of str, optional
        The options that the graph takes; all where absent.
    """
    chosen = [name for name in names or model.model_fields if name != "config"]
    options = tuple(
        (name, None if field.is_required() else "", field.description or "")
        for name, field in ((name, model.model_fields[name]) for name in chosen)
    )
    return (
        *options,
        ("config", "", "configuration files after the shipped ones, separated by blanks"),
        ("set", "", "key=value settings, separated by blanks"),
    )


def request_options(model: type[Request], values: Mapping[str, str]) -> dict[str, Any]:
    """Return the options of a request from the launch arguments that are given; lists are split at blanks."""
    return {
        name: split_words(values[name]) if get_origin(field.annotation) is tuple else values[name]
        for name, field in model.model_fields.items()
        if name != "config" and values.get(name)
    }


class NodeEnd:
    """What ``launch`` does when a node has ended, by the rules of our supervisor.

    Parameters
    ----------
    spec : NodeSpec
    shutdown : callable
        Gives the action that ends the launch, from its reason.
    """

    def __init__(self, spec: NodeSpec, shutdown: Callable[[str], Any]) -> None:
        self._spec, self._shutdown = spec, shutdown
        self._deaths, self._started = 0, time.monotonic()

    def __call__(self, event: Any, context: Any) -> list[Any]:
        """Return the actions that follow.

        Raises
        ------
        SubiacoError
            The job cannot go on: ``launch`` shuts the other nodes down and exits with 1.
        """
        spec, code = self._spec, int(event.returncode)
        if context.is_shutdown:
            return []
        if code == 0:
            return [self._shutdown(f"{spec.name} has ended")] if spec.principal else []
        ran, self._started = time.monotonic() - self._started, time.monotonic()
        refused = code in (InputError.exit_code, RegistrationError.exit_code) and ran < SETTLING
        self._deaths += 1
        if not refused and (not spec.essential or (spec.restart and self._deaths <= MOST_RESTARTS)):
            return []
        raise SubiacoError(f"node {spec.name} ended with exit code {code}; it said why above")


def launch_actions(graph: GraphSpec) -> list[Any]:
    """Return one ``launch_ros`` node a process, and what follows from the end of each."""
    from launch.actions import EmitEvent, RegisterEventHandler
    from launch.event_handlers import OnProcessExit
    from launch.events import Shutdown
    from launch_ros.actions import Node

    def shutdown(reason: str) -> Any:
        return EmitEvent(event=Shutdown(reason=reason))

    actions: list[Any] = []
    for spec in graph.nodes:
        node = Node(
            package=spec.package,
            executable=spec.executable,
            arguments=spec.arguments(),
            output="screen",
            respawn=spec.restart,
            respawn_delay=RESTART_DELAY,
            respawn_max_retries=MOST_RESTARTS,
            sigterm_timeout=str(spec.grace),
            sigkill_timeout=str(spec.grace),
        )
        ended = OnProcessExit(target_action=node, on_exit=NodeEnd(spec, shutdown))
        actions += [RegisterEventHandler(ended), node]
    return actions


def local_environment() -> list[Any]:
    """Return the actions that keep nodes to this host where nothing else is set."""
    from launch.actions import SetEnvironmentVariable

    return [SetEnvironmentVariable(name, value) for name, value in dds_defaults(os.environ).items()]


def launch_description(
    arguments: Sequence[tuple[str, str | None, str]], describe: Callable[[Arguments], GraphSpec]
) -> Any:
    """Build a launch description whose graph is described once the arguments are known.

    Parameters
    ----------
    arguments : sequence of (name, default or None, help)
    describe : callable
        Launch arguments to graph.
    """
    from launch.actions import DeclareLaunchArgument, OpaqueFunction
    from launch.substitutions import LaunchConfiguration

    from launch import LaunchDescription  # type: ignore[attr-defined,unused-ignore]

    every = (*arguments, *COMMON_ARGUMENTS)

    def expand(context: Any) -> list[Any]:
        values = {name: LaunchConfiguration(name).perform(context) for name, _, _ in every}
        return launch_actions(as_deployed(describe(values), values))

    declared = [
        DeclareLaunchArgument(name, default_value=default, description=text) for name, default, text in every
    ]
    return LaunchDescription([*declared, *local_environment(), OpaqueFunction(function=expand)])
