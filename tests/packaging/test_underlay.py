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

#: The generators that an import in Python needs; C++ and the transport would take most of the time.
CMAKE = """
cmake_minimum_required(VERSION 3.16)
project({name})
find_package(ament_cmake REQUIRED)
foreach(_generator generator_type_description generator_c typesupport_introspection_c typesupport_c
    generator_py cmake)
  find_package(rosidl_${{_generator}} REQUIRED)
endforeach()
foreach(_needed {needed})
  find_package(${{_needed}} REQUIRED)
endforeach()
rosidl_generate_interfaces({name} {files} DEPENDENCIES {needed})
ament_package()
"""
MANIFEST = """<package format="3"><name>{name}</name><version>1.0.0</version><description>d</description>
<maintainer email="nobody@example.com">nobody</maintainer><license>BSD</license>
<buildtool_depend>ament_cmake</buildtool_depend>
{needed}<member_of_group>rosidl_interface_packages</member_of_group>
<export><build_type>ament_cmake</build_type></export></package>"""


def build_environment() -> dict[str, str]:
    """Return an environment without any workspace: ROS alone."""
    left_out = ("PYTHONPATH", "CMAKE_PREFIX_PATH", "COLCON_PREFIX_PATH", "_ROS_WHEELS_BOOTSTRAP_COMPLETE")
    environment = {name: value for name, value in os.environ.items() if name not in left_out}
    ros = "/opt/ros/jazzy" if Path("/opt/ros/jazzy/setup.bash").is_file() else sys.prefix
    return environment | {"AMENT_PREFIX_PATH": ros, "MAKEFLAGS": "-j2"}


def colcon(sources: Path | str, target: Path, environment: dict[str, str], *words: str) -> set[str]:
    """Build packages; return the names of those that are installed then."""
    result = subprocess.run(
        ["colcon", "--log-base", str(target / "log"), "build", "--base-paths", str(sources),
         "--build-base", str(target / "build"), "--install-base", str(target / "install"), *words],
        cwd=REPOSITORY, env=environment, capture_output=True, text=True, timeout=280, check=False,
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
    options = ("-G", "Ninja", "-DBUILD_TESTING=OFF", "-DCMAKE_C_FLAGS=-O0", "-DCMAKE_CXX_FLAGS=-O0")
    python = f"-DPython3_EXECUTABLE={sys.executable}"
    built = colcon(folder / "src", folder, build_environment(), "--cmake-args", *options, python)
    assert built == set(VENDORED)
    return folder / "install"


def type_hashes(share: Path, package: str) -> dict[str, str]:
    """Return the type hashes of the messages of a package, by name, as it was installed."""
    found: dict[str, str] = {}
    for file in (share / "msg").glob("*.json"):
        description: dict[str, Any] = json.loads(file.read_text())
        hashes = {entry["type_name"]: entry["hash_string"] for entry in description["type_hashes"]}
        name = f"{package}/msg/{file.stem}"
        found[name] = hashes[name]
    return found


USED = """
    import json, ouster_sensor_msgs, tf2_msgs
    from ouster_sensor_msgs.msg import PacketMsg, Telemetry
    from tf2_msgs.action import LookupTransform
    from tf2_msgs.msg import TFMessage
    from subiaco_mapping.nodes import odometry_node
    for kind in (PacketMsg, Telemetry, TFMessage):
        kind.__import_type_support__()
        assert kind._TYPE_SUPPORT is not None
    files = [module.__file__ for module in (tf2_msgs, ouster_sensor_msgs, odometry_node)]
    print(json.dumps({"files": files, "used": odometry_node.TFMessage is TFMessage}))
"""


@pytest.mark.slow
@pytest.mark.ros
@pytest.mark.skipif(shutil.which("colcon") is None, reason="colcon is not installed")
def test_the_workspace_leaves_the_full_messages_of_an_underlay_alone_and_uses_them(
    underlay: Path, tmp_path: Path
) -> None:
    from ament_index_python.packages import get_package_prefix

    environment = build_environment()
    prefixes = [str(underlay / name) for name in VENDORED]
    environment["AMENT_PREFIX_PATH"] = ":".join([*prefixes, environment["AMENT_PREFIX_PATH"]])
    listed = subprocess.run(
        ["colcon", "list", "--names-only", "--base-paths", "ros2_ws/src"],
        cwd=REPOSITORY, env=environment, capture_output=True, text=True, check=True,
    ).stdout.split()  # fmt: skip
    assert set(listed) == {path.parent.name for path in (REPOSITORY / "src").glob("subiaco*/package.xml")}
    # What uses these messages is built over them; compiling our own takes minutes, and needs none of them.
    options = ("--symlink-install", "--packages-skip", "subiaco_msgs", "--packages-up-to", "subiaco_mapping")
    built = colcon("ros2_ws/src", tmp_path, environment, *options)
    assert built == {"subiaco_geo", "subiaco_ros", "subiaco_mapping"}

    messages = Path(get_package_prefix("subiaco_msgs"))
    scripts = [underlay / "local_setup.bash", messages / "share/subiaco_msgs/package.bash"]
    sourced = " && ".join(f"source {script}" for script in (*scripts, tmp_path / "install/local_setup.bash"))
    run = ["bash", "-c", f'{sourced} && exec "$0" -c "$1"', sys.executable, textwrap.dedent(USED)]
    result = subprocess.run(run, env=environment, capture_output=True, text=True, timeout=120, check=False)
    assert result.returncode == 0, result.stderr[-2000:]
    said = json.loads(result.stdout.splitlines()[-1])
    *theirs, own = map(Path, said["files"])
    assert all(file.is_relative_to(underlay) for file in theirs)
    assert own.resolve().is_relative_to(REPOSITORY / "src")
    assert said["used"] is True


@pytest.mark.slow
@pytest.mark.ros
@pytest.mark.parametrize("name", VENDORED)
def test_vendored_messages_have_the_type_hashes_of_the_full_ones(underlay: Path, name: str) -> None:
    from ament_index_python.packages import get_package_prefix

    full = type_hashes(underlay / name / "share" / name, name)
    here = type_hashes(Path(get_package_prefix(name)) / "share" / name, name)  # the vendored copy, or apt's
    assert len(full) == 2
    assert here
    assert here.items() <= full.items()
