"""The Python API: maps, comparison, own functions, and the tutorials that show them."""

from __future__ import annotations

import runpy
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import subiaco
from subiaco_geo.cloud_io import write_cloud
from subiaco_geo.clouds import from_world

TUTORIALS = Path(__file__).resolve().parents[2] / "docs" / "tutorials"


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the first tutorial: two clouds and their change directory (seed 1, in the script)."""
    folder = tmp_path_factory.mktemp("tutorial")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["compare_two_clouds.py", str(folder)])
        runpy.run_path(str(TUTORIALS / "compare_two_clouds.py"), run_name="__main__")
    return folder


def run_tutorial(name: str, *arguments: object, capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [name, *map(str, arguments)])
        runpy.run_path(str(TUTORIALS / name), run_name="__main__")
    return capsys.readouterr().out


def test_the_first_tutorial_finds_the_house_that_was_taken_away(compared: Path) -> None:
    table = subiaco.open_changes(compared / "change").table
    assert table.crs == "EPSG:7850"
    buildings = table[table["class"] == "building"].set_index("label")
    assert list(buildings.index).count("Removed") == 1
    assert list(buildings.index).count("Unchanged") == 2
    gone = buildings.loc["Removed"]
    assert gone.geometry.area == pytest.approx(10 * 12, rel=0.2)


def test_points_of_an_object_are_those_of_its_footprint_in_world_coordinates(compared: Path) -> None:
    changes = subiaco.open_changes(compared / "change")
    gone = changes.table[changes.table["label"] == "Removed"].iloc[0]
    points = changes.points(int(gone["object_id"]), "before")
    voxels = np.unique(np.floor(points / 0.25), axis=0)
    assert len(points) >= len(voxels) == pytest.approx(gone["n_before"], rel=0.05)
    west, south, east, north = gone.geometry.bounds
    assert (points[:, :2] >= [west - 1, south - 1]).all()
    assert (points[:, :2] <= [east + 1, north + 1]).all()
    assert len(changes.points(int(gone["object_id"]), "after")) == 0
    with pytest.raises(ValueError, match="'before' or 'after'"):
        changes.cloud("later")


def test_the_tutorial_for_gis_runs_on_a_change_directory(
    compared: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said = run_tutorial("changes_for_gis.py", compared / "change", capsys=capsys)
    assert "compared in EPSG:7850" in said
    assert "places to visit" in said


def test_own_functions_replace_registration_segmentation_and_decision(
    compared: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = (compared / "before.ply", compared / "after.ply", tmp_path / "own")
    said = run_tutorial("own_functions.py", *arguments, capsys=capsys)
    assert "Removed" in said
    changes = subiaco.open_changes(tmp_path / "own")
    assert set(changes.table["class"]) <= {"building", "ground"}
    before, after = (subiaco.open_map(path).cloud.world() for path in arguments[:2])
    expected = after.min(axis=0) - before.min(axis=0)
    np.testing.assert_allclose(changes.T_after_before[:3, 3], expected, atol=1e-6)


def test_a_decision_function_changes_rows_and_the_points_of_their_objects(
    compared: Path, tmp_path: Path
) -> None:
    def nothing_is_removed(row: subiaco.ChangeRecord) -> subiaco.ChangeRecord:
        if row.change is not subiaco.Change.REMOVED:
            return row
        return replace(row, change=subiaco.Change.UNCHANGED, confidence=0.5, reason="by order")

    changes = subiaco.compare(
        compared / "before.ply", compared / "after.ply", tmp_path / "c",
        transform=np.eye(4), decision=nothing_is_removed,
    )  # fmt: skip
    assert "Removed" not in set(changes.table["label"])
    row = changes.table[changes.table["reason"] == "by order"].iloc[0]
    cloud = changes.cloud("before")
    mine = cloud.fields["instance"] == row["object_id"]
    assert mine.any()
    assert not (cloud.fields["change"][mine] == subiaco.Change.REMOVED).any()
    np.testing.assert_allclose(cloud.fields["confidence"][mine], 0.5)


def both(tmp_path: Path) -> tuple[Path, Path]:
    world = np.random.default_rng(2).uniform(0, 20, (500, 3)) + np.array([391_200.0, 6_464_300.0, 12.0])
    for name in ("a.ply", "b.ply"):
        write_cloud(tmp_path / name, from_world(world, crs="EPSG:7850"))
    return tmp_path / "a.ply", tmp_path / "b.ply"


WRONG = {
    "no transform": ({"registration": lambda before, after: np.eye(3)}, "no rigid transform"),
    "scaled": ({"registration": lambda before, after: 2 * np.eye(4)}, "no rigid transform"),
    "too few": ({"segmentation": lambda cloud: (np.zeros(3, int), np.zeros(3, int))}, "all 500 points"),
    "unknown class": (
        {"segmentation": lambda cloud: (np.full(500, 77), np.ones(500, int))},
        r"class codes \[77\]",
    ),
}


@pytest.mark.parametrize("name", list(WRONG))
def test_a_function_that_returns_something_else_is_refused_and_nothing_is_written(
    tmp_path: Path, name: str
) -> None:
    functions, said = WRONG[name]
    before, after = both(tmp_path)
    with pytest.raises(subiaco.InputError, match=said):
        subiaco.compare(before, after, tmp_path / "out", **functions)
    assert not (tmp_path / "out").exists()


def test_a_transform_and_a_registration_function_exclude_each_other(tmp_path: Path) -> None:
    before, after = both(tmp_path)
    with pytest.raises(subiaco.InputError, match="exclude each other"):
        subiaco.compare(
            before, after, tmp_path / "out", transform=np.eye(4), registration=lambda a, b: np.eye(4)
        )


def test_settings_are_checked_by_name(tmp_path: Path) -> None:
    before, after = both(tmp_path)
    with pytest.raises(subiaco.InputError, match="no_such_setting"):
        subiaco.compare(before, after, tmp_path / "out", settings={"no_such_setting": 1})
    with pytest.raises(subiaco.InputError, match="no such map"):
        subiaco.open_map(tmp_path / "none")
