"""The mapping graph as its launch file describes it, run through the installed executables."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from bags import last_seconds
from launch_stand_in import Launch, stand_in

from subiaco_bringup.jobs import run_mapping_graph
from subiaco_geo.config import load_config
from subiaco_geo.errors import SubiacoError
from subiaco_geo.maps import read_map
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.request import MappingRequest

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.usefixtures("own_domain")]

LAUNCH = Path(__file__).resolve().parents[2] / "src" / "subiaco_bringup" / "launch"
SETTINGS = ["gnss.min_length=2.0", "gnss.min_fixes=5"]
PATIENCE = 280.0  # of a busy machine [s]


@pytest.fixture(autouse=True)
def launch_stub(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stand in for the library that is not here."""
    stand_in(monkeypatch)


def test_the_launch_file_of_the_mapping_gives_the_map_of_the_command(survey: Path, tmp_path: Path) -> None:
    last_seconds(survey / "before", tmp_path / "bag", 2.0)
    launch = Launch(
        LAUNCH / "mapping.launch.py",
        bag=str(tmp_path / "bag"), output=str(tmp_path / "launched"), set=" ".join(SETTINGS),
    )  # fmt: skip
    assert launch.run(PATIENCE) == dict.fromkeys(("replay_node", "odometry_node", "pose_graph_node"), 0)
    config = load_config(MappingConfig, [], SETTINGS)
    run_mapping_graph(
        MappingRequest.of(bags=(tmp_path / "bag",), output=tmp_path / "commanded", config=config)
    )
    launched, commanded = read_map(tmp_path / "launched"), read_map(tmp_path / "commanded")
    np.testing.assert_array_equal(launched.cloud.world(), commanded.cloud.world())
    assert launched.trajectory is not None
    assert commanded.trajectory is not None
    np.testing.assert_array_equal(launched.trajectory.positions, commanded.trajectory.positions)
    assert launched.manifest == commanded.manifest


def test_a_launch_whose_bag_is_missing_ends_with_an_error_and_leaves_nothing_running(tmp_path: Path) -> None:
    launch = Launch(LAUNCH / "mapping.launch.py", bag=str(tmp_path / "none"), output=str(tmp_path / "map"))
    with pytest.raises(SubiacoError, match="node replay ended with exit code 2"):
        launch.run(PATIENCE)
    assert launch.processes["replay_node"].returncode == 2
    assert all(process.poll() is not None for process in launch.processes.values())
    assert not (tmp_path / "map").exists()
