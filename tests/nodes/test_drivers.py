"""Drivers start through their own launch files, with the sensors where the settings place them."""

from __future__ import annotations

import re
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from subiaco_bringup.drivers import (
    LaunchedFile,
    LaunchedNode,
    driver_actions,
    gnss_driver,
    in_namespace,
    lidar_driver,
    sensor_places,
)
from subiaco_geo.config import validate
from subiaco_geo.errors import InputError
from subiaco_mapping.preprocessing.config import SensorsConfig

#: Between two publications of a status that has not changed [s].
PERIOD = 1.0

CONFIG = Path(__file__).resolve().parents[2] / "config"


def test_each_driver_gets_its_parameter_file(tmp_path: Path) -> None:
    file = tmp_path / "driver.yaml"
    file.write_text("{}")
    (lidar,) = lidar_driver("ouster", str(file))
    assert lidar == LaunchedFile(
        "ouster_ros",
        "launch/driver.launch.py",
        {"params_file": str(file), "ouster_ns": "ouster", "viz": "False"},
    )
    (ublox,) = gnss_driver("ublox", str(file))
    assert ublox == LaunchedNode("ublox_gps", "ublox_gps_node", "ublox_gps_node", (), (str(file),))
    (septentrio,) = gnss_driver("septentrio", str(file))
    name = "septentrio_gnss_driver"
    assert septentrio == LaunchedNode(name, f"{name}_node", name, (), (str(file),))
    assert lidar_driver("none", "") == gnss_driver("none", "") == []


