"""Progress for people: a bar on a terminal, plain lines otherwise."""

from __future__ import annotations

import sys
import time
from types import TracebackType
from typing import Never, Self

from tqdm import tqdm

#: Seconds between plain lines of one stage.
LINE_INTERVAL = 5.0


class Progress:
    """Callable ``progress(stage, fraction)``, used as a context manager.

    Parameters
    ----------
    quiet : bool
        Say nothing at all.
    """

    def __init__(self, *, quiet: bool = False) -> None:
        self._quiet = quiet
        self._bar: tqdm[Never] | None = None
        self._terminal = sys.stderr.isatty()
        self._stage = ""
        self._last_line = 0.0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close_bar()

    def __call__(self, stage: str, fraction: float) -> None:
        """Report that a stage stands at a fraction 0..1."""
        if self._quiet:
            return
        if self._terminal:
            self._draw_bar(stage, fraction)
        else:
            self._print_line(stage, fraction)

    def _close_bar(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None

    def _draw_bar(self, stage: str, fraction: float) -> None:
        if stage != self._stage:
            self._close_bar()
            self._stage = stage
        bar = self._bar
        if bar is None:
            layout = "{desc:<34}{percentage:3.0f}% |{bar}| {elapsed}"
            bar = self._bar = tqdm(total=100, desc=stage, bar_format=layout, file=sys.stderr)
        bar.n = round(100 * fraction)
        bar.refresh()

    def _print_line(self, stage: str, fraction: float) -> None:
        now = time.monotonic()
        begins = stage != self._stage
        if begins or now - self._last_line > LINE_INTERVAL:
            suffix = "" if begins and fraction == 0.0 else f" {fraction:4.0%}"
            sys.stderr.write(f"{stage}{suffix}\n")
            sys.stderr.flush()
            self._last_line = now
        self._stage = stage
