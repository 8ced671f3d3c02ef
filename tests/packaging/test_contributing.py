"""CONTRIBUTING leads to places that exist and say of themselves what it says of them."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
TEXT = (REPOSITORY / "CONTRIBUTING.md").read_text(encoding="utf-8")
QUESTIONS = re.findall(r"^\| ([^|]+\?) \| `([^`]+)` \| (.+) \|$", TEXT, re.MULTILINE)


def module(path: str) -> Path:
    """File of a module that is named from its package on."""
    return REPOSITORY / "src" / path.partition("/")[0] / path


def test_a_newcomer_finds_25_questions_answered() -> None:
    assert len(QUESTIONS) >= 25


@pytest.mark.parametrize(("question", "path", "answer"), QUESTIONS, ids=[row[0] for row in QUESTIONS])
def test_the_file_that_answers_a_question_begins_with_the_answer(
    question: str, path: str, answer: str
) -> None:
    found = ast.get_docstring(ast.parse(module(path).read_text(encoding="utf-8")))
    assert found is not None, question
    assert found.splitlines()[0] == answer


def test_every_folder_and_script_that_is_named_exists() -> None:
    for package, folders in re.findall(r"^\| `(subiaco\w*)` \| (.+?) \| .+ \|$", TEXT, re.MULTILINE):
        for folder in re.findall(r"`(\w+)/`", folders):
            assert (REPOSITORY / "src" / package / package / folder).is_dir(), f"{package}/{folder}"
    for script in re.findall(r"(scripts/[\w.]+)", TEXT):
        assert (REPOSITORY / script).is_file(), script
