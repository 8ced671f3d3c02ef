"""Usage and configuration at fault, outputs that exist, interruptions, faults of ours."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from contextlib import suppress

import psutil
import pytest
import typer
from small_bags import points_bag, room
from small_clouds import ORIGIN, street, write_street

from subiaco_bringup.cli import main
from subiaco_geo.clouds import PointCloud
from subiaco_geo.maps import write_map
from subiaco_geo.survey_map import SurveyMap

CONFIG = "/**:\n  ros__parameters:\n    {line}\n"


@pytest.fixture
def bag(tmp_path):
    return points_bag(tmp_path / "bag", [room()])


@pytest.fixture
def good(tmp_path):
    return write_street(tmp_path / "good.ply")


@pytest.mark.parametrize("verb", ["explode", "mapp"])
def test_an_unknown_verb(refused, verb):
    refused([verb], verb, "subiaco --help")


@pytest.mark.parametrize("verb", ["map", "change", "simulate", "inspect", "report"])
def test_an_unknown_option(refused, verb):
    refused([verb, "--frobnicate"], "--frobnicate", f"see 'subiaco {verb} --help'")


def test_a_missing_argument_and_a_missing_output(refused, good):
    refused(["map"], "BAG", "--help")
    refused(["change", good, good], "--output", "--help")


def test_a_number_that_is_none(refused, tmp_path):
    refused(["simulate", tmp_path / "out", "--duration", "long"], "--duration", "valid number", "--help")


def test_a_configuration_file_that_is_missing(refused, bag, tmp_path):
    arguments = ["map", bag, "-o", tmp_path / "out", "--config", tmp_path / "none.yaml"]
    refused(arguments, "none.yaml: cannot be read", "No such file")


def test_a_configuration_file_that_is_not_yaml(refused, bag, tmp_path):
    (tmp_path / "odd.yaml").write_text("/**: [unclosed\n")
    arguments = ["map", bag, "-o", tmp_path / "out", "--config", tmp_path / "odd.yaml"]
    refused(arguments, "odd.yaml: not valid YAML")


def test_a_configuration_file_without_the_ros_form(refused, bag, tmp_path):
    (tmp_path / "flat.yaml").write_text("crs: EPSG:7850\n")
    arguments = ["map", bag, "-o", tmp_path / "out", "--config", tmp_path / "flat.yaml"]
    refused(arguments, "flat.yaml", "'/**:'", "'ros__parameters:'")


def test_an_unknown_key_names_its_file_and_the_nearest_known_one(refused, bag, tmp_path):
    (tmp_path / "typo.yaml").write_text(CONFIG.format(line="odometry: {voxl: 1.0}"))
    (tmp_path / "fine.yaml").write_text(CONFIG.format(line="fusion: {leaf: 0.3}"))
    files = ["--config", tmp_path / "typo.yaml", "--config", tmp_path / "fine.yaml"]
    line = refused(
        ["map", bag, "-o", tmp_path / "out", *files], "typo.yaml: odometry.voxl", "did you mean voxel?"
    )
    assert "fine.yaml" not in line


def test_an_unknown_section_lists_what_is_known(refused, good, tmp_path):
    arguments = ["change", good, good, "-o", tmp_path / "out", "--set", "qqq=1"]
    refused(arguments, "--set qqq=1: qqq: no such setting", "leaf", "registration")


@pytest.mark.parametrize("setting", ["leaf", "=1", "a..b=1", ".leaf=1"])
def test_a_malformed_setting(refused, good, tmp_path, setting):
    arguments = ["change", good, good, "-o", tmp_path / "out", "--set", setting]
    refused(arguments, f"--set {setting}", "expected key=value")


def test_a_setting_whose_value_is_not_yaml(refused, good, tmp_path):
    arguments = ["change", good, good, "-o", tmp_path / "out", "--set", "leaf=[1"]
    refused(arguments, "--set leaf=[1", "quote it")


@pytest.mark.parametrize(("setting", "field"), [("leaf=-1", "leaf"), ("leaf=wide", "leaf"), ("lod=3", "lod")])
def test_a_setting_out_of_bounds_or_of_the_wrong_kind(refused, good, tmp_path, setting, field):
    arguments = ["change", good, good, "-o", tmp_path / "out", "--set", setting]
    refused(arguments, f"--set {setting}: {field}: Input should be")


def test_an_unknown_preset(refused, tmp_path):
    refused(["simulate", tmp_path / "out", "--preset", "castle"], "castle", "easy, default")


@pytest.mark.parametrize(
    ("option", "value", "known"),
    [("--mode", "5x5", "512x10"), ("--epoch", "never", "before"), ("--duration", "0.1", "greater than 1")],
)
def test_simulation_options_out_of_bounds(refused, tmp_path, option, value, known):
    refused(["simulate", tmp_path / "out", option, value], option.lstrip("-"), value, known)


@pytest.mark.parametrize(
    ("arguments", "typed"),
    [
        (["simulate", "--duration", "-5"], "--duration -5.0: "),
        (["map", "BAG", "--threads", "-2"], "--threads -2: "),
    ],
)
def test_an_option_out_of_bounds_is_named_as_it_was_typed(refused, bag, tmp_path, arguments, typed):
    words = [bag if word == "BAG" else word for word in arguments]
    out = [tmp_path / "out"] if words[0] == "simulate" else ["-o", tmp_path / "out"]
    said = refused([*words, *out], typed)
    assert "--set" not in said


def test_a_cloud_is_no_directory_to_export(refused, good, tmp_path):
    refused(["export", good, "--to", "tiles", "-o", tmp_path / "out"], "good.ply: is a file", "map directory")


def test_invalid_yaml_is_named_with_its_line(refused, good, tmp_path):
    (tmp_path / "odd.yaml").write_text("/**:\n  ros__parameters:\n    leaf: [0.5\n")
    run = ["change", good, good, "-o", tmp_path / "out", "--config"]
    refused([*run, tmp_path / "odd.yaml"], "odd.yaml: not valid YAML (line 4: ", "correct it")
    (tmp_path / "cloud.laz").write_bytes(bytes(range(128, 256)))
    said = refused([*run, tmp_path / "cloud.laz"], "cloud.laz: not a text file", "configuration in YAML")
    assert "codec" not in said


def test_a_log_that_is_missing_is_named_without_a_number_of_the_system(refused, tmp_path):
    (tmp_path / "drive.pcap").write_bytes(b"")
    run = ["import", tmp_path / "drive.pcap", "--imu", tmp_path / "none.csv", "-o", tmp_path / "out"]
    said = refused(run, "none.csv", "no such file or directory", "check the file")
    assert "Errno" not in said


def test_an_output_that_exists(refused, good, bag, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("keep me")
    (tmp_path / "drive.pcap").write_bytes(b"")
    for arguments in (
        ["change", good, good, "-o", tmp_path / "out"],
        ["map", bag, "-o", tmp_path / "out"],
        ["import", tmp_path / "drive.pcap", "-o", tmp_path / "out"],
        ["simulate", tmp_path / "out"],
    ):
        refused(arguments, "out: exists already", "--overwrite")


def test_an_output_that_exists_offers_no_option_that_the_verb_lacks(refused, bag, tmp_path):
    write_map(tmp_path / "map", SurveyMap(PointCloud(street(), ORIGIN, "EPSG:7850")))
    (tmp_path / "out").mkdir()
    (tmp_path / "drive").mkdir()
    (tmp_path / "drive" / "drive_0.mcap").write_bytes(next(bag.glob("*.mcap")).read_bytes()[:-30])
    for arguments in (
        ["export", tmp_path / "map", "--to", "ply", "-o", tmp_path / "out"],
        ["recover", tmp_path / "drive", "-o", tmp_path / "out"],
    ):
        said = refused(arguments, "out: exists already", "choose another place", "remove it")
        assert "--overwrite" not in said


def test_a_recording_that_exists_is_gone_on_with_or_left_alone(refused, tmp_path):
    (tmp_path / "out").mkdir()
    said = refused(["record", "-o", tmp_path / "out"], "out: exists already", "--resume")
    assert "--overwrite" not in said


def test_refusals_of_the_recorder_leave_no_folder(refused, tmp_path):
    for arguments, said in (
        (["--set", "nonsense=1"], "no such setting"),
        (["--remap", "/gnss/fix"], "expected OUR_TOPIC:=SOURCE"),
        (["--config", tmp_path / "none.yaml"], "none.yaml"),
    ):
        refused(["record", "-o", tmp_path / "drive", *arguments], said)
        assert list(tmp_path.iterdir()) == []


def test_messages_name_no_option_that_no_verb_has(repository):
    """Texts of the sources that advise an option; `--ros-args` and options of other programs are left out."""
    command = typer.main.get_command(main.app)
    groups = [command, *(c for c in command.commands.values() if hasattr(c, "commands"))]
    verbs = [verb for group in groups for verb in group.commands.values()]
    known = {option for verb in verbs for p in verb.params for option in (*p.opts, *p.secondary_opts)}
    advised = re.compile(r"(?:pass|give|use|with|without|leave|add|or|and) (--[a-z][a-z-]+)")
    foreign = {"--clock", "--ros-args", "--shm-size"}
    found = {
        (path.name, option)
        for path in (repository / "src").rglob("*.py")
        for option in advised.findall(path.read_text(encoding="utf-8"))
    }
    assert len(found) >= 15
    assert {(name, option) for name, option in found if option not in known | foreign} == set()


def test_a_folder_of_other_things_is_never_replaced(refused, good, bag, tmp_path):
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis.tex").write_text("years of work")
    (tmp_path / "drive.pcap").write_bytes(b"")
    for arguments in (
        ["change", good, good, "-o", tmp_path / "home"],
        ["map", bag, "-o", tmp_path / "home"],
        ["import", tmp_path / "drive.pcap", "-o", tmp_path / "home"],
        ["simulate", tmp_path / "home"],
    ):
        refused([*arguments, "--overwrite"], "home: holds other things", "choose another place")


def test_an_output_under_a_file(refused, good, tmp_path):
    refused(["change", good, good, "-o", good / "out"], "good.ply: is a file", "choose another place")


def interrupt(*_, **__):
    raise KeyboardInterrupt


def break_down(*_, **__):
    raise ZeroDivisionError("division by zero\nin two lines")


def test_an_interruption_leaves_nothing(refused, bag, tmp_path, monkeypatch):
    monkeypatch.setattr("subiaco_mapping.job.map_survey", interrupt)
    refused(["map", bag, "-o", tmp_path / "out"], "interrupted", "no output was written", code=130)


def test_an_interrupted_run_leaves_its_stages_and_goes_on_from_there(
    command, good, tmp_path, monkeypatch, caplog
):
    monkeypatch.setattr("subiaco_report.pages.write_report", interrupt)
    options = ["--registration", "identity", "--set", "leaf=0.5"]
    run = ["change", good, good, "-o", tmp_path / "out", "--workers", "1", *options]
    stopped = command(*run)
    assert stopped.code == 130
    assert stopped.err.splitlines()[-1].startswith("subiaco: interrupted")
    assert "the same command goes on from there" in caplog.text
    assert {path.name for path in tmp_path.iterdir()} == {"good.ply", "out.stages"}
    monkeypatch.undo()
    caplog.clear()
    assert command(*run).code == 0
    assert "what a run that was stopped finished there is used again" in caplog.text
    assert {path.name for path in tmp_path.iterdir()} == {"good.ply", "out"}


def under(process):
    """Return the living processes that a process started; none where it has ended."""
    try:
        return [child for child in process.children(recursive=True) if child.status() != "zombie"]
    except psutil.NoSuchProcess:
        return []


def wait_until(true, seconds=120.0):
    deadline = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < deadline, "too slow"
        time.sleep(0.02)


@pytest.mark.parametrize("started", [1, 3], ids=["while workers load", "while workers work"])
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_a_run_with_all_its_workers_and_shows_no_traceback(
    good, tmp_path, number, code, started
):
    """Ctrl-C reaches the workers too; SIGTERM reaches the command alone."""
    words = ["change", good, good, "-o", tmp_path / "out", "--workers", "2", "--registration", "identity"]
    with (tmp_path / "said").open("w") as said:
        run = psutil.Popen(
            [sys.executable, "-m", "subiaco_bringup.cli.main", *map(str, words), "--set", "leaf=0.5"],
            stderr=said,
            start_new_session=True,
        )
    loader = "multiprocessing.forkserver"
    seen: list[psutil.Process] = []

    def running() -> bool:
        assert run.poll() is None, (tmp_path / "said").read_text()
        seen[:] = under(run)
        loading = [child for child in seen if loader in " ".join(child.cmdline())]
        return len(loading) >= started

    try:
        wait_until(running)
        (os.killpg if number == signal.SIGINT else os.kill)(run.pid, number)
        # a process that SIGINT itself ended has the code 130 in shells
        assert run.wait(60) in ({code} | ({-signal.SIGINT} if code == 130 else set()))
        wait_until(lambda: not any(child.is_running() and child.status() != "zombie" for child in seen), 60)
        lines = (tmp_path / "said").read_text().splitlines()
        assert not [line for line in lines if "Traceback" in line or "Error" in line]
        assert [line for line in lines if line.startswith("subiaco:")] == [
            "subiaco: interrupted; no output was written"
        ]
    finally:
        for child in [*seen, *([run] if run.poll() is None else [])]:
            with suppress(psutil.NoSuchProcess):
                child.kill()


def test_an_interruption_while_simulating_leaves_nothing(refused, tmp_path, monkeypatch):
    monkeypatch.setattr("subiaco_sim.survey.plan_survey", interrupt)
    refused(["simulate", tmp_path / "out"], "interrupted", code=130)


def test_a_fault_of_ours_is_called_one_and_shows_no_traceback(refused, bag, tmp_path, monkeypatch):
    monkeypatch.setattr("subiaco_mapping.job.map_survey", break_down)
    words = ("fault: ZeroDivisionError: division by zero in two lines", "-v")
    refused(["map", bag, "-o", tmp_path / "out"], *words, code=1)


def test_a_fault_of_ours_shows_the_traceback_with_v(command, bag, tmp_path, monkeypatch):
    monkeypatch.setattr("subiaco_mapping.job.map_survey", break_down)
    ran = command("map", bag, "-o", tmp_path / "out", "-v")
    assert ran.code == 1
    assert "Traceback" in ran.err
    assert "break_down" in ran.err
    assert "subiaco: fault" in ran.err
    assert not (tmp_path / "out").exists()


def test_bad_input_shows_the_traceback_only_with_v(command, tmp_path):
    assert "Traceback" not in command("inspect", tmp_path / "none").err
    assert "Traceback" in command("inspect", tmp_path / "none", "-v").err


def process(*words, **environment):
    return subprocess.run(
        [sys.executable, "-m", "subiaco_bringup.cli.main", *map(str, words)],
        check=False,
        capture_output=True,
        text=True,
        env={**os.environ, **environment},
        timeout=120,
    )


def test_a_process_ends_with_the_code_and_one_line(tmp_path):
    ran = process("map", tmp_path / "none", "-o", tmp_path / "out")
    assert ran.returncode == 2
    assert ran.stdout == ""
    assert ran.stderr.count("\n") == 1
    assert ran.stderr.startswith(f"subiaco: {tmp_path / 'none'}: no such bag")


def test_a_process_of_a_fault_writes_nothing_on_stdout(tmp_path):
    (tmp_path / "e.ply").write_bytes(b"ply\n")
    ran = process("change", tmp_path / "e.ply", tmp_path / "e.ply", "-o", tmp_path / "out")
    assert ran.returncode == 2
    assert ran.stdout == ""
    assert "e.ply" in ran.stderr
    assert sorted(p.name for p in tmp_path.iterdir()) == ["e.ply"]
