"""One request through the command, the Python API and the action gives one table."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import subiaco
from subiaco_bringup.cli.main import run
from subiaco_change.config import ChangeConfig
from subiaco_change.request import ChangeRequest
from subiaco_geo.cloud_io import write_cloud
from subiaco_geo.clouds import from_world
from subiaco_geo.frames import Floats
from subiaco_report.pages import write_pages

pytestmark = pytest.mark.ros

CORNER = np.array([391_200.0, 6_464_300.0, 12.0])  # east, north, height in EPSG:7850
SETTINGS = {"leaf": 0.4, "decisions": {"min_observed": 0.2}}


def house(rng: np.random.Generator, corner: tuple[float, float], height: float) -> Floats:
    """Roof and walls (N, 3) of a house of 8 by 6 m."""
    u, v = rng.uniform(0, 1, (2, 4_000))
    roof = np.column_stack([8 * u[:2_000], 6 * v[:2_000], np.full(2_000, height)])
    side = rng.integers(0, 4, 2_000)
    along, up = u[2_000:], height * v[2_000:]
    x = np.select([side == 0, side == 1], [np.zeros(2_000), np.full(2_000, 8.0)], 8 * along)
    y = np.select([side == 2, side == 3], [np.zeros(2_000), np.full(2_000, 6.0)], 6 * along)
    return np.concatenate([roof, np.column_stack([x, y, up])]) + np.array([*corner, 0.0])


@pytest.fixture(scope="module")
def clouds(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two registered clouds of one street (seed 4): of three houses, one is removed."""
    rng = np.random.default_rng(4)
    folder = tmp_path_factory.mktemp("street")
    for name, corners in {"before": [2.0, 16.0, 30.0], "after": [2.0, 30.0]}.items():
        ground = np.column_stack([rng.uniform(0, 42, 20_000), rng.uniform(0, 20, 20_000), np.zeros(20_000)])
        parts = [ground, *(house(rng, (x, 7.0), 4.0) for x in corners)]
        write_cloud(folder / f"{name}.ply", from_world(np.concatenate(parts) + CORNER, crs="EPSG:7850"))
    return folder / "before.ply", folder / "after.ply"


def table_hash(directory: Path) -> str:
    return str(json.loads((directory / "run.json").read_text())["table_hash"])


def by_command(request: ChangeRequest) -> None:
    words = ["change", request.before, request.after, "-o", request.output, "--registration", "identity"]
    options = ["--workers", "1", "--set", "leaf=0.4", "--set", "decisions.min_observed=0.2", "-q"]
    assert run([*map(str, words), *options]) == 0


def by_api(request: ChangeRequest) -> None:
    subiaco.compare(
        request.before, request.after, request.output, transform=np.eye(4),
        settings={"leaf": 0.4, "decisions.min_observed": 0.2},
    )  # fmt: skip


def by_action(ros: Any) -> Callable[[ChangeRequest], None]:
    from rclpy.action import ActionClient

    from subiaco_change.nodes.change_node import ChangeApp, ChangeParameters, make_detect
    from subiaco_msgs.action import DetectChanges
    from subiaco_ros.parameters import read_models

    node = ros.node("change")
    own, config = read_models(node, ChangeParameters, ChangeConfig)
    ros.apps.append(ChangeApp(node, own, config, make_detect(write_pages, 5_000)))
    client = ActionClient(ros.node("user"), DetectChanges, "change/detect")
    ros.until(client.server_is_ready)

    def send(request: ChangeRequest) -> None:
        goal = DetectChanges.Goal(request_json=request.to_json())
        sent = client.send_goal_async(goal)
        ros.until(sent.done)
        answer = sent.result().get_result_async()
        ros.until(answer.done, 120.0)
        assert answer.result().result.success, answer.result().result.message
        assert len(answer.result().result.table.records) > 0

    return send


def test_command_api_and_action_give_the_same_table(
    ros: Any, clouds: tuple[Path, Path], tmp_path: Path
) -> None:
    doors = {"command": by_command, "api": by_api, "action": by_action(ros)}
    before, after = clouds
    for name, door in doors.items():
        output = tmp_path / name
        door(
            ChangeRequest.of(before=before, after=after, output=output, transform="identity", config=SETTINGS)
        )
    hashes = {name: table_hash(tmp_path / name) for name in doors}
    assert len(set(hashes.values())) == 1, hashes
    configs = {(tmp_path / name / "config.yaml").read_text() for name in doors}
    assert len(configs) == 1
    labels = set(subiaco.open_changes(tmp_path / "action").table["label"])
    assert "Removed" in labels
