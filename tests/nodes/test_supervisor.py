"""What the supervisor does when a node goes: start it again, go on without, or end the job."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from subiaco_bringup import supervisor as module
from subiaco_bringup.graph import GraphSpec, NodeSpec
from subiaco_bringup.supervisor import Supervisor
from subiaco_geo.errors import InputError, SubiacoError


@pytest.fixture
def scripts(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[[NodeSpec, str], NodeSpec]:
    """Let nodes be small scripts instead; ``tally`` counts the starts of each."""
    programs: dict[str, str] = {}

    def command(spec: NodeSpec) -> list[str]:
        head = f"open({str(tmp_path / spec.name)!r}, 'a').write('x')\n"
        return [sys.executable, "-c", head + programs[spec.name]]

    def script(spec: NodeSpec, program: str) -> NodeSpec:
        programs[spec.name] = program
        return spec

    monkeypatch.setattr(module, "process_command", command)
    monkeypatch.setattr(module, "RESTART_DELAY", 0.05)
    return script


def node(name: str, **how: Any) -> NodeSpec:
    return NodeSpec(name, "package", "executable", {}, **how)


def tally(folder: Path, name: str) -> int:
    path = folder / name
    return len(path.read_text()) if path.exists() else 0


def tells(*reports: str) -> str:
    """Return a program that sends reports, each written as ``kind=value``."""
    lines = ["from subiaco_ros.supervision import NodeProgress, supervisor_channel"]
    for report in reports:
        kind, _, value = report.partition("=")
        lines.append(f"supervisor_channel().{kind}({value})")
    return "\n".join([*lines, ""])


WAITS = "import time\ntime.sleep(60)"


def run_until(supervisor: Supervisor, until: Callable[[], bool]) -> None:
    """Run; kill the principal once a condition holds."""

    def watch() -> None:
        deadline = time.monotonic() + 30
        while not until() and time.monotonic() < deadline:
            time.sleep(0.02)
        for process in list(supervisor.processes):
            if process.spec.principal:
                process.send(module.signal.SIGKILL)

    threading.Thread(target=watch, daemon=True).start()
    supervisor.run()


def test_a_node_that_dies_is_named_and_started_again_a_few_times(scripts: Any, tmp_path: Path) -> None:
    dies = scripts(node("dies", restart=True), "import sys\nsys.exit(7)")
    with pytest.raises(SubiacoError, match=r"node dies crashed \(exit code 7\)"):
        Supervisor(GraphSpec("test", (dies,)), dict(os.environ)).run()
    assert tally(tmp_path, "dies") == 6


def test_the_others_go_on_meanwhile_and_without_a_node_that_nobody_needs(
    scripts: Any, tmp_path: Path
) -> None:
    gone = scripts(node("gone", essential=False), "raise RuntimeError('no more')")
    stays = scripts(node("stays", principal=True), WAITS)
    supervisor = Supervisor(GraphSpec("test", (gone, stays)), dict(os.environ), grace=5.0)
    with pytest.raises(SubiacoError, match="node stays was killed"):
        run_until(supervisor, lambda: len(supervisor.deaths) == 1 and tally(tmp_path, "stays") == 1)
    (death,) = supervisor.deaths
    assert death.node == "gone"
    assert "no more; going on without it" in death.how
    assert (tally(tmp_path, "gone"), tally(tmp_path, "stays")) == (1, 1)


def test_bad_input_at_the_start_ends_the_job_at_once(scripts: Any, tmp_path: Path) -> None:
    refused = scripts(node("refused", restart=True), tells('error="no such thing"') + "raise SystemExit(2)")
    with pytest.raises(InputError, match="no such thing"):
        Supervisor(GraphSpec("test", (refused,)), dict(os.environ)).run()
    assert tally(tmp_path, "refused") == 1


def test_after_an_interruption_a_node_that_could_not_put_everything_away_is_named(scripts: Any) -> None:
    ends = """import json, os, signal, sys, time
