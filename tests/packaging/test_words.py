"""Readers meet the field's words: no household phrase in documentation, messages, pages and docstrings."""

from __future__ import annotations

import ast
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
#: The simulator states the hash of its own source with every scene, so that its words stay as they are.
FROZEN = "subiaco_sim"
MESSAGES = ROOT / "src/subiaco_msgs"
PHRASES = (
    r"goes? with",
    r"told (?:by|from|apart|wrong)",
    r"(?:be|been|is|are) told (?:what|nothing)",
    r"drove by",
    r"what stands",
    r"what moved",
    r"what is (?:gone|left of one)",
    r"held apart",
    r"walked",
    r"look again",
    r"look back",
    r"second look",
    r"lonely",
    r"likewise",
    r"such a",
    r"drawn by lot",
    r"beside each other",
    r"passes for",
    r"out of sight",
    r"no beam reached",
    r"seen by no beam",
    r"mended",
)
WORD = re.compile(rf"\b(?:{'|'.join(PHRASES)})\b", re.IGNORECASE)


def found_in(text: str) -> list[str]:
    """Return the household phrases of a text, across line ends."""
    joined = re.sub(r"\s+", " ", text)
    return [m[0] for m in WORD.finditer(joined)]


def pages() -> list[Path]:
    front = [ROOT / f"{name}.md" for name in ("README", "CONTRIBUTING", "CHANGELOG")]
    documents = [*front, *(ROOT / "docs").rglob("*.md")]
    templates = [p for ending in ("*.j2", "*.html") for p in (ROOT / "src").rglob(ending)]
    interfaces = [p for kind in ("msg", "srv", "action") for p in (MESSAGES / kind).iterdir()]
    configs = [*(ROOT / "src/subiaco_bringup/config").rglob("*.yaml")]
    return sorted([*documents, *templates, *interfaces, *configs])


def strings() -> Iterator[tuple[str, str]]:
    """Yield every string of the sources with its place, also docstrings and parts of formatted strings."""
    for path in sorted((ROOT / "src").rglob("*.py")):
        if FROZEN in path.parts:
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                yield f"{path.relative_to(ROOT)}:{node.lineno}", node.value


@pytest.mark.parametrize("page", pages(), ids=lambda page: page.relative_to(ROOT).as_posix())
def test_a_page_uses_no_household_phrase(page: Path) -> None:
    assert found_in(page.read_text(encoding="utf-8")) == []


def test_no_string_of_the_sources_uses_a_household_phrase() -> None:
    found = {place: words for place, text in strings() if (words := found_in(text))}
    assert found == {}


def test_no_comment_and_no_string_of_the_tree_uses_a_household_phrase() -> None:
    """Comments everywhere, and strings of tests and scripts; those of the sources are read above."""
    found = {}
    for path in sorted(p for folder in ("src", "tests", "scripts") for p in (ROOT / folder).rglob("*.py")):
        if FROZEN in path.parts or path.name in {"test_words.py", "test_setting_descriptions.py"}:
            continue
        with path.open(encoding="utf-8") as stream:
            for token in tokenize.generate_tokens(stream.readline):
                checked = token.type == tokenize.COMMENT or (
                    token.type == tokenize.STRING and ROOT / "src" not in path.parents
                )
                if checked and (words := found_in(token.string)):
                    found[f"{path.relative_to(ROOT)}:{token.start[0]}"] = words
    assert found == {}


def test_a_phrase_is_found_across_lines_and_a_similar_word_is_not() -> None:
    assert found_in("a hedge is told\n   from a wall") == ["told from"]
    assert found_in("the untold rest; a setting such as a leaf") == []
