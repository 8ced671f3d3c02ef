"""The graph description as ``ros2 launch`` takes it, for installations that have ``launch``."""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from subiaco_bringup.environment import dds_defaults
from subiaco_bringup.graph import GraphSpec

Arguments = dict[str, str]


def split_words(text: str) -> list[str]:
    """Split the value of a launch argument into words, quotes kept together."""
    return shlex.split(text)


def split_paths(text: str) -> list[Path]:
    """Split the value of a launch argument into paths."""
    return [Path(word) for word in split_words(text)]


def launch_actions(graph: GraphSpec) -> list[Any]:
    """Return one ``launch_ros`` node a process; the end of the principal one ends the launch."""
    from launch.actions import EmitEvent, RegisterEventHandler
    from launch.event_handlers import OnProcessExit
    from launch.events import Shutdown
    from launch_ros.actions import Node

    actions: list[Any] = []
    for spec in graph.nodes:
        node = Node(
            package=spec.package,
            executable=spec.executable,
            arguments=spec.arguments(),
            output="screen",
            respawn=spec.restart,
            respawn_delay=1.0,
            sigterm_timeout=str(spec.grace),
            sigkill_timeout=str(spec.grace),
        )
        actions.append(node)
        if spec.principal:
            ended = EmitEvent(event=Shutdown(reason=f"{spec.name} has ended"))
            actions.append(RegisterEventHandler(OnProcessExit(target_action=node, on_exit=[ended])))
    return actions


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
    from launch.actions import DeclareLaunchArgument, OpaqueFunction, SetEnvironmentVariable
    from launch.substitutions import LaunchConfiguration

    from launch import LaunchDescription  # type: ignore[attr-defined,unused-ignore]

    def expand(context: Any) -> list[Any]:
        values = {name: LaunchConfiguration(name).perform(context) for name, _, _ in arguments}
        return launch_actions(describe(values))

    declared = [
        DeclareLaunchArgument(name, default_value=default, description=text)
        for name, default, text in arguments
    ]
    local = [SetEnvironmentVariable(name, value) for name, value in dds_defaults(os.environ).items()]
    return LaunchDescription([*declared, *local, OpaqueFunction(function=expand)])
