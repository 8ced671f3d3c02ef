"""What starts the drivers of a vehicle: their own launch files, and the places of the sensors.

None of this is a part of the wheels; the packages of the drivers and ``launch`` are needed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from subiaco_geo.errors import InputError
from subiaco_mapping.preprocessing.config import SensorsConfig


@dataclass(frozen=True)
class LaunchedFile:
    """A launch file of another package.

    Parameters
    ----------
    package, file : str
        Name, and path below its share.
    arguments : mapping
    """

    package: str
    file: str
    arguments: Mapping[str, str]


@dataclass(frozen=True)
class LaunchedNode:
    """An executable of another package.

    Parameters
    ----------
    package, executable, name : str
    arguments : tuple of str
    parameters : tuple of str
        Parameter files.
    """

    package: str
    executable: str
    name: str
    arguments: tuple[str, ...] = ()
    parameters: tuple[str, ...] = ()


Launched = LaunchedFile | LaunchedNode


def lidar_driver(name: str, parameters: str) -> list[Launched]:
    """Return what starts a LiDAR: ``ouster``, or nothing for ``none``.

    Raises
    ------
    InputError
        The driver is not known, or its parameter file is missing.
    """
    if name == "none":
        return []
    if name != "ouster":
        raise InputError(f"lidar {name}: no such driver; choose from ouster, none")
    path = _parameter_file("lidar_params", parameters)
    given = {"params_file": path, "ouster_ns": "ouster", "viz": "False"}
    return [LaunchedFile("ouster_ros", "launch/driver.launch.py", given)]


def gnss_driver(name: str, parameters: str) -> list[Launched]:
    """Return what starts a receiver: ``ublox``, ``septentrio``, or nothing for ``none``.

    Raises
    ------
    InputError
        The driver is not known, or its parameter file is missing.
    """
    if name == "none":
        return []
    if name not in ("ublox", "septentrio"):
        raise InputError(f"gnss {name}: no such driver; choose from ublox, septentrio, none")
    path = _parameter_file("gnss_params", parameters)
    if name == "ublox":
        return [LaunchedNode("ublox_gps", "ublox_gps_node", "ublox_gps_node", (), (path,))]
    # Not its launch file, which also publishes base_link -> imu -> gnss without any lever arm.
    node = "septentrio_gnss_driver"
    return [LaunchedNode(node, f"{node}_node", node, (), (path,))]


def sensor_places(sensors: SensorsConfig) -> list[Launched]:
    """Return publishers of the static transforms of all sensors whose places are set."""
    placed = (
        (sensors.lidar_frame, sensors.lidar),
        (sensors.imu_frame, sensors.imu),
        (sensors.gnss_frame, sensors.gnss),
    )
    found: list[Launched] = []
    for frame, pose in placed:
        if pose is None:
            continue
        x, y, z = pose.translation
        roll, pitch, yaw = np.radians(pose.rotation_deg).tolist()
        values = {"x": x, "y": y, "z": z, "roll": roll, "pitch": pitch, "yaw": yaw}
        words = [word for key, value in values.items() for word in (f"--{key}", f"{value:.9g}")]
        words += ["--frame-id", sensors.base_frame, "--child-frame-id", frame]
        found.append(LaunchedNode("tf2_ros", "static_transform_publisher", f"place_of_{frame}", tuple(words)))
    return found


def _parameter_file(argument: str, path: str) -> str:
    if not path:
        raise InputError(f"{argument}: give the parameter file of the driver")
    if not Path(path).is_file():
        raise InputError(f"{argument}: {path}: no such file")
    return str(Path(path).resolve())


def in_namespace(namespace: str, actions: list[Any]) -> list[Any]:
    """Return actions of ``launch`` that start nodes in a namespace, with a tree of frames of its own.

    Drivers name ``/tf`` and ``/tf_static`` absolutely; a graph in a namespace hears those in it.
    """
    from launch.actions import GroupAction
    from launch_ros.actions import PushRosNamespace, SetRemap

    name = namespace.strip("/")
    if not name:
        return actions
    frames = [SetRemap(topic, f"/{name}{topic}") for topic in ("/tf", "/tf_static")]
    return [GroupAction([PushRosNamespace(name), *frames, *actions])]


def driver_actions(launched: list[Launched]) -> list[Any]:
    """Return the actions of ``launch`` that start drivers."""
    from ament_index_python.packages import get_package_share_directory
    from launch.actions import IncludeLaunchDescription
    from launch.launch_description_sources import AnyLaunchDescriptionSource
    from launch_ros.actions import Node

    share: Callable[[str], str] = get_package_share_directory
    actions: list[Any] = []
    for item in launched:
        if isinstance(item, LaunchedFile):
            source = AnyLaunchDescriptionSource(str(Path(share(item.package)) / item.file))
            actions.append(IncludeLaunchDescription(source, launch_arguments=list(item.arguments.items())))
        else:
            actions.append(
                Node(
                    package=item.package,
                    executable=item.executable,
                    name=item.name,
                    arguments=list(item.arguments),
                    parameters=list(item.parameters),
                    output="screen",
                    respawn=True,
                )
            )
    return actions
