"""Data flows one way: a folder imports from itself and from the folders before it."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

SOURCES = Path(__file__).resolve().parents[2] / "src"
ORDER = {
    "subiaco_change": (
        "method_numbers", "method_rules", "segmentation", "registration", "level_of_detection", "objects",
        "association", "instance_splitting", "decisions", "tiling", "outputs", "nodes",
    ),
}  # fmt: skip


def imported_folders(path: Path, package: str) -> set[str]:
    """Name the folders of a package that a module imports from, as it runs or for its types."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    names = [n.module for n in ast.walk(tree) if isinstance(n, ast.ImportFrom) and n.module and not n.level]
    names += [a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names]
    return {name.split(".")[1] for name in names if name.startswith(f"{package}.")}


@pytest.mark.parametrize("package", ORDER)
def test_every_folder_of_a_package_has_its_place_in_the_order(package: str) -> None:
    folders = {path.parent.name for path in (SOURCES / package / package).glob("*/__init__.py")}
    assert folders == set(ORDER[package])


@pytest.mark.parametrize("package", ORDER)
def test_a_folder_imports_from_no_folder_behind_it(package: str) -> None:
    order = ORDER[package]
    root = SOURCES / package / package
    against = [
        f"{path.relative_to(root)} imports {name}"
        for place, folder in enumerate(order)
        for path in sorted((root / folder).rglob("*.py"))
        for name in sorted(imported_folders(path, package) & set(order[place + 1 :]))
    ]
    assert against == []
