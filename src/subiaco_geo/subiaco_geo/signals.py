"""Signals that end a command, a job or its processes."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

#: Seconds after which a signal that came during an import is handled, if that import has ended.
_AGAIN = 0.05


@contextmanager
def signals_interrupt() -> Iterator[list[int]]:
    """Let SIGTERM end what runs inside as Ctrl-C does, both after an import that is under way.

    Libraries catch ``KeyboardInterrupt`` while they are imported, and the run would go on as if no signal
    had come. Yields the numbers of the signals that came. A job inside of a command that does so already
    leaves the signals to the command.
    """
    came: list[int] = []
    main = threading.current_thread() is threading.main_thread()
    if not main or callable(signal.getsignal(signal.SIGTERM)):
        yield came
        return

    def interrupt(number: int, frame: FrameType | None) -> None:
        came.append(number)
        if not _importing(frame):
            raise KeyboardInterrupt
        again = signal.signal(signal.SIGALRM, lambda _, later: interrupt(number, later))
        before.setdefault(signal.SIGALRM, again)
        signal.setitimer(signal.ITIMER_REAL, _AGAIN)

    numbers = [signal.SIGTERM]
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # background jobs ignore it
        numbers.append(signal.SIGINT)
    before: dict[int, Any] = {}
    before.update({number: signal.signal(number, interrupt) for number in numbers})
    try:
        yield came
    finally:
        if signal.SIGALRM in before:
            signal.setitimer(signal.ITIMER_REAL, 0)
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)


def _importing(frame: FrameType | None) -> bool:
    """Return whether a frame belongs to an import."""
    while frame is not None and not frame.f_code.co_filename.startswith("<frozen importlib"):
        frame = frame.f_back
    return frame is not None


@contextmanager
def interrupt_blocked() -> Iterator[None]:
    """Let processes that start meanwhile, and those that they start, get no SIGINT: Ctrl-C goes to all."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
