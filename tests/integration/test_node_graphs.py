"""The two jobs through real processes and real ROS 2 topics, against the same jobs in process."""

from __future__ import annotations

import logging
import os
import re
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from bags import last_seconds

from subiaco_bringup.environment import node_environment
from subiaco_bringup.graph import GraphSpec, NodeSpec, deployed, in_one_process, mapping_graph
from subiaco_bringup.jobs import run_change_graph, run_mapping_graph
from subiaco_bringup.supervisor import Supervisor
from subiaco_change.request import ChangeRequest
from subiaco_geo.bags import BagReader
from subiaco_geo.clouds import voxel_indices, voxel_keys
from subiaco_geo.config import load_config
from subiaco_geo.errors import InputError, RegistrationError, SubiacoError
from subiaco_geo.maps import read_map, write_map
from subiaco_geo.survey_map import SurveyMap
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.pipeline import map_survey
from subiaco_mapping.request import MappingRequest

pytestmark = [pytest.mark.ros, pytest.mark.slow]

SETTINGS = ["gnss.min_length=6.0"]  # the simulated drives are short


@pytest.fixture(scope="module", autouse=True)
def workspace() -> None:
    pytest.importorskip("subiaco_msgs.msg", reason="workspace not sourced: source ros2_ws/env.sh")


