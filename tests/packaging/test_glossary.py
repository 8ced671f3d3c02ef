"""The glossary explains every term once, and no row of it is broken."""

from __future__ import annotations

import re
from pathlib import Path

PAGE = Path(__file__).resolve().parents[2] / "docs/glossary.md"


def _rows() -> list[list[str]]:
    lines = [line for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith("| ")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return [row for row in cells if row[0] != "term"]


def test_every_term_stands_once_with_a_meaning() -> None:
    terms = [term.strip().lower() for row in _rows() for term in re.split(r",\s+", row[0])]
    assert len(terms) > 60
    assert sorted(terms) == sorted(set(terms))
    assert all(len(row[1]) > 10 for row in _rows())


def test_every_row_has_a_word_of_each_field_or_a_dash() -> None:
    assert {len(row) for row in _rows()} == {2, 5}
    assert all(all(row) for row in _rows())
    assert sum(row[2] != "–" for row in _rows() if len(row) == 5) > 15, "words of ROS"
