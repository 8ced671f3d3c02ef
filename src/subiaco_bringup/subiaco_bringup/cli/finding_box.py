"""Findings of a change run on the terminal, each once: while the run goes on, or else at its end."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import typer


class _Memory(logging.Handler):
    """Remembers the lines of a log."""

    def __init__(self) -> None:
        super().__init__()
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Keep a line."""
        self.lines.append(record.getMessage())


@contextmanager
def remembered_log() -> Iterator[list[str]]:
    """Yield the lines that the change method logs inside, as far as the user sees them."""
    memory, log = _Memory(), logging.getLogger("subiaco_change")
    log.addHandler(memory)
    try:
        yield memory.lines
    finally:
        log.removeHandler(memory)


def say_findings(directory: Path, said: Sequence[str] = (), *, quiet: bool = False) -> None:
    """Say the findings of a change directory that the log has not said; serious ones also where quiet.

    Parameters
    ----------
    directory : Path
    said : sequence of str
        Of :func:`remembered_log`.
    quiet : bool
        Only errors are asked for: leave warnings out.
    """
    run = json.loads((directory / "run.json").read_text(encoding="utf-8"))
    again = 0
    for found in run.get("findings", []):
        serious = found["severity"] == "serious"
        if any(found["sentence"] in line for line in said):
            again += serious
        elif serious or (found["severity"] == "warning" and not quiet):
            typer.secho(
                f"{directory}: {found['sentence']} {found['remedy']}".rstrip(),
                err=True, fg="red" if serious else "yellow",
            )  # fmt: skip
    if again:
        typer.secho(
            f"{directory}: {again} serious finding{'' if again == 1 else 's'}, printed above and at the top"
            " of report.html",
            err=True, fg="red",
        )  # fmt: skip
