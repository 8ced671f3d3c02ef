"""Work made a little ahead of its use, on threads, in order."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

A = TypeVar("A")
T = TypeVar("T")

WORKERS = 2


def ahead(make: Callable[[A], T], inputs: Iterable[A], workers: int = WORKERS) -> Iterator[T]:
    """Yield ``make(x)`` of every input in order, made by threads, at most one a worker ahead.

    What ``make`` does must not depend on the order in which it is called.
    """
    waiting: deque[Future[T]] = deque()
    with ThreadPoolExecutor(workers) as pool:
        for item in inputs:
            waiting.append(pool.submit(make, item))
            if len(waiting) > workers:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
