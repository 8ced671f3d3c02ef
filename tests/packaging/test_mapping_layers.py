"""The mapping package is built in one direction: each part imports only parts that stand before it."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[2] / "src/subiaco_mapping/subiaco_mapping"
#: Folders and modules of the package, from what knows nothing of the others to what joins all.
ORDER = [
    "measurements", "method_numbers", "topic_names", "request", "named_bags", "robust_plane",
    "control_points", "control",
    "preprocessing", "importers", "recording",
    "odometry",
    "pose_graph", "loop_closure", "manifest", "sequences", "absolute_positions", "survey_graph",
    "fusion", "map_quality",
    "health_monitor",
    "backend", "nodes",
    "checkpoint", "recordings", "pipeline", "job",
    "inspection", "calibration",
]  # fmt: skip
#: Joins the settings of all folders to one model, and every folder may read this model.
SETTINGS = "config"


def parts() -> set[str]:
    """Return the folders and the modules of the package."""
    folders = {path.parent.name for path in PACKAGE.glob("*/__init__.py")}
    return folders | {path.stem for path in PACKAGE.glob("*.py")} - {"__init__"}


def imported(source: str) -> Iterator[str]:
    """Yield the parts that a module imports, also inside of functions."""
    for node in ast.walk(ast.parse(source)):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module == PACKAGE.name:
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = [node.module]
        yield from (name.split(".")[1] for name in names if name.startswith(f"{PACKAGE.name}."))


def test_the_order_names_every_part_once() -> None:
    assert sorted([*ORDER, SETTINGS]) == sorted(parts())


def test_every_part_imports_only_parts_that_stand_before_it() -> None:
    wrong = []
    for path in sorted(PACKAGE.rglob("*.py")):
        own = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
        if own in (SETTINGS, "__init__"):
            continue
        for other in imported(path.read_text(encoding="utf-8")):
            if other not in (own, SETTINGS) and ORDER.index(other) > ORDER.index(own):
                wrong.append(f"{path.relative_to(PACKAGE)} imports {other}")
    assert wrong == []


def test_the_check_sees_imports_of_every_form() -> None:
    source = (
        "import subiaco_mapping.fusion.config\nfrom subiaco_mapping import job\n"
        "def f():\n    from subiaco_mapping.odometry.frontend import x\n"
    )
    assert sorted(imported(source)) == ["fusion", "job", "odometry"]
