"""The graph description: one source for launch files, supervisor and parameters."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from launch_stand_in import (
    Action,
    Ended,
    SetEnvironmentVariable,
    description_of,
    ends_of,
    launched_nodes,
    stand_in,
)

from subiaco_bringup.graph import (
    GraphSpec,
    change_graph,
    deployed,
    in_one_process,
    mapping_graph,
    merged_config,
    process_command,
    ros_parameters,
    with_foxglove,
)
from subiaco_bringup.launching import COMMON_ARGUMENTS
from subiaco_change.request import ChangeRequest
from subiaco_geo.config import load_config
from subiaco_geo.errors import InputError, SubiacoError
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.request import MappingRequest

LAUNCH = Path(__file__).resolve().parents[2] / "src" / "subiaco_bringup" / "launch"


def write_yaml(path: Path, **values: Any) -> Path:
    path.write_text(yaml.safe_dump({"/**": {"ros__parameters": values}}))
    return path


def mapping_request(folder: Path, **options: Any) -> MappingRequest:
    return MappingRequest.of(**{"bags": (folder / "bag",), "output": folder / "out", **options})


def change_request(folder: Path, **options: Any) -> ChangeRequest:
    return ChangeRequest.of(
        **{"before": folder / "before", "after": folder / "after", "output": folder / "output", **options}
    )


def command_lines(graph: GraphSpec) -> list[list[str]]:
    """Return package, executable and arguments of every process."""
    return [[node.package, node.executable, *node.arguments()] for node in graph.nodes]


def parameters_of(command: list[str]) -> dict[str, Any]:
    text = Path(command[command.index("--params-file") + 1]).read_text()
    return dict(yaml.safe_load(text)["/**"]["ros__parameters"])


def test_every_node_gets_the_same_configuration_as_the_command_line(tmp_path: Path) -> None:
    file = write_yaml(
        tmp_path / "m.yaml",
        odometry={"voxel": 0.7},
        sensors={"lidar": {"translation": [1, 0.5, 2]}, "imu": None},
    )
    settings = ["odometry.voxel=0.9", "crs=EPSG:7851"]
    expected = load_config(MappingConfig, [file], settings)
    graph = mapping_graph(mapping_request(tmp_path, config=expected))
    own = {"use_sim_time", "exit_at_end", "consumers", "output_directory", "overwrite", "bags"}
    for command in command_lines(graph)[1:]:
        given = {k: v for k, v in parameters_of(command).items() if k not in own}
        assert MappingConfig.model_validate(given) == expected


def test_what_ros_parameters_cannot_hold_is_left_out_or_made_uniform() -> None:
    values = {"a": [1, 2.5], "b": None, "c": {"d": None}, "e": [], "f": {"g": ("x", "y")}, "h": Path("/p")}
    assert ros_parameters(values) == {"a": [1.0, 2.5], "f": {"g": ["x", "y"]}, "h": "/p"}
    with pytest.raises(InputError, match=r"a\.b: a list of lists"):
        ros_parameters({"a": {"b": [[1, 2]]}})


def test_equal_graphs_have_equal_command_lines_and_others_not(tmp_path: Path) -> None:
    lines = [command_lines(mapping_graph(mapping_request(tmp_path), rate=rate)) for rate in (0, 0, 2)]
    assert lines[0] == lines[1]
    assert lines[0] != lines[2]


def test_the_replay_waits_for_every_other_node(tmp_path: Path) -> None:
    replay, *others = mapping_graph(mapping_request(tmp_path)).nodes
    assert replay.parameters["consumers"] == [node.name for node in others]
    assert [node.name for node in others if node.principal] == ["pose_graph"]


def test_settings_win_over_files_and_later_files_over_earlier_ones(tmp_path: Path) -> None:
    files = [write_yaml(tmp_path / f"{v}.yaml", odometry={"voxel": v, "max_range": v}) for v in (1.0, 2.0)]
    merged = merged_config(files, ["odometry.voxel=3.0"])
    assert merged == {"odometry": {"voxel": 3.0, "max_range": 2.0}}


def test_processes_are_started_with_this_interpreter(tmp_path: Path) -> None:
    node = change_graph(change_request(tmp_path)).nodes[0]
    command = process_command(node)
    assert command[:3] == [sys.executable, "-m", "subiaco_bringup.nodes.change_node"]
    assert command[3:] == command_lines(change_graph(change_request(tmp_path)))[0][2:]


def test_nodes_in_one_process_are_given_what_their_own_processes_would_be(tmp_path: Path) -> None:
    from subiaco_bringup.nodes.composed_nodes import parts_of

    graph = with_foxglove(mapping_graph(mapping_request(tmp_path)), 0)
    composed = in_one_process(deployed(graph, namespace="left"))
    process, foxglove = composed.nodes
    assert process.principal
    assert foxglove.executable == "foxglove_node"  # a companion may fail and the job goes on
    line = process_command(process)
    assert line[1:3] == ["-m", "subiaco_bringup.nodes.composed_nodes"]
    own = command_lines(deployed(mapping_graph(mapping_request(tmp_path)), namespace="left"))
    assert [words[1:] for words in parts_of(line[3:])] == own
    assert [words[0] for words in parts_of(line[3:])] == ["replay", "odometry", "pose_graph"]


@pytest.fixture
def launch_stub(monkeypatch: pytest.MonkeyPatch) -> None:
    """Put a minimal ``launch`` in place: the real one is not on PyPI."""
    stand_in(monkeypatch)


def launched_lines(file: Path, **arguments: str) -> list[list[str]]:
    """Return the command lines of the nodes of a launch file."""
    nodes = launched_nodes(file, **arguments)
    return [[n["package"], n["executable"], *n["arguments"]] for n in nodes]


@pytest.mark.usefixtures("launch_stub")
def test_launch_file_and_supervisor_start_the_same_mapping_command_lines(tmp_path: Path) -> None:
    from subiaco_bringup.defaults import config_files

    bags = [tmp_path / "one", tmp_path / "two words"]
    launched = launched_lines(
        LAUNCH / "mapping.launch.py",
        bag=f"{bags[0]} '{bags[1]}'",
        output=str(tmp_path / "out"),
        set="odometry.voxel=0.8",
        rate="2.0",
        overwrite="true",
    )
    config = load_config(MappingConfig, config_files("mapping"), ["odometry.voxel=0.8"])
    request = mapping_request(tmp_path, bags=tuple(bags), overwrite=True, config=config)
    graph = mapping_graph(request, rate=2.0)
    assert launched == command_lines(graph)


@pytest.mark.usefixtures("launch_stub")
@pytest.mark.parametrize("name", ["replay_node", "odometry_node", "pose_graph_node"])
@pytest.mark.parametrize("code", [1, 2, -9])
def test_a_launch_ends_with_an_error_when_any_node_of_the_mapping_dies(
    name: str, code: int, tmp_path: Path
) -> None:
    end = ends_of(LAUNCH / "mapping.launch.py", bag="/nope", output=str(tmp_path / "out"))[name]
    with pytest.raises(SubiacoError, match=rf"node \w+ ended with exit code {code}"):
        end(Ended(code), Ended())


@pytest.mark.usefixtures("launch_stub")
def test_a_launch_ends_well_with_its_principal_node_alone_and_says_nothing_of_nodes_that_it_stops(
    tmp_path: Path,
) -> None:
    ends = ends_of(LAUNCH / "mapping.launch.py", bag="/nope", output=str(tmp_path / "out"))
    assert [name for name, end in ends.items() if end(Ended(0), Ended())] == ["pose_graph_node"]
    assert all(end(Ended(1), Ended(shut_down=True)) == [] for end in ends.values())


@pytest.mark.usefixtures("launch_stub")
def test_a_launch_starts_a_live_node_again_a_few_times_and_goes_on_without_the_map(tmp_path: Path) -> None:
    from subiaco_bringup.supervisor import MOST_RESTARTS

    ends = ends_of(LAUNCH / "live.launch.py", output=str(tmp_path / "drive"))
    assert ends["pose_graph_node"](Ended(1), Ended()) == []
    for _ in range(MOST_RESTARTS):
        assert ends["recorder_node"](Ended(-11), Ended()) == []
    with pytest.raises(SubiacoError, match="node recorder ended with exit code -11"):
        ends["recorder_node"](Ended(-11), Ended())
    for _ in range(MOST_RESTARTS + 1):  # the recording goes on
        assert ends["odometry_node"](Ended(-11), Ended()) == []
        assert ends["monitor_node"](Ended(-11), Ended()) == []
    with pytest.raises(SubiacoError, match="node recorder ended with exit code 2"):
        ends["recorder_node"](Ended(2), Ended())


@pytest.mark.usefixtures("launch_stub")
@pytest.mark.parametrize("file", sorted(LAUNCH.glob("*.launch.py")), ids=lambda path: path.name)
def test_a_launch_refuses_a_setting_that_is_none_before_it_starts_a_node(file: Path, tmp_path: Path) -> None:
    given = {name: str(tmp_path / name) for name in ("bag", "output", "before", "after")}
    with pytest.raises(InputError, match="nonsense: no such setting"):
        launched_nodes(file, **given, set="nonsense=1")


@pytest.mark.usefixtures("launch_stub")
def test_launch_file_and_supervisor_start_the_same_change_command_line(tmp_path: Path) -> None:
    options = {
        "trajectory_before": str(tmp_path / "before.tum"), "transform": "identity", "workers": "3",
        "parcels": str(tmp_path / "lots.gpkg"), "given": "semantic instance", "overwrite": "true",
    }  # fmt: skip
    names = {name: str(tmp_path / name) for name in ("before", "after", "output")}
    launched = launched_lines(LAUNCH / "change.launch.py", **names, **options, set="leaf=0.4 seed=2")
    request = change_request(
        tmp_path, trajectory_before=tmp_path / "before.tum", transform=np.eye(4), workers=3,
        parcels=tmp_path / "lots.gpkg", given=("semantic", "instance"), overwrite=True,
        config={"leaf": 0.4, "seed": 2},
    )  # fmt: skip
    graph = change_graph(request)
    assert launched == command_lines(graph)
    carried = parameters_of(launched[0])
    assert ChangeRequest.from_json(carried["request"], "node") == request


@pytest.mark.usefixtures("launch_stub")
def test_a_launch_file_takes_every_option_of_a_request() -> None:
    declared = {a.given[0] for a in description_of(LAUNCH / "change.launch.py") if type(a) is Action}
    common = {name for name, _, _ in COMMON_ARGUMENTS}
    assert declared == {*ChangeRequest.model_fields, "set"} | common


@pytest.mark.usefixtures("launch_stub")
def test_launch_file_and_supervisor_start_the_same_recorder(tmp_path: Path) -> None:
    from subiaco_bringup.recording import record_graph

    launched = launched_lines(
        LAUNCH / "record.launch.py",
        output=str(tmp_path / "drive"),
        set="record.split_duration=5.0",
        remap="/gnss/fix:=/ublox/fix",
    )
    remappings = [("/gnss/fix", "/ublox/fix")]
    graph = record_graph(tmp_path / "drive", (), ["record.split_duration=5.0"], remappings=remappings)
    assert launched == command_lines(graph)
    assert launched[0][:6] == [
        "subiaco_mapping", "recorder_node", "--ros-args", "-r", "__node:=recorder", "-r"
    ]  # fmt: skip
    assert launched[0][6] == "gnss/fix:=/ublox/fix"


def test_the_recorder_gets_its_slice_of_the_configuration_alone(tmp_path: Path) -> None:
    from subiaco_bringup.recording import recorder_spec

    config = {"crs": "EPSG:7850", "record": {"split_duration": 5.0}}
    parameters = recorder_spec(config, tmp_path / "drive").parameters
    assert parameters == {
        "record": {"exit_when_stopped": False, "split_duration": 5.0},
        "output": str(tmp_path / "drive"),
        "resume": True,
        "duration": 0.0,
    }


@pytest.mark.parametrize("text", ["/gnss/fix", ":=/ublox/fix", "/gnss/fix:="])
def test_a_remapping_that_is_none_says_how_one_looks(text: str) -> None:
    from subiaco_bringup.recording import parse_remapping
    from subiaco_geo.errors import InputError

    with pytest.raises(InputError, match="expected OUR_TOPIC:=SOURCE"):
        parse_remapping(text)


@pytest.mark.usefixtures("launch_stub")
def test_launch_file_and_supervisor_start_the_same_live_command_lines(tmp_path: Path) -> None:
    from subiaco_bringup.defaults import config_files
    from subiaco_bringup.live_graph import live_graph

    driver = LAUNCH.parents[2] / "config" / "drivers" / "ublox.yaml"
    launched = launched_lines(
        LAUNCH / "live.launch.py",
        output=str(tmp_path / "drive"),
        config=str(driver),
        set="watch.gnss.max_hdop=2.0 record.split_duration=30",
        remap="/imu/data:=/xsens/imu",
        route=str(tmp_path / "plan.geojson"),
    )
    graph = live_graph(
        tmp_path / "drive",
        config_files("mapping", (driver,)),
        ["watch.gnss.max_hdop=2.0", "record.split_duration=30"],
        remappings=[("/imu/data", "/xsens/imu")],
        route=tmp_path / "plan.geojson",
    )
    assert launched == command_lines(graph)


def test_every_driver_profile_gives_valid_nodes_that_hear_the_drivers_topics(tmp_path: Path) -> None:
    from subiaco_bringup.live_graph import live_graph
    from subiaco_mapping.nodes.monitor_node import MonitorParameters

    profiles = sorted((LAUNCH.parents[2] / "config" / "drivers").glob("*.yaml"))
    assert len(profiles) >= 5
    for profile in profiles:
        graph = live_graph(tmp_path / "drive", [profile], ["record.queue_mb=64"])
        recorder, monitor, *_ = graph.nodes
        assert recorder.parameters["record"]["queue_mb"] == 64
        assert all(node.remappings == monitor.remappings for node in graph.nodes)
        assert monitor.remappings, f"{profile.name} names no topic"
        own = set(MonitorParameters.model_fields) | {"use_sim_time"}
        given = {k: v for k, v in ros_parameters(monitor.parameters).items() if k not in own}
        config = MappingConfig.model_validate(given)
        assert {ours.lstrip("/") for ours, _ in config.topics.remappings()} == {
            ours for ours, _ in monitor.remappings
        }


def test_only_what_can_be_started_again_without_harm_is(tmp_path: Path) -> None:
    from subiaco_bringup.live_graph import live_graph

    nodes = {node.name: node for node in live_graph(tmp_path / "drive").nodes}
    assert [name for name, node in nodes.items() if node.restart] == ["recorder", "monitor", "odometry"]
    assert [name for name, node in nodes.items() if node.essential] == ["recorder"]
    unrecorded = live_graph(tmp_path / "drive", record=False).nodes
    assert [node.name for node in unrecorded if node.essential] == ["odometry"]
    assert "recorder" not in {node.name for node in live_graph(tmp_path / "drive", record=False).nodes}


@pytest.mark.usefixtures("launch_stub")
@pytest.mark.parametrize(("record", "sim_time"), [(True, False), (False, True)])
def test_launch_file_and_supervisor_treat_the_live_nodes_alike(
    tmp_path: Path, record: bool, sim_time: bool
) -> None:
    from subiaco_bringup.defaults import config_files
    from subiaco_bringup.live_graph import live_graph

    file, drive = LAUNCH / "live.launch.py", tmp_path / "drive"
    given = {"output": str(drive), "record": str(record).lower(), "use_sim_time": str(sim_time).lower()}
    graph = live_graph(drive, config_files("mapping"), record=record, sim_time=sim_time)
    assert launched_lines(file, **given) == command_lines(deployed(graph, use_sim_time=sim_time))
    nodes = launched_nodes(file, **given)
    assert [n["respawn"] for n in nodes] == [spec.restart for spec in graph.nodes]
    assert [float(n["sigterm_timeout"]) for n in nodes] == [spec.grace for spec in graph.nodes]
    names = ["monitor_node", "odometry_node", "pose_graph_node"]
    assert [n["executable"] for n in nodes] == [*(["recorder_node"] if record else []), *names]


@pytest.mark.usefixtures("launch_stub")
@pytest.mark.parametrize("file", sorted(LAUNCH.glob("*.launch.py")), ids=lambda path: path.name)
def test_a_launch_file_keeps_to_this_host_where_nothing_else_is_set(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from subiaco_bringup.environment import dds_defaults

    for name in dds_defaults({}):
        monkeypatch.delenv(name, raising=False)
    said = dict(a.given for a in description_of(file) if isinstance(a, SetEnvironmentVariable))
    assert said == dds_defaults({})
    for name in said:
        monkeypatch.setenv(name, "mine")
    assert not [a for a in description_of(file) if isinstance(a, SetEnvironmentVariable)]


def test_every_process_of_every_graph_is_an_executable_of_its_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from subiaco_bringup.live_graph import live_graph

    graphs = [
        live_graph(tmp_path),
        mapping_graph(mapping_request(tmp_path)),
        in_one_process(mapping_graph(mapping_request(tmp_path))),
        change_graph(change_request(tmp_path)),
    ]
    for spec in {node.executable: node for graph in graphs for node in graph.nodes}.values():
        said = (LAUNCH.parents[1] / spec.package / "setup.py").read_text()
        assert f"{spec.executable} = {spec.package}.nodes.executables:{spec.executable}" in said
        assert importlib.util.find_spec(f"{spec.package}.nodes.{spec.executable}") is not None
        executables = importlib.import_module(f"{spec.package}.nodes.executables")
        started: list[str] = []
        monkeypatch.setattr(executables, "start", started.append)
        getattr(executables, spec.executable)()
        assert started == [f"{spec.package}.nodes.{spec.executable}"]


@pytest.mark.usefixtures("launch_stub")
def test_every_launch_file_takes_namespace_clock_autostart_and_a_port_for_foxglove(tmp_path: Path) -> None:
    nodes = launched_lines(
        LAUNCH / "live.launch.py",
        output=str(tmp_path / "drive"),
        namespace="left",
        use_sim_time="true",
        autostart="false",
        foxglove_port="8765",
    )
    assert [line[1] for line in nodes] == [
        "recorder_node", "monitor_node", "odometry_node", "pose_graph_node", "foxglove_node"
    ]  # fmt: skip
    for line in nodes:
        assert line[line.index("__ns:=/left") - 1] == "-r"
        given = parameters_of(line)
        assert (given["use_sim_time"], given["autostart"]) == (True, False)
    assert parameters_of(nodes[-1])["host"] == "127.0.0.1"
    plain = launched_lines(LAUNCH / "mapping.launch.py", bag=str(tmp_path / "bag"), output="out")
    for line in plain:
        assert not any(word.startswith("__ns") for word in line)
        assert "autostart" not in parameters_of(line)


@pytest.mark.usefixtures("launch_stub")
def test_a_launch_argument_that_is_neither_true_nor_false_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="launch argument maybe: expected true or false"):
        launched_nodes(LAUNCH / "live.launch.py", output=str(tmp_path / "drive"), autostart="maybe")
