"""Reads files of native libraries, each in a forked process: `python fork_server.py MODULE FUNCTION`.

The server itself reads no file: libraries start threads, and a process with threads cannot be forked.
A path a line comes in, a line of JSON goes out: how the reader ended.
"""

from __future__ import annotations

import importlib
import json
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import IO

import psutil

sys.path.insert(0, str(Path(__file__).parent))

from subiaco_geo.errors import SubiacoError

_WALL_SECONDS = 60


def outcome(read: Callable[[Path], object], path: Path) -> tuple[str, str]:
    """Return ``read``, ``refused`` or ``fault``, and what was said."""
    try:
        read(path)
    except SubiacoError as error:
        return "refused", str(error)
    except BaseException as error:  # noqa: BLE001 - whatever it is, it is told
        return "fault", f"{type(error).__name__}: {str(error)[:300]}"
    return "read", ""


def forked(read: Callable[[Path], object], path: Path, seconds: int, memory: int) -> tuple[str, str]:
    """Read in a forked process; its death by a signal is a refusal, as it is in subiaco."""
    receiving, sending = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(receiving)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # the last words of the library
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
        limit = psutil.Process().memory_info().vms + memory
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        signal.alarm(_WALL_SECONDS)
        os.write(sending, json.dumps(outcome(read, path)).encode()[:60_000])
        os._exit(0)
    os.close(sending)
    with os.fdopen(receiving, "rb") as stream:
        said = stream.read()
    _, status = os.waitpid(child, 0)
    if not os.WIFSIGNALED(status):
        kind, text = json.loads(said)
        return str(kind), str(text)
    number = signal.Signals(os.WTERMSIG(status))
    if number in (signal.SIGXCPU, signal.SIGKILL, signal.SIGALRM):
        return "fault", f"the library ran into a limit ({number.name})"
    return "refused", f"{path}: the library that reads it ended its process ({number.name})"


@cache
def server(module: str, function: str) -> subprocess.Popen[str]:
    """Return the server of a reader; it ends with the process that started it."""
    command = [sys.executable, __file__, module, function]
    single = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}  # their pools are threads
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=single)


def ask(module: str, function: str, path: Path, seconds: int, memory: int) -> tuple[str, str]:
    """Let the server of a reader read a file."""
    process = server(module, function)
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write(json.dumps([str(path), seconds, memory]) + "\n")
    process.stdin.flush()
    kind, text = json.loads(process.stdout.readline())
    return str(kind), str(text)


def serve(read: Callable[[Path], object], questions: IO[str], answers: IO[str]) -> None:
    """Answer until the questions end."""
    for line in questions:
        path, seconds, memory = json.loads(line)
        answers.write(json.dumps(forked(read, Path(path), seconds, memory)) + "\n")
        answers.flush()


if __name__ == "__main__":
    reader = getattr(importlib.import_module(sys.argv[1]), sys.argv[2])
    outcome(reader, Path("absent"))  # libraries are loaded once, and start no thread yet
    if len(list(Path("/proc/self/task").iterdir())) > 1:
        sys.exit("the reader started a thread: it cannot be forked")
    serve(reader, sys.stdin, sys.stdout)
