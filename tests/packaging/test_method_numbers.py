"""No number that moves a label hides in a module: settings and the numbers of the method hold them all."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from subiaco_change.method_numbers import NUMBERS
from subiaco_geo.settings import setting_fields, setting_values

CHANGE = Path(__file__).resolve().parents[2] / "src" / "subiaco_change" / "subiaco_change"
DECIDING = (
    "decisions", "association", "segmentation", "instance_splitting", "registration", "level_of_detection",
    "tiling",
)  # fmt: skip
#: Constants with fractions that stay in their module, and why.
ALLOWED = {
    "decisions/confidence.py: PAPER_WEIGHTS": "the paper's score decides nothing",
    "decisions/confidence.py: _EPSILON": "keeps a logarithm finite",
    "segmentation/ground_model.py: _ABSENT": "marks a cell without height",
    "segmentation/raised_surfaces.py: _LATTICE": "tiles share their cells whatever its value",
    "segmentation/clustering.py: _HALF": "indices of neighbours",
    "tiling/epoch_stages.py: _BEAMS": "size of stored pieces of counted beams",
    "tiling/ground_stage.py: _SIGNS": "up and down",
}


def constants(source: str) -> list[str]:
    """Return the names of the assignments of a module whose value holds a number with a fraction."""
    found = []
    for node in ast.parse(source).body:
        if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None:
            continue
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        if any(isinstance(c, ast.Constant) and isinstance(c.value, float) for c in ast.walk(node.value)):
            found += [ast.unparse(target) for target in targets]
    return found


@pytest.mark.parametrize("folder", DECIDING)
def test_no_module_that_decides_holds_a_number_of_its_own(folder: str) -> None:
    hidden = [
        name
        for path in sorted((CHANGE / folder).rglob("*.py"))
        for constant in constants(path.read_text(encoding="utf-8"))
        if (name := f"{folder}/{path.name}: {constant}") not in ALLOWED
    ]
    assert not hidden, f"move to subiaco_change.method_numbers, with unit and meaning: {hidden}"


def test_the_check_sees_numbers_wherever_they_stand_in_a_value() -> None:
    source = "a = 1.5\nB: float = 2.0\nc = f(step=0.5)\nd = 3\ne = g.h\n\ndef k():\n    m = 0.1\n"
    assert constants(source) == ["a", "B", "c"]


def test_every_allowed_constant_exists() -> None:
    for name in ALLOWED:
        file, _, constant = name.partition(": ")
        assert f"\n{constant} " in (CHANGE / file).read_text(encoding="utf-8"), name


def test_every_number_is_described_and_used_by_the_module_that_its_section_names() -> None:
    fields = dict(setting_fields(type(NUMBERS)))
    assert set(setting_values(NUMBERS)) == set(fields)
    sources = "\n".join(path.read_text(encoding="utf-8") for path in CHANGE.rglob("*.py"))
    assert [name for name in fields if f"NUMBERS.{name}" not in sources] == []
    assert [name for name, field in fields.items() if not field.description] == []
