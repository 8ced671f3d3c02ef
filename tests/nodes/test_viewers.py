"""Viewer layouts show topics that our nodes publish, with the durability that they offer."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
import yaml

BRINGUP = Path(__file__).resolve().parents[2] / "src" / "subiaco_bringup"
LATCHED = {
    "/map/points",
    "/path",
    "/quality/markers",
    "/change/before",
    "/change/after",
    "/change/markers",
    "/change/table",
}
VOLATILE = {"/points_deskewed", "/odometry", "/gnss/fix", "/imu/data", "/diagnostics"}


def displays(file: Path) -> list[dict[str, Any]]:
    manager = yaml.safe_load(file.read_text())["Visualization Manager"]
    assert manager["Global Options"]["Fixed Frame"] == "map"
    return [display for display in manager["Displays"] if "Topic" in display]


@pytest.mark.parametrize("name", ["mapping", "change"])
def test_rviz_displays_ask_for_what_the_nodes_offer(name: str) -> None:
    shown = displays(BRINGUP / "rviz" / f"{name}.rviz")
    assert len(shown) >= 3
    for display in shown:
        topic = "/" + display["Topic"]["Value"]
        durability = display["Topic"]["Durability Policy"]
        assert durability == ("Transient Local" if topic in LATCHED else "Volatile"), topic
        assert topic in LATCHED | VOLATILE


@pytest.mark.parametrize("name", ["mapping", "change"])
def test_foxglove_layouts_name_known_topics_and_every_panel_is_laid_out(name: str) -> None:
    text = (BRINGUP / "foxglove" / f"{name}.json").read_text()
    layout = json.loads(text)
    topics = set(re.findall(r'"(/[a-z_/]+)', text))
    assert topics
    assert topics <= LATCHED | VOLATILE
    placed = set(re.findall(r'"([A-Za-z0-9]+![a-z]+)"', json.dumps(layout["layout"])))
    assert placed == layout["configById"].keys()
