"""The reference is generated from the code, and says something of every command, field, setting and file."""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def generator() -> Iterator[Any]:
    sys.path.insert(0, str(ROOT / "scripts"))
    try:
        import reference_pages
        import reference_pages.commands
        import reference_pages.file_tables
        import reference_pages.messages
        import reference_pages.settings

        yield reference_pages
    finally:
        sys.path.remove(str(ROOT / "scripts"))


@pytest.fixture(scope="module")
def pages(generator: Any) -> dict[str, str]:
    return generator.pages()


def test_every_command_has_a_text_and_every_option_a_meaning(generator: Any) -> None:
    found = dict(generator.commands.verbs())
    assert len(found) > 20
    silent = []
    for name, command in found.items():
        assert len((command.help or "").split()) > 3, name
        silent += [
            f"{name} {parameter.opts}"
            for parameter in command.params
            if "--help" not in parameter.opts and not getattr(parameter, "help", None)
        ]
    assert silent == []


def test_the_page_of_commands_holds_every_verb_option_and_exit_code(
    generator: Any, pages: dict[str, str]
) -> None:
    from subiaco_geo.errors import InputError, RegistrationError, SubiacoError

    page = pages["reference/commands.md"]
    for name, command in generator.commands.verbs():
        section = page.split(f"\n## {name}\n")[1].split("\n## ")[0]
        for parameter in command.params:
            options = [option for option in parameter.opts if option.startswith("--") and option != "--help"]
            assert all(f"`{option}`" in section for option in options), (name, options)
    codes = set(generator.commands.EXIT_CODES)
    assert {0, SubiacoError.exit_code, InputError.exit_code, RegistrationError.exit_code, 130, 143} == codes


def test_every_interface_and_every_field_has_a_meaning(generator: Any) -> None:
    found = list(generator.messages.interfaces())
    files = [
        path for kind in ("msg", "srv", "action") for path in (ROOT / "src/subiaco_msgs" / kind).iterdir()
    ]
    assert len(found) == len(files)
    for interface in found:
        assert len(interface.text.split()) > 3, interface.name
        for part in interface.parts:
            assert [f"{interface.name}.{f.name}" for f in part if len(f.text.split()) < 2] == []


def test_the_fields_of_the_page_are_those_of_the_files(generator: Any, tmp_path: Path) -> None:
    (tmp_path / "A.action").write_text(
        "# What it does.\n\nint32 a  # first\nstring[3] b  # second\n  # and more\n---\n---\nf/G g  # third\n"
    )
    read = generator.messages.read(tmp_path / "A.action", "action")
    assert read.text == "What it does."
    assert [[(f.type, f.name, f.text) for f in part] for part in read.parts] == [
        [("int32", "a", "first"), ("string[3]", "b", "second and more")],
        [],
        [("f/G", "g", "third")],
    ]


def test_every_setting_of_the_commands_stands_on_a_page(generator: Any, pages: dict[str, str]) -> None:
    for name, (_, model, _) in generator.settings.models().items():
        page = pages[f"reference/{name}.md"]
        for setting in generator.settings.settings(model):
            assert f"| `{setting.name}` |" in page
            assert setting.type
            assert setting.description


def test_a_setting_shows_unit_type_default_and_bounds(generator: Any) -> None:
    from pydantic import Field

    from subiaco_geo.config import StrictModel

    class Inner(StrictModel):
        size: float = Field(2.5, gt=0, le=9, description="Edge of a cell [m]; larger cells are faster")
        kind: int | None = Field(None, description="Number of the kind")

    class Outer(StrictModel):
        inner: Inner = Inner()

    size, kind = generator.settings.settings(Outer)
    assert (size.name, size.unit, size.type, size.default, size.bounds) == (
        "inner.size", "m", "number", "2.5", "> 0, ≤ 9",
    )  # fmt: skip
    assert size.description == "Edge of a cell; larger cells are faster"
    assert (kind.type, kind.default) == ("whole number or none", "none")


