"""A run that was killed goes on, and its map is that of a run that was not."""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
from mapping_scenes import SECOND, START_NS, room_scan, turning_pose, write_clouds

from subiaco_geo.maps import SurveyMap, write_map
from subiaco_mapping import pipeline
from subiaco_mapping.config import FusionConfig, MappingConfig, OdometryConfig
from subiaco_mapping.journal import journal_folder
from subiaco_mapping.loops.config import LoopConfig

CONFIG = MappingConfig(
    deskewed=True,
    odometry=OdometryConfig(voxel=0.5),
    loops=LoopConfig(enabled=False),
    fusion=FusionConfig(active_voxels=2000),
)


class Killed(BaseException):
    """Nobody catches it, as nobody catches SIGKILL."""


def killer(stage: str, least: float):
    def progress(name: str, fraction: float) -> None:
        if name == stage and fraction >= least:
            raise Killed

    return progress


def content(survey: SurveyMap, folder: Path) -> dict[str, str]:
    """Hash every file of a map."""
    write_map(folder, survey)
    files = [p for p in sorted(folder.rglob("*")) if p.is_file()]
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bags") / "room"
    poses = turning_pose(START_NS + np.arange(4) * SECOND // 10, speed=2.0, rate=0.3)
    write_clouds(folder, [room_scan(pose, 4000, k, 0.01) for k, pose in enumerate(poses)])
    return folder


@pytest.fixture(scope="module")
def expected(bag: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Hashes of the map of a run that nothing stops."""
    return content(pipeline.map_survey([bag], CONFIG), tmp_path_factory.mktemp("whole") / "map")


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the recordings whose odometry was run."""
    found: list[str] = []
    run = pipeline.run_sequence

    def counted(reader, backend, config, progress):  # type: ignore[no-untyped-def]
        found.append(Path(reader.path).name)
        return run(reader, backend, config, progress)

    monkeypatch.setattr(pipeline, "run_sequence", counted)
    return found


@pytest.mark.parametrize(
    ("stage", "least", "read_again"),
    [
        ("odometry room", 0.5, True),
        ("solving the pose graph", 0.0, False),
        ("fusing scans", 1.0, False),
        ("finishing the map", 0.5, False),
    ],
)
def test_a_killed_run_goes_on_and_its_map_is_the_same(
    bag: Path,
    expected: dict[str, str],
    tmp_path: Path,
    reads: list[str],
    stage: str,
    least: float,
    read_again: bool,
) -> None:
    journal = journal_folder(tmp_path / "map")
    with pytest.raises(Killed):
        pipeline.map_survey([bag], CONFIG, killer(stage, least), journal=journal)
    reads.clear()
    survey = pipeline.map_survey([bag], CONFIG, journal=journal, resume=True)
    assert reads == (["room"] if read_again else [])
    assert content(survey, tmp_path / "map") == expected


def interrupted(bag: Path, journal: Path) -> None:
    with pytest.raises(Killed):
        pipeline.map_survey([bag], CONFIG, killer("fusing scans", 0.0), journal=journal)


def test_another_configuration_or_recording_begins_anew(
    bag: Path, tmp_path: Path, reads: list[str], caplog: pytest.LogCaptureFixture
) -> None:
    journal = tmp_path / ".map.journal"
    interrupted(bag, journal)
    reads.clear()
    other = CONFIG.model_copy(update={"odometry": OdometryConfig(voxel=0.6)})
    pipeline.map_survey([bag], other, journal=journal, resume=True)
    assert reads == ["room"]
    assert "another configuration" in caplog.text
    interrupted(bag, journal)
    write_clouds(tmp_path / "room", [room_scan(np.eye(4), 4000, 99, 0.01)] * 2)
    reads.clear()
    survey = pipeline.map_survey([tmp_path / "room"], CONFIG, journal=journal, resume=True)
    assert reads == ["room"]
    assert len(survey.trajectory) == 2


def test_a_damaged_journal_is_not_believed(bag: Path, tmp_path: Path, reads: list[str]) -> None:
    journal = tmp_path / ".map.journal"
    interrupted(bag, journal)
    record = journal / "000" / "sequence.npz"
    record.write_bytes(record.read_bytes()[:-7] + b"garbage")
    reads.clear()
    pipeline.map_survey([bag], CONFIG, journal=journal, resume=True)
    assert reads == ["room"]
    (journal / "journal.json").write_text("{")
    pipeline.map_survey([bag], CONFIG, journal=journal, resume=True)
    assert reads == ["room", "room"]


def test_without_resume_a_run_begins_anew_and_notes_each_recording(
    bag: Path, tmp_path: Path, reads: list[str]
) -> None:
    journal = tmp_path / ".map.journal"
    interrupted(bag, journal)
    reads.clear()
    pipeline.map_survey([bag], CONFIG, journal=journal)
    assert reads == ["room"]
    noted = json.loads((journal / "journal.json").read_text())["sequences"]["0"]
    assert noted["bag"][0] == "room"


def test_a_run_that_spares_no_work_leaves_no_journal(bag: Path, tmp_path: Path) -> None:
    journal = tmp_path / ".map.journal"
    with pytest.raises(Killed):
        pipeline.map_survey([bag], CONFIG, killer("odometry room", 0.0), journal=journal)
    assert not journal.exists()
