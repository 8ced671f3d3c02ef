"""Launch files through the real ``launch`` and ``launch_ros``, where these are installed.

They are not among the wheels; docs/how-to/ros2-command.md says how they are added. Drivers are stand-ins:
small nodes under the names of the packages and executables that the vehicle has.
"""

from __future__ import annotations

import importlib.util
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import yaml

SOURCES = Path(__file__).resolve().parents[2] / "src"
LAUNCH = SOURCES / "subiaco_bringup" / "launch"


def installed() -> bool:
    """Whether ``launch`` is a library here, not merely a folder of that name on the path."""
    found = [importlib.util.find_spec(name) for name in ("launch", "launch_ros", "composition_interfaces")]
    return all(spec is not None and spec.origin is not None for spec in found)


pytestmark = [
    pytest.mark.ros,
    pytest.mark.skipif(not installed(), reason="no launch library: see docs/how-to/ros2-command.md"),
]

GIVEN: dict[str, dict[str, str]] = {
    "change": {"before": "/maps/a", "after": "/maps/b", "output": "/maps/change", "set": "leaf=0.4"},
    "live": {
        "output": "/tmp/drive", "remap": "/imu/data:=/xsens/imu", "namespace": "left",
        "use_sim_time": "true", "foxglove_port": "8765",
    },
    "mapping": {"bag": "/bags/one '/bags/two words'", "output": "/maps/a", "rate": "2.0"},
    "record": {"output": "/tmp/drive", "remap": "/gnss/fix:=/ublox/fix"},
}  # fmt: skip

NODES: dict[str, list[str]] = {
    "change": ["/change"],
    "live": ["/left/recorder", "/left/monitor", "/left/odometry", "/left/pose_graph", "/left/foxglove"],
    "mapping": ["/replay", "/odometry", "/pose_graph"],
    "record": ["/recorder"],
}


def expanded(name: str, arguments: dict[str, str]) -> list[Any]:
    """Return the nodes that ``ros2 launch`` would start, with their substitutions performed."""
    from launch.launch_description_sources import get_launch_description_from_python_launch_file
    from launch_ros.actions import Node

    from launch import LaunchContext

    context = LaunchContext(argv=[])
    waiting = list(get_launch_description_from_python_launch_file(str(LAUNCH / f"{name}.launch.py")).entities)
    context.launch_configurations.update(arguments)
    nodes = []
    while waiting:
        entity = waiting.pop(0)
        if isinstance(entity, Node):
            entity._perform_substitutions(context)
            words = ["".join(part.perform(context) for part in word) for word in entity.cmd]
            nodes.append((entity, words))
        else:
            waiting = [*(entity.visit(context) or []), *waiting]
    return nodes


def after(words: list[str], flag: str) -> list[str]:
    """Return the words that follow a flag."""
    return [value for word, value in pairwise(words) if word == flag]


@pytest.mark.parametrize("name", GIVEN)
def test_a_launch_file_starts_executables_that_exist_with_files_and_names_that_are_right(name: str) -> None:
    from ament_index_python.packages import get_package_prefix

    found = expanded(name, GIVEN[name])
    names = []
    for node, (executable, *words) in found:
        package = node.node_package
        assert Path(executable).parent == Path(get_package_prefix(package)) / "lib" / package
        assert os.access(executable, os.X_OK)
        rules = dict(rule.split(":=", 1) for rule in after(words, "-r"))
        (file,) = after(words, "--params-file")
        given = yaml.safe_load(Path(file).read_text())["/**"]["ros__parameters"]
        names.append(f"{rules.get('__ns', '')}/{rules['__node']}")
        if name == "live":
            assert given["use_sim_time"] is True
            assert rules.get("imu/data", "/xsens/imu") == "/xsens/imu"
    assert names == NODES[name]


DRIVER = '''#!{python}
"""Stands for a driver: says its parameters, and publishes a frame where tf2 does."""
import json, os, sys
import rclpy
from geometry_msgs.msg import TransformStamped
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String
from tf2_msgs.msg import TFMessage

rclpy.init(args=sys.argv)
words = rclpy.utilities.remove_ros_args(sys.argv)[1:]
given = dict(zip(words[::2], words[1::2]))
node = rclpy.create_node(os.path.basename(sys.argv[0]), automatically_declare_parameters_from_overrides=True)
values = {{name: parameter.value for name, parameter in node.get_parameters_by_prefix("").items()}}
latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
said = node.create_publisher(String, "~/said", latched)
frames = node.create_publisher(TFMessage, "/tf_static", latched)
packets = node.create_publisher(String, "metadata", latched)
packets.publish(String(data="a sensor"))
frame = TransformStamped()
frame.header.frame_id = given.get("--frame-id", "os_sensor")
frame.child_frame_id = given.get("--child-frame-id", "os_imu")
frame.transform.translation.z = float(given.get("--z", 0.0))
if "ublox" not in node.get_name():
    frames.publish(TFMessage(transforms=[frame]))
said.publish(String(data=json.dumps(values, default=str)))
try:
    rclpy.spin(node)
except (KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
    pass
'''

DRIVER_LAUNCH = """
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

def generate_launch_description():
    viewer = IfCondition(LaunchConfiguration("viz"))
    return LaunchDescription([
        DeclareLaunchArgument("params_file"),
        DeclareLaunchArgument("ouster_ns", default_value="ouster"),
        DeclareLaunchArgument("viz", default_value="True"),
        Node(package="ouster_ros", executable="os_driver", name="os_driver",
             namespace=LaunchConfiguration("ouster_ns"), parameters=[LaunchConfiguration("params_file")]),
        Node(package="rviz2", executable="rviz2", condition=viewer),
    ])
"""