@pytest.fixture(scope="module")
def in_process(survey: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Map directories of both epochs, made in process."""
    config = load_config(MappingConfig, [], SETTINGS)
    folder = tmp_path_factory.mktemp("maps")
    for epoch in ("before", "after"):
        write_map(folder / epoch, map_survey([survey / epoch], config))
    return {epoch: folder / epoch for epoch in ("before", "after")}


def mapping_request(bags: list[Path], output: Path, settings: Sequence[str] = ()) -> MappingRequest:
    config = load_config(MappingConfig, [], settings)
    return MappingRequest.of(bags=tuple(bags), output=output, config=config)


def voxels(survey: SurveyMap, origin: np.ndarray, leaf: float) -> set[int]:
    cloud = survey.cloud.rebased(origin)
    return set(voxel_keys(voxel_indices(cloud.xyz, leaf)).tolist())


def test_the_mapping_graph_loses_no_packet_and_gives_the_map_of_the_process(
    survey: Path, in_process: dict[str, Path], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, logger="subiaco_bringup")
    stages: list[str] = []
    run_mapping_graph(
        mapping_request([survey / "before"], tmp_path / "map", SETTINGS),
        progress=lambda stage, fraction: stages.append(f"{stage} {fraction:.2f}"),
    )
    with BagReader(survey / "before") as reader:
        recorded = {topic: info.count for topic, info in reader.topics.items()}
    said = [record.getMessage() for record in caplog.records]
    line = next(message for message in said if "played and consumed" in message)
    played = {topic: int(n) for topic, n in re.findall(r"(/\S+) (\d+)", line)}
    assert {topic: played[topic] for topic in recorded} == recorded
    assert "replay 1.00" in stages

    through, direct = read_map(tmp_path / "map"), read_map(in_process["before"])
    packets = through.manifest["sequences"]["before"]["packets"]
    assert packets["packets"] == recorded["/ouster/lidar_packets"]
    assert packets["lost"] == 0
    assert through.crs == direct.crs == "EPSG:7850"
    assert through.trajectory is not None
    assert direct.trajectory is not None
    np.testing.assert_array_equal(through.trajectory.times_ns, direct.trajectory.times_ns)
    # Poses travel as doubles, points as float32 in the sensor frame (4 um at 70 m), which moves a point
    # over a step of the 2 mm spool or a voxel face now and then.
    assert np.abs(through.trajectory.positions - direct.trajectory.positions).max() < 1e-3
    ours, theirs = (voxels(m, direct.cloud.origin, 0.25) for m in (through, direct))
    assert len(ours & theirs) >= 0.999 * len(ours | theirs)
    assert through.visibility is not None
    assert direct.visibility is not None
    seen, seen_too = (set(m.visibility.keys.tolist()) for m in (through, direct))
    assert len(seen & seen_too) >= 0.999 * len(seen | seen_too)  # sky beams travel through the graph too
    assert through.info["config_hash"] == direct.info["config_hash"]
    assert through.info["inputs"] == direct.info["inputs"]
    assert through.manifest == direct.manifest


def test_two_bags_are_two_sequences_of_one_map(survey: Path, tmp_path: Path) -> None:
    counts = {name: last_seconds(survey / name, tmp_path / name, 2.0) for name in ("before", "after")}
    near = ["gnss.min_length=2.0", "gnss.min_fixes=5"]
    run_mapping_graph(mapping_request([tmp_path / name for name in counts], tmp_path / "map", near))
    both = read_map(tmp_path / "map")
    assert sorted(both.odometry) == ["after", "before"]
    driven = both.manifest["sequences"]
    assert {name: driven[name]["packets"]["packets"] for name in driven} == counts


def test_nodes_of_one_process_in_a_namespace_give_the_map_of_processes_of_their_own(
    survey: Path, tmp_path: Path
) -> None:
    last_seconds(survey / "before", tmp_path / "bag", 2.0)
    near = ["gnss.min_length=2.0", "gnss.min_fixes=5"]
    several, one = (mapping_request([tmp_path / "bag"], tmp_path / name, near) for name in ("several", "one"))
    run_mapping_graph(several)
    supervisor = run(in_one_process(deployed(mapping_graph(one), namespace="left")))
    assert [process.spec.name for process in supervisor.processes] == ["mapping"]
    expected, found = read_map(several.output), read_map(one.output)
    np.testing.assert_array_equal(found.cloud.world(), expected.cloud.world())
    assert found.trajectory is not None
    assert expected.trajectory is not None
    np.testing.assert_array_equal(found.trajectory.positions, expected.trajectory.positions)
    assert found.manifest == expected.manifest


def test_a_fault_of_one_node_of_a_process_ends_it_with_its_line(tmp_path: Path) -> None:
    request = mapping_request([tmp_path / "none"], tmp_path / "map")
    with pytest.raises(InputError, match="none: no such bag"):
        run(in_one_process(mapping_graph(request)))
    assert not (tmp_path / "map").exists()


def test_the_change_graph_gives_the_table_of_the_process(
    in_process: dict[str, Path], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    from subiaco_change.config import ChangeConfig
    from subiaco_change.pipeline import detect_changes

    caplog.set_level(logging.INFO, logger="subiaco_bringup")
    before, after = in_process["before"], in_process["after"]
    request = ChangeRequest.of(before=before, after=after, output=tmp_path / "change")
    run_change_graph(request)
    expected = detect_changes(read_map(before), read_map(after), ChangeConfig())
    table = pd.read_csv(tmp_path / "change" / "changes.csv")
    labels = Counter(record.change.label for record in expected.records)
    assert len(table) == len(expected.records) > 0
    assert Counter(table["label"]) == labels
    by_id = {record.object_id: record for record in expected.records}
    for row in table.to_dict("records"):
        record = by_id[row["object_id"]]
        assert (row["label"], row["class"]) == (record.change.label, record.semantic.label)
        # The same library steps on the same files: the rounding of the table is all that differs.
        for name in ("x", "y", "z", "confidence", "delta_h_m", "delta_v_m3", "lod95_m"):
            value = getattr(record, name)
            known = value if np.isfinite(value) else np.nan  # the table leaves unknown and endless empty
            assert row[name] == pytest.approx(known, abs=1e-3, nan_ok=True), name
    assert (tmp_path / "change" / "report.html").is_file()
    assert any("objects:" in record.getMessage() for record in caplog.records)


def test_a_missing_bag_is_one_line_and_exit_code_2(tmp_path: Path) -> None:
    finished = subprocess.run(
        [sys.executable, "-m", "subiaco_bringup.cli.main", "graph", "mapping", str(tmp_path / "none"), "-o",
         str(tmp_path / "map")],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert finished.returncode == 2
    lines = [line for line in finished.stderr.splitlines() if line.strip()]
    assert len(lines) == 1
    assert "none: no such bag" in lines[0]
    assert not (tmp_path / "map").exists()


def run(graph: GraphSpec) -> Supervisor:
    with node_environment() as environment:
        supervisor = Supervisor(graph, environment)
        try:
            supervisor.run()
        finally:
            assert all(process.code is not None for process in supervisor.processes)
        return supervisor


def test_a_bag_that_only_the_replay_finds_bad_stops_the_whole_graph_with_its_line(
    survey: Path, tmp_path: Path
) -> None:
    bag = next((survey / "before" / "bag").glob("*.mcap"))
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(bag.read_bytes()[: bag.stat().st_size // 2])
    with pytest.raises(InputError, match=r"cut\.mcap.*cut"):
        run(mapping_graph(mapping_request([cut], tmp_path / "map")))
    assert not (tmp_path / "map").exists()


def test_an_unknown_crs_is_bad_input_through_the_graph_too(survey: Path, tmp_path: Path) -> None:
    request = mapping_request([survey / "before"], tmp_path / "map", ["crs=EPSG:99999"])
    with pytest.raises(InputError, match="EPSG:99999"):
        run_mapping_graph(request)
    assert not (tmp_path / "map").exists()


def test_maps_that_cannot_be_registered_are_exit_code_3(tmp_path: Path) -> None:
    from subiaco_geo.cloud_io import write_cloud
    from subiaco_geo.clouds import PointCloud

    rng = np.random.default_rng(7)
    for name in ("a", "b"):
        noise = rng.uniform(-20, 20, (4_000, 3))
        write_cloud(tmp_path / f"{name}.ply", PointCloud(noise))
    with pytest.raises(RegistrationError):
        run_change_graph(
            ChangeRequest(before=tmp_path / "a.ply", after=tmp_path / "b.ply", output=tmp_path / "change")
        )
    assert not (tmp_path / "change").exists()


def test_a_crash_is_noticed_and_named_and_nothing_is_left_running(survey: Path, tmp_path: Path) -> None:
    graph = mapping_graph(mapping_request([survey / "before"], tmp_path / "map", SETTINGS), rate=0.5)
    with node_environment() as environment:
        supervisor: Supervisor

        def kill_odometry(stage: str, fraction: float) -> None:
            if stage == "replay" and fraction > 0:
                supervisor.processes[1].send(signal.SIGKILL)

        supervisor = Supervisor(graph, environment, kill_odometry)
        with pytest.raises(SubiacoError, match="node odometry was killed by SIGKILL"):
            supervisor.run()
    assert all(process.code is not None for process in supervisor.processes)
    assert not (tmp_path / "map").exists()


def test_an_interrupted_job_ends_with_130_and_leaves_nothing(survey: Path, tmp_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "subiaco_bringup.cli.main", "graph", "mapping", str(survey / "before"), "-o",
         str(tmp_path / "map"), "--rate", "0.05"],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    assert process.stdout is not None
    for line in process.stdout:
        if "replay" in line:
            break
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=60)
    assert process.returncode == 130
    assert list(tmp_path.iterdir()) == []
    left = subprocess.run(["ps", "-ww", "-eo", "args"], capture_output=True, text=True, check=True).stdout
    assert str(tmp_path) not in left


def test_runs_side_by_side_have_domains_of_their_own() -> None:
    with node_environment() as one, node_environment() as two:
        if "ROS_DOMAIN_ID" not in os.environ:
            assert one["ROS_DOMAIN_ID"] != two["ROS_DOMAIN_ID"]


def test_a_node_that_cannot_start_is_named() -> None:
    graph = GraphSpec("odd", (NodeSpec("ghost", "subiaco_mapping", "ghost_node", {}, principal=True),))
    with pytest.raises(SubiacoError, match=r"node ghost crashed \(exit code 1\): .*ghost_node"):
        run(graph)
