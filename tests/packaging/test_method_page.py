"""The page that explains the method holds every heading that the code cites."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs/explanation/method.md"
DECISIONS = 21

_DECISION = re.compile(r"\bDecisions?\s+(\d+)(?:\s+(and|to)\s+(\d+))?")
_PART = re.compile(r"\b(?:parts?|method)\s+([A-H]\d*)\b(?:\s+and\s+([A-H]\d*)\b)?")
_NAMED_PART = re.compile(r"\bpart\s+([A-H]),\s+\*([a-z ]+)\*")


def _cited_decisions(text: str) -> set[int]:
    found: set[int] = set()
    for first, joint, last in _DECISION.findall(text):
        found.update(range(int(first), int(last) + 1) if joint == "to" else [int(first)])
        if joint == "and":
            found.add(int(last))
    return found


def _cited_parts(text: str) -> set[str]:
    found = {name for pair in _PART.findall(text) for name in pair if name}
    return found | {f"{letter}, {name}" for letter, name in _NAMED_PART.findall(text)}


def _headings() -> list[str]:
    return re.findall(r"^#+ (.+)$", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)


def _sources() -> list[Path]:
    files = [p for pattern in ("*.py", "*.yaml") for p in (ROOT / "src").rglob(pattern)]
    return [p for p in files if not {"build", "install"} & set(p.parts)]


def test_a_citation_is_read_whole() -> None:
    assert _cited_decisions("(method, Decisions 8 to 11) and Decisions 3 and 12, Decision 5") == {
        3, 5, 8, 9, 10, 11, 12,
    }  # fmt: skip
    assert _cited_parts("(method, parts C3 and C4); method B7; part A, *moving things*") == {
        "C3", "C4", "B7", "A", "A, moving things",
    }  # fmt: skip


def test_every_decision_that_the_code_cites_is_a_heading() -> None:
    written = {int(n) for h in _headings() for n in re.findall(r"^Decision (\d+): \S", h)}
    cited = set().union(*(_cited_decisions(p.read_text(encoding="utf-8")) for p in _sources()))
    assert len(cited) > 10, "the search for citations finds nothing"
    assert written == set(range(1, DECISIONS + 1))
    assert not cited - written


def test_every_part_that_the_code_cites_is_a_heading() -> None:
    headings = [m[1] for h in _headings() if (m := re.match(r"Part ([A-H]\d*(?:, [a-z ]+)?)(?::|$)", h))]
    cited = set().union(*(_cited_parts(p.read_text(encoding="utf-8")) for p in _sources()))
    assert len(cited) > 8, "the search for citations finds nothing"
    assert not cited - set(headings)


@pytest.mark.parametrize("number", range(1, DECISIONS + 1))
def test_every_decision_says_what_the_paper_says_what_we_do_why_and_which_setting(number: int) -> None:
    sections = re.split(r"^#+ ", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)
    (section,) = [s for s in sections if s.startswith(f"Decision {number}:")]
    for field in ("**Paper.**", "**Here.**", "**Why.**", "**Setting.**"):
        assert field in section, f"Decision {number} lacks {field}"


def test_every_setting_that_the_page_names_exists() -> None:
    from subiaco_change.config import ChangeConfig
    from subiaco_mapping.config import MappingConfig

    known = _paths(ChangeConfig()) | _paths(MappingConfig())
    named = re.findall(r"`([a-z_]+(?:\.[a-z_*]+)+)(?:: [^`]*)?`", PAGE.read_text(encoding="utf-8"))
    files = (".py", ".yaml", ".laz", ".csv", ".tif", ".json", ".md", ".html")
    settings = [n for n in named if not n.endswith(files)]
    assert len(settings) > 40
    missing = [n for n in settings if not any(re.fullmatch(_pattern(n), k) for k in known)]
    assert not missing


def _pattern(name: str) -> str:
    return re.escape(name).replace(r"\*", ".*")


def _paths(model: object, prefix: str = "") -> set[str]:
    found: set[str] = set()
    for name in type(model).model_fields:  # type: ignore[attr-defined]
        value = getattr(model, name)
        found.add(prefix + name)
        if hasattr(type(value), "model_fields"):
            found |= _paths(value, f"{prefix}{name}.")
    return found
