"""Drivers start through their own launch files, with the sensors where the settings place them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

from subiaco_bringup.drivers import LaunchedFile, LaunchedNode, gnss_driver, lidar_driver, sensor_places
from subiaco_geo.config import validate
from subiaco_geo.errors import InputError
from subiaco_mapping.config import SensorsConfig

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


def test_the_aggregator_knows_every_status_of_our_nodes() -> None:
    from subiaco_mapping.health_monitor.snapshot import _LINES

    parameters = yaml.safe_load((CONFIG / "diagnostics.yaml").read_text())["/**"]["ros__parameters"]
    groups = [value for value in parameters.values() if isinstance(value, dict)]
    assert {group["type"] for group in groups} == {"diagnostic_aggregator/GenericAnalyzer"}
    listed = [name for group in groups for name in group["contains"]]
    tasks = {"odometry: registration", "pose_graph: solution", "recorder: recording", "change: comparison"}
    assert sorted(listed) == sorted(tasks | {f"monitor: {line}" for line in (*_LINES, "street")})
