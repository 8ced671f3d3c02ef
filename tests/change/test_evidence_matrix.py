"""The evidence matrix goes on where it was stopped, with rows of the same surveys and source code alone."""

import sys
from pathlib import Path

import numpy as np
import pytest

from subiaco_evaluation.scores import reliability

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import bench_evidence_matrix as matrix

ROW = {"preset": "easy", "sensors": "same sensor", "evidence": "bare cloud alone", "mIoU": 50.0}
EMPTY = {
    "grid": {"miou_percent": 50.0, "iou_percent": {"Added": 1.0}, "abstention_percent": 0.0},
    "objects": None,
    "reliability": None,
}


def test_a_row_is_found_again_by_its_surveys_and_its_source_code_alone(tmp_path):
    kept = matrix.Kept(tmp_path / "work" / "rows.jsonl", "abc")
    assert kept.find(["easy", "map"]) is None
    kept.add(["easy", "map"], ROW)
    assert kept.find(["easy", "map"]) == ROW
    assert kept.find(["easy", "bare"]) is None
    assert matrix.Kept(kept.path, "other source").find(["easy", "map"]) is None


def test_a_row_states_the_calibration_error_as_the_evaluation_names_it():
    trust, right = np.full(20, 0.9), np.arange(20) < 16
    found = {**EMPTY, "reliability": {"changed_rows": reliability(trust, right, 10)}}
    assert matrix._row(("easy", "same sensor"), "map", 1, found)["ECE changed rows"] == pytest.approx(0.1)
    assert matrix._row(("easy", "same sensor"), "map", 1, EMPTY)["ECE changed rows"] is None


def test_a_stopped_matrix_keeps_its_table_and_goes_on_after_the_last_row(tmp_path, monkeypatch):
    cases = [matrix.Case(tmp_path / name, (name, "same sensor")) for name in ("easy", "hard")]
    asked = []

    def evaluated(group, kind, work):
        asked.append((group[0].folder.name, kind))
        if len(asked) == 3:
            raise KeyboardInterrupt
        return EMPTY

    monkeypatch.setattr(matrix, "_evaluated", evaluated)
    table = tmp_path / "matrix.md"
    with pytest.raises(KeyboardInterrupt):
        matrix.score(cases, ("map", "bare"), tmp_path / "work", table)
    assert table.read_text().count("same sensor") == 2
    rows = matrix.score(cases, ("map", "bare"), tmp_path / "work", table)
    assert [row["preset"] for row in rows] == ["easy", "easy", "hard", "hard"]
    assert asked == [("easy", "map"), ("easy", "bare"), ("hard", "map"), ("hard", "map"), ("hard", "bare")]
    assert table.read_text().count("same sensor") == 4