def end(*_):
    os.write(int(os.environ['SUBIACO_REPORT_CHANNEL']), b'{"error": "no space left for the map"}\\n')
    sys.exit(1)
signal.signal(signal.SIGINT, end)
signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
print('ready', flush=True)
time.sleep(60)"""
    unlucky = scripts(node("unlucky", restart=True), ends)
    supervisor = Supervisor(GraphSpec("test", (unlucky,)), dict(os.environ))

    def interrupt() -> None:
        deadline = time.monotonic() + 30
        while time.monotonic() < deadline and not (
            supervisor.processes and "ready" in supervisor.processes[0].tail
        ):
            time.sleep(0.02)
        os.kill(os.getpid(), module.signal.SIGTERM)

    threading.Thread(target=interrupt, daemon=True).start()
    with pytest.raises(KeyboardInterrupt):
        supervisor.run()
    with pytest.raises(SubiacoError, match="no space left for the map"):
        supervisor.require_whole()


def test_a_node_that_was_gone_at_the_end_leaves_a_survey_that_is_not_whole(
    scripts: Any,
) -> None:
    gone = scripts(node("gone", essential=False), "raise RuntimeError('no more')")
    supervisor = Supervisor(GraphSpec("test", (gone,)), dict(os.environ))
    supervisor.run()
    with pytest.raises(SubiacoError, match=r"node gone crashed.*going on without it"):
        supervisor.require_whole()


def test_status_and_progress_reach_whoever_shows_them_and_lines_of_the_log_do_not(scripts: Any) -> None:
    seen: list[dict[str, Any]] = []
    stages: list[tuple[str, float]] = []
    long = {"light": "red", "lines": ["x" * 70_000]}  # more than a pipe holds at once
    program = tells("progress=NodeProgress('fusing scans', 0.25)", f"status={long!r}")
    program += """print('progress: nothing 50 %\\n[INFO] status: {"light": "green"}')"""
    says = scripts(node("says", principal=True), program)
    graph = GraphSpec("test", (says,))
    Supervisor(graph, dict(os.environ), lambda *told: stages.append(told), on_status=seen.append).run()
    assert seen == [long]
    assert stages == [("fusing scans", 0.25)]


def test_a_report_that_a_killed_node_left_half_is_passed_over() -> None:
    from subiaco_ros.supervision import NodeProgress, ReportListener

    told: list[Any] = []
    reading, writing = os.pipe()
    os.write(writing, b'{"progress": {"stage": "fusing scans", "fraction": 0.5}}\n{"error": "no sp')
    os.close(writing)
    ReportListener(told.append, told.append, told.append).read(reading)
    assert told == [NodeProgress("fusing scans", 0.5)]


def test_a_node_whose_supervisor_has_gone_works_on(monkeypatch: pytest.MonkeyPatch) -> None:
    from subiaco_ros.supervision import NodeProgress, SupervisorChannel

    reading, writing = os.pipe()
    channel = SupervisorChannel(writing)
    assert channel.supervised
    os.close(reading)
    channel.progress(NodeProgress("fusing scans", 0.5))
    assert not channel.supervised
    channel.error("said to nobody")
    os.close(writing)


def test_an_interruption_during_the_imports_of_a_node_waits_for_their_end(scripts: Any) -> None:
    program = """import os, signal, sys
os.kill(os.getpid(), signal.SIGINT)
from subiaco_ros.node_process import run_node
sys.exit(run_node('starting', lambda node: None))"""
    starting = scripts(node("starting"), program)
    environment = os.environ | {"SUBIACO_SUPERVISOR": str(os.getpid())}
    supervisor = Supervisor(GraphSpec("test", (starting,)), environment)
    with pytest.raises(KeyboardInterrupt):
        supervisor.run()
    assert [process.code for process in supervisor.processes] == [module.INTERRUPTED]
