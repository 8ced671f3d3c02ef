"""The page of learned methods: its tables, and which cases it reads."""

import sys
from pathlib import Path

import numpy as np
import pytest

from subiaco_evaluation.config import BaselineConfig
from subiaco_evaluation.learned.weights_file import write_weights

FOLDER = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture
def bench(monkeypatch):
    monkeypatch.syspath_prepend(str(FOLDER))
    for name in ("bench_learned", "bench_evidence_matrix", "bench_real", "bench_real_site", "tabulated"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    import bench_learned

    return bench_learned


def test_the_page_shows_every_table_and_names_methods_that_were_not_run(bench):
    found = {
        "day": "2026-11-22",
        "revision": "abc",
        "training": [{"method": "efs-kpconv", "hours": 0.25}],
        "surveys": [{"method": "dsm", "mIoU %": 40.5}],
        "surveys_names": ["one", "two"],
        "surveys_each": [{"mIoU %": "dsm", "one": 41.0, "two": 40.0}],
        "site": [{"method": "dsm", "claims": 7}],
        "absent": {"pdal-m3c2": "the command 'pdal' was not found"},
        "remarks": ["A sentence."],
    }
    text = bench.page(found)
    for piece in (
        "| efs-kpconv | 0.25 |",
        "| dsm | 40.5 |",
        "| dsm | 41 | 40 |",
        "one, two",
        "| dsm | 7 |",
        "pdal-m3c2 was not run",
    ):
        assert piece in text
    assert text.count("\n| --- |") == 4
    assert "Another sensor" not in text
    assert text.endswith("* A sentence.\n")


def test_bare_clouds_of_a_survey_are_made_once(bench, tmp_path, monkeypatch):
    made = []

    def write(survey, folder):
        made.append((survey, folder))
        folder.mkdir(parents=True)
        (folder / "after.tum").touch()

    monkeypatch.setattr(bench, "write_foreign", write)
    cases = [bench.bare_case(Path("sim/a"), tmp_path) for _ in range(2)]
    folder = tmp_path / "bare" / "a" / "clouds"
    assert made == [(Path("sim/a"), folder)]
    assert cases[0] == cases[1]
    assert (cases[0].before, cases[0].after) == (folder / "before.ply", folder / "after.laz")
    assert (cases[0].group, cases[0].truth) == ("bare", Path("sim/a"))


def test_a_method_whose_program_is_missing_is_named_and_left_out(bench, monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    good, absent = bench.available(["dsm", "pdal-m3c2"])
    assert good == ["dsm"]
    assert list(absent) == ["pdal-m3c2"]


def test_a_row_of_other_weights_runs_the_method_that_their_record_names(bench, tmp_path):
    write_weights(tmp_path / "w.npz", {"a": np.zeros(2)}, {"method": "dsm-siamese"})
    also = {"signed": tmp_path / "w.npz"}
    method, settings = bench.resolve("signed", also)
    assert (method, settings.learned.weights) == ("dsm-siamese", str(tmp_path / "w.npz"))
    assert bench.resolve("dsm", also) == ("dsm", BaselineConfig())


def test_a_training_that_began_with_weights_counts_from_its_first_cylinder(bench, tmp_path):
    config = {
        "seed": 0,
        "point_network": {"features": ["height"]},
        "point_training": {"samples": 100},
    }
    part = {"config": config, "epochs": 3, "hours": 0.5, "revision": "old"}
    record = {
        **part, "method": "siamese-kpconv", "parameters": 7, "surveys": ["a", "b"],
        "validation_surveys": ["c"], "best_epoch": 1,
        "validation_miou_percent": 50.0, "prior_power": 0.25, "moving_objects": "unchanged",
        "earlier": [{**part, "epochs": 4}],
    }  # fmt: skip
    write_weights(tmp_path / "w.npz", {"a": np.zeros(2)}, record)
    (row,) = bench.training_rows(["row"], {"row": tmp_path / "w.npz"})
    assert (row["epochs"], row["cylinders or patches"], row["hours"], row["best epoch"]) == (7, 700, 1.0, 6)
    assert (row["input"], row["learned on"], row["moving objects"]) == ("1, height", "a, b", "unchanged")
