"""The script that tunes the simple methods finds settings that are known to be best."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from test_baselines import AFTER, BEFORE

from subiaco_evaluation.baseline_run import compare_pair
from subiaco_evaluation.baselines.pair_preparation import prepare_pair
from subiaco_evaluation.config import BaselineConfig

SCRIPTS = Path(__file__).parents[2] / "scripts"


@pytest.fixture
def script(monkeypatch):
    monkeypatch.syspath_prepend(str(SCRIPTS))
    import tune_baselines

    yield tune_baselines
    sys.modules.pop("tune_baselines")


def test_a_threshold_that_made_the_truth_is_found_again(script, monkeypatch, capsys):
    config = BaselineConfig()
    pair, _ = prepare_pair(BEFORE.survey(1), AFTER.survey(2), config, np.eye(4))
    made = compare_pair(pair, "dsm", script.with_setting(config, "dsm", "threshold", 1.0))
    case = script.Case(pair, script.cells_of(made.before, made.after))
    monkeypatch.setattr(script, "prepare", lambda survey, config: case)
    best = script.tune([Path("any")], ["dsm"])
    assert best["dsm"]["threshold"] == 1.0
    assert best["dsm"]["miou_percent"] == 100.0
    assert "1.0: 100.0" in capsys.readouterr().out


def test_reporting_seeds_are_refused(script, monkeypatch, tmp_path, capsys):
    import prove_presets

    monkeypatch.setattr(sys, "argv", ["prove", "--tune", "--seeds", "101,2", "--work", str(tmp_path)])
    assert prove_presets.main() == 2
    assert "seeds [2]" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
