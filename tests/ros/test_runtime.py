"""Parameters into models, and how a node process ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import pytest
from pydantic import Field

from subiaco_bringup.graph import merged_config, parameter_file
from subiaco_geo.config import StrictModel, load_config
from subiaco_geo.errors import InputError, SubiacoError
from subiaco_mapping.config import MappingConfig

pytestmark = pytest.mark.ros

PATIENCE = 200.0  # of a busy machine, for a process that imports our libraries [s]


class Own(StrictModel):
    """Parameters of a node of ours."""

    rate: float = Field(0.0, ge=0, description="speed")
    bags: tuple[str, ...] = Field((), description="bags")


PROGRAM = """
import sys
from subiaco_geo.errors import {error}
from subiaco_ros.parameters import read_models
from subiaco_ros.node_process import run_node
from subiaco_mapping.config import MappingConfig
from subiaco_bringup.graph import merged_config, parameter_file
from subiaco_geo.config import StrictModel

class Own(StrictModel):
    rate: float = 0.0

class App:
    done = False
    def step(self):
        {step}
        return 0.05

def build(node):
    own, config = read_models(node, Own, MappingConfig)
    node.get_logger().info("CONFIG " + config.model_dump_json())
    return App()

sys.exit(run_node("probe", build))
"""


def probe(step: str, *arguments: str, error: str = "InputError") -> subprocess.Popen[str]:
    """Start a process that runs one node with a given step."""
    return subprocess.Popen(
        [sys.executable, "-c", PROGRAM.format(step=step, error=error), *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "RCUTILS_CONSOLE_OUTPUT_FORMAT": "[{severity}] {message}", "ROS_DOMAIN_ID": "101"},
    )


@pytest.fixture(autouse=True)
def workspace() -> None:
    pytest.importorskip("subiaco_msgs.msg", reason="workspace not sourced: source ros2_ws/env.sh")


def test_nested_parameters_make_the_models_and_ros_own_ones_are_left_out(ros: Any) -> None:
    from subiaco_ros.parameters import read_models

    given = {"odometry__voxel": 0.7, "sensors__lidar__translation": [1.0, 0.0, 2.0], "use_sim_time": True}
    node = ros.node("probe", rate=2.0, bags=["a", "b"], **given)
    own, config = read_models(node, Own, MappingConfig)
    assert own == Own(rate=2.0, bags=("a", "b"))
    assert config.odometry.voxel == 0.7
    assert config.sensors.lidar.translation == (1.0, 0.0, 2.0)


def test_an_unknown_parameter_is_named(ros: Any) -> None:
    from subiaco_ros.parameters import read_models

    with pytest.raises(InputError, match=r"parameters of probe: odometry\.voxels"):
        read_models(ros.node("probe", odometry__voxels=0.7), Own, MappingConfig)


def test_no_node_parameter_has_the_name_of_a_configuration_slice() -> None:
    from subiaco_change.config import ChangeConfig
    from subiaco_change.nodes.change_node import ChangeParameters
    from subiaco_mapping.nodes.odometry_node import OdometryParameters
    from subiaco_mapping.nodes.pose_graph_node import PoseGraphParameters

    for own in (OdometryParameters, PoseGraphParameters):
        assert not own.model_fields.keys() & MappingConfig.model_fields.keys()
    assert not ChangeParameters.model_fields.keys() & ChangeConfig.model_fields.keys()


def test_a_file_and_settings_give_a_node_the_model_of_the_command_line(tmp_path: Path) -> None:
    file = tmp_path / "m.yaml"
    file.write_text(
        "/**:\n  ros__parameters:\n    crs: EPSG:7851\n    odometry: {voxel: 2, max_range: 80.0}\n"
        "    sensors: {override: true, imu: {rotation_deg: [0.0, 0.0, 90.0]}}\n"
    )
    merged = parameter_file(merged_config([file], ["odometry.voxel=0.5"]))
    process = probe("raise InputError('enough')", "--ros-args", "--params-file", str(merged))
    output = process.communicate(timeout=PATIENCE)[0]
    line = next(line for line in output.splitlines() if "CONFIG " in line)
    given = MappingConfig.model_validate_json(line.split("CONFIG ", 1)[1])
    assert given == load_config(MappingConfig, [file], ["odometry.voxel=0.5"])


def test_a_parameter_file_that_somebody_changed_is_written_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    path = parameter_file({"output_directory": "/mine"})
    text = path.read_text()
    path.write_text(text.replace("/mine", "/theirs"))
    assert parameter_file({"output_directory": "/mine"}) == path
    assert path.read_text() == text
    other = tmp_path / "other.yaml"
    other.write_text(text.replace("/mine", "/theirs"))
    path.unlink()
    path.symlink_to(other)
    assert parameter_file({"output_directory": "/mine"}).read_text() == text
    assert path.parent.stat().st_mode & 0o077 == 0


def test_a_parameter_folder_of_another_user_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    parameter_file({"a": 1})
    mine = os.getuid()
    monkeypatch.setattr(os, "getuid", lambda: mine + 1)
    (tmp_path / f"subiaco-parameters-{mine}").rename(tmp_path / f"subiaco-parameters-{mine + 1}")
    with pytest.raises(SubiacoError, match=r"belongs to another user.*set TMPDIR"):
        parameter_file({"a": 1})


def test_bad_input_is_one_line_and_exit_code_2() -> None:
    process = probe("raise InputError('/x: not there; look elsewhere')")
    output = process.communicate(timeout=PATIENCE)[0]
    assert process.returncode == 2
    assert output.splitlines()[-1] == "[FATAL] /x: not there; look elsewhere"
    assert "Traceback" not in output


def test_a_failed_registration_is_exit_code_3() -> None:
    process = probe("raise RegistrationError('no overlap')", error="RegistrationError")
    process.communicate(timeout=PATIENCE)
    assert process.returncode == 3


def test_a_fault_is_a_traceback_and_exit_code_1() -> None:
    process = probe("1 / 0")
    output = process.communicate(timeout=PATIENCE)[0]
    assert process.returncode == 1
    assert "ZeroDivisionError" in output


def test_a_parameter_file_that_is_missing_is_exit_code_2(tmp_path: Path) -> None:
    process = probe("pass", "--ros-args", "--params-file", str(tmp_path / "none.yaml"))
    output = process.communicate(timeout=PATIENCE)[0]
    assert process.returncode == 2
    assert "none.yaml" in output


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize(("supervised", "code"), [(True, 130), (False, 0)])
def test_a_signal_ends_a_node_quietly_with_130_under_our_supervisor_and_0_under_launch(
    number: signal.Signals, supervised: bool, code: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("SUBIACO_SUPERVISOR", raising=False)
    if supervised:
        monkeypatch.setenv("SUBIACO_SUPERVISOR", str(os.getpid()))
    process = probe("pass")
    assert process.stdout is not None
    while "CONFIG " not in process.stdout.readline():
        assert process.poll() is None
    process.send_signal(number)
    output = process.communicate(timeout=PATIENCE)[0]
    assert process.returncode == code
    assert "Traceback" not in output


SLOW_NODE = """
import os, signal, time
os.kill(os.getpid(), signal.SIGINT)
time.sleep(0.2)
from subiaco_ros.node_process import run_node

def main():
    return run_node("slow", lambda node: None)
"""


def test_an_interruption_during_the_imports_of_a_node_ends_it_quietly(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("SUBIACO_SUPERVISOR", raising=False)
    (tmp_path / "slow_node.py").write_text(SLOW_NODE)
    program = "import sys; from subiaco_mapping.nodes.executables import start; sys.exit(start('slow_node'))"
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
