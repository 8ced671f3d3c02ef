"""One small survey for all tests of this room (seed 3, 5 s, 512 columns)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest

from subiaco_sim.config import SimulationConfig
from subiaco_sim.drives import Survey, plan_survey
from subiaco_sim.survey import simulate

CONFIG = SimulationConfig(preset="easy", seed=3, duration=4.0, mode="512x10", ground_cell=0.8)


@dataclass(frozen=True)
class Sample:
    """Where the survey lies, and the plan it was made from."""

    folder: Path
    survey: Survey


@pytest.fixture(scope="session")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Sample:
    """Return a survey of both epochs."""
    folder = tmp_path_factory.mktemp("sim") / "survey"
    simulate(folder, CONFIG)
    return Sample(folder, plan_survey(CONFIG))
