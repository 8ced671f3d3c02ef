"""Runs without some rules: what these rules touch is done again, and the result is that of a whole run."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from subiaco_change.method_rules.switches import applies, obeys_rules
from subiaco_evaluation.rule_runner import FullRunner, PartialRunner, RuleNotes
from subiaco_geo.work.store import DiskStore
from subiaco_geo.work.task_runner import TaskRunner
from subiaco_geo.work.tasks import Task

RULE, OTHER = "thin_volumes", "closed_gaps"


@dataclass(frozen=True)
class Value:
    value: NDArray[np.int64]


@dataclass(frozen=True)
class Config:
    number: int
    rules_off: tuple[str, ...]


@dataclass(frozen=True)
class Params:
    config: Config

    @property
    def rules_off(self):
        return self.config.rules_off


@dataclass(frozen=True)
class NoParams:
    pass


@obeys_rules
def capped(inputs, params):
    """The number, at most 3 by the rule; negative numbers are zero by the other rule."""
    number = 3 if applies(RULE, params.config.number > 3) else params.config.number
    return Value(np.array([0 if applies(OTHER, number < 0) else number]))


def parity(inputs, params):
    return Value(inputs.of(Value, "capped").value % 2)


def labels(inputs, params):
    return Value(sum(inputs.of(Value, name).value for name in inputs.keys))


def street(runner, numbers, off=()):
    """A run of three stages, the first of which obeys rules; returns its last value."""
    first = runner.run(
        [Task("semantics", str(i), capped, {}, Params(Config(n, off))) for i, n in enumerate(numbers)]
    )
    second = runner.run([Task("parity", t, parity, {"capped": key}, NoParams()) for t, key in first.items()])
    last = runner.one(Task("labels", "all", labels, second, NoParams()))
    return runner.load(Value, last).value.tolist()


@pytest.fixture
def full(tmp_path):
    def run(numbers):
        store, notes = DiskStore(tmp_path / "stages"), RuleNotes(tmp_path / "used")
        runner = FullRunner(store, notes)
        street(runner, numbers)
        return runner, lambda *rules: PartialRunner(store, notes, runner.keys, frozenset(rules))

    return run


def done(runner):
    return [(spent.stage, spent.name) for spent in runner.spent]


def test_the_full_run_notes_the_rules_at_work_also_where_it_goes_on(full):
    runner, _ = full([1, 5, -2])
    assert runner.used == {RULE, OTHER}
    again, _ = full([1, 5, -2])
    assert again.used == {RULE, OTHER}
    assert done(again) == []


def test_only_tasks_that_the_rule_touched_are_done_again(full):
    _, partly = full([1, 5, -2])
    runner = partly(OTHER)
    street(runner, [1, 5, -2], off=(OTHER,))
    assert ("semantics", "2") in done(runner)
    assert {name for _, name in done(runner)} <= {"2", "all"}


def test_what_rests_on_an_equal_result_is_not_done_again(full):
    _, partly = full([1, 5, -2])
    runner = partly(RULE)  # 5 instead of 3: as odd as before
    assert street(runner, [1, 5, -2], off=(RULE,)) == [2]
    assert done(runner) == [("semantics", "1"), ("parity", "1")]
    assert runner.moved == {"semantics/1"}
    assert not runner.scored_moved


def test_a_result_that_differs_is_carried_to_the_end(full):
    _, partly = full([1, 6, -2])
    runner = partly(RULE)
    assert street(runner, [1, 6, -2], off=(RULE,)) == [1]
    assert runner.scored_moved


@pytest.mark.parametrize("off", [(), (RULE,), (OTHER,), (RULE, OTHER)])
@pytest.mark.parametrize("numbers", [[1, 2], [7, -3, 4], [-1, 6, 8, 3]])
def test_a_partial_run_ends_as_a_run_from_the_start(full, off, numbers):
    _, partly = full(numbers)
    assert street(partly(*off), numbers, off) == street(TaskRunner(), numbers, off)
