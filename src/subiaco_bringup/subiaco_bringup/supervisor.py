"""Start the processes of a graph, show what they say, notice who fails, leave nothing running."""

from __future__ import annotations

import logging
import os
import re
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from subiaco_bringup.graph import GraphSpec, NodeSpec, process_command
from subiaco_geo.errors import InputError, RegistrationError, SubiacoError
from subiaco_geo.signals import interrupt_blocked, signals_interrupt
from subiaco_ros.supervision import CHANNEL, NodeProgress, ReportListener

LOGGER = logging.getLogger(__name__)

Report = Callable[[str, float], None]

OnStatus = Callable[[dict[str, Any]], None]

#: How :func:`subiaco_bringup.environment.node_environment` has nodes begin the lines of their logs.
_LEVEL = re.compile(r"^\[(DEBUG|INFO|WARN|ERROR|FATAL)\] ?(.*)$")
_LEVELS = {
    "DEBUG": logging.DEBUG,
    "INFO": logging.INFO,
    "WARN": logging.WARNING,
    "ERROR": logging.ERROR,
    "FATAL": logging.DEBUG,  # raised as the error of the job instead
}
_POLL = 0.05
#: A node that ends with bad input within this time is not started again, as it would end again [s].
SETTLING = 15.0
#: A node that crashes more often than this is not started again.
MOST_RESTARTS = 5
#: Before the first restart; each further one waits longer by as much [s].
RESTART_DELAY = 1.0
INTERRUPTED = 130


class NodeProcess:
    """One running node and what it says.

    Parameters
    ----------
    spec : NodeSpec
    environment : mapping
    progress : callable, optional
        Told ``(stage, fraction)``.
    on_status : callable, optional
        Told what the node sees.
    """

    def __init__(
        self,
        spec: NodeSpec,
        environment: Mapping[str, str],
        progress: Report | None,
        on_status: OnStatus | None = None,
    ) -> None:
        self.spec = spec
        self.started = time.monotonic()
        self._on_status = on_status
        self.fatal = ""
        self._tail: list[str] = []
        self._progress = progress
        reading, writing = os.pipe()
        with interrupt_blocked():  # one that comes during its imports would break them; run_node unblocks it
            self._process = subprocess.Popen(
                process_command(spec),
                env={**environment, CHANNEL: str(writing)},
                pass_fds=(writing,),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                errors="replace",
                start_new_session=True,
            )
        os.close(writing)
        reports = ReportListener(self._on_progress, self._show, self._on_error)
        self._readers = [
            threading.Thread(target=take, args=taken, name=f"{what} of {spec.name}", daemon=True)
            for what, take, taken in (("log", self._read, ()), ("reports", reports.read, (reading,)))
        ]
        for reader in self._readers:
            reader.start()

    @property
    def code(self) -> int | None:
        """Exit code, negative for a signal, None while it runs."""
        return self._process.poll()

    @property
    def tail(self) -> str:
        """The last lines, for a crash."""
        return "\n".join(self._tail)

    def send(self, number: signal.Signals) -> None:
        """Send a signal, if it still runs."""
        if self.code is None:
            self._process.send_signal(number)

    def finish_reading(self) -> None:
        """Wait until everything said has been taken in."""
        for reader in self._readers:
            reader.join(timeout=2.0)

    def _on_progress(self, progress: NodeProgress) -> None:
        if self._progress is not None:
            self._progress(progress.stage, progress.fraction)

    def _show(self, status: dict[str, Any]) -> None:
        if self._on_status is not None:
            self._on_status(status)

    def _on_error(self, text: str) -> None:
        self.fatal = text

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._take(line.rstrip("\n"))

    def _take(self, line: str) -> None:
        if not line.strip():
            return
        self._tail = [*self._tail[-19:], line]
        match = _LEVEL.match(line)
        level, text = (match[1], match[2]) if match else ("INFO", line)
        if not text.strip():
            return
        LOGGER.log(_LEVELS[level], "[%s] %s", self.spec.name, text)


def failure(process: NodeProcess) -> SubiacoError:
    """Turn how a node ended into the error of the job, with the exit code of the contract."""
    process.finish_reading()
    code = process.code
    if code == InputError.exit_code:
        return InputError(process.fatal or f"{process.spec.name}: bad input")
    if code == RegistrationError.exit_code:
        return RegistrationError(process.fatal or f"{process.spec.name}: registration failed")
    if process.fatal:
        return SubiacoError(process.fatal)
    if code is not None and code < 0:
        how = f"was killed by {signal.Signals(-code).name}"
    else:
        how = f"crashed (exit code {code})"
    LOGGER.debug("last lines of %s:\n%s", process.spec.name, process.tail)
    last = process.tail.splitlines()[-1:] or ["it said nothing"]
    return SubiacoError(f"node {process.spec.name} {how}: {last[0]}")


