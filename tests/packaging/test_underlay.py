"""The workspace over an underlay that holds the full messages of others, as an apt installation does.

The underlay is compiled here from the definitions of upstream: geometry2 and ouster-ros, both branch jazzy.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
PATIENCE = 900.0  # a build on an idle core takes a tenth of this [s]
APT_ROS = Path("/opt/ros/jazzy/setup.bash")
VENDORED = ("ouster_sensor_msgs", "tf2_msgs")

#: Files of each package upstream; the vendored copies have the first alone.
UPSTREAM: dict[str, dict[str, str]] = {
    "tf2_msgs": {
        "msg/TFMessage.msg": "geometry_msgs/TransformStamped[] transforms",
        "msg/TF2Error.msg": """
            uint8 NO_ERROR = 0
            uint8 LOOKUP_ERROR = 1
            uint8 CONNECTIVITY_ERROR = 2
            uint8 EXTRAPOLATION_ERROR = 3
            uint8 INVALID_ARGUMENT_ERROR = 4
            uint8 TIMEOUT_ERROR = 5
            uint8 TRANSFORM_ERROR = 6
            uint8 error
            string error_string
        """,
        "srv/FrameGraph.srv": """
            ---
            string frame_yaml
        """,
        "action/LookupTransform.action": """
            string target_frame
            string source_frame
            builtin_interfaces/Time source_time
            builtin_interfaces/Duration timeout
            builtin_interfaces/Time target_time
            string fixed_frame
            bool advanced
            ---
            geometry_msgs/TransformStamped transform
            tf2_msgs/TF2Error error
            ---
        """,
    },
    "ouster_sensor_msgs": {
        "msg/PacketMsg.msg": "uint8[] buf",
        "msg/Telemetry.msg": """
            uint8 THERMAL_SHUTDOWN_NORMAL=0
            uint8 THERMAL_SHUTDOWN_IMMINENT=1
            std_msgs/Header header
            uint16 countdown_thermal_shutdown
            uint16 countdown_shot_limiting
            uint8 thermal_shutdown
            uint8 shot_limiting
        """,
        "srv/GetConfig.srv": """
            ---
            string config
        """,
        "srv/SetConfig.srv": """
            string config_file
            ---
            string config
        """,
        "srv/GetMetadata.srv": """
            ---
            string metadata
        """,
    },
}
NEEDED = {"tf2_msgs": "geometry_msgs action_msgs", "ouster_sensor_msgs": "std_msgs"}

#: Whole but for what no Python node needs: introspection and dispatch of C++.
CMAKE = """
cmake_minimum_required(VERSION 3.16)
project({name})
find_package(ament_cmake REQUIRED)
find_package(rosidl_default_generators REQUIRED)
foreach(_needed {needed})
  find_package(${{_needed}} REQUIRED)
endforeach()
list(FILTER AMENT_EXTENSIONS_rosidl_generate_idl_interfaces
    EXCLUDE REGEX "introspection_cpp|typesupport_cpp_generate")
