"""The graph in the vehicle: real processes on topics that nobody paces."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import yaml
from live_run import LiveRun
from scipy.spatial import cKDTree

from subiaco_geo.bags import BagReader
from subiaco_geo.config import load_config
from subiaco_geo.maps import read_map
from subiaco_geo.survey_map import SurveyMap
from subiaco_geo.topics import FIX, IMU, LIDAR_PACKETS
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.pipeline import map_survey

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.realtime, pytest.mark.usefixtures("own_domain")]

SECONDS = 5.0
MUTED = (2.1, 4.0)  # the GNSS driver is gone [s]
SETTINGS = ("gnss.min_length=2.0",)  # the drive is short
KEPT = 100  # messages of a topic that a publisher of vehicle.py keeps
SAME = 0.02  # live and replayed, where nothing was lost on the way [m]


def play(live: LiveRun, *words: object) -> str:
    """Run the vehicle to its end."""
    script = Path(__file__).with_name("vehicle.py")
    finished = subprocess.run(
        [sys.executable, str(script), *map(str, words)],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert finished.returncode == 0, f"{finished.stdout}\n{finished.stderr}\n{live.text}"
    return finished.stdout


@pytest.fixture
def live(tmp_path: Path) -> Iterator[LiveRun]:
    """A live graph that is recorded; ended whatever happens."""
    run = LiveRun("-o", tmp_path / "survey", "--sim-time", settings=SETTINGS)
    yield run
    run.kill()


def test_a_survey_is_recorded_watched_mapped_and_ended_whole(
    survey: Path, live: LiveRun, tmp_path: Path
) -> None:
    """The GNSS driver is gone for a while; the map grows meanwhile; the record gives the same map again."""
    folder, drive = tmp_path / "survey", survey / "before" / "bag"
    live.until(lambda: live.heard("lidar: none: nothing yet"))
    said = play(live, drive, "--listeners", 3, "--mute", "/gnss/fix", *MUTED, "--save", tmp_path / "saved")
    assert live.heard(r"gnss: bad: .*gnss_silent")
    assert live.stop() == 0, live.text
    counts = [int(n) for n in re.findall(r"\d+", said)]
    assert counts[0] >= 10 * SECONDS - 4  # poses on the path
    assert counts[1] >= 5  # and it grew meanwhile

    manifest = yaml.safe_load((folder / "manifest.yaml").read_text())
    (silence,) = manifest["sequences"]["live"]["flagged"]["gnss_silent"]
    with BagReader(drive) as reader:
        start = reader.start_ns * 1e-9
    assert silence["start_s"] - start == pytest.approx(MUTED[0], abs=0.4)
    assert manifest["sequences"]["live"]["packets"]["packets"] > 0
    features = json.loads((folder / "quality.geojson").read_text())["features"]
    assert {f["properties"]["light"] for f in features} <= {"green", "amber", "red"}

    whole, asked = read_map(folder / "map"), read_map(tmp_path / "saved")
    assert len(asked.cloud) == pytest.approx(len(whole.cloud), rel=0.1)  # a scan or two may still have come
    assert whole.crs == "EPSG:7850"
    assert (
        "gnss_silent" in whole.manifest["sequences"]["live"]["flagged"]
    )  # the mapping extends what was watched

    driven = whole.manifest["sequences"]["live"]
    arrivals = {**driven["arrivals_odometry"], **driven["arrivals_pose_graph"]}
    missing = {
        topic: {k: n for k, n in counts.items() if k != "received"} for topic, counts in arrivals.items()
    }
    assert missing == {topic: {"lost": 0, "before_start": 0, "left_out": 0} for topic in arrivals}
    assert arrivals.keys() >= {"/ouster/lidar_packets", "/imu/data", "/gnss/fix", "/points_deskewed"}

    again = map_survey([folder], load_config(MappingConfig, [], list(SETTINGS)))
    assert again.trajectory is not None
    assert whole.trajectory is not None
    common, first, second = np.intersect1d(
        whole.trajectory.times_ns, again.trajectory.times_ns, return_indices=True
    )
    assert len(again.trajectory.times_ns) - len(common) <= 1  # the scan that only the end of a bag closes
    apart = whole.trajectory.positions[first] - again.trajectory.positions[second]
    assert np.linalg.norm(apart, axis=1).max() < SAME
    assert len(again.cloud) == pytest.approx(len(whole.cloud), rel=0.02)
    distance, _ = cKDTree(again.cloud.xyz).query(whole.cloud.xyz)
    assert np.quantile(distance, 0.99) < SAME
    assert "gnss_silent" in again.manifest["sequences"]["survey"]["flagged"]


@pytest.fixture(scope="module")
def from_the_bag(survey: Path) -> SurveyMap:
    """The map of the bag in process, where nothing can be lost."""
    return map_survey([survey / "before"], load_config(MappingConfig, [], list(SETTINGS)))


@pytest.mark.parametrize("rate", [1.0, 0.5])
def test_a_bag_player_that_knows_nothing_of_ours_gives_the_map_of_the_bag_or_the_loss_is_counted(
    survey: Path, from_the_bag: SurveyMap, tmp_path: Path, rate: float
) -> None:
    """As ``ros2 bag play --clock 40 --rate``: it waits for nobody, and what is missed stands in the map."""
    drive, folder = survey / "before" / "bag", tmp_path / "drive"
    graph = LiveRun("-o", folder, "--no-record", "--sim-time", settings=SETTINGS)
    try:
        graph.until(lambda: graph.heard("lidar: none: nothing yet"))
        play(graph, drive, "--listeners", 2, "--rate", rate)
        assert graph.stop() == 0, graph.text
    finally:
        graph.kill()
    assert not (folder / "bag").exists()

    played = read_map(folder / "map")
    driven = played.manifest["sequences"]["live"]
    arrivals = {**driven["arrivals_odometry"], **driven["arrivals_pose_graph"]}
    with BagReader(drive) as reader:
        recorded = {topic: info.count for topic, info in reader.topics.items()}
    for topic in (LIDAR_PACKETS, IMU, FIX):
        counts = arrivals[topic]
        known = counts["received"] + counts["lost"] + counts["before_start"]
        # What was sent last may find nobody: the player ends once the path is within 0.45 s of its end, and
        # nothing that comes later tells how much of what its publisher kept was overwritten.
        unknown = 0.45 / SECONDS * recorded[topic] + KEPT
        assert recorded[topic] - unknown - 1 <= known <= recorded[topic]
        assert counts["received"] > 0
    missed = sum(counts["lost"] + counts["left_out"] for counts in arrivals.values())

    assert played.trajectory is not None
    assert from_the_bag.trajectory is not None
    _, first, second = np.intersect1d(
        played.trajectory.times_ns, from_the_bag.trajectory.times_ns, return_indices=True
    )
    if missed == 0:
        unseen = 1.0 - arrivals[LIDAR_PACKETS]["received"] / recorded[LIDAR_PACKETS]  # the share of the end
        closed_by_an_end = 1
        assert len(from_the_bag.trajectory.times_ns) - len(first) <= closed_by_an_end + 10 * SECONDS * unseen
        apart = played.trajectory.positions[first] - from_the_bag.trajectory.positions[second]
        assert np.linalg.norm(apart, axis=1).max() < SAME
        assert len(played.cloud) == pytest.approx(len(from_the_bag.cloud), rel=0.05 + unseen)
    else:  # a machine too busy for real time
        assert graph.heard("missing|lost|misses"), graph.text


def test_a_bag_that_is_played_in_a_loop_is_mapped_once(
    survey: Path, from_the_bag: SurveyMap, tmp_path: Path
) -> None:
    """The clock goes back to the start: every node lives on, and no drive lies in the map twice."""
    folder = tmp_path / "drive"
    graph = LiveRun("-o", folder, "--no-record", "--sim-time", settings=SETTINGS)
    try:
        graph.until(lambda: graph.heard("lidar: none: nothing yet"))
        play(graph, survey / "before" / "bag", "--rate", 1.0, "--turns", 2)
        for said in (
            "/clock went back",
            r"lidar_packets: time went back by 4\.\d s .*the odometry begins again",
            r"/odometry: time went back by 4\.\d s; the map leaves out what it has",
        ):
            graph.until(lambda said=said: graph.heard(said))
        assert graph.stop() == 0, graph.text
    finally:
        graph.kill()
    played = read_map(folder / "map")
    assert played.trajectory is not None
    assert from_the_bag.trajectory is not None
    times = played.trajectory.times_ns
    assert (np.diff(times) > 0).all()
    assert len(np.intersect1d(times, from_the_bag.trajectory.times_ns)) == len(times)
    driven = played.manifest["sequences"]["live"]
    assert "odometry_silent" not in driven["flagged"]
    left_out = driven["arrivals_pose_graph"]
    assert left_out["/odometry"]["left_out"] > 0
    assert left_out[FIX]["left_out"] > 0


def test_a_folder_that_holds_a_drive_is_not_written_into(tmp_path: Path) -> None:
    (tmp_path / "survey" / "bag").mkdir(parents=True)
    live = LiveRun("-o", tmp_path / "survey")
    assert live.wait() == 2
    assert live.heard("give every drive a folder of its own")
