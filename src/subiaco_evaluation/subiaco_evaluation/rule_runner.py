"""Runs of the method without some rules that do again only what these rules touch.

The full method is run once, and of each task it is kept which rules' answers once differed there from those
without them. A task in which none of the rules that are switched off differed has the result of the full
method, if its inputs are the same; and a task whose result is equal to that of the full method although its
inputs are not passes the key of the full method on, so that what rests on it is not done again.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from subiaco_change.method_rules.switches import rules_recorded
from subiaco_geo.atomic import whole_file
from subiaco_geo.work.executors import InProcess
from subiaco_geo.work.store import Arrays, MemoryStore, Store
from subiaco_geo.work.task_runner import TaskRunner
from subiaco_geo.work.tasks import Task, TaskCost

#: Stages that hold all that is scored.
SCORED = ("decide", "patches", "labels")


@dataclass(frozen=True)
class RuleNotes:
    """Which rules were at work in each task of the full method, as files below a folder."""

    folder: Path

    def of(self, key: str) -> frozenset[str] | None:
        """Return the rules whose answer differed in a task; None where that is not known."""
        path = self._path(key)
        return frozenset(json.loads(path.read_text(encoding="utf-8"))) if path.is_file() else None

    def write(self, key: str, used: set[str]) -> None:
        """Keep the rules at work in a task."""
        path = self._path(key)
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(path) as temporary:
            temporary.write_text(json.dumps(sorted(used)), encoding="utf-8")

    def _path(self, key: str) -> Path:
        return self.folder / f"{key}.json"


class _Recorded(InProcess):
    """Does tasks in this process and notes the rules at work in each."""

    def __init__(self, notes: RuleNotes) -> None:
        self._notes = notes

    def run(self, store: Store, tasks: Sequence[Task[Any]]) -> Iterator[TaskCost]:
        for task in tasks:
            with rules_recorded() as used:
                spent = list(super().run(store, [task]))
            self._notes.write(task.key, used)
            yield from spent


class FullRunner(TaskRunner):
    """Runs the full method and notes the rules at work; ``keys``: of the results by ``stage/name``."""

    def __init__(self, store: Store, notes: RuleNotes) -> None:
        super().__init__(store, _Recorded(notes))
        self._notes = notes
        self.keys: dict[str, str] = {}

    @property
    def used(self) -> frozenset[str]:
        """Rules at work in any task of the run."""
        return frozenset().union(*(self._notes.of(key) or () for key in self.keys.values()))

    def together(
        self, stages: Sequence[Sequence[Task[Any]]], span: tuple[float, float] = (0.0, 1.0)
    ) -> list[dict[str, str]]:
        """Do the tasks of independent stages, and keep their keys."""
        self.keys |= {f"{task.stage}/{task.name}": task.key for stage in stages for task in stage}
        return super().together(stages, span)

    def _open(self, task: Task[Any]) -> bool:
        return super()._open(task) or self._notes.of(task.key) is None


class PartialRunner(TaskRunner):
    """Runs the method without some rules, over the results of a run of the full method.

    ``moved``: tasks, by ``stage/name``, whose result is not that of the full method.

    Parameters
    ----------
    full : Store
        Results of the full method; nothing is added to it.
    notes : RuleNotes
        Of the full method.
    keys : mapping
        Keys of its results by ``stage/name``.
    rules : frozenset of str
        Switched off here, beyond what is off in the full method.
    """

    def __init__(self, full: Store, notes: RuleNotes, keys: Mapping[str, str], rules: frozenset[str]) -> None:
        super().__init__(_Above(full))
        self._notes, self._keys, self._rules = notes, keys, rules
        self.moved: set[str] = set()

    def together(
        self, stages: Sequence[Sequence[Task[Any]]], span: tuple[float, float] = (0.0, 1.0)
    ) -> list[dict[str, str]]:
        """Do the tasks that the rules touch; equal results have the keys of the full method."""
        plain = [[self._plain(task) for task in stage] for stage in stages]
        super().together(plain, span)
        return [{task.name: self._known(task) for task in stage} for stage in plain]

    @property
    def scored_moved(self) -> bool:
        """Tell whether anything that is scored differs from the full method."""
        return any(name.split("/")[0] in SCORED for name in self.moved)

    def _plain(self, task: Task[Any]) -> Task[Any]:
        """Return a task as the full method does it, where the rules had no say in it."""
        off = tuple(getattr(task.params, "rules_off", ()))
        if not self._rules.intersection(off):
            return task
        full = tuple(name for name in off if name not in self._rules)
        base = dataclasses.replace(task, params=_with_rules_off(task.params, full))
        used = self._notes.of(base.key)
        return task if used is None or used & self._rules else base

    def _known(self, task: Task[Any]) -> str:
        name = f"{task.stage}/{task.name}"
        base = self._keys.get(name)
        if base == task.key:
            return task.key
        if base is not None and _equal(self.store.load(base), self.store.load(task.key)):
            return base
        self.moved.add(name)
        return task.key


def _with_rules_off(params: Any, off: tuple[str, ...]) -> Any:
    """Return parameters of a task, or the slice of the configuration in them, with other rules off."""
    names = {own.name for own in dataclasses.fields(params)}
    if "rules_off" in names:
        return dataclasses.replace(params, rules_off=off)
    return dataclasses.replace(params, config=_with_rules_off(params.config, off))


def _equal(first: Arrays, second: Arrays) -> bool:
    return set(first) == set(second) and all(_same(first[name], second[name]) for name in first)


def _same(first: NDArray[Any], second: NDArray[Any]) -> bool:
    return first.dtype == second.dtype and np.array_equal(first, second, equal_nan=first.dtype.kind == "f")


@dataclass(frozen=True)
class _Above:
    """A store in memory above another, which is only read."""

    below: Store
    own: MemoryStore = field(default_factory=MemoryStore)
    shared: bool = False

    def has(self, key: str) -> bool:
        return self.own.has(key) or self.below.has(key)

    def size(self, key: str) -> int:
        return self.own.size(key) if self.own.has(key) else self.below.size(key)

    def load(self, key: str) -> Arrays:
        return self.own.load(key) if self.own.has(key) else self.below.load(key)

    def save(self, key: str, arrays: Arrays) -> None:
        self.own.save(key, arrays)

    def note(self, name: str, words: Mapping[str, Any]) -> None:
        """Leave no note: the run is no run of its own."""
