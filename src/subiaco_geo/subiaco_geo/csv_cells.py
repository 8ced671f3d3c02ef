"""Texts in CSV cells that a spreadsheet would take for formulas: escaped when written, restored when read."""

from __future__ import annotations

import re

_FORMULA = re.compile(r"^[=+\-@\t\r]")
_NUMBER = re.compile(r"^[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?$")
_ESCAPED = re.compile(r"^'[=+\-@\t\r]")


def escape_cell(text: str) -> str:
    """Return a text with an apostrophe before a first sign that a spreadsheet evaluates; numbers stay."""
    return f"'{text}" if _FORMULA.match(text) and not _NUMBER.match(text) else text


def restore_cell(text: str) -> str:
    """Return a text without the apostrophe that :func:`escape_cell` put before it."""
    return text[1:] if _ESCAPED.match(text) and not _NUMBER.match(text[1:]) else text
