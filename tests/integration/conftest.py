"""What the integration tests share; they find their helpers beside them."""

from __future__ import annotations

import fcntl
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[1] / "ros"))


@pytest.fixture(scope="module")
def own_domain() -> Iterator[None]:
    """A ROS domain of a module's own: a live graph listens to everybody in its domain."""
    import domain_coordinator
    from ros_harness import next_domain

    before = os.environ.get("ROS_DOMAIN_ID")
    held = domain_coordinator.domain_id(next_domain)
    os.environ["ROS_DOMAIN_ID"] = str(held.__enter__())
    yield
    held.__exit__(None, None, None)
    if before is None:
        del os.environ["ROS_DOMAIN_ID"]
    else:
        os.environ["ROS_DOMAIN_ID"] = before


@pytest.fixture(scope="session")
def survey(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Both epochs of a few seconds of street, seed 5; the workers of a session share them."""
    from subiaco_sim.config import SimulationConfig
    from subiaco_sim.survey import simulate

    base = tmp_path_factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    out, whole = shared / "survey", shared / "survey.whole"
    with (shared / "survey.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not whole.exists():
            config = SimulationConfig(preset="easy", mode="512x10", duration=5.0, seed=5, ground_cell=0.8)
            simulate(out, config)
            whole.touch()
    return out
