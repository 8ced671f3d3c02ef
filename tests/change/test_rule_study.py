"""Ablation of rules: gains in pairs of runs, what is not run, and studies that go on."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest

from subiaco_change.config import ChangeConfig
from subiaco_evaluation import rule_study
from subiaco_evaluation.paired import block_differences
from subiaco_evaluation.rule_study import BASELINE, RuleRun, StudyTables, run_rule_study, study_markdown
from subiaco_evaluation.scoring import EvaluationConfig
from subiaco_geo.errors import InputError


def blocks(right, wrong, count=12):
    """Blocks in which so many unchanged cells are right, and so many added cells called unchanged."""
    matrix = np.zeros((5, 6), dtype=np.int64)
    matrix[4, 4], matrix[0, 4], matrix[0, 0] = right, wrong, 20 - wrong
    return np.stack([matrix] * count)


def objects(net, count=12):
    return np.array([(k, 0, net) for k in range(count)], dtype=np.int64)


def test_a_method_compared_with_itself_gains_nothing():
    found = block_differences(
        [(blocks(50, 5), blocks(50, 5))] * 2, [np.zeros(12, dtype=np.int64)] * 2, 200, 0
    )
    assert found["miou"] == (0.0, 0.0, 0.0)
    assert found["objects"] == (0.0, 0.0, 0.0)


def test_a_gain_in_every_block_has_an_interval_above_zero_and_its_opposite_one_below():
    better, worse = blocks(50, 2), blocks(50, 9)
    step = np.full(12, 1)
    gain = block_differences([(better, worse)], [step], 500, 0)
    loss = block_differences([(worse, better)], [-step], 500, 0)
    assert gain["miou"][1] > 0
    assert gain["objects"] == (12.0, 12.0, 12.0)
    assert loss["miou"][0] == pytest.approx(-gain["miou"][0])
    assert loss["miou"][2] < 0


def test_a_gain_in_one_block_of_many_does_not_exclude_zero():
    step = np.zeros(12, dtype=np.int64)
    step[3] = 1
    found = block_differences([(blocks(50, 5), blocks(50, 5))], [step], 500, 0)
    assert found["objects"][0] == 1.0
    assert found["objects"][1] == 0.0


@pytest.fixture
def study(tmp_path, monkeypatch):
    """A study whose runs are made up: by scene and rule the wrong cells and the net count of objects."""
    made = []
    scores = {
        ("first", BASELINE): (2, 1), ("second", BASELINE): (2, 1),
        ("first", "thin_volumes"): (9, 0), ("second", "thin_volumes"): (9, 0),
        ("first", "closed_gaps"): (1, 2), ("second", "closed_gaps"): (1, 2),
    }  # fmt: skip
    used = {"first": ("thin_volumes", "closed_gaps"), "second": ("thin_volumes", "closed_gaps")}

    def run(job):
        made.append((job.survey.name, job.rule))
        wrong, net = scores[job.survey.name, job.rule]
        job.folder.mkdir(parents=True, exist_ok=True)
        names = used[job.survey.name] if job.rule == BASELINE else ()
        stored = RuleRun(blocks(50, wrong), objects(net))
        np.savez(
            job.folder / f"{job.rule}.npz",
            cells=stored.cells,
            objects=stored.objects,
            used=np.array(names, dtype="U64"),
        )

    monkeypatch.setattr(rule_study, "_run", run)
    surveys = [tmp_path / "first", tmp_path / "second"]
    for survey in surveys:
        (survey / "truth").mkdir(parents=True)
        (survey / "truth" / "scene.yaml").touch()

    def start(only=("thin_volumes", "closed_gaps", "roof_gap"), config=None):
        made.clear()
        table = run_rule_study(surveys, tmp_path / "out", config or ChangeConfig(), only=only)
        return table.set_index("rule"), list(made)

    start.folder = tmp_path / "out"
    return start


def test_the_table_says_which_rule_pays_which_costs_and_which_never_differed(study):
    table, made = study()
    assert table.loc["thin_volumes", "verdict"] == "pays"
    assert table.loc["closed_gaps", "verdict"] == "costs"
    assert table.loc["roof_gap", "verdict"] == "never differed"
    assert table.loc["roof_gap", "miou"] == 0.0
    assert ("first", "roof_gap") not in made
    assert len(made) == 6
    stored = pd.read_csv(study.folder / "rules.csv").set_index("rule")
    assert stored["verdict"].to_dict() == table["verdict"].to_dict()
    assert "| thin_volumes | 2 of 2 |" in (study.folder / "rules.md").read_text(encoding="utf-8")


def test_a_study_that_was_stopped_goes_on_with_what_is_missing(study):
    study()
    (study.folder / "runs" / "second" / "closed_gaps.npz").unlink()
    table, made = study()
    assert made == [("second", "closed_gaps")]
    assert table.loc["closed_gaps", "verdict"] == "costs"


def test_a_folder_of_other_settings_or_of_something_else_is_refused(study, tmp_path):
    study()
    with pytest.raises(InputError, match="other code or settings"):
        study(config=ChangeConfig(leaf=0.3))
    with pytest.raises(InputError, match="output of 'subiaco simulate'"):
        run_rule_study([tmp_path], tmp_path / "other", ChangeConfig())
    assert not (tmp_path / "other").exists()
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "one.txt").write_text("x", encoding="utf-8")
    with pytest.raises(InputError, match="no folder of a study"):
        run_rule_study([tmp_path / "first"], tmp_path / "photos", ChangeConfig())
    with pytest.raises(InputError, match="did you mean thin_volumes"):
        study(only=("thin_volume",))


def test_a_rule_that_is_not_finished_everywhere_has_no_verdict_and_no_figures(study):
    study()
    (study.folder / "runs" / "second" / "closed_gaps.npz").unlink()
    tables = StudyTables(study.folder, ("first", "second"), ("closed_gaps",), EvaluationConfig())
    table = tables.write()
    assert table["verdict"].tolist() == ["not finished"]
    assert "–" in study_markdown(table)
    assert json.loads((study.folder / "study.json").read_text(encoding="utf-8"))["key"]


def test_clouds_in_the_folder_of_a_survey_take_the_place_of_its_maps(tmp_path):
    def files(epoch):
        return rule_study.epoch_files(tmp_path, epoch)

    assert files("before") == (tmp_path / "before", None)
    for name in ("before.ply", "after.laz", "after.tum"):
        (tmp_path / name).touch()
    assert files("before") == (tmp_path / "before.ply", None)
    assert files("after") == (tmp_path / "after.laz", tmp_path / "after.tum")
