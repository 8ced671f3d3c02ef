"""A short survey of each family, as fused maps with truth (seed 104, 60 m, 3 s, 512 columns)."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
import yaml

from subiaco_geo.codes import Change
from subiaco_sim.config import SimulationConfig
from subiaco_sim.families.config import Family
from subiaco_sim.scene import BUILDING, GROUND, VEGETATION
from subiaco_sim.sensors import SENSORS, SensorName
from subiaco_sim.survey import simulate


@pytest.fixture(scope="module", params=["suburb", "dense_hard"])
def survey(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a short survey of a family."""
    folder = tmp_path_factory.mktemp("family") / "survey"
    asked = {"preset": request.param, "seed": 104, "duration": 3.0, "mode": "512x10", "maps_only": True}
    config = SimulationConfig.model_validate(
        asked | {"ground_cell": 0.6, "map_every": 2, "street": {"length": 60.0}}
    )
    simulate(folder, config)
    return folder


def test_the_truth_names_family_and_sensors(survey: Path) -> None:
    scene = yaml.safe_load((survey / "truth" / "scene.yaml").read_text())
    assert scene["family"] in [str(family) for family in Family]
    for epoch in ("before", "after"):
        sensor = SENSORS[SensorName(scene["config"][f"sensor_{epoch}"])]
        assert scene["epochs"][epoch]["lidar"] == sensor.line


def test_the_object_table_marks_changes_near_a_gate(survey: Path) -> None:
    rows = list(csv.DictReader((survey / "truth" / "objects.csv").open()))
    assert len(rows) > 40
    assert {row["near_gate"] for row in rows} <= {"0", "1"}
    for row in rows:
        if row["label"] in ("Added", "Removed"):
            assert row["near_gate"] == "0"


def test_points_of_ground_buildings_and_plants_have_truth(survey: Path) -> None:
    for epoch in ("before", "after"):
        with np.load(survey / epoch / "truth" / "points.npz") as data:
            classes, change = data["class"], data["change"]
        assert {GROUND, BUILDING, VEGETATION} <= set(np.unique(classes).tolist())
        assert set(np.unique(change).tolist()) <= {int(code) for code in Change}
        assert np.mean(change == int(Change.UNCHANGED)) > 0.3
        assert (survey / epoch / "map.ply").stat().st_size > 100_000
