"""What the driver sees in the terminal: the light of the street, and a line for each sensor."""

from __future__ import annotations

import math
import sys
import threading
from collections.abc import Mapping
from types import TracebackType
from typing import Any, Self

from rich.console import Console, Group
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

_LEVELS = (("ok", "green"), ("look", "yellow"), ("bad", "bold red"), ("none", "dim"))
_LIGHTS = {"green": "black on green", "amber": "black on yellow", "red": "white on red"}


def picture(status: Mapping[str, Any]) -> Group:
    """Return one screen of a status: street light, sensors, what to drive again."""
    light = str(status["light"])
    reasons = ", ".join(status["reasons"])
    head = Text(f" {light.upper()} ", style=_LIGHTS.get(light, "reverse"))
    head.append(f"  {reasons or 'this street is usable so far'}", style="default")
    table = Table(box=None, pad_edge=False, expand=False)
    for column in ("sensor", "", "", "values"):
        table.add_column(column, overflow="fold")
    for line in status["lines"]:
        word, style = _LEVELS[line["level"]]
        values = "  ".join(f"{key} {value}" for key, value in line["values"].items())
        message = "" if line["message"] == "ok" else line["message"]
        table.add_row(
            line["name"], Text(word, style=style), Text(message, style=style), Text(values, style="dim")
        )
    return Group(Panel(head, title="street", title_align="left"), table, Text(_summary(status)))


def _summary(status: Mapping[str, Any]) -> str:
    counts = ", ".join(f"{n} {name}" for name, n in status["counts"].items())
    words = f"segments: {counts}; to be driven again: {status['again']}"
    undriven = status["undriven"]
    known = undriven is not None and math.isfinite(undriven)
    return f"{words}; of the route undriven: {undriven:.0f} m" if known else words


def plain_lines(status: Mapping[str, Any], before: Mapping[str, Any] | None) -> list[str]:
    """Return what changed since the status before, for logs and pipes."""
    old = {line["name"]: line for line in before["lines"]} if before is not None else {}
    said = []
    for line in status["lines"]:
        known = old.get(line["name"])
        # details count on (since 1.5 s, since 2.0 s): the names of the flags are what changes
        if known is None or (line["level"], _names(line)) != (known["level"], _names(known)):
            said.append(f"{line['name']}: {_LEVELS[line['level']][0]}: {line['message']}")
    if before is None or before["light"] != status["light"]:
        reasons = ", ".join(status["reasons"])
        said.append(f"street: {status['light']}" + (f" ({reasons})" if reasons else ""))
    return said


def _names(line: Mapping[str, Any]) -> list[str]:
    return [part.split(":")[0] for part in str(line["message"]).split("; ")]


class LiveView:
    """Show each status: a picture on a terminal, changes as lines elsewhere.

    Parameters
    ----------
    quiet : bool
        Show nothing.
    console : Console, optional
        Standard error where absent: standard output is for results.
    """

    def __init__(self, *, quiet: bool = False, console: Console | None = None) -> None:
        self._quiet = quiet
        self._console = console or Console(stderr=True)
        self._live = Live(console=self._console, auto_refresh=False, transient=False)
        self._before: Mapping[str, Any] | None = None
        self._lock = threading.Lock()

    def __enter__(self) -> Self:
        if self._console.is_terminal and not self._quiet:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._live.stop()

    def __call__(self, status: Mapping[str, Any]) -> None:
        """Take a status."""
        if self._quiet:
            return
        with self._lock:
            if self._console.is_terminal:
                self._live.update(picture(status), refresh=True)
            else:
                for line in plain_lines(status, self._before):
                    sys.stderr.write(line + "\n")
                sys.stderr.flush()
            self._before = status
