"""Bytecode that set-up writes, so that no process compiles the modules again."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).resolve().parents[2] / "scripts/write_bytecode.py"


def write_bytecode(folder: Path) -> subprocess.CompletedProcess[str]:
    """Run the script on the package of a folder, where Python is told to write none."""
    environment = os.environ | {"PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    return subprocess.run(
        [sys.executable, str(SCRIPT), "surveyed"],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )


def package(folder: Path, **modules: str) -> Path:
    """Write a package with these modules; return where its bytecode belongs."""
    (folder / "surveyed").mkdir()
    for name, text in {"__init__": "", **modules}.items():
        (folder / "surveyed" / f"{name}.py").write_text(text, encoding="utf-8")
    return folder / "surveyed/__pycache__"


def test_every_module_has_bytecode_even_where_python_is_told_to_write_none(tmp_path: Path) -> None:
    kept = package(tmp_path, roads="from surveyed import lanes", lanes="WIDTH = 3.5")
    assert write_bytecode(tmp_path).returncode == 0
    assert sorted(path.name.partition(".")[0] for path in kept.iterdir()) == ["__init__", "lanes", "roads"]


def test_a_module_whose_own_imports_are_not_installed_is_left_out(tmp_path: Path) -> None:
    kept = package(tmp_path, learned="import a_network_that_nobody_has", roads="")
    assert write_bytecode(tmp_path).returncode == 0
    assert any(path.name.startswith("roads.") for path in kept.iterdir())


def test_a_program_is_not_started(tmp_path: Path) -> None:
    package(tmp_path, __main__="raise SystemExit(3)")
    assert write_bytecode(tmp_path).returncode == 0


def test_a_module_that_fails_is_named(tmp_path: Path) -> None:
    package(tmp_path, roads="1 / 0")
    done = write_bytecode(tmp_path)
    assert done.returncode != 0
    assert "roads.py" in done.stderr
