"""A run that was killed goes on, and its map is that of a run that was not."""

import hashlib
import json
import logging
from pathlib import Path

import numpy as np
import pytest
from mapping_scenes import SECOND, START_NS, point_cloud_message, room_scan, turning_pose

from subiaco_geo.bags import TYPESTORE, BagWriter
from subiaco_geo.errors import InputError
from subiaco_geo.maps import write_map
from subiaco_geo.survey_map import SurveyMap
from subiaco_geo.topics import FIX, MESSAGE_TYPES, POINTS
from subiaco_mapping import pipeline
from subiaco_mapping.checkpoint.checkpoint import checkpoint_folder
from subiaco_mapping.config import MappingConfig, MapQualityConfig
from subiaco_mapping.fusion.config import FusionConfig
from subiaco_mapping.loop_closure.config import LoopConfig
from subiaco_mapping.odometry.config import OdometryConfig
from subiaco_mapping.pose_graph.config import GnssConfig
from subiaco_mapping.preprocessing.config import FramePose, SensorsConfig

CONFIG = MappingConfig(
    deskewed=True,
    sensors=SensorsConfig(lidar=FramePose(), gnss=FramePose()),
    gnss=GnssConfig(min_fixes=3, min_length=0.5),
    odometry=OdometryConfig(voxel=0.5),
    loops=LoopConfig(enabled=False),
    fusion=FusionConfig(active_voxels=2000),
    quality=MapQualityConfig(enabled=False),  # four pictures, most of the time of a run
)
SCANS = 5


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


