"""Signals that end a command, a job or its processes."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def sigterm_interrupts() -> Iterator[list[int]]:
    """Let SIGTERM end what runs inside as Ctrl-C does; yield the signals that came.

    A job inside of a command that does so already leaves SIGTERM to the command.
    """
    came: list[int] = []
    main = threading.current_thread() is threading.main_thread()
    if not main or callable(signal.getsignal(signal.SIGTERM)):
        yield came
        return

    def interrupt(number: int, _frame: FrameType | None) -> None:
        came.append(number)
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield came
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL if before is None else before)


@contextmanager
def interrupt_blocked() -> Iterator[None]:
    """Let processes that start meanwhile, and those that they start, get no SIGINT: Ctrl-C goes to all."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
