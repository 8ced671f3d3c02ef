"""Tasks with a key that covers inputs, parameters and code, so that a finished task is not done twice."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import resource
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Generic, TypeVar

import numpy as np
from pydantic import BaseModel

from subiaco_geo.work.results import Result, pack, unpack
from subiaco_geo.work.source_code import source_fingerprint
from subiaco_geo.work.store import Store

Params = TypeVar("Params")
#: Name of a task that answers for all tiles.
WHOLE = "all"


def fingerprint(value: Any) -> str:
    """Hash what a piece of work rests on: numbers, texts, arrays, models, dataclasses, and lists of them."""
    digest = hashlib.sha256()
    _feed(digest, value)
    return digest.hexdigest()[:20]


def _feed(digest: Any, value: Any) -> None:
    if isinstance(value, np.ndarray):
        digest.update(f"{value.dtype.str}{value.shape}".encode())
        digest.update(np.ascontiguousarray(value).data)
    elif isinstance(value, BaseModel):
        digest.update(json.dumps(value.model_dump(mode="json"), sort_keys=True).encode())
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        _feed(digest, {f.name: getattr(value, f.name) for f in dataclasses.fields(value)})
    elif isinstance(value, Mapping):
        for name in sorted(value):
            digest.update(f"{name}=".encode())
            _feed(digest, value[name])
            digest.update(b";")
    elif isinstance(value, list | tuple):
        digest.update(b"[")
        for item in value:
            _feed(digest, item)
            digest.update(b",")
        digest.update(b"]")
    elif value is None or isinstance(value, str | bool | int | float | np.generic):
        digest.update(f"{type(value).__name__}{value!r}".encode())
    else:
        raise TypeError(f"{type(value).__name__} has no fingerprint")


@dataclass(frozen=True)
class Inputs:
    """What a task rests on: keys of finished pieces by alias."""

    store: Store
    keys: Mapping[str, str]
    _opened: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)

    def of(self, kind: type[Result], alias: str) -> Result:
        """Open the result of an earlier stage; each of its fields is read once."""
        if alias not in self._opened:
            self._opened[alias] = self.once(kind, alias)
        found: Result = self._opened[alias]
        return found

    def once(self, kind: type[Result], alias: str) -> Result:
        """Open a result that is looked at once: nothing of it is kept here."""
        return unpack(kind, self.store.load(self.keys[alias]))

    def find(self, kind: type[Result], alias: str) -> Result | None:
        """Open a result, None where the task does not rest on it."""
        return self.of(kind, alias) if alias in self.keys else None

    def __contains__(self, alias: object) -> bool:
        return alias in self.keys

    def under(self, prefix: str) -> list[str]:
        """Return the aliases below ``prefix/``, in order, without it."""
        start = prefix + "/"
        return sorted(alias[len(start) :] for alias in self.keys if alias.startswith(start))


@dataclass(frozen=True)
class Task(Generic[Params]):
    """One piece of work.

    Parameters
    ----------
    stage, name : str
        ``name`` is a tile, or :data:`WHOLE`.
    function : callable
        At the top of a module, so that other processes find it: inputs and parameters to a dataclass that
        :func:`~subiaco_geo.work.results.pack` can store.
    inputs : mapping of str to str
        Keys of finished pieces by alias.
    params : dataclass
        All else that the result depends on (see :func:`fingerprint`).
    """

    stage: str
    name: str
    function: Callable[[Inputs, Params], Any]
    inputs: Mapping[str, str]
    params: Params

    @cached_property
    def key(self) -> str:
        """Return ``stage/name-hash``: another input, another parameter or other code is another key."""
        where = f"{self.function.__module__}.{self.function.__qualname__}"
        code = source_fingerprint(self.function.__module__)
        return f"{self.stage}/{self.name}-{fingerprint([code, where, self.inputs, self.params])}"


@dataclass(frozen=True)
class TaskCost:
    """What a task cost: seconds of the clock and of the processor, largest memory of its process [MiB]."""

    stage: str
    name: str
    wall: float
    cpu: float
    peak_mib: float


def execute(store: Store, task: Task[Any]) -> TaskCost:
    """Do a task and keep what it leaves."""
    wall, cpu = time.perf_counter(), time.process_time()
    store.save(task.key, pack(task.function(Inputs(store, task.inputs), task.params)))
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    return TaskCost(task.stage, task.name, wall, cpu, peak_mib())


def peak_mib() -> float:
    """Return the largest resident memory of this process so far [MiB]."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1024.0 if sys.platform != "darwin" else peak / 1024.0**2