rosidl_generate_interfaces({name} {files} DEPENDENCIES {needed})
ament_package()
"""
MANIFEST = """<package format="3"><name>{name}</name><version>1.0.0</version><description>d</description>
<maintainer email="nobody@example.com">nobody</maintainer><license>BSD</license>
<buildtool_depend>ament_cmake</buildtool_depend>
{needed}<member_of_group>rosidl_interface_packages</member_of_group>
<export><build_type>ament_cmake</build_type></export></package>"""


def build_environment() -> dict[str, str]:
    """Return an environment without any workspace: ROS alone, and none of our libraries on the path."""
    left_out = {
        "PYTHONPATH", "LD_LIBRARY_PATH", "AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH", "COLCON_PREFIX_PATH",
        "_ROS_WHEELS_BOOTSTRAP_COMPLETE",
    }  # fmt: skip
    environment = {name: value for name, value in os.environ.items() if name not in left_out}
    if APT_ROS.is_file():
        command = ["bash", "-c", 'source "$0" && env -0', str(APT_ROS)]
        said = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
        environment = dict(entry.split("=", 1) for entry in said.split("\0") if "=" in entry)
    else:
        environment["AMENT_PREFIX_PATH"] = sys.prefix
    return environment | {"MAKEFLAGS": "-j2"}


#: What is compiled here is never run for its speed.
FAST = ("-G", "Ninja", "-DBUILD_TESTING=OFF", "-DCMAKE_BUILD_TYPE=None", "-DCMAKE_C_FLAGS=-O0",
        "-DCMAKE_CXX_FLAGS=-O0", f"-DPython3_EXECUTABLE={sys.executable}")  # fmt: skip


def colcon(sources: Path | str, target: Path, environment: dict[str, str], *options: str) -> set[str]:
    """Build packages; return the names of those that are installed then."""
    result = subprocess.run(
        ["colcon", "--log-base", str(target / "log"), "build", "--base-paths", str(sources),
         "--build-base", str(target / "build"), "--install-base", str(target / "install"), *options,
         "--cmake-args", *FAST, "--no-warn-unused-cli"],
        cwd=REPOSITORY, env=environment, capture_output=True, text=True, timeout=PATIENCE, check=False,
    )  # fmt: skip
    assert result.returncode == 0, result.stdout[-2000:] + result.stderr[-2000:]
    return {path.name for path in (target / "install").iterdir() if path.is_dir()}


@pytest.fixture(scope="module")
def underlay(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The full messages of others, compiled and installed."""
    folder = tmp_path_factory.mktemp("underlay")
    for name, files in UPSTREAM.items():
        for file, text in files.items():
            path = folder / "src" / name / file
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(textwrap.dedent(text).strip() + "\n")
        listed = " ".join(f'"{file}"' for file in files)
        depends = "".join(f"<depend>{needed}</depend>\n" for needed in NEEDED[name].split())
        (folder / "src" / name / "CMakeLists.txt").write_text(
            CMAKE.format(name=name, files=listed, needed=NEEDED[name])
        )
        (folder / "src" / name / "package.xml").write_text(MANIFEST.format(name=name, needed=depends))
    assert colcon(folder / "src", folder, build_environment()) == set(VENDORED)
    return folder / "install"


def upstream_hashes() -> dict[str, str]:
    """Return the type hash of each message from its definition, by another implementation than ROS's own."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    types = get_typestore(Stores.ROS2_JAZZY)
    found = {}
    for package, files in UPSTREAM.items():
        for file, text in files.items():
            if file.startswith("msg/"):
                name = f"{package}/{file.removesuffix('.msg')}"
                types.fielddefs.pop(name, None)
                types.register(get_types_from_msg(textwrap.dedent(text).strip(), name))
                found[name] = types.hash_rihs01(name)
    return found


def installed_hashes(prefix: Path, package: str) -> dict[str, str]:
    """Return the type hashes of the messages of an installed package, by name."""
    found: dict[str, str] = {}
    for file in (prefix / "share" / package / "msg").glob("*.json"):
        description: dict[str, Any] = json.loads(file.read_text())
        hashes = {entry["type_name"]: entry["hash_string"] for entry in description["type_hashes"]}
        name = f"{package}/msg/{file.stem}"
        found[name] = hashes[name]
    return found


#: What a process loads over both workspaces: modules, libraries, and the hashes that its topics announce.
LOADED = """
    import json, ouster_sensor_msgs, rclpy, subiaco_msgs, tf2_msgs
    from ouster_sensor_msgs.msg import PacketMsg, Telemetry
    from tf2_msgs.action import LookupTransform
    from tf2_msgs.msg import TF2Error, TFMessage
    from subiaco_msgs.msg import ScanQuality
    from subiaco_mapping.nodes import odometry_node
    rclpy.init()
    node = rclpy.create_node("tester")
    kinds = {"tf2_msgs": (TFMessage, TF2Error), "ouster_sensor_msgs": (PacketMsg, Telemetry)}
    publishers = []
    hashes = {}
    for kind in (*kinds["tf2_msgs"], *kinds["ouster_sensor_msgs"], ScanQuality):
        publishers.append(node.create_publisher(kind, kind.__name__, 1))
        (end,) = node.get_publishers_info_by_topic(kind.__name__)
        hashes[end.topic_type] = str(end.topic_type_hash)
    LookupTransform.__class__.__import_type_support__()
    mapped = {line.split()[-1] for line in open("/proc/self/maps") if ".so" in line}
    modules = (tf2_msgs, ouster_sensor_msgs, subiaco_msgs, odometry_node)
    print(json.dumps({
        "hashes": hashes, "used": odometry_node.TFMessage is TFMessage,
        "files": {module.__name__: module.__file__ for module in modules},
        "libraries": sorted(path for path in mapped if "tf2_msgs" in path or "ouster_sensor_msgs" in path),
    }))
