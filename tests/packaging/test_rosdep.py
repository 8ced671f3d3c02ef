"""An apt installation: every import has a rosdep key or a line in requirements-ros.txt.

``tests/data/rosdep_jazzy_noble.json`` is an extract of github.com/ros/rosdistro: keys and the Ubuntu packages
that they stand for, with commit and day.
"""

from __future__ import annotations

import ast
import json
import re
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
SOURCES = REPOSITORY / "src"
PACKAGES = sorted(path.parent for path in SOURCES.glob("subiaco*/setup.py"))
MANIFESTS = sorted(SOURCES.glob("subiaco*/package.xml"))
KEYS = json.loads((REPOSITORY / "tests/data/rosdep_jazzy_noble.json").read_text())["keys"]
OWN_NAMES = {"PIL": "python3-pil", "yaml": "python3-yaml"}
#: Distributions of imports without a rosdep key for Ubuntu 24.04.
NO_KEY = {
    "annotated_types": "annotated-types", "backports": "backports-zstd", "contourpy": "contourpy",
    "gtsam": "gtsam", "kiss_icp": "kiss-icp", "laspy": "laspy", "lazrs": "lazrs", "lz4": "lz4",
    "mcap": "mcap",
    "open3d": "open3d", "ouster": "ouster-sdk", "pgeof": "pgeof", "pyogrio": "pyogrio", "rosbags": "rosbags",
    "small_gicp": "small-gicp", "pydantic": "pydantic", "threadpoolctl": "threadpoolctl",
}  # fmt: skip
#: Imported where the user asks for it: a cluster, object storage, learned methods, a live viewer.
OPTIONAL = {"dask", "distributed", "torch", "foxglove", "fsspec"}


def imports(package: Path) -> set[str]:
    found = set()
    for path in package.rglob("*.py"):
        if path.name == "setup.py":
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                found |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                found.add(node.module.split(".")[0])
    return found - set(sys.stdlib_module_names) - {package.name, "__future__"} - OPTIONAL


def declared(manifest: Path) -> set[str]:
    tags = {"depend", "exec_depend", "build_depend", "buildtool_depend", "test_depend"}
    return {node.text or "" for node in ET.parse(manifest).getroot() if node.tag in tags}


def requirements() -> dict[str, str]:
    lines = (REPOSITORY / "requirements-ros.txt").read_text().splitlines()
    pinned = [re.match(r"([\w.-]+)==([^;\s]+)", line) for line in lines if line and line[0] != "#"]
    return {match[1]: match[2] for match in pinned if match}


@pytest.mark.parametrize("manifest", MANIFESTS, ids=lambda path: path.parent.name)
def test_every_key_of_a_manifest_is_known_to_rosdep(manifest: Path) -> None:
    ours = {path.parent.name for path in MANIFESTS}
    assert declared(manifest) - ours <= {key for key, package in KEYS.items() if package}


@pytest.mark.parametrize("package", PACKAGES, ids=lambda path: path.name)
def test_every_import_has_a_key_in_the_manifest_or_a_line_in_the_requirements(package: Path) -> None:
    known, listed = declared(package / "package.xml"), requirements()
    for name in sorted(imports(package)):
        keys = {name, OWN_NAMES.get(name, f"python3-{name}")}
        if name not in NO_KEY:
            assert keys & known, f"{package.name} imports {name}: add a rosdep key to its package.xml"
        else:
            assert NO_KEY[name] in listed, f"{package.name} imports {name}: add it to requirements-ros.txt"


def test_the_requirements_are_those_of_the_lock() -> None:
    text = (REPOSITORY / "requirements.lock").read_text()
    locked = set(re.findall(r"^([\w.-]+)==([^;\s]+)", text, re.MULTILINE))
    listed = (REPOSITORY / "requirements-ros.txt").read_text()
    assert set(re.findall(r"^([\w.-]+)==([^;\s]+)", listed, re.MULTILINE)) <= locked
    page = (REPOSITORY / "docs/how-to/apt-ros.md").read_text()
    assert "pip install --no-deps -r requirements-ros.txt" in listed
    assert "pip install --no-deps -r requirements-ros.txt" in page


def test_a_plain_build_does_not_see_the_messages_of_others() -> None:
    linked = {path.name for path in (REPOSITORY / "ros2_ws/src").iterdir()}
    assert linked == {path.parent.name for path in MANIFESTS}
    assert (SOURCES / "vendor_msgs/COLCON_IGNORE").is_file()
    assert '"$ROOT"/src/vendor_msgs/*/' in (REPOSITORY / "scripts/setup.sh").read_text()


def test_vendored_messages_have_the_type_hashes_of_upstream() -> None:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    upstream = get_typestore(Stores.ROS2_JAZZY)
    ours = get_typestore(Stores.ROS2_JAZZY)
    for package, message in (("tf2_msgs", "TFMessage"), ("ouster_sensor_msgs", "PacketMsg")):
        name = f"{package}/msg/{message}"
        text = (SOURCES / f"vendor_msgs/{package}/msg/{message}.msg").read_text()
        ours.fielddefs.pop(name, None)
        ours.register(get_types_from_msg(text, name))
        if name in upstream.fielddefs:
            assert ours.hash_rihs01(name) == upstream.hash_rihs01(name)
        else:  # uint8[] buf, as ouster-ros has it; computed once from its definition
            assert ours.fielddefs[name] == (
                [],
                [("buf", ours.fielddefs["std_msgs/msg/UInt8MultiArray"][1][1][1])],
            )