def fix(pose: np.ndarray, stamp_ns: int) -> object:
    """A fixed NavSatFix of an antenna at the sensor, 1 cm."""
    types = TYPESTORE.types
    time = types["builtin_interfaces/msg/Time"](sec=stamp_ns // SECOND, nanosec=stamp_ns % SECOND)
    return types["sensor_msgs/msg/NavSatFix"](
        header=types["std_msgs/msg/Header"](stamp=time, frame_id="gnss_link"),
        status=types["sensor_msgs/msg/NavSatStatus"](status=2, service=1),
        latitude=-31.95 + pose[1, 3] / 110_870,
        longitude=115.83 + pose[0, 3] / 94_540,
        altitude=20.0,
        position_covariance=np.diag([1e-4] * 3).ravel(),
        position_covariance_type=2,
    )


def record(folder: Path, seed: int) -> Path:
    """A bag of a turn through a room, 0.2 m a scan, with fixes."""
    stamps = START_NS + (100 * seed + np.arange(SCANS)) * SECOND // 10
    poses = turning_pose(START_NS + np.arange(SCANS) * SECOND // 10, speed=2.0, rate=0.3)
    with BagWriter(folder) as writer:
        for k, (pose, stamp) in enumerate(zip(poses, stamps.tolist(), strict=True)):
            cloud = point_cloud_message(room_scan(pose, 4000, SCANS * seed + k, 0.01), stamp)
            writer.write(POINTS, MESSAGE_TYPES[POINTS], cloud, stamp)
            writer.write(FIX, MESSAGE_TYPES[FIX], fix(pose, stamp), stamp)
    return folder


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("bags")
    return [record(folder / "room", 0), record(folder / "again", 1)]


@pytest.fixture
def bag(bags: list[Path]) -> Path:
    return bags[0]


@pytest.fixture(scope="module")
def expected(bags: list[Path], tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Hashes of the map of a run that nothing stops."""
    survey = pipeline.map_survey(bags, CONFIG)
    assert survey.crs is not None
    return content(survey, tmp_path_factory.mktemp("whole") / "map")


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the recordings whose odometry was run."""
    found: list[str] = []
    run = pipeline.run_sequence

    def counted(reader, *given):  # type: ignore[no-untyped-def]
        found.append(Path(reader.path).name)
        return run(reader, *given)

    monkeypatch.setattr(pipeline, "run_sequence", counted)
    return found


@pytest.mark.parametrize(
    ("stage", "least", "read_again"),
    [
        ("odometry room", 0.5, ["room", "again"]),
        ("odometry again", 0.5, ["again"]),
        ("solving the pose graph", 0.0, []),
        ("fusing scans", 1.0, []),
        ("finishing the map", 0.5, []),
    ],
)
def test_a_killed_run_goes_on_and_its_map_is_the_same(
    bags: list[Path],
    expected: dict[str, str],
    tmp_path: Path,
    reads: list[str],
    stage: str,
    least: float,
    read_again: list[str],
) -> None:
    checkpoint = checkpoint_folder(tmp_path / "map")
    with pytest.raises(Killed):
        pipeline.map_survey(bags, CONFIG, killer(stage, least), checkpoint=checkpoint)
    reads.clear()
    survey = pipeline.map_survey(bags, CONFIG, checkpoint=checkpoint, resume=True)
    assert reads == read_again
    assert content(survey, tmp_path / "map") == expected


def interrupted(bag: Path, checkpoint: Path) -> None:
    with pytest.raises(Killed):
        pipeline.map_survey([bag], CONFIG, killer("fusing scans", 0.0), checkpoint=checkpoint)


def test_another_configuration_or_recording_begins_anew(
    bag: Path, tmp_path: Path, reads: list[str], caplog: pytest.LogCaptureFixture
) -> None:
    checkpoint = tmp_path / ".map.checkpoint"
    interrupted(bag, checkpoint)
    reads.clear()
    caplog.set_level(logging.WARNING, logger="subiaco_mapping")
    other = CONFIG.model_copy(update={"odometry": OdometryConfig(voxel=0.6)})
    pipeline.map_survey([bag], other, checkpoint=checkpoint, resume=True)
    assert reads == ["room"]
    assert "another configuration" in caplog.text
    interrupted(bag, checkpoint)
    other_bag = record(tmp_path / "room", 2)
    reads.clear()
    survey = pipeline.map_survey([other_bag], CONFIG, checkpoint=checkpoint, resume=True)
    assert reads == ["room"]
    assert survey.trajectory.times_ns[0] == START_NS + 20 * SECOND


def test_recordings_read_by_two_workers_make_the_same_map(
    bags: list[Path], expected: dict[str, str], tmp_path: Path, reads: list[str]
) -> None:
    survey = pipeline.map_survey(bags, CONFIG, checkpoint=tmp_path / ".map.checkpoint", workers=2)
    assert reads == []  # not in this process
    assert content(survey, tmp_path / "map") == expected


def test_a_setting_of_later_stages_alone_reads_no_recording_again(
    bag: Path, tmp_path: Path, reads: list[str]
) -> None:
    interrupted(bag, tmp_path / ".map.checkpoint")
    other = CONFIG.model_copy(update={"fusion": FusionConfig(leaf=0.5), "crs": "EPSG:28350"})
    fresh = content(pipeline.map_survey([bag], other), tmp_path / "fresh")
    reads.clear()
    survey = pipeline.map_survey([bag], other, checkpoint=tmp_path / ".map.checkpoint", resume=True)
    assert reads == []
    assert content(survey, tmp_path / "map") == fresh


def test_two_recordings_of_one_name_are_refused_before_any_is_read(
    bag: Path, tmp_path: Path, reads: list[str]
) -> None:
    with pytest.raises(InputError, match="two bags have this name"):
        pipeline.map_survey([bag, bag], CONFIG, checkpoint=tmp_path / ".map.checkpoint", workers=2)
    assert reads == []


def test_a_damaged_checkpoint_is_not_believed(bag: Path, tmp_path: Path, reads: list[str]) -> None:
    checkpoint = tmp_path / ".map.checkpoint"
    interrupted(bag, checkpoint)
    record = checkpoint / "000" / "sequence.npz"
    record.write_bytes(record.read_bytes()[:-7] + b"garbage")
    reads.clear()
    pipeline.map_survey([bag], CONFIG, checkpoint=checkpoint, resume=True)
    assert reads == ["room"]
    (checkpoint / "checkpoint.json").write_text("{")
    pipeline.map_survey([bag], CONFIG, checkpoint=checkpoint, resume=True)
    assert reads == ["room", "room"]


def test_a_recording_whose_scans_a_power_cut_took_is_read_again(
    bag: Path, tmp_path: Path, reads: list[str]
) -> None:
    checkpoint = tmp_path / ".map.checkpoint"
    interrupted(bag, checkpoint)
    (checkpoint / "000" / "fusion-left").mkdir()
    (checkpoint / "000" / "fusion-left" / "sums.npy").write_bytes(bytes(100))
    reads.clear()
    pipeline.map_survey([bag], CONFIG, checkpoint=checkpoint, resume=True)
    assert reads == []  # what a killed run left while fusing is none of its scans
    interrupted(bag, checkpoint)
    reads.clear()
    scan = next(path for path in sorted((checkpoint / "000").glob("*.scan")) if path.stat().st_size)
    scan.write_bytes(b"")
    pipeline.map_survey([bag], CONFIG, checkpoint=checkpoint, resume=True)
    assert reads == ["room"]


def test_without_resume_a_run_begins_anew_and_notes_each_recording(
    bag: Path, tmp_path: Path, reads: list[str]
) -> None:
    checkpoint = tmp_path / ".map.checkpoint"
    interrupted(bag, checkpoint)
    reads.clear()
    pipeline.map_survey([bag], CONFIG, checkpoint=checkpoint)
    assert reads == ["room"]
    noted = json.loads((checkpoint / "checkpoint.json").read_text())["sequences"]["0"]
    assert noted["bag"][0] == "room"


def test_a_run_that_spares_no_work_leaves_no_checkpoint(bag: Path, tmp_path: Path) -> None:
    checkpoint = tmp_path / ".map.checkpoint"
    with pytest.raises(Killed):
        pipeline.map_survey([bag], CONFIG, killer("odometry room", 0.0), checkpoint=checkpoint)
    assert not checkpoint.exists()
