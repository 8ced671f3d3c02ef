"""`make bench-check`: a ratio that worsens by more than a third is named."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest


@pytest.fixture
def ratios(repository: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location("ratios", repository / "tests" / "benchmarks" / "ratios.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def run(**row: Any) -> dict[str, Any]:
    return {"benchmarks": {"mapping": {"rows": [{"stage": "front end", **row}]}}}


def test_a_ratio_to_a_peer_that_grew_by_more_than_a_third_is_named(ratios: ModuleType) -> None:
    lines, compared = ratios.worsened(run(**{"of kiss_icp": 0.30}), run(**{"of kiss_icp": 0.41}))
    assert compared == 1
    assert lines == ["mapping: front end, of kiss_icp: 0.41, recorded 0.3 (1.37 times as bad)"]


def test_a_ratio_that_grew_by_less_or_fell_is_fine(ratios: ModuleType) -> None:
    for value in (0.39, 0.1):
        assert ratios.worsened(run(**{"of kiss_icp": 0.30}), run(**{"of kiss_icp": value})) == ([], 1)


def test_less_than_real_time_is_worse_and_more_is_not(ratios: ModuleType) -> None:
    assert ratios.worsened(run(**{"times real time": 1.5}), run(**{"times real time": 3.0})) == ([], 1)
    lines, _ = ratios.worsened(run(**{"times real time": 1.5}), run(**{"times real time": 1.0}))
    assert len(lines) == 1


def test_seconds_are_not_compared(ratios: ModuleType) -> None:
    assert ratios.worsened(run(**{"CPU s": 1.0}), run(**{"CPU s": 9.0})) == ([], 0)


def test_ratios_of_wall_times_are_not_compared_and_those_of_processor_times_are(ratios: ModuleType) -> None:
    before = {"of M3C2 0.5 m, wall": 6.0, "of M3C2 0.5 m, CPU": 4.0}
    lines, compared = ratios.worsened(run(**before), run(**dict.fromkeys(before, 9.0)))
    assert compared == 1
    assert lines == ["mapping: front end, of M3C2 0.5 m, CPU: 9, recorded 4 (2.25 times as bad)"]


def test_the_recorded_benchmarks_hold_ratios_to_compare(ratios: ModuleType, repository: Path) -> None:
    recorded = json.loads((repository / "benchmarks.json").read_text())
    assert ratios.worsened(recorded, recorded)[0] == []
    assert ratios.worsened(recorded, recorded)[1] >= 10
