"""An accuracy gate: three small simulated surveys with floors, so that a rule that costs points is seen.

The surveys are made by the frozen simulator (``config/frozen.yaml``) on seeds that no table reports: a street
of each family, measured by unlike sensors, with its visibility layers, and a crowded street as bare clouds
without trajectories. Floors lie a few points below what was measured when they were set. They are raised when
the method gets better, and not lowered to let a change pass. One was, by one object of 39 (method 1.15): a
tree that grew by 0.54 m was measured in four columns, and the excess of its top equalled its limit to the
centimetre. The floors of the other two streets rose by more. That of the bare street was lowered once: method
1.18 passed the former floor of 71.0 on one machine and scored 70.9 on another, as method 1.19 does. It had
fallen from 74.8 since the floor was set. With method 1.43 it rose: version 1.42 had deleted a rule that this
street needs, and scored 68.9.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from subiaco_bringup.cli.main import run

pytestmark = pytest.mark.slow


@dataclass(frozen=True)
class Gate:
    """One survey and what must be reached on it."""

    preset: str
    seed: int
    duration: float
    bare: bool
    least_miou_percent: float
    least_found_percent: float
    most_false_claims: int
    most_wrong_cells: int
    most_unseen_claims: int


GATES = (
    Gate("suburb", 201, 8.0, False, 57.5, 45.5, 9, 10, 2),  # measured: 60.3, 46.2, 6, 1, 1
    Gate("dense", 201, 8.0, False, 45.0, 54.0, 8, 10, 5),  # measured: 48.9, 60.4, 7, 4, 2
    Gate("default", 202, 10.0, True, 74.0, 70.0, 4, 25, 4),  # measured: 77.5, 73.5, 2, 10, 1
)


@pytest.fixture(autouse=True)
def benchmarks(monkeypatch: pytest.MonkeyPatch, repository: Path) -> None:
    monkeypatch.syspath_prepend(str(repository / "tests" / "benchmarks"))


def bare_words(survey: Path, folder: Path) -> list[str]:
    """Write both epochs as another fusion program would; return the words that name them to the command."""
    from bench_evidence_matrix import write_foreign

    write_foreign(survey, folder)
    return [str(folder / "before.ply"), str(folder / "after.laz")]


def wrong_signs(confusion: list[list[int]]) -> int:
    """Count the cells that were claimed to change in the opposite direction; rows are the truth."""
    added, removed, increased, decreased = range(4)
    pairs = [(added, removed), (increased, decreased), (increased, removed), (decreased, added)]
    return sum(confusion[a][b] + (confusion[b][a] if (a, b) in pairs[:2] else 0) for a, b in pairs)


def scored(gate: Gate, folder: Path) -> dict[str, Any]:
    """Simulate, compare and evaluate through the command; return the evaluation."""
    survey, output = folder / "survey", folder / "change"
    words = ["--preset", gate.preset, "--seed", str(gate.seed), "--duration", str(gate.duration)]
    assert run(["simulate", str(survey), *words, "--maps-only", "--mode", "512x10", "--quiet"]) == 0
    epochs = [str(survey / "before"), str(survey / "after")]
    if gate.bare:
        epochs = bare_words(survey, folder / "bare")
    assert run(["change", *epochs, "-o", str(output), "--quiet"]) == 0
    assert run(["evaluate", str(output), str(survey), "-o", str(folder / "scores"), "--quiet"]) == 0
    found: dict[str, Any] = json.loads((folder / "scores" / "evaluation.json").read_text())
    return found


@pytest.mark.parametrize("gate", GATES, ids=lambda gate: f"{gate.preset}{'-bare' if gate.bare else ''}")
def test_a_street_is_scored_no_worse_than_its_floor(gate: Gate, tmp_path: Path) -> None:
    scores = scored(gate, tmp_path)
    objects = scores["objects"]
    assert scores["grid"]["miou_percent"] >= gate.least_miou_percent
    assert objects["recall_percent"] >= gate.least_found_percent
    assert objects["predicted"] - objects["right"] <= gate.most_false_claims
    assert wrong_signs(scores["grid"]["confusion_rows_truth"]) <= gate.most_wrong_cells
    assert objects["claims_in_unobserved_places_above_half_confidence"] <= gate.most_unseen_claims
