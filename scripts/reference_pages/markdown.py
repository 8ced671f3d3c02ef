"""Cells and tables of Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

GENERATED = "*Generated from the code when the documentation is built.*"


def cell(text: object) -> str:
    """Return a text that stands in one cell of a table."""
    return " ".join(str(text).replace("|", "\\|").split())


def code(text: object) -> str:
    """Return a text as code; pipes are kept apart, because they end a cell."""
    return f"`{cell(text)}`" if str(text) else ""


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table; cells are already escaped."""
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)]) + "\n"
