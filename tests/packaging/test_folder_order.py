"""Data flows one way: a part of a package imports only parts that stand before it in the package."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

SOURCES = Path(__file__).resolve().parents[2] / "src"
#: Folders and modules of the large packages, from what knows nothing of the others to what joins all.
ORDER = {
    "subiaco_mapping": [
        "measurements", "method_numbers", "topic_names", "request", "named_bags", "robust_plane",
        "planes_in_cubes",
        "control_points", "control",
        "preprocessing", "importers", "recording",
        "odometry",
        "pose_graph", "loop_closure", "manifest", "sequences", "absolute_positions", "survey_graph",
        "fusion", "map_quality",
        "health_monitor",
        "backend", "nodes",
        "checkpoint", "recordings", "pipeline", "job",
        "inspection", "calibration",
    ],
    "subiaco_change": [
        "records", "request", "extensions", "given_classes", "input_checks",
        "method_numbers", "method_rules", "geometry", "quantiles", "view_from_above", "survey_places",
        "visibility_tests", "visibility_evidence",
        "segmentation", "objects", "point_spacing",
        "registration", "level_of_detection",
        "association", "instance_splitting", "decisions",
        "strategies", "tiling", "outputs",
        "pipeline", "job", "dry_run", "history", "nodes",
    ],
    "subiaco_evaluation": [
        "truth", "layouts", "grid", "scores", "families",
        "object_matching", "near_gate", "paired", "reliability_plot", "score_files", "scoring",
        "rule_runner", "rule_study", "ablation_study", "confidence_fit",
        "injection", "baselines", "learned", "baseline_run",
    ],
}  # fmt: skip
#: Joins the settings of all folders to one model, and every folder may read this model.
SETTINGS = "config"


def parts(package: str) -> set[str]:
    """Return the folders and the modules of a package."""
    root = SOURCES / package / package
    folders = {path.parent.name for path in root.glob("*/__init__.py")}
    return folders | {path.stem for path in root.glob("*.py")} - {"__init__"}


def imported(source: str, package: str) -> Iterator[str]:
    """Yield the parts of a package that a module imports, also inside of functions and for its types."""
    for node in ast.walk(ast.parse(source)):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module == package:
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = [node.module]
        yield from (name.split(".")[1] for name in names if name.startswith(f"{package}."))


@pytest.mark.parametrize("package", ORDER)
def test_the_order_names_every_part_once(package: str) -> None:
    assert sorted([*ORDER[package], SETTINGS]) == sorted(parts(package))


@pytest.mark.parametrize("package", ORDER)
def test_every_part_imports_only_parts_that_stand_before_it(package: str) -> None:
    order, root = ORDER[package], SOURCES / package / package
    wrong = []
    for path in sorted(root.rglob("*.py")):
        own = path.relative_to(root).parts[0].removesuffix(".py")
        if own in (SETTINGS, "__init__"):
            continue
        for other in imported(path.read_text(encoding="utf-8"), package):
            if other not in (own, SETTINGS) and order.index(other) > order.index(own):
                wrong.append(f"{path.relative_to(root)} imports {other}")
    assert wrong == []


def test_the_check_sees_imports_of_every_form() -> None:
    source = (
        "import subiaco_mapping.fusion.config\nfrom subiaco_mapping import job\n"
        "def f():\n    from subiaco_mapping.odometry.frontend import x\n"
    )
    assert sorted(imported(source, "subiaco_mapping")) == ["fusion", "job", "odometry"]
