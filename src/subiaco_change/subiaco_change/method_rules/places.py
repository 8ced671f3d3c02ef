"""Places in the source at which rules are applied."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

_APPLY = ("switchable", "applies", "rule_mask")


def rule_places(package: Path | None = None) -> dict[str, list[str]]:
    """Return, by name of a rule, ``folder/module.py: function`` of every place that applies the rule.

    Parameters
    ----------
    package : Path, optional
        Folder of the sources; this package by default.
    """
    root = Path(__file__).parents[1] if package is None else package
    found: dict[str, list[str]] = {}
    for path in sorted(root.rglob("*.py")):
        if path.parent == Path(__file__).parent:
            continue
        for name, function in _applied(ast.parse(path.read_text(encoding="utf-8"))):
            found.setdefault(name, []).append(f"{path.relative_to(root).as_posix()}: {function}")
    return found


def _applied(module: ast.Module) -> Iterator[tuple[str, str]]:
    """Yield the rules that a module applies, each with the function at the top of the module that does."""
    for statement in module.body:
        for node in ast.walk(statement):
            called = isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in _APPLY
            if called and isinstance(node, ast.Call) and isinstance(node.args[0], ast.Constant):
                yield str(node.args[0].value), getattr(statement, "name", "module")
