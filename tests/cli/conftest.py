"""Runs the command in process and checks what a refusal must look like."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from subiaco_bringup.cli import main
from subiaco_sim.config import SimulationConfig
from subiaco_sim.survey import simulate

Refused = Callable[..., str]


@dataclass(frozen=True)
class Ran:
    """How a command ended."""

    code: int
    out: str
    err: str


@pytest.fixture
def command(capfd: pytest.CaptureFixture[str]) -> Callable[..., Ran]:
    """Run ``subiaco`` in process."""

    def run(*words: object) -> Ran:
        capfd.readouterr()
        code = main.run([str(word) for word in words])
        captured = capfd.readouterr()
        return Ran(code, captured.out, captured.err)

    return run


def everything_in(folder: Path) -> dict[Path, bytes | None]:
    """Return every file of a folder with its bytes, folders as None."""
    return {p: p.read_bytes() if p.is_file() else None for p in folder.rglob("*")}


@pytest.fixture
def refused(command: Callable[..., Ran], tmp_path: Path) -> Refused:
    """Run a command that must be refused in one line and leave ``tmp_path`` as it was.

    ``words`` must all be in the line: what is at fault, and the remedy.
    """

    def check(arguments: list[object], *words: object, code: int = 2) -> str:
        before = everything_in(tmp_path)
        ran = command(*arguments)
        lines = [line for line in ran.err.splitlines() if line.startswith("subiaco:")]
        assert ran.code == code, ran.err
        assert len(lines) == 1, ran.err
        assert ran.err.rstrip().endswith(lines[0]), "the complaint is the last thing said"
        assert "Traceback" not in ran.err
        assert ran.out == ""
        for word in words:
            assert str(word) in lines[0], lines[0]
        assert everything_in(tmp_path) == before, "something was left or changed"
        return lines[0]

    return check


@pytest.fixture(scope="session")
def survey(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a simulated epoch 'before' of two seconds (seed 3): bag and truth."""
    folder = tmp_path_factory.mktemp("sim") / "survey"
    simulate(
        folder,
        SimulationConfig(preset="easy", seed=3, duration=2.0, mode="512x10", epoch="before", ground_cell=1.5),
    )
    return folder


@pytest.fixture(scope="session")
def survey_of_both(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return fused maps with truth of both epochs, 1.2 seconds each (seed 3)."""
    folder = tmp_path_factory.mktemp("sim") / "maps"
    config = SimulationConfig(
        preset="easy", seed=3, duration=1.2, mode="512x10", ground_cell=2.0, maps_only=True
    )
    simulate(folder, config)
    return folder
