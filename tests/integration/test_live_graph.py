"""The graph in the vehicle: real processes on topics that nobody paces."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial import cKDTree

from subiaco_geo.bags import BagReader
from subiaco_geo.maps import read_map

pytestmark = [pytest.mark.ros, pytest.mark.slow]

SECONDS = 7.0
SETTINGS = ["gnss.min_length=2.0"]  # the drive is short
SAME = 0.02  # live and replayed, where nothing was lost on the way [m]


RUNS: list[LiveRun] = []


@pytest.fixture(autouse=True)
def leave_nothing_running() -> Iterator[None]:
    """End a run whose test failed; its nodes notice that their supervisor is gone."""
    yield
    while RUNS:
        run = RUNS.pop()
        if run.process.poll() is None:
            run.process.kill()
            run.process.wait(timeout=10)


class LiveRun:
    """``subiaco graph live`` in a process, and what it says."""

    def __init__(self, *words: object) -> None:
        command = [sys.executable, "-m", "subiaco_bringup.cli.main", "graph", "live", *map(str, words)]
        for setting in SETTINGS:
            command += ["--set", setting]
        self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        RUNS.append(self)
        self.lines: list[str] = []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self.lines.append(line.rstrip())

    def until(self, condition: Callable[[], object], timeout: float = 90.0) -> None:
        deadline = time.monotonic() + timeout
        while not condition():
            assert self.process.poll() is None, "\n".join(self.lines)
            assert time.monotonic() < deadline, "\n".join(self.lines)
            time.sleep(0.05)

    def said(self, pattern: str) -> bool:
        return any(re.search(pattern, line) for line in list(self.lines))

    def children(self, module: str) -> list[int]:
        """Return the process ids of a node of this run."""
        table = subprocess.run(
            ["ps", "-ww", "-eo", "pid,ppid,args"], capture_output=True, text=True, check=True
        ).stdout
        rows = [line.split(None, 2) for line in table.splitlines()[1:]]
        return [int(row[0]) for row in rows if int(row[1]) == self.process.pid and module in row[2]]

    def stop(self) -> int:
        self.process.send_signal(signal.SIGINT)
        code = self.process.wait(timeout=600)  # a first run compiles while it builds the map
        self._reader.join(timeout=5)
        return code


@pytest.fixture(scope="module", autouse=True)
def domain() -> Iterator[None]:
    """A ROS domain of this module's own: a live graph listens to everybody in its domain."""
    import domain_coordinator

    before = os.environ.get("ROS_DOMAIN_ID")
    held = domain_coordinator.domain_id()
    os.environ["ROS_DOMAIN_ID"] = str(held.__enter__())
    yield
    held.__exit__(None, None, None)
    if before is None:
        del os.environ["ROS_DOMAIN_ID"]
    else:
        os.environ["ROS_DOMAIN_ID"] = before


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A drive of a few seconds of street, seed 5."""
    from subiaco_sim.config import SimulationConfig
    from subiaco_sim.survey import simulate

    out = tmp_path_factory.mktemp("survey") / "sim"
    config = SimulationConfig(
        preset="easy", mode="512x10", duration=SECONDS, seed=5, ground_cell=0.8, epoch="before"
    )
    simulate(out, config)
    return out / "before" / "bag"


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
    assert finished.returncode == 0, "\n".join([finished.stdout, finished.stderr, *live.lines])
    return finished.stdout


def test_a_survey_is_recorded_watched_mapped_and_ended_whole(drive: Path, tmp_path: Path) -> None:
    """A GNSS driver dies on the way; the map grows meanwhile; the record gives the same map again."""
    from subiaco_geo.config import load_config
    from subiaco_mapping.config import MappingConfig
    from subiaco_mapping.pipeline import map_survey

    folder = tmp_path / "survey"
    live = LiveRun("-o", folder, "--sim-time")
    live.until(lambda: live.said("lidar: none: nothing yet"))
    said = play(live, drive, "--listeners", 3, "--mute", "/gnss/fix", 4.5, "--save", tmp_path / "saved")
    assert live.said(r"gnss: bad: .*gnss_silent")
    assert live.stop() == 0, "\n".join(live.lines)
    counts = [int(n) for n in re.findall(r"\d+", said)]
    assert counts[0] >= 10 * SECONDS - 4  # poses on the path
    assert counts[1] >= 5  # and it grew meanwhile

    manifest = yaml.safe_load((folder / "manifest.yaml").read_text())
    (silence,) = manifest["sequences"]["live"]["flagged"]["gnss_silent"]
    with BagReader(drive) as reader:
        start = reader.start_ns * 1e-9
    assert silence["start_s"] - start == pytest.approx(4.5, abs=0.4)
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

    again = map_survey([folder], load_config(MappingConfig, [], SETTINGS))
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


def test_nodes_that_crash_are_named_and_started_again_and_drivers_may_use_other_names(
    drive: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "survey"
    other = "/gnss/fix:=/ublox_gps_node/fix"
    live = LiveRun("-o", folder, "--sim-time", "--no-record", "--remap", other)
    live.until(lambda: live.said("lidar: none: nothing yet"))
    os.kill(live.children("odometry_node")[0], signal.SIGKILL)
    live.until(lambda: live.said("node odometry was killed by SIGKILL.*starting it again"))
    live.until(lambda: live.children("odometry_node"))
    play(live, drive, "--ros-args", "-r", other)
    assert live.stop() == 0, "\n".join(live.lines)
    flagged = yaml.safe_load((folder / "manifest.yaml").read_text())["sequences"]["live"]["flagged"]
    assert [entry["source"] for entry in flagged["node_died"]] == ["odometry"]
    mapped = read_map(folder / "map")
    assert mapped.trajectory is not None
    assert mapped.manifest["sequences"]["live"]["arrivals_pose_graph"]["/gnss/fix"]["received"] > 20


def test_a_folder_that_holds_a_drive_is_not_written_into(tmp_path: Path) -> None:
    (tmp_path / "survey" / "bag").mkdir(parents=True)
    live = LiveRun("-o", tmp_path / "survey")
    assert live.process.wait(timeout=60) == 2
    assert live.said("give every drive a folder of its own")