@dataclass(frozen=True)
class Death:
    """A node that ended unasked, and what became of it."""

    node: str
    time_ns: int
    how: str


class Supervisor:
    """Run one graph to its end.

    A node that may be restarted is, a few times; one that the job can do without is named and done
    without; any other ends the job.

    Parameters
    ----------
    graph : GraphSpec
    environment : mapping
        See :func:`subiaco_bringup.environment.node_environment`.
    progress : callable, optional
    grace : float
        Least seconds that a node gets to end after SIGINT, and again after SIGTERM.
    on_status : callable, optional
        Told what nodes see.
    linger : float
        Seconds that the others get to end after the principal node.
    """

    def __init__(
        self,
        graph: GraphSpec,
        environment: Mapping[str, str],
        progress: Report | None = None,
        grace: float = 10.0,
        linger: float = 20.0,
        on_status: OnStatus | None = None,
    ) -> None:
        self._graph = graph
        self._environment = environment
        self._progress = progress
        self._grace = grace
        self._linger = linger
        self._on_status = on_status
        self.processes: list[NodeProcess] = []
        self.deaths: list[Death] = []
        self._due: list[tuple[float, NodeSpec]] = []

    def run(self) -> None:
        """Start every node, wait for the end, and leave nothing running.

        Raises
        ------
        SubiacoError
            A node failed: InputError, RegistrationError or a fault, as its exit code says.
        KeyboardInterrupt
            Interrupted from outside, or a node was.
        """
        with signals_interrupt():
            try:
                for spec in self._graph.nodes:
                    self._start(spec)
                self._wait()
            finally:
                self._stop()

    def require_whole(self) -> None:
        """Say after an interruption that a node could not put everything away, or was missing at the end.

        Raises
        ------
        SubiacoError
            With the node's own reason.
        """
        for process in self.processes:
            if process.code not in (0, INTERRUPTED, -signal.SIGINT):
                raise failure(process)
        present = {process.spec.name for process in self.processes}
        for death in self.deaths:
            if death.node not in present:
                raise SubiacoError(death.how)

    def _start(self, spec: NodeSpec) -> None:
        self.processes.append(NodeProcess(spec, self._environment, self._progress, self._on_status))

    def _wait(self) -> None:
        deadline: float | None = None
        while True:
            self._check()
            self._start_due()
            awaited = (process for process in self.processes if not process.spec.companion)
            if not self._due and all(process.code is not None for process in awaited):
                break
            if deadline is None and self._principal_done():
                deadline = time.monotonic() + self._linger
            if deadline is not None and time.monotonic() > deadline:
                return
            time.sleep(_POLL)
        self._check()

    def _principal_done(self) -> bool:
        return any(process.spec.principal and process.code == 0 for process in self.processes)

    def _start_due(self) -> None:
        now = time.monotonic()
        for when, spec in [item for item in self._due if item[0] <= now]:
            self._due.remove((when, spec))
            self._start(spec)

    def _check(self) -> None:
        failed = [process for process in self.processes if process.code not in (None, 0)]
        fatal = [process for process in failed if not self._survived(process)]
        if not fatal:
            return
        if all(process.code == INTERRUPTED for process in fatal):
            raise KeyboardInterrupt
        raise failure(next(process for process in fatal if process.code != INTERRUPTED))

    def _survived(self, process: NodeProcess) -> bool:
        """Restart a failed node, or go on without it, where that is safe."""
        spec = process.spec
        refused = process.code in (InputError.exit_code, RegistrationError.exit_code)
        if refused and time.monotonic() - process.started < SETTLING:
            return False
        before = sum(death.node == spec.name for death in self.deaths)
        again = spec.restart and before < MOST_RESTARTS
        if not again and spec.essential:
            return False
        what = "starting it again" if again else "going on without it"
        how = str(failure(process))
        LOGGER.error("%s; %s", how, what)
        self.deaths.append(Death(spec.name, time.time_ns(), f"{how}; {what}"))
        self.processes.remove(process)
        if again:
            self._due.append((time.monotonic() + RESTART_DELAY * (1 + before), spec))
        return True

    def _stop(self) -> None:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
            running = [process for process in self.processes if process.code is None]
            if not running:
                break
            for process in running:
                process.send(number)
            self._await_end(running)
        for process in self.processes:
            process.finish_reading()

    def _await_end(self, running: list[NodeProcess]) -> None:
        deadline = time.monotonic() + max([self._grace, *(process.spec.grace for process in running)])
        while any(process.code is None for process in running) and time.monotonic() < deadline:
            time.sleep(_POLL)
