"""No number that moves a label hides in a module: settings and the numbers of the method hold them all."""

from __future__ import annotations

import ast
import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from subiaco_change.config import ChangeConfig
from subiaco_change.method_numbers import NUMBERS
from subiaco_geo.settings import METHOD_VERSION, setting_fields, setting_values
from subiaco_geo.work.tasks import fingerprint
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.method_numbers import NUMBERS as MAPPING_NUMBERS

REPOSITORY = Path(__file__).resolve().parents[2]
SOURCES = REPOSITORY / "src"
PACKAGES = ("subiaco_change", "subiaco_mapping", "subiaco_geo")
CHANGE, MAPPING, GEO = (SOURCES / name / name for name in PACKAGES)
DECIDING = [
    *(CHANGE / folder for folder in (
        "decisions", "association", "segmentation", "instance_splitting", "registration",
        "level_of_detection", "tiling",
    )),
    *(MAPPING / folder for folder in (
        "absolute_positions", "fusion", "loop_closure", "odometry", "pose_graph", "preprocessing",
        "survey_graph",
    )),
    GEO / "free_space",
]  # fmt: skip
#: Constants with fractions that stay in their module, and why.
ALLOWED = {
    "decisions/confidence.py: PAPER_WEIGHTS": "the paper's score decides nothing",
    "decisions/confidence.py: _EPSILON": "keeps a logarithm finite",
    "segmentation/ground_model.py: _ABSENT": "marks a cell without height",
    "segmentation/raised_surfaces.py: _LATTICE": "tiles share their cells whatever its value",
    "tiling/epoch_stages.py: _BEAMS": "size of stored pieces of counted beams",
    "tiling/ground_stage.py: _SIGNS": "up and down",
    "absolute_positions/control_ties.py: _UPWARDS": "the vertical",
    "fusion/finishing.py: _FAR": "where coordinates need an origin of their own",
    "fusion/full_density.py: _STEP": "resolution of stored coordinates",
    "fusion/preview.py: _RANGE": "the preview decides nothing",
    "fusion/projection.py: _BASIS": "step of a difference quotient",
    "preprocessing/imu_clock.py: SECOND": "a unit",
    "preprocessing/scan_spool.py: _BEAM_OFFSET": "bound of stored coordinates",
    "preprocessing/velocity_filter.py: SECOND": "a unit",
    "free_space/depth_images.py: _FARTHEST": "the largest value of 16 bits",
    "free_space/view_estimation.py: _ANGLES": "from the horizon to the zenith",
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


@pytest.mark.parametrize("folder", DECIDING, ids=lambda folder: f"{folder.parent.name}/{folder.name}")
def test_no_module_that_decides_holds_a_number_of_its_own(folder: Path) -> None:
    hidden = [
        name
        for path in sorted(folder.rglob("*.py"))
        for constant in constants(path.read_text(encoding="utf-8"))
        if (name := f"{folder.name}/{path.name}: {constant}") not in ALLOWED
    ]
    assert not hidden, f"move to the method_numbers of the package, with unit and meaning: {hidden}"


def test_the_check_sees_numbers_wherever_they_stand_in_a_value() -> None:
    source = "a = 1.5\nB: float = 2.0\nc = f(step=0.5)\nd = 3\ne = g.h\n\ndef k():\n    m = 0.1\n"
    assert constants(source) == ["a", "B", "c"]


def test_every_allowed_constant_exists() -> None:
    folders = {folder.name: folder for folder in DECIDING}
    for name in ALLOWED:
        file, _, constant = name.partition(": ")
        folder, _, module = file.partition("/")
        assert f"\n{constant} " in (folders[folder] / module).read_text(encoding="utf-8"), name


@pytest.mark.parametrize(("numbers", "package"), [(NUMBERS, CHANGE), (MAPPING_NUMBERS, MAPPING)])
def test_every_number_is_described_and_used_by_the_module_that_its_section_names(
    numbers: Any, package: Path
) -> None:
    fields = dict(setting_fields(type(numbers)))
    assert set(setting_values(numbers)) == set(fields)
    sources = "\n".join(path.read_text(encoding="utf-8") for path in package.rglob("*.py"))
    sources += "\n".join(path.read_text(encoding="utf-8") for path in (GEO / "free_space").rglob("*.py"))
    named = {name: f"NUMBERS.{name}".replace("NUMBERS.free_space.", "FREE_SPACE.") for name in fields}
    assert [name for name, use in named.items() if use not in sources] == []
    assert [name for name, field in fields.items() if not field.description] == []


def numbers_in_kernels(source: str) -> list[str]:
    """Return the compiled functions of a module that read a number of the method as a global."""
    body = ast.parse(source).body
    numbers = {
        name.id
        for node in body
        if isinstance(node, ast.Assign) and re.search(r"\b(NUMBERS|FREE_SPACE)\b", ast.unparse(node.value))
        for target in node.targets
        for name in ast.walk(target)
        if isinstance(name, ast.Name)
    } | {"NUMBERS", "FREE_SPACE"}
    return [
        node.name
        for node in body
        if isinstance(node, ast.FunctionDef)
        and any("njit" in ast.unparse(decorator) for decorator in node.decorator_list)
        and numbers & {name.id for name in ast.walk(node) if isinstance(name, ast.Name)}
    ]


def test_no_compiled_function_reads_a_number_as_a_global() -> None:
    """The compiled form is stored by the text of its file: a number that changed elsewhere is not noticed."""
    assert numbers_in_kernels("A = NUMBERS.x.y\n\n@numba.njit\ndef f(x):\n    return A * x\n") == ["f"]
    found = [
        f"{path.name}: {name}"
        for path in sorted(SOURCES.rglob("*.py"))
        for name in numbers_in_kernels(path.read_text(encoding="utf-8"))
    ]
    assert found == [], "hand the numbers over as arguments"


def test_the_version_of_the_method_rises_with_its_numbers() -> None:
    now = {
        "change": fingerprint(setting_values(ChangeConfig()) | setting_values(NUMBERS))[:16],
        "mapping": fingerprint(setting_values(MappingConfig()) | setting_values(MAPPING_NUMBERS))[:16],
    }
    versions = yaml.safe_load((REPOSITORY / "config" / "method_versions.yaml").read_text(encoding="utf-8"))
    assert list(versions)[-1] == METHOD_VERSION, "config/method_versions.yaml ends with another version"
    assert versions[METHOD_VERSION] == now, (
        "A default or a number of the method changed, so results are those of another method. Raise "
        f"METHOD_VERSION in subiaco_geo/settings.py and add it to config/method_versions.yaml with {now}"
    )
