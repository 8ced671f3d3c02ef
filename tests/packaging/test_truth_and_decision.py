"""Truth and decision share no code and no thresholds: the gates of the truth are those of the publication."""

from __future__ import annotations

import ast
from pathlib import Path

import yaml

from subiaco_evaluation.families import NEVER_TUNED, TUNED
from subiaco_sim.families.config import Family
from subiaco_sim.labels import GROUND_AREA, GROUND_RISE, MOBILE_CENTROID, MOBILE_IOU, RULES
from subiaco_sim.scene import BUILDING, VEGETATION

REPOSITORY = Path(__file__).resolve().parents[2]
SIMULATOR = REPOSITORY / "src" / "subiaco_sim"


def imported_by(path: Path) -> set[str]:
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
    return found


def test_the_simulator_imports_nothing_but_the_shared_package_of_formats_and_frames() -> None:
    modules = sorted(SIMULATOR.rglob("*.py"))
    assert len(modules) > 40
    ours = {name for path in modules for name in imported_by(path) if name.startswith("subiaco")}
    assert {name.split(".")[0] for name in ours} <= {"subiaco_sim", "subiaco_geo"}


def test_the_gates_of_the_truth_are_the_numbers_of_the_publication() -> None:
    building, plant = RULES[BUILDING], RULES[VEGETATION]
    assert (building.iou_changed, building.iou_unchanged, building.centroid) == (0.10, 0.20, 1.5)
    assert (building.height, building.volume) == (0.50, 0.10)
    assert (plant.iou_changed, plant.iou_unchanged, plant.centroid) == (0.08, 0.20, 2.0)
    assert (plant.height, plant.volume) == (0.30, 0.15)
    assert (GROUND_RISE, GROUND_AREA) == (0.15, 25.0)
    assert (MOBILE_IOU, MOBILE_CENTROID) == (0.20, 2.0)


def test_the_modules_that_label_the_truth_hold_their_numbers_as_literals() -> None:
    for name in ("labels.py", "gate_margins.py"):
        read = imported_by(SIMULATOR / "subiaco_sim" / name)
        assert {
            module.removeprefix("subiaco_geo.") for module in read if module.startswith("subiaco_geo")
        } <= {
            "clouds",
            "codes",
            "frames",
        }


def test_one_family_is_never_tuned_on_and_has_no_seeds_to_tune_or_fit_on() -> None:
    seeds = yaml.safe_load((REPOSITORY / "config" / "seeds.yaml").read_text(encoding="utf-8"))
    families = seeds["families"]
    assert set(families) == {str(family) for family in Family}
    assert seeds["never_tuned"] == NEVER_TUNED
    assert families[NEVER_TUNED]["tuning"] == families[NEVER_TUNED]["calibration"] == []
    assert families[TUNED]["tuning"]
    for family in families.values():
        assert not set(family["reporting"]) & {
            *family["tuning"],
            *family["calibration"],
            *family.get("check", []),
        }