def _files(generator: Any, folder: str) -> dict[str, Any]:
    (found,) = [f for f in generator.file_tables.folders() if f.title == folder]
    return {file.name: file for file in found.files}


def test_the_columns_of_tables_are_those_that_are_written(generator: Any) -> None:
    from subiaco_change.history import COLUMNS as HISTORY
    from subiaco_change.outputs.change_directory_reading import RegistrationDocument, RunDocument
    from subiaco_change.outputs.difference_rasters import VOLUMES
    from subiaco_change.outputs.rasters import COVERAGE
    from subiaco_evaluation.injection.detectability import COLUMNS as INSERTED
    from subiaco_geo import map_tables
    from subiaco_geo.tile_uncertainty import TILE_COLUMNS

    mapped, changed = _files(generator, "Map directory"), _files(generator, "Change directory")
    assert list(mapped["heights.csv"].columns) == list(map_tables.HEIGHT_COLUMNS)
    assert list(mapped["uncertainty.csv"].columns) == map_tables._UNCERTAINTY_COLUMNS
    assert list(mapped["tile_uncertainty.csv"].columns) == list(TILE_COLUMNS)
    assert list(_files(generator, "History of several epochs")["history.csv"].columns) == list(HISTORY)
    calibrated = _files(generator, "Calibration by injection")
    assert list(calibrated["changes.csv"].columns) == list(INSERTED)
    delivered = _files(generator, "Delivery")
    assert list(delivered["volumes/volumes.csv"].columns) == list(VOLUMES)
    assert set(RunDocument.model_fields) <= set(changed["run.json"].columns)
    assert set(RegistrationDocument.model_fields) <= set(changed["registration.json"].columns)
    codes = changed["coverage.tif"].columns["1"]
    assert all(str(code) in codes for code in COVERAGE)


def test_every_file_of_a_change_run_is_on_the_page_with_its_columns(generator: Any, tmp_path: Path) -> None:
    import json
    import subprocess

    script = ROOT / "docs/tutorials/compare_two_clouds.py"
    subprocess.run([sys.executable, str(script), str(tmp_path)], check=True, capture_output=True)
    known = _files(generator, "Change directory")
    written = {path.name for path in (tmp_path / "change").iterdir()}
    assert written <= set(known), written - set(known)
    for name in ("run.json", "registration.json"):
        found = json.loads((tmp_path / "change" / name).read_text())
        assert list(found) == list(known[name].columns)
    blocks = tmp_path / "change/registration_blocks.csv"
    if blocks.is_file():
        assert blocks.read_text().splitlines()[0].split(",") == list(known["registration_blocks.csv"].columns)
    head = (tmp_path / "change/after_labelled.ply").read_bytes()[:2000].split(b"end_header")[0].decode()
    fields = re.findall(r"^property \w+ (\w+)$", head, flags=re.MULTILINE)
    described = ", ".join(known["before_labelled.ply"].columns).split(", ")
    assert set(fields) <= set(described)


def test_the_page_of_the_live_monitor_names_every_flag_and_no_other() -> None:
    from subiaco_mapping.health_monitor.flags import MEANINGS

    page = (ROOT / "docs/reference/live-monitor.md").read_text(encoding="utf-8")
    rows = [line.split("|")[1] for line in page.splitlines() if line.startswith("| `")]
    assert {name for row in rows for name in re.findall(r"`(\w+)`", row)} == set(MEANINGS)


def test_the_page_of_findings_names_every_code_that_a_run_may_state() -> None:
    stated = set()
    for path in sorted((ROOT / "src").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Finding":
                stated |= {arg.value for arg in node.args[:1] if isinstance(arg, ast.Constant)}
    page = (ROOT / "docs/reference/findings.md").read_text(encoding="utf-8")
    rows = [line.split("|")[1] for line in page.splitlines() if line.startswith("| `")]
    assert len(stated) > 12
    assert stated <= {name for row in rows for name in re.findall(r"`(\w+)`", row)}
