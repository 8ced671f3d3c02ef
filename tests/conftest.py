"""What every test may use: real recordings where they are, one hypothesis profile."""

from __future__ import annotations

import fcntl
import logging
import os
import signal
import tempfile
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any, TextIO

import pytest
from hypothesis import HealthCheck, settings

REPOSITORY = Path(__file__).resolve().parents[1]

# A ROS domain for each session and each of its workers, so that tests running side by side do not hear each
# other. Domains 1 to 101 keep clear of the ephemeral ports.
_DOMAIN = os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 101))
_OF_WORKERS = [1 + (int(_DOMAIN) + 50 * worker) % 101 for worker in range(8)]
# Tests that take a domain of their own leave those of the workers alone (tests/ros/ros_harness.py).
os.environ.setdefault("SUBIACO_TEST_DOMAINS", " ".join(map(str, [int(_DOMAIN), *_OF_WORKERS])))
_WORKER = os.environ.get("PYTEST_XDIST_WORKER")
if _WORKER is not None:
    os.environ["ROS_DOMAIN_ID"] = str(_OF_WORKERS[int(_WORKER.removeprefix("gw"))])

# A shell without job control lets what it starts in the background ignore SIGINT, and children inherit
# that: a graph that a test interrupts would go on.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

_FEW_TESTS = 6  # of a file

# Same examples on every run; what takes long on a busy machine is not a failure.
settings.register_profile(
    "subiaco", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("subiaco")


def pytest_configure(config: pytest.Config) -> None:
    """Register the markers here too, for `colcon test`, which does not read pyproject.toml."""
    config.addinivalue_line("markers", "slow: takes more than ten seconds")
    config.addinivalue_line("markers", "ros: needs the built workspace (source ros2_ws/env.sh)")
    config.addinivalue_line("markers", "realtime: has to keep up with a clock, and runs alone")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Share out whole files, but the streets of the accuracy gate one by one: each takes a minute.

    In the order of :func:`pytest_collection_modifyitems`.
    """
    from xdist.scheduler import LoadFileScheduling

    class Scheduling(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return nodeid if nodeid.startswith("tests/accuracy/") else str(super()._split_scope(nodeid))

    if config.getoption("dist") != "loadfile":
        return None
    config.option.loadscopereorder = False
    return Scheduling(config, log)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Order the files so that no worker waits for another: they are handed out in this order.

    Files with slow tests come first, for a slow one at the end would leave the other worker without work;
    then the files with many tests. A test that has to be alone waits for the test that the other worker is
    at: those files come late, beside files with few and short tests.
    """
    if _WORKER is None:
        return
    files: dict[Path, list[pytest.Item]] = {}
    for item in items:
        files.setdefault(item.path, []).append(item)

    def rank(item: pytest.Item) -> tuple[int, int, str]:
        own = files[item.path]
        if any(other.get_closest_marker("realtime") for other in own):
            turn = 2
        elif any(other.get_closest_marker("slow") for other in own):
            turn = 0
        else:
            turn = 1 if len(own) > _FEW_TESTS else 3
        return turn, -len(own), str(item.path)

    items.sort(key=rank)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Let a test that has to keep real time run while the other workers wait.

    A worker holds a lock while it runs a test: shared, or exclusive under the marker ``realtime``. Whoever
    wants the lock queues at a second one, so that a test that wants to be alone gets its turn.
    """
    if _WORKER is None:
        return (yield)
    kind = fcntl.LOCK_SH if item.get_closest_marker("realtime") is None else fcntl.LOCK_EX
    with _lock_file("queue") as queue, _lock_file("running") as running:
        fcntl.flock(queue, fcntl.LOCK_EX)
        fcntl.flock(running, kind)
        fcntl.flock(queue, fcntl.LOCK_UN)
        return (yield)


def _lock_file(name: str) -> TextIO:
    return (Path(tempfile.gettempdir()) / f"subiaco-tests-{os.getuid()}.{name}").open("w")


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip ROS tests, with the reason, where the workspace is not on the path."""
    if item.get_closest_marker("ros") is not None:
        pytest.importorskip("rclpy", reason="no rclpy: run make setup")
        pytest.importorskip("subiaco_msgs.msg", reason="workspace not sourced: source ros2_ws/env.sh")


@pytest.fixture(scope="session")
def repository() -> Path:
    """Root of the repository."""
    return REPOSITORY


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real recordings: $SUBIACO_TEST_DATA, else ../shared/data; skips where there is none."""
    named = os.environ.get("SUBIACO_TEST_DATA")
    folder = Path(named) if named else REPOSITORY.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"no real recordings: {folder} is no folder (set SUBIACO_TEST_DATA)")
    return folder


@pytest.fixture(autouse=True)
def _levels_of_our_loggers() -> Iterator[None]:
    """Undo what a command in this process set: ``--quiet`` would silence the warnings of later tests."""
    yield
    for name in ("geo", "sim", "mapping", "change", "evaluation", "bringup"):
        logging.getLogger(f"subiaco_{name}").setLevel(logging.NOTSET)
