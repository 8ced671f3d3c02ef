"""A result made from a simulated survey names its simulator, preset and scene; any other names none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

from subiaco_geo.cloud_io import write_cloud
from subiaco_geo.clouds import PointCloud
from subiaco_geo.errors import InputError
from subiaco_geo.maps import load_epoch, read_map, write_map
from subiaco_geo.simulated import distinct, mark_simulated, simulation_of

NAMED = {
    "preset": "easy",
    "seed": 7,
    "simulator_hash": "ab12",
    "preset_hash": "cd34",
    "scene_hash": "ef56",
}


@pytest.fixture
def survey(tmp_path: Path) -> Path:
    """Return a simulated survey with one fused map and the folder of a bag."""
    folder = tmp_path / "survey"
    for name in ("truth", "before/bag", "after"):
        (folder / name).mkdir(parents=True)
    (folder / "truth" / "scene.yaml").write_text(yaml.safe_dump({**NAMED, "crs": "EPSG:7850"}))
    xyz = np.random.default_rng(1).uniform(0, 9, (50, 3)).astype(np.float32)
    write_cloud(folder / "after" / "map.ply", PointCloud(xyz, np.zeros(3), "EPSG:7850", {}))
    return folder


@pytest.mark.parametrize("inside", ["before", "before/bag", "before/bag/drive.mcap", "after/map.ply"])
def test_every_part_of_a_survey_is_known_as_its_own(survey: Path, inside: str) -> None:
    assert simulation_of(survey / inside) == NAMED


def test_what_lies_in_no_survey_has_no_name(tmp_path: Path, survey: Path) -> None:
    assert simulation_of(tmp_path / "elsewhere.mcap") is None
    assert simulation_of(survey.parent) is None
    assert distinct([None, None]) == {}


def test_a_fused_map_carries_the_name_and_a_map_made_from_it_keeps_it(survey: Path, tmp_path: Path) -> None:
    fused = load_epoch(survey / "after")
    assert fused.info["simulations"] == [NAMED]
    assert load_epoch(survey / "after" / "map.ply").info["simulations"] == [NAMED]
    made = mark_simulated(fused, [survey / "before" / "bag", survey / "before"])
    write_map(tmp_path / "map", made)
    assert read_map(tmp_path / "map").info["simulations"] == [NAMED]
    assert load_epoch(tmp_path / "map").info["simulations"] == [NAMED]


def test_several_surveys_are_all_named_once_in_order() -> None:
    other = {**NAMED, "seed": 8}
    assert distinct([NAMED, other, None, NAMED]) == {"simulations": [NAMED, other]}


def test_a_scene_that_cannot_be_read_is_named(survey: Path) -> None:
    (survey / "truth" / "scene.yaml").write_text("[1, 2")
    with pytest.raises(InputError, match=r"truth/scene\.yaml: cannot be read"):
        simulation_of(survey / "before")
