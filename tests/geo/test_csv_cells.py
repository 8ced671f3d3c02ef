"""No cell of a CSV is a formula, and every text comes back as it was."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from subiaco_geo.csv_cells import escape_cell, restore_cell


@given(st.text(max_size=20) | st.from_regex(r"[=+\-@].{0,10}"))
def test_a_text_comes_back_and_begins_with_no_sign_of_a_formula(text: str) -> None:
    escaped = escape_cell(text)
    if not text.startswith("'"):
        assert restore_cell(escaped) == text
    assert escaped in {text, f"'{text}"}


@pytest.mark.parametrize("text", ["=1+1", "@SUM(A1)", "+cmd|' /C calc'!A0", "-2+3", "\t=1", "=HYPERLINK(1)"])
def test_a_formula_is_escaped(text: str) -> None:
    assert escape_cell(text) == f"'{text}"


@pytest.mark.parametrize("text", ["-1", "+3.5", "-1e-3", "Added", "a=b", ""])
def test_numbers_and_words_stay(text: str) -> None:
    assert escape_cell(text) == text
