"""Helpers of the mapping tests lie beside them; one simulated survey serves them all."""

import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(1, str(Path(__file__).parents[1] / "integration"))  # plain_fusion

from subiaco_geo.survey_map import SurveyMap
from subiaco_geo.trajectories import Trajectory
from subiaco_sim.drives import Survey


@dataclass(frozen=True)
class TwoDrives:
    """Two simulated drives through one street, there and back, mapped together.

    ``truth`` holds the LiDAR's true trajectory in the map CRS by sequence.
    """

    bags: dict[str, Path]
    truth: dict[str, Trajectory]
    scene: Survey
    survey: SurveyMap


@pytest.fixture(scope="session")
def two_drives(tmp_path_factory: pytest.TempPathFactory) -> TwoDrives:
    """Six seconds each way, 512x10, seed 1; RTK with its usual gaps."""
    from simulated import map_two_drives

    return TwoDrives(*map_two_drives(tmp_path_factory.mktemp("drives")))