def make_package(prefix: Path, name: str, executable: str) -> None:
    """Install a stand-in as a package with one executable."""
    for folder in (f"share/{name}", f"lib/{name}", "share/ament_index/resource_index/packages"):
        (prefix / folder).mkdir(parents=True, exist_ok=True)
    (prefix / "share/ament_index/resource_index/packages" / name).touch()
    (prefix / f"share/{name}/package.xml").write_text(f"<package><name>{name}</name></package>")
    file = prefix / f"lib/{name}" / executable
    file.write_text(DRIVER.format(python=sys.executable))
    file.chmod(0o755)


@pytest.fixture
def vehicle(tmp_path: Path) -> dict[str, str]:
    """The environment of a vehicle: drivers are installed."""
    prefix = tmp_path / "drivers"
    for name, executable in (
        ("ouster_ros", "os_driver"),
        ("ublox_gps", "ublox_gps_node"),
        ("septentrio_gnss_driver", "septentrio_gnss_driver_node"),
        ("tf2_ros", "static_transform_publisher"),
    ):
        make_package(prefix, name, executable)
    launch = prefix / "share/ouster_ros/launch/driver.launch.py"
    launch.parent.mkdir()
    launch.write_text(DRIVER_LAUNCH)
    for name, values in {"ouster": {"lidar_mode": "1024x10"}, "gnss": {"rate": 8}}.items():
        (tmp_path / f"{name}.yaml").write_text(yaml.safe_dump({"/**": {"ros__parameters": values}}))
    path = f"{prefix}:{os.environ['AMENT_PREFIX_PATH']}"
    environment = {k: v for k, v in os.environ.items() if k != "_ROS_WHEELS_BOOTSTRAP_COMPLETE"}
    return environment | {"AMENT_PREFIX_PATH": path, "ROS_LOG_DIR": str(tmp_path / "log")}


def launching(file: str, environment: dict[str, str], **arguments: str) -> subprocess.Popen[str]:
    """Run a launch file as ``ros2 launch`` does, in a process of its own."""
    code = """
import sys
from launch import LaunchDescription, LaunchService
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import AnyLaunchDescriptionSource
given = [tuple(word.split(":=", 1)) for word in sys.argv[2:]]
service = LaunchService()
source = AnyLaunchDescriptionSource(sys.argv[1])
service.include_launch_description(
    LaunchDescription([IncludeLaunchDescription(source, launch_arguments=given)]))
sys.exit(service.run())
"""
    words = [f"{name}:={value}" for name, value in arguments.items()]
    return subprocess.Popen(
        [sys.executable, "-c", code, str(LAUNCH / file), *words],
        env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True,
    )  # fmt: skip


@pytest.fixture
def processes() -> Iterator[list[subprocess.Popen[str]]]:
    """Launches of a test; ended with it."""
    started: list[subprocess.Popen[str]] = []
    yield started
    for process in started:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


@pytest.mark.slow
@pytest.mark.parametrize("namespace", ["", "left"])
def test_drivers_start_with_their_parameters_and_frames_come_where_the_graph_hears_them(
    ros: Any, vehicle: dict[str, str], processes: list[Any], tmp_path: Path, namespace: str
) -> None:
    from std_msgs.msg import String

    from tf2_msgs.msg import TFMessage

    environment = vehicle | {"ROS_DOMAIN_ID": str(ros.context.get_domain_id())}
    process = launching(
        "drivers.launch.py", environment, namespace=namespace, lidar="ouster", gnss="ublox",
        lidar_params=str(tmp_path / "ouster.yaml"), gnss_params=str(tmp_path / "gnss.yaml"),
        set="sensors.lidar_frame=os_sensor sensors.lidar.translation=[0,0,1.9]",
    )  # fmt: skip
    processes.append(process)
    top = f"/{namespace}" if namespace else ""
    listener = ros.node("listener")
    lidar, place, gnss = (
        ros.collect(listener, String, f"{name}/said")
        for name in (f"{top}/ouster/os_driver", f"{top}/place_of_os_sensor", "/ublox_gps_node")
    )
    frames = ros.collect(listener, TFMessage, f"{top}/tf_static")
    elsewhere = ros.collect(listener, TFMessage, "/tf_static") if namespace else []
    metadata = ros.collect(listener, String, f"{top}/ouster/metadata")
    ros.until(lambda: lidar and place and gnss and metadata and len(frames) >= 2, timeout=120.0)
    assert json.loads(lidar[0].data)["lidar_mode"] == "1024x10"
    assert json.loads(gnss[0].data)["rate"] == 8
    heights = {
        (t.header.frame_id, t.child_frame_id): t.transform.translation.z for m in frames for t in m.transforms
    }
    assert heights == {("base_link", "os_sensor"): 1.9, ("os_sensor", "os_imu"): 0.0}
    assert elsewhere == []
    os.killpg(process.pid, signal.SIGINT)
    said, _ = process.communicate(timeout=60)
    assert process.returncode in (0, 1), said  # launch gives 1 where it was interrupted
    assert "rviz2" not in said


def test_a_driver_that_is_not_known_ends_the_launch_with_its_reason(
    vehicle: dict[str, str], processes: list[Any]
) -> None:
    process = launching("drivers.launch.py", vehicle, lidar="velodyne")
    processes.append(process)
    said, _ = process.communicate(timeout=120)
    assert process.returncode == 1
    assert "lidar velodyne: no such driver; choose from ouster, none" in said
