"""The unit that records in the vehicle: its options, paths and signals are those of the command."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
import typer

REPOSITORY = Path(__file__).resolve().parents[2]
UNIT = REPOSITORY / "src" / "subiaco_bringup" / "systemd" / "subiaco-record.service"


def settings() -> dict[str, list[str]]:
    """Return ``Section.Key`` to its values."""
    found: dict[str, list[str]] = {}
    section = ""
    for line in UNIT.read_text().splitlines():
        if line.startswith("["):
            section = line.strip("[]")
        elif line and not line.startswith("#"):
            key, _, value = line.partition("=")
            found.setdefault(f"{section}.{key}", []).append(value)
    return found


def environment() -> dict[str, str]:
    return dict(value.split("=", 1) for value in settings()["Service.Environment"])


def shell_line() -> str:
    """Return what the unit gives to bash; systemd writes % as %%."""
    (start,) = settings()["Service.ExecStart"]
    program, option, line = shlex.split(start)
    assert (program, option) == ("/bin/bash", "-c")
    return line.replace("%%", "%")


def record_command() -> Any:
    from subiaco_bringup.cli.main import app

    return typer.main.get_command(app).commands["record"]  # type: ignore[attr-defined]


def test_the_unit_starts_the_recorder_with_options_that_it_has() -> None:
    line = shell_line()
    assert (REPOSITORY / "ros2_ws" / "env.sh").is_file()
    assert line.startswith('source "$SUBIACO_ROOT/ros2_ws/env.sh" && exec subiaco record ')
    known = {name for parameter in record_command().params for name in parameter.opts}
    assert set(re.findall(r"--[a-z-]+", line)) <= known
    assert set(re.findall(r"\$([A-Z_]+)", line)) <= set(environment())


def test_the_unit_closes_the_recording_and_tries_again_what_may_succeed() -> None:
    from subiaco_bringup.recording import GRACE
    from subiaco_geo.errors import InputError

    said = settings()
    assert said["Service.KillSignal"] == ["SIGINT"]
    assert said["Service.KillMode"] == ["mixed"]
    assert float(said["Service.TimeoutStopSec"][0]) > GRACE
    assert said["Service.Restart"] == ["on-failure"]
    assert said["Service.RestartPreventExitStatus"] == [str(InputError.exit_code)]


def test_the_unit_is_installed_and_documented() -> None:
    assert 'glob("systemd/*.service")' in (REPOSITORY / "src/subiaco_bringup/setup.py").read_text()
    page = (REPOSITORY / "docs/how-to/in-the-vehicle.md").read_text()
    assert str(UNIT.relative_to(REPOSITORY)) in page
    assert all(name in page for name in set(environment()) - {"SUBIACO_BAGS"})


def test_systemd_finds_no_fault_in_the_unit(tmp_path: Path) -> None:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("no systemd-analyze")
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", shutil.copy(UNIT, tmp_path)],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.ros
@pytest.mark.slow
def test_what_the_unit_starts_refuses_where_no_sensor_is_and_leaves_no_folder(tmp_path: Path) -> None:
    if not (REPOSITORY / "ros2_ws" / "install").is_dir():
        pytest.skip("no workspace here: run make setup")
    given = {"SUBIACO_ROOT": str(REPOSITORY), "SUBIACO_BAGS": str(tmp_path / "bags")}
    options = {"SUBIACO_RECORD_OPTIONS": "--duration 1"}
    done = subprocess.run(
        ["/bin/bash", "-c", shell_line()],
        env=os.environ | environment() | given | options | {"ROS_DOMAIN_ID": os.environ["ROS_DOMAIN_ID"]},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 2
    assert "no LiDAR data" in done.stderr
    assert not list((tmp_path / "bags").glob("*"))
