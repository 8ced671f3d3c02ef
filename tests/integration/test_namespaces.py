"""A live graph in a namespace, as each of several LiDARs has one: it hears its own drivers alone."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from live_run import LiveRun

from subiaco_bringup.environment import node_environment
from subiaco_bringup.graph_inspection import inspect
from subiaco_geo.bags import BagReader
from subiaco_geo.maps import read_map
from subiaco_geo.topics import IMU, LIDAR_PACKETS

pytestmark = [
    pytest.mark.ros, pytest.mark.slow, pytest.mark.realtime, pytest.mark.usefixtures("own_domain")
]  # fmt: skip

CONFIG = Path(__file__).resolve().parents[2] / "config"
#: Topics that all namespaces share.
SHARED = {"/clock", "/diagnostics", "/parameter_events", "/rosout"}
NODES = ["foxglove", "monitor", "odometry", "pose_graph", "recorder"]


def running() -> dict[str, Any]:
    """Return nodes and topics of the domain."""
    with node_environment(shared=True) as environment:
        return inspect(environment, {"what": "graph", "seconds": 0.0})


def groups_of(status: str) -> list[str]:
    """Return the groups of the aggregator that take a status."""
    parameters = yaml.safe_load((CONFIG / "diagnostics.yaml").read_text())["/**"]["ros__parameters"]
    groups = [value for value in parameters.values() if isinstance(value, dict)]
    return [group["path"] for group in groups if any(text in status for text in group["contains"])]


def test_a_graph_in_a_namespace_maps_its_own_drivers_alone(survey: Path, tmp_path: Path) -> None:
    """The IMU comes where a driver of that namespace publishes it, by the profile of the driver."""
    drive, folder = survey / "before" / "bag", tmp_path / "drive"
    profile = tmp_path / "driver.yaml"
    profile.write_text(yaml.safe_dump({"/**": {"ros__parameters": {"topics": {"imu": "ouster/imu"}}}}))
    graph = LiveRun(
        "-o", folder, "--sim-time", "--namespace", "left", "--config", profile, "--foxglove", 0,
        settings=("gnss.min_length=2.0",),
    )  # fmt: skip
    try:
        graph.until(lambda: graph.heard("lidar: none: nothing yet"))
        looks: list[dict[str, Any]] = []  # discovery takes a while on a busy machine

        def complete() -> bool:
            looks.append(running())
            return len(looks[-1]["nodes"]) >= len(NODES)

        graph.until(complete, timeout=120.0)
        command = [sys.executable, str(Path(__file__).with_name("vehicle.py")), str(drive)]
        options = ["--listeners", "3", "--rate", "0.5", "--statuses"]
        names = ["--ros-args", "-r", "__ns:=/left", "-r", "imu/data:=ouster/imu"]
        finished = subprocess.run(
            [*command, *options, *names], capture_output=True, text=True, timeout=280, check=False
        )
        assert finished.returncode == 0, f"{finished.stdout}\n{finished.stderr}\n{graph.text}"
        assert graph.stop() == 0, graph.text
    finally:
        graph.kill()
    found = looks[-1]
    assert sorted(found["nodes"]) == [f"/left/{name}" for name in NODES]
    names_of_topics = {name for name, facts in found["topics"].items() if facts["subscriptions"]}
    assert {name for name in names_of_topics if not name.startswith("/left/")} <= SHARED

    statuses = json.loads(finished.stdout.splitlines()[-1])
    assert {name.split(":")[0] for name in statuses} == {
        f"left/{name}" for name in ("monitor", "odometry", "pose_graph", "recorder")
    }
    assert all(len(groups_of(name)) == 1 for name in statuses)

    with BagReader(drive) as sent, BagReader(folder / "bag") as recorded:
        assert recorded.topics[LIDAR_PACKETS].count == sent.topics[LIDAR_PACKETS].count
        assert recorded.topics[IMU].count > 0  # under our name, wherever the driver published it
    whole = read_map(folder / "map")
    arrivals = whole.manifest["sequences"]["live"]["arrivals_odometry"]
    assert arrivals[IMU]["received"] > 0
    assert whole.trajectory is not None
    assert len(whole.trajectory) > 10
