"""The workspace beside the wheels: what is built for Python without CMake, against what the wheels hold."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
import sysconfig
import textwrap
from importlib.metadata import distributions
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
WHEELS = not Path(os.environ.get("SUBIACO_APT_ROS", "/opt/ros/jazzy"), "setup.bash").is_file()
MESSAGES = {
    "subiaco_msgs": REPOSITORY / "src/subiaco_msgs",
    "tf2_msgs": REPOSITORY / "src/vendor_msgs/tf2_msgs",
    "ouster_sensor_msgs": REPOSITORY / "src/vendor_msgs/ouster_sensor_msgs",
}


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, REPOSITORY / f"scripts/{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def builder() -> ModuleType:
    return load("build_workspace")


def test_the_definitions_that_are_built_are_those_that_cmake_lists(builder: ModuleType) -> None:
    for name, source in MESSAGES.items():
        text = (source / "CMakeLists.txt").read_text(encoding="utf-8")
        found = [str(file) for file in builder.Interfaces(source, source, source).files]
        assert found, name
        assert (
            sorted(line.strip().strip('"') for line in text.splitlines() if line.startswith('  "')) == found
        )


def test_a_script_to_source_puts_its_paths_in_front_once(builder: ModuleType, tmp_path: Path) -> None:
    builder.write_scripts(
        tmp_path, "local_setup", {"PYTHONPATH": [Path("/a b"), Path("/c")], "LD_LIBRARY_PATH": []}
    )
    for shell in ("bash", "sh"):
        source = f'. "{tmp_path}/local_setup.{shell}"'
        command = f'set -u; {source}; {source}; printf %s "$PYTHONPATH"'
        for before, after in (("/d", "/a b:/c:/d"), (None, "/a b:/c")):
            environment = {"PATH": "/usr/bin:/bin"} | ({"PYTHONPATH": before} if before else {})
            said = subprocess.run(
                [shell, "-c", command], env=environment, capture_output=True, text=True, check=True
            )
            assert said.stdout == after


def test_a_python_package_is_linked_and_its_nodes_written(
    builder: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = tmp_path / "src/some_nodes"
    (source / "resource").mkdir(parents=True)
    (source / "resource/some_nodes").touch()
    (source / "package.xml").write_text("<package/>", encoding="utf-8")
    (source / "setup.py").write_text(
        "from setuptools import setup\n"
        "setup(name='some_nodes', version='1.2', data_files=[('share/some_nodes', ['package.xml']),"
        " ('share/ament_index/resource_index/packages', ['resource/some_nodes'])],"
        " entry_points={'console_scripts': ['a_node = some_nodes.nodes:main']})\n",
        encoding="utf-8",
    )
    site = tmp_path / "site"
    site.mkdir()
    (site / "__editable__.some_nodes-1.1.pth").touch()
    (site / "__editable__.some_nodes_more-1.1.pth").touch()
    monkeypatch.setattr(builder.sysconfig, "get_paths", lambda: {"purelib": str(site)})
    builder.link_python_package(source, tmp_path / "install")
    prefix = tmp_path / "install/some_nodes"
    assert (prefix / "share/some_nodes/package.xml").resolve() == source / "package.xml"
    assert (prefix / "share/ament_index/resource_index/packages/some_nodes").is_file()
    node = (prefix / "lib/some_nodes/a_node").read_text(encoding="utf-8").splitlines()
    assert node[0] == f"#!{sys.prefix}/bin/python"
    assert "from some_nodes.nodes import main" in node
    assert {path.name for path in site.iterdir()} == {
        "__editable__.some_nodes-1.2.pth", "__editable__.some_nodes_more-1.1.pth", "some_nodes-1.2.dist-info",
    }  # fmt: skip
    record = (site / "some_nodes-1.2.dist-info/RECORD").read_text().splitlines()
    assert all((site / line.split(",")[0]).is_file() for line in record)


@pytest.mark.ros
@pytest.mark.skipif(not WHEELS, reason="colcon builds the workspace here")
def test_our_packages_are_installed_where_they_are() -> None:
    (said,) = distributions(name="subiaco-bringup", path=[sysconfig.get_paths()["purelib"]])
    url = json.loads(said.read_text("direct_url.json") or "")
    assert url["dir_info"] == {"editable": True}
    assert url["url"].endswith("/src/subiaco_bringup")
    assert {entry.name for entry in said.entry_points} >= {"subiaco", "change_node"}


@pytest.mark.ros
@pytest.mark.skipif(not WHEELS, reason="colcon builds the workspace here")
def test_messages_are_described_as_tools_expect_them() -> None:
    from ament_index_python.packages import get_package_share_directory
    from ament_index_python.resources import get_resource

    for name, source in MESSAGES.items():
        share = Path(get_package_share_directory(name))
        listed, _ = get_resource("rosidl_interfaces", name)
        for path in [path for path in source.glob("*/*") if path.suffix in (".msg", ".srv", ".action")]:
            relative = path.relative_to(source)
            assert (share / relative).read_bytes() == path.read_bytes()
            assert {str(relative), str(relative.with_suffix(".idl"))} <= set(listed.split())
            assert (share / relative.with_suffix(".json")).is_file()
        known = share.parents[1] / "share/colcon-core/packages" / name  # colcon builds over this workspace
        assert "rosidl_default_runtime" in known.read_text().split(":")
        assert (share.parents[2] / ".colcon_install_layout").read_text().strip() == "isolated"


#: Says which hash each message has in its description and in what a publisher announces.
ANNOUNCED = """
    import json, rclpy
    from subiaco_msgs.msg import ChangeRecord, ChangeTable, ReplayCounts, ScanQuality
    from tf2_msgs.msg import TFMessage
    from ouster_sensor_msgs.msg import PacketMsg
    rclpy.init()
    node = rclpy.create_node("announcer")
    said, kept = {}, []
    for kind in (ChangeRecord, ChangeTable, ReplayCounts, ScanQuality, TFMessage, PacketMsg):
        kept.append(node.create_publisher(kind, kind.__name__, 1))
        (end,) = node.get_publishers_info_by_topic(kind.__name__)
        said[end.topic_type] = str(end.topic_type_hash)
    print(json.dumps(said))
"""


@pytest.mark.ros
@pytest.mark.skipif(not WHEELS, reason="colcon builds the workspace here")
def test_a_publisher_announces_the_hash_of_the_definition() -> None:
    from ament_index_python.packages import get_package_share_directory

    environment = {k: v for k, v in os.environ.items() if k != "_ROS_WHEELS_BOOTSTRAP_COMPLETE"}
    command = [sys.executable, "-c", textwrap.dedent(ANNOUNCED)]
    result = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60, check=False)
    assert result.returncode == 0, result.stderr[-2000:]
    said: dict[str, str] = json.loads(result.stdout.splitlines()[-1])
    assert len(said) == 6
    for name, announced in said.items():
        package, kind, stem = name.split("/")
        file = Path(get_package_share_directory(package)) / kind / f"{stem}.json"
        described: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
        assert announced == {e["type_name"]: e["hash_string"] for e in described["type_hashes"]}[name]
