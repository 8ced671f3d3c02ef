"""What the set-up of the demo takes out of its environment, and what it must not touch."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
SCRIPT = REPOSITORY / "scripts/slim_venv.py"


@pytest.fixture(scope="module")
def slim() -> ModuleType:
    spec = importlib.util.spec_from_file_location("slim_venv", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def put(path: Path, text: str = "x") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return path


def test_tests_samples_and_headers_go_and_modules_stay(slim: ModuleType, tmp_path: Path) -> None:
    site = tmp_path / "lib/python3/site-packages"
    gone = [
        put(site / "pandas/tests/io/test_sql.py"),
        put(site / "gtsam/Data/dlr.g2o"),
        put(site / "open3d/open3d_tf_ops.so"),
        put(tmp_path / "include/std_msgs/std_msgs/msg/header.h"),
        put(tmp_path / "share/std_msgs/cmake/std_msgsConfig.cmake"),
    ]
    kept = [
        put(site / "pandas/testing.py"),
        put(site / "open3d/libOpen3D.so.0.20"),
        put(tmp_path / "share/std_msgs/msg/Header.msg"),
        put(tmp_path / "lib/libaction_msgs__rosidl_typesupport_fastrtps_cpp.so"),
    ]
    slim.slim(tmp_path, site)
    assert not [path for path in gone if path.exists()]
    assert all(path.exists() for path in kept)


def test_copies_of_a_library_become_one_file(slim: ModuleType, tmp_path: Path) -> None:
    data = os.urandom(slim.WORTH)
    for name in ("libx.so", "libx.so.2"):
        (tmp_path / name).write_bytes(data)
    (tmp_path / "liby.so").write_bytes(os.urandom(slim.WORTH))
    slim.link_copies(tmp_path)
    assert [(tmp_path / name).stat().st_nlink for name in ("libx.so", "libx.so.2", "liby.so")] == [2, 2, 1]
    assert (tmp_path / "libx.so.2").read_bytes() == data


def test_the_viewer_of_open3d_is_imported_only_where_its_packages_are(
    slim: ModuleType, tmp_path: Path
) -> None:
    lines = "from ._external_visualizer import *\nfrom .draw_plotly import draw_plotly\n"
    file = put(tmp_path / "open3d/visualization/__init__.py", lines)
    (tmp_path / "dash").mkdir()
    slim.without_viewer(tmp_path)
    assert file.read_text() == lines
    (tmp_path / "dash").rmdir()
    slim.without_viewer(tmp_path)
    assert file.read_text() == "from ._external_visualizer import *\n"


def test_an_installation_of_python_is_never_touched(tmp_path: Path) -> None:
    base = getattr(sys, "_base_executable", sys.executable)
    link = tmp_path / "venv/bin/python"
    link.parent.mkdir(parents=True)
    link.symlink_to(base)
    put(tmp_path / "venv/pyvenv.cfg", f"home = {Path(base).parent}\n")
    code = f"import runpy; runpy.run_path({str(SCRIPT)!r})['environment']()"
    for python, options in ((base, []), (link, ["-S"])):
        result = subprocess.run(
            [python, *options, "-c", code], capture_output=True, text=True, check=False, timeout=60
        )
        assert result.returncode == 1
        assert "no virtual environment: nothing is touched" in result.stderr
