"""Every setting has a description that can be read alone, in config.yaml, in --help and in an error."""

from __future__ import annotations

import ast
import re
from dataclasses import dataclass
from pathlib import Path

import pytest

SOURCES = Path(__file__).resolve().parents[2] / "src"
#: The simulator states the hash of its own source with every scene; its descriptions stay as they are.
FROZEN = "subiaco_sim"

BEGINNINGS = (
    "and",
    "but",
    "it",
    "likewise",
    "or",
    "same",
    "such",
    "that",
    "the same",
    "these",
    "this",
    "those",
)
PHRASES = (
    "go with",
    "goes with",
    "held apart",
    "likewise",
    "lonely",
    "look again",
    "second look",
    "such a",
    "the same as above",
    "told by",
    "told from",
    "drove by",
    "walked",
    "what stands",
)
UNITS = {
    "1", "1/m", "GB", "MB", "bytes", "cells", "days", "deg", "m", "m or 1", "m/m", "m/s", "m/s2",
    "m/s2/sqrt(s)", "m2", "m3", "messages", "min", "ms", "ns", "rad", "rad/s", "s", "years",
}  # fmt: skip
#: Words that say that a number has no unit.
PURE = ("coefficient", "factor", "fraction", "multiple", "number of", "odds", "probability", "ratio",
        "standard deviations", "weight")  # fmt: skip
#: Units that the name of a setting states.
SUFFIXES = {
    "_bytes": "bytes",
    "_days": "days",
    "_deg": "deg",
    "_gb": "GB",
    "_mb": "MB",
    "_minutes": "min",
    "_ns": "ns",
}


@dataclass(frozen=True)
class Setting:
    """One field of a settings model: where it is, its type, and its description if it has one."""

    place: str
    name: str
    annotation: str
    description: str | None


def models() -> list[tuple[Path, ast.ClassDef]]:
    """Classes that derive from StrictModel, by the names of their bases, with the file of each.

    The source is parsed and not imported: nodes import ROS, which not every machine has.
    """
    classes = [
        (path, node)
        for path in sorted(SOURCES.rglob("*.py"))
        if FROZEN not in path.parts
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.ClassDef)
    ]
    names = {"StrictModel"}
    while True:
        found = [(p, c) for p, c in classes if names & {ast.unparse(base) for base in c.bases}]
        if {c.name for _, c in found} <= names:
            return found
        names |= {c.name for _, c in found}


def description_of(value: ast.expr | None) -> str | None:
    keywords = value.keywords if isinstance(value, ast.Call) else []
    texts = [ast.literal_eval(k.value) for k in keywords if k.arg == "description"]
    return str(texts[0]) if texts else None


def settings() -> list[Setting]:
    """Fields of all models; a field that is a model itself is described by its own fields."""
    found = models()
    names = {c.name for _, c in found}
    return [
        Setting(
            f"{path.relative_to(SOURCES).as_posix()}: {model.name}.{field.target.id}",
            field.target.id,
            ast.unparse(field.annotation),
            description_of(field.value),
        )
        for path, model in found
        for field in model.body
        if isinstance(field, ast.AnnAssign)
        and isinstance(field.target, ast.Name)
        and ast.unparse(field.annotation) not in names
        and not ast.unparse(field.annotation).startswith("ClassVar")
    ]


SETTINGS = settings()


def texts() -> list[tuple[Setting, str]]:
    return [(setting, setting.description or "") for setting in SETTINGS]


def test_the_settings_of_every_room_are_found() -> None:
    rooms = {setting.place.split("/")[0] for setting in SETTINGS}
    assert {"subiaco_geo", "subiaco_mapping", "subiaco_change"} <= rooms
    assert len(SETTINGS) > 700


def test_every_setting_is_described_in_three_words_or_more() -> None:
    assert [setting.place for setting, text in texts() if len(text.split()) < 3] == []


def test_no_description_begins_as_if_another_stood_before_it() -> None:
    begins = re.compile(rf"(?:{'|'.join(BEGINNINGS)})\b", re.IGNORECASE)
    assert [f"{setting.place}: {text}" for setting, text in texts() if begins.match(text)] == []


@pytest.mark.parametrize("phrase", PHRASES)
def test_no_description_uses_a_phrase_that_readers_have_to_guess(phrase: str) -> None:
    word = re.compile(rf"\b{re.escape(phrase)}\b", re.IGNORECASE)
    assert [f"{setting.place}: {text}" for setting, text in texts() if word.search(text)] == []


def test_units_in_brackets_are_units() -> None:
    found = {unit for _, text in texts() for unit in re.findall(r"\[([^\]]*)\]", text)}
    assert found <= UNITS


def test_every_float_states_its_unit_or_says_that_it_has_none() -> None:
    floats = [(s, t) for s, t in texts() if s.annotation in ("float", "float | None")]
    assert len(floats) > 400
    silent = [s.place for s, t in floats if "[" not in t and not any(word in t.lower() for word in PURE)]
    assert silent == []


def test_a_unit_in_the_name_of_a_setting_is_that_of_its_description() -> None:
    named = [(s, t, unit) for s, t in texts() for suffix, unit in SUFFIXES.items() if s.name.endswith(suffix)]
    assert len(named) > 30
    assert [s.place for s, t, unit in named if f"[{unit}]" not in t] == []
