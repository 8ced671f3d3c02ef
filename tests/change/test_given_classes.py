"""Classes that others gave: ASPRS codes replace the segmentation where there are any, and the run says so."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scenes import Scene

from subiaco_change.config import ChangeConfig
from subiaco_change.given_classes import (
    UNGIVEN,
    GivenClassesConfig,
    classified,
    given_class_findings,
)
from subiaco_change.job import run_change
from subiaco_change.request import ChangeRequest
from subiaco_geo.cloud_io import write_cloud
from subiaco_geo.clouds import PointCloud
from subiaco_geo.errors import InputError
from subiaco_geo.sources import open_epoch

TREE = np.array([-5.0, -12.0])


def written(path: Path, scene: Scene, seed: int, codes: bool = True) -> Path:
    """A LAZ of a scene: one tree is called a building, 30 points are noise, all else is unclassified."""
    cloud = scene.cloud(seed)
    if codes:
        given = np.ones(len(cloud), dtype=np.uint8)
        given[np.linalg.norm(cloud.xyz[:, :2] - TREE, axis=1) < 3.0] = 6
        noise = np.random.default_rng(seed).uniform([-25, -15, 12], [25, 15, 20], (30, 3))
        xyz = np.concatenate([cloud.xyz, noise])
        cloud = PointCloud(xyz, cloud.origin, cloud.crs, {"classification": np.append(given, [7] * 30)})
    write_cloud(path, cloud)
    return path


def test_points_classified_by_others_keep_their_class_and_the_rest_gets_ours(tmp_path: Path) -> None:
    before = written(tmp_path / "before.laz", Scene(), 1)
    after = written(tmp_path / "after.laz", Scene(trees=[(-20, -8), (-5, -12)]), 2)
    request = ChangeRequest.of(
        before=before, after=after, output=tmp_path / "out", transform="identity", given=("classification",)
    )
    rows = run_change(request)
    near = [row for row in rows if np.linalg.norm(np.array([row.x, row.y]) - TREE) < 3.0]
    assert {row.semantic.label for row in near if row.semantic.label != "ground"} == {"building"}
    other = [row for row in rows if np.linalg.norm(np.array([row.x, row.y]) - [-20, -8]) < 3.0]
    assert "vegetation" in {row.semantic.label for row in other}
    findings = {
        entry["code"]: entry for entry in json.loads((tmp_path / "out/run.json").read_text())["findings"]
    }
    assert "of the points of BEFORE" in findings["classes_given"]["sentence"]
    assert findings["classes_left_out"]["sentence"].startswith("60 points")
    assert "classes_one_epoch" not in findings


def test_every_code_of_the_table_becomes_the_class_it_names(tmp_path: Path) -> None:
    codes = np.array([0, 1, 2, 3, 4, 5, 6, 8, 10, 11, 14, 17, 64, 9, 18], dtype=np.uint8)
    xyz = np.column_stack([np.arange(len(codes)), np.zeros(len(codes)), np.zeros(len(codes))])
    write_cloud(tmp_path / "a.las", PointCloud(xyz, fields={"classification": codes}))
    epochs = open_epoch(tmp_path / "a.las"), open_epoch(tmp_path / "a.las")
    (part,) = classified(epochs, GivenClassesConfig())[0].clouds(("semantic", "intensity"))
    expected = [UNGIVEN, UNGIVEN, 0, 2, 2, 2, 1, 0, 4, 0, 4, 1, 3]
    assert part.fields["semantic"].tolist() == expected  # water and noise are gone


def test_one_epoch_without_classes_is_warned_of_and_two_are_refused(tmp_path: Path) -> None:
    codes = written(tmp_path / "codes.laz", Scene(), 1)
    bare = written(tmp_path / "bare.laz", Scene(), 2, codes=False)
    paths = codes, bare
    labelled = classified((open_epoch(codes), open_epoch(bare)), GivenClassesConfig())
    for epoch in labelled:
        assert sum(len(part) for part in epoch.clouds(("semantic",))) > 1000
    assert [finding.code for finding in given_class_findings(labelled, paths)] == [
        "classes_given",
        "classes_left_out",
        "classes_one_epoch",
    ]
    none = classified((open_epoch(bare), open_epoch(bare)), GivenClassesConfig())
    with pytest.raises(InputError, match="no point has a class in its field 'classification'"):
        given_class_findings(none, paths)


def test_a_code_in_two_lists_is_refused() -> None:
    config = ChangeConfig.model_validate({"classes": {"building": [6, 17, 2]}})
    with pytest.raises(InputError, match=r"classes.building: 2 is in two lists"):
        config.classes.table()
    with pytest.raises(InputError, match="300 is no ASPRS class"):
        GivenClassesConfig(other=(300,)).table()
