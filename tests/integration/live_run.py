"""``subiaco graph live`` as people run it, and what it says when."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path


class LiveRun:
    """The live graph in a process; ``lines`` holds what it said, and when by the steady clock [s]."""

    def __init__(self, *words: object, settings: tuple[str, ...] = ()) -> None:
        command = [sys.executable, "-m", "subiaco_bringup.cli.main", "graph", "live", *map(str, words)]
        for setting in settings:
            command += ["--set", setting]
        self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        self.lines: list[tuple[float, str]] = []
        self._stalls: list[tuple[float, float]] = []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        threading.Thread(target=self._feel, daemon=True).start()

    def _read(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self.lines.append((time.monotonic(), line.rstrip()))

    def _feel(self) -> None:
        """Note how long the machine lets nobody run: a thread that asks for 20 ms."""
        while self.process.poll() is None:
            begun = time.monotonic()
            time.sleep(0.02)
            self._stalls.append((begun, time.monotonic() - begun - 0.02))

    @property
    def text(self) -> str:
        return "\n".join(line for _, line in list(self.lines))

    def until(self, condition: Callable[[], object], timeout: float = 90.0) -> None:
        deadline = time.monotonic() + timeout
        while not condition():
            assert self.process.poll() is None, self.text
            assert time.monotonic() < deadline, self.text
            time.sleep(0.02)

    def heard(self, pattern: str, since: float = 0.0) -> float | None:
        """Return when a line first matched after some time, None where none has."""
        return next((at for at, line in list(self.lines) if at >= since and re.search(pattern, line)), None)

    def noticed(self, pattern: str, since: float) -> float:
        """Wait for a line; return how long after ``since`` it came, less three stalls of the machine [s].

        Three, because a driver, the watch and the supervisor have to run one after the other.
        """
        self.until(lambda: self.heard(pattern, since))
        at = self.heard(pattern, since)
        assert at is not None
        stall = max((late for begun, late in list(self._stalls) if since <= begun <= at), default=0.0)
        return at - since - 3 * stall

    def children(self, module: str) -> list[int]:
        """Return the process ids of a node of this run."""
        table = subprocess.run(
            ["ps", "-ww", "-eo", "pid,ppid,args"], capture_output=True, text=True, check=True
        ).stdout
        rows = [line.split(None, 2) for line in table.splitlines()[1:]]
        return [int(row[0]) for row in rows if int(row[1]) == self.process.pid and module in row[2]]

    def wait(self) -> int:
        """Return the exit code once it has ended and everything said is there."""
        code = self.process.wait(timeout=600)  # a first run compiles while it builds the map
        self._reader.join(timeout=5)
        return code

    def stop(self) -> int:
        """Press Ctrl-C."""
        self.process.send_signal(signal.SIGINT)
        return self.wait()

    def kill(self) -> None:
        """End it where a test has failed; its nodes notice that their supervisor is gone."""
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait(timeout=10)


class Drivers:
    """A process of ``sensors.py``."""

    def __init__(self, *words: str) -> None:
        script = Path(__file__).with_name("sensors.py")
        self.process = subprocess.Popen(
            [sys.executable, str(script), *words], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def obey(self, command: str) -> float:
        """Give a command; return when it held."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(command + "\n")
        self.process.stdin.flush()
        assert self.process.stdout.readline() == command + "\n"
        return time.monotonic()

    def kill(self) -> float:
        """Kill it; return when."""
        self.process.kill()
        self.process.wait(timeout=10)
        return time.monotonic()