@pytest.mark.parametrize(
    ("name", "path", "words"),
    [
        ("velodyne", "x", "no such driver"),
        ("ouster", "", "give the parameter file"),
        ("ouster", "/nope.yaml", "/nope.yaml: no such file"),
    ],
)
def test_a_driver_that_is_not_known_or_lacks_its_file_is_refused(name: str, path: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        lidar_driver(name, path)


def test_sensors_are_placed_where_the_settings_say() -> None:
    given = {
        "lidar": {"translation": [0.0, 0.5, 1.9], "rotation_deg": [0.0, 0.0, 90.0]},
        "gnss": {"translation": [-0.4, 0.0, 2.1]},
        "gnss_frame": "gps",
    }
    lidar, gnss = sensor_places(validate(SensorsConfig, given, "sensors"))
    assert isinstance(lidar, LaunchedNode)
    assert isinstance(gnss, LaunchedNode)
    words = dict(zip(lidar.arguments[::2], lidar.arguments[1::2], strict=True))
    assert float(words["--yaw"]) == pytest.approx(np.pi / 2)
    assert (float(words["--y"]), float(words["--z"])) == (0.5, 1.9)
    assert (words["--frame-id"], words["--child-frame-id"]) == ("base_link", "lidar_link")
    assert gnss.arguments[-1] == "gps"
    assert sensor_places(SensorsConfig()) == []


class Action:
    """Stands for every class of ``launch``: keeps what it was given."""

    def __init__(self, *given: Any, **named: Any) -> None:
        self.given, self.named = given, named


@pytest.fixture
def launch_stub(monkeypatch: pytest.MonkeyPatch) -> None:
    contents = {
        "launch": (),
        "launch.actions": ("GroupAction", "IncludeLaunchDescription"),
        "launch.launch_description_sources": ("AnyLaunchDescriptionSource",),
        "launch_ros": (),
        "launch_ros.actions": ("Node", "PushRosNamespace", "SetRemap"),
    }
    for name, members in contents.items():
        module = types.ModuleType(name)
        vars(module).update({member: type(member, (Action,), {}) for member in members})
        monkeypatch.setitem(sys.modules, name, module)


@pytest.mark.ros
@pytest.mark.usefixtures("launch_stub")
def test_in_a_namespace_a_driver_has_a_tree_of_frames_of_its_own(tmp_path: Path) -> None:
    file = tmp_path / "driver.yaml"
    file.write_text("{}")
    actions = driver_actions(gnss_driver("septentrio", str(file)))
    assert in_namespace("", actions) == actions
    (group,) = in_namespace("/left/", actions)
    push, *remaps, node = group.given[0]
    assert push.given == ("left",)
    assert [rule.given for rule in remaps] == [("/tf", "/left/tf"), ("/tf_static", "/left/tf_static")]
    assert node is actions[0]
    assert node.named["executable"] == "septentrio_gnss_driver_node"
    assert node.named["parameters"] == [str(file)]


def analyzers() -> dict[str, dict[str, Any]]:
    """Return the groups of the aggregator's parameter file."""
    parameters = yaml.safe_load((CONFIG / "diagnostics.yaml").read_text())["/**"]["ros__parameters"]
    return {name: value for name, value in parameters.items() if isinstance(value, dict)}


def taken_by(status: str) -> list[str]:
    """Return the groups that take a status, by the rules of ``GenericAnalyzer``."""
    found = []
    for group in analyzers().values():
        rules = (
            any(re.fullmatch(pattern, status) for pattern in group.get("regex", ())),
            status in group.get("expected", ()),
            any(status.startswith(text) for text in group.get("startswith", ())),
            any(text in status for text in group.get("contains", ())),
        )
        if any(rules):
            found.append(str(group["path"]))
    return found


def test_the_aggregator_reads_its_parameters_with_the_types_that_it_asks_for() -> None:
    parameters = yaml.safe_load((CONFIG / "diagnostics.yaml").read_text())["/**"]["ros__parameters"]
    assert isinstance(parameters["pub_rate"], float)
    assert isinstance(parameters["path"], str)
    words = {"type", "path", "timeout", "contains", "startswith", "expected", "regex"}
    for group in analyzers().values():
        assert group.keys() <= words  # an unknown word would be passed over in silence
        assert group["type"] == "diagnostic_aggregator/GenericAnalyzer"
        assert isinstance(group["timeout"], float)
        assert group["timeout"] >= 3 * PERIOD  # a node that lives is never stale
        assert all(isinstance(text, str) for text in group["contains"])


def test_every_status_of_our_nodes_is_in_one_group_in_every_namespace() -> None:
    from subiaco_mapping.health_monitor.snapshot import _LINES

    tasks = ["odometry: registration", "pose_graph: solution", "recorder: recording", "change: comparison"]
    names = [*tasks, *(f"monitor: {line}" for line in (*_LINES, "street"))]
    for name in names:
        (group,) = taken_by(name)
        assert taken_by(f"left/{name}") == [group]
    listed = [name for group in analyzers().values() for name in group["contains"]]
    assert sorted(listed) == sorted(names)  # and nothing is listed that no node says
    assert taken_by("ouster: Sync Pulse In") == []


@pytest.mark.ros
def test_nodes_put_on_diagnostics_the_names_that_the_aggregator_takes(ros: Any, tmp_path: Path) -> None:
    """The recorder and the monitor speak by themselves; the others once they have worked."""
    from diagnostic_msgs.msg import DiagnosticArray

    from subiaco_mapping.nodes import monitor_node, odometry_node, recorder_node
    from subiaco_ros.diagnostics import Diagnostics

    said = ros.collect(ros.node("aggregator"), DiagnosticArray, "/diagnostics", latched=False)
    made = {
        "recorder": (recorder_node.build, {"output": str(tmp_path / "drive")}),
        "monitor": (monitor_node.build, {}),
        "odometry": (odometry_node.build, {}),
    }
    nodes = {name: ros.node(name, namespace="left", **given) for name, (_, given) in made.items()}
    apps = {name: make(nodes[name]) for name, (make, _) in made.items()}
    waiting = [value for value in vars(apps["odometry"]).values() if isinstance(value, Diagnostics)]
    assert len(waiting) == 1
    waiting[0].report("odometry", {})

    def names() -> set[str]:
        return {status.name for array in said for status in array.status}

    ros.until(lambda: {name.split(":")[0] for name in names()} >= {f"left/{name}" for name in made})
    for name in names():
        assert len(taken_by(name)) == 1, name
    for app in apps.values():
        if hasattr(app, "close"):
            app.close()