"""


@pytest.mark.slow
@pytest.mark.ros
@pytest.mark.timeout(2 * PATIENCE)
@pytest.mark.skipif(shutil.which("colcon") is None, reason="colcon is not installed")
def test_the_workspace_built_over_full_messages_leaves_them_alone_and_loads_them(
    underlay: Path, tmp_path: Path
) -> None:
    from ament_index_python.packages import get_package_prefix

    environment = build_environment()
    ours = get_package_prefix("subiaco_msgs")
    prefixes = [*(str(underlay / name) for name in VENDORED), ours]
    environment["AMENT_PREFIX_PATH"] = ":".join([*prefixes, environment["AMENT_PREFIX_PATH"]])
    listed = subprocess.run(
        ["colcon", "--log-base", "/dev/null", "list", "--names-only", "--base-paths", "ros2_ws/src"],
        cwd=REPOSITORY, env=environment, capture_output=True, text=True, check=True,
    ).stdout.split()  # fmt: skip
    assert set(listed) == {path.parent.name for path in (REPOSITORY / "src").glob("subiaco*/package.xml")}
    # Our own messages use none of these, and take a minute: those that the set-up compiled are taken.
    built = colcon("ros2_ws/src", tmp_path, environment, "--packages-skip", "subiaco_msgs")
    assert built == set(listed) - {"subiaco_msgs"}

    # the built packages, not the sources that a developer's PYTHONPATH may name
    messages = Path(ours) / "share/subiaco_msgs/package.bash"
    scripts = (underlay / "local_setup.bash", messages, tmp_path / "install/local_setup.bash")
    sourced = " && ".join(f"source {script}" for script in scripts)
    run = ["bash", "-c", f'{sourced} && exec "$0" -c "$1"', sys.executable, textwrap.dedent(LOADED)]
    result = subprocess.run(
        run, env=environment, cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE, check=False
    )
    assert result.returncode == 0, result.stderr[-2000:]
    said = json.loads(result.stdout.splitlines()[-1])
    files = {name: Path(file) for name, file in said["files"].items()}
    assert all(files[name].is_relative_to(underlay) for name in VENDORED)
    assert files["subiaco_mapping.nodes.odometry_node"].is_relative_to(tmp_path / "install")
    assert said["used"] is True
    assert {Path(path).name.split("__")[0] for path in said["libraries"]} >= {
        f"lib{name}" for name in VENDORED
    }
    assert all(Path(path).is_relative_to(underlay) for path in said["libraries"])
    assert {name: said["hashes"].pop(name) for name in upstream_hashes()} == upstream_hashes()
    assert set(said["hashes"]) == {"subiaco_msgs/msg/ScanQuality"}


@pytest.mark.slow
@pytest.mark.ros
@pytest.mark.timeout(2 * PATIENCE)
@pytest.mark.parametrize("name", VENDORED)
def test_vendored_messages_have_the_type_hashes_of_the_full_ones(underlay: Path, name: str) -> None:
    from ament_index_python.packages import get_package_prefix

    full = installed_hashes(underlay / name, name)
    here = installed_hashes(Path(get_package_prefix(name)), name)  # the vendored copy, or that of apt
    assert full == {key: value for key, value in upstream_hashes().items() if key.startswith(name)}
    assert here
    assert here.items() <= full.items()
