"""Switches of rules: a rule that is switched off gives way to the plain answer stated beside it.

The rules that are switched off travel in the parameters of a stage (:func:`obeys_rules`), not in those of
every function, so that one function states the rule and no caller has to know that a switch exists.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import wraps
from typing import Any, ParamSpec, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

P = ParamSpec("P")
R = TypeVar("R")
_OFF: ContextVar[frozenset[str]] = ContextVar("rules_off", default=frozenset())
_USED: ContextVar[set[str] | None] = ContextVar("rules_used", default=None)


@dataclass(frozen=True)
class Rule:
    """One rule of the method that decides or moves a label.

    ``name``: by which the rule is switched off. ``stages``: groups of stages in which the rule acts (see
    ``STAGES_OF_RULES``). ``reason``: why the rule is there. ``numbers``: dotted names of its settings, or of
    constants below ``method_numbers``. ``guards``: the rule keeps real recordings free of false claims, so
    that simulated scenes alone do not decide whether it is deleted.
    """

    name: str
    stages: tuple[str, ...]
    reason: str
    numbers: tuple[str, ...] = ()
    guards: bool = False


class _HasRules(Protocol):
    @property
    def rules_off(self) -> tuple[str, ...]: ...


Params = TypeVar("Params", bound=_HasRules)


@contextmanager
def rules_switched_off(names: Iterable[str]) -> Iterator[None]:
    """Switch rules off by name while the context lasts."""
    token = _OFF.set(frozenset(names))
    try:
        yield
    finally:
        _OFF.reset(token)


@contextmanager
def rules_recorded() -> Iterator[set[str]]:
    """Collect the names of the rules whose answer, in this process, once differs from that without them.

    Switching off a rule that is not among them changes no result: before the first answer that differs,
    nothing differs.
    """
    used: set[str] = set()
    token = _USED.set(used)
    try:
        yield used
    finally:
        _USED.reset(token)


def applies(name: str, condition: bool | np.bool_) -> bool:
    """Tell whether a rule is on and its condition holds: a rule that is one condition among others."""
    if not condition or name in _OFF.get():
        return False
    used = _USED.get()
    if used is not None:
        used.add(name)
    return True


def rule_mask(name: str, where: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return where a rule holds: nowhere if the rule is off."""
    if name in _OFF.get():
        return np.zeros_like(where)
    used = _USED.get()
    if used is not None and where.any():
        used.add(name)
    return where


def switchable(name: str, otherwise: Callable[..., Any]) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Make a function the one place at which a rule is applied.

    Parameters
    ----------
    name : str
        Of the rule in the registry.
    otherwise : callable
        Takes the arguments of the function and returns the answer without the rule.
    """

    def around(function: Callable[P, R]) -> Callable[P, R]:
        @wraps(function)
        def switched(*args: P.args, **kwargs: P.kwargs) -> R:
            if name in _OFF.get():
                plain: R = otherwise(*args, **kwargs)
                return plain
            answer = function(*args, **kwargs)
            used = _USED.get()
            if used is not None and name not in used and not _same(answer, otherwise(*args, **kwargs)):
                used.add(name)
            return answer

        return switched

    return around


def obeys_rules(stage: Callable[[Any, Params], R]) -> Callable[[Any, Params], R]:
    """Switch off, in a stage, the rules that its parameters name."""

    @wraps(stage)
    def switched(inputs: Any, params: Params) -> R:
        with rules_switched_off(params.rules_off):
            return stage(inputs, params)

    return switched


def _same(first: Any, second: Any) -> bool:
    """Tell whether two answers are the same: equal values and arrays, or the very same objects."""
    if first is second:
        return True
    if isinstance(first, np.ndarray) and isinstance(second, np.ndarray):
        return np.array_equal(first, second, equal_nan=first.dtype.kind == "f")
    if isinstance(first, list | tuple) and isinstance(second, list | tuple):
        return len(first) == len(second) and all(map(_same, first, second))
    if isinstance(first, float) and isinstance(second, float) and math.isnan(first):
        return math.isnan(second)
    plain = (bool, np.bool_, int, float, str, np.number)
    return isinstance(first, plain) and isinstance(second, plain) and bool(first == second)


def first_argument(first: Any, *_: Any, **__: Any) -> Any:
    """Return the first argument as it is."""
    return first


def second_argument(_: Any, second: Any, *__: Any, **___: Any) -> Any:
    """Return the second argument as it is."""
    return second


def third_argument(_: Any, __: Any, third: Any, *___: Any, **____: Any) -> Any:
    """Return the third argument."""
    return third


def never(*_: Any, **__: Any) -> bool:
    """Return False."""
    return False


def always(*_: Any, **__: Any) -> bool:
    """Return True."""
    return True


def no_decision(*_: Any, **__: Any) -> None:
    """Decide nothing."""


def none_of_them(first: Any, *_: Any, **__: Any) -> NDArray[np.bool_]:
    """Return a mask (N,) that holds none of N places."""
    return np.zeros(len(first), dtype=bool)


def one_part(first: Any, *_: Any, **__: Any) -> NDArray[np.int64]:
    """Return labels (N,) of N places that are all one part."""
    return np.zeros(len(first), dtype=np.int64)


def zeros_of_them(first: Any, *_: Any, **__: Any) -> NDArray[np.float64]:
    """Return zeros (N,) for N places."""
    return np.zeros(len(first))


def none_like_second(_: Any, second: NDArray[np.bool_], *__: Any, **___: Any) -> NDArray[np.bool_]:
    """Return a mask of the shape of the second argument that holds nothing."""
    return np.zeros_like(second)
