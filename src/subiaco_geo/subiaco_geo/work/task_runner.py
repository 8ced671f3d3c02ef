"""The task runner: stages of tasks over one store and one executor, with their cost."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from subiaco_geo.errors import InputError
from subiaco_geo.work.executors import Executor, InProcess
from subiaco_geo.work.results import Result, pack, unpack
from subiaco_geo.work.store import MemoryStore, Store
from subiaco_geo.work.tasks import Task, TaskCost, fingerprint

_LOG = logging.getLogger(__name__)
Progress = Callable[[str, float], None]


@dataclass
class TaskRunner:
    """Runs stages; finished tasks are taken from the store.

    Parameters
    ----------
    store : Store
    executor : Executor
    progress : callable, optional
        Called with the name of the stage and the fraction of the run done.
    redo : set of str
        Stages whose tasks are done again even where they are finished.
    on_task : callable, optional
        Called with stage and name of every task that is done.
    """

    store: Store = field(default_factory=MemoryStore)
    executor: Executor = field(default_factory=InProcess)
    progress: Progress | None = None
    redo: frozenset[str] = frozenset()
    on_task: Callable[[str, str], None] | None = None
    spent: list[TaskCost] = field(default_factory=list)
    kept: int = 0
    _done: set[str] = field(default_factory=set)

    def put(self, stage: str, name: str, result: Any) -> str:
        """Keep a result made here, a dataclass, under a key of its content; return the key."""
        arrays = pack(result)
        key = f"{stage}/{name}-{fingerprint(arrays)}"
        if not self.store.has(key):
            self.store.save(key, arrays)
        return key

    def load(self, kind: type[Result], key: str) -> Result:
        """Return a finished result."""
        return unpack(kind, self.store.load(key))

    def run(self, tasks: Sequence[Task[Any]], span: tuple[float, float] = (0.0, 1.0)) -> dict[str, str]:
        """Do the tasks of one stage that are not finished; return their keys by name.

        Parameters
        ----------
        tasks : sequence of Task
            Independent of each other.
        span : (float, float)
            Fractions of the whole run at the beginning and the end of the stage.
        """
        return self.together([tasks], span)[0]

    def together(
        self, stages: Sequence[Sequence[Task[Any]]], span: tuple[float, float] = (0.0, 1.0)
    ) -> list[dict[str, str]]:
        """Do the tasks of independent stages in parallel; see :meth:`run`.

        Progress is told of the first stage that is not finished.
        """
        tasks = [task for stage in stages for task in stage]
        if tasks:
            todo = list({task.key: task for task in tasks if self._open(task)}.values())
            self.kept += len(tasks) - len(todo)
            names = ", ".join(dict.fromkeys(task.stage for task in tasks))
            _LOG.info("%s: %d tasks, %d finished before", names, len(tasks), len(tasks) - len(todo))
            self._tell(tasks[0].stage, span[0])
            left = [task.stage for task in todo]
            for number, spent in enumerate(self.executor.run(self.store, todo), 1):
                self.spent.append(spent)
                left.remove(spent.stage)
                if self.on_task is not None:
                    self.on_task(spent.stage, spent.name)
                self._tell(
                    left[0] if left else spent.stage, span[0] + (span[1] - span[0]) * number / len(todo)
                )
            self._done.update(task.key for task in tasks)
        return [{task.name: task.key for task in stage} for stage in stages]

    def one(self, task: Task[Any], span: tuple[float, float] = (0.0, 1.0)) -> str:
        """Do a single task; return its key."""
        return self.run([task], span)[task.name]

    def _open(self, task: Task[Any]) -> bool:
        again = task.stage in self.redo and task.key not in self._done
        return again or not self.store.has(task.key)

    def _tell(self, stage: str, fraction: float) -> None:
        if self.progress is not None:
            self.progress(stage, fraction)

    def costs(self) -> dict[str, dict[str, float]]:
        """Return what every stage cost in this run.

        Returns
        -------
        dict
            By stage ``tasks`` done, ``cpu_s``, ``wall_s`` added up over tasks, and ``peak_mib``, the
            largest memory of a process that did one of them.
        """
        total: dict[str, dict[str, float]] = {}
        for spent in self.spent:
            own = total.setdefault(spent.stage, {"tasks": 0, "cpu_s": 0.0, "wall_s": 0.0, "peak_mib": 0.0})
            own["tasks"] += 1
            own["cpu_s"] += spent.cpu
            own["wall_s"] += spent.wall
            own["peak_mib"] = max(own["peak_mib"], spent.peak_mib)
        return total

    def seconds(self) -> dict[str, float]:
        """Return the processor seconds that every stage cost in this run."""
        return {stage: cost["cpu_s"] for stage, cost in self.costs().items()}


def stages_from(order: Sequence[str], first: str) -> frozenset[str]:
    """Return ``first`` and the stages after it.

    Raises
    ------
    InputError
        No such stage.
    """
    if first not in order:
        raise InputError(f"--from {first}: no such stage; choose from {', '.join(order)}")
    return frozenset(order[order.index(first) :])
