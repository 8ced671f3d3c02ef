"""Locks on outputs, and removal of what killed runs left.

Locks are those of ``flock(2)``: they end with the process that holds them, however it ends.
"""

from __future__ import annotations

import fcntl
import logging
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from subiaco_geo.errors import InputError

logger = logging.getLogger(__name__)


@contextmanager
def locked(output: Path) -> Iterator[None]:
    """Hold an output for this process alone.

    Parameters
    ----------
    output : Path
        What is worked on; the lock is the file ``.NAME.lock`` beside it, which is removed at the end.

    Raises
    ------
    InputError
        Another process holds it.
    """
    output = output.absolute()
    output.parent.mkdir(parents=True, exist_ok=True)
    path = output.with_name(f".{output.name}.lock")
    stream = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        if not _taken(stream) or not _same(stream, path):
            holder = os.read(stream, 20).decode(errors="replace").strip() or "unknown"
            raise InputError(
                f"{output}: another run is working on it (process {holder});"
                " wait until it ends, or choose another output"
            )
        os.ftruncate(stream, 0)
        os.write(stream, f"{os.getpid()}\n".encode())
        try:
            yield
        finally:
            path.unlink(missing_ok=True)
    finally:
        os.close(stream)


@contextmanager
def held_directory(folder: Path) -> Iterator[Path]:
    """Make a working folder that is removed at the end; :func:`sweep` leaves it alone until then."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    stream = os.open(folder, os.O_RDONLY)
    try:
        _taken(stream)
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(stream)


def sweep(parent: Path, prefix: str) -> None:
    """Remove the working folders under a parent that begin with a prefix and that no process holds."""
    for folder in parent.glob(f"{prefix}*"):
        if folder.is_symlink() or not folder.is_dir():
            continue
        stream = os.open(folder, os.O_RDONLY)
        try:
            if _taken(stream):
                logger.info("%s: left by a run that was killed; removed", folder)
                shutil.rmtree(folder, ignore_errors=True)
        finally:
            os.close(stream)


def _taken(stream: int) -> bool:
    """Take the lock of an open file; False where another process has it."""
    try:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks: nothing can be told there
        return True
    return True


def _same(stream: int, path: Path) -> bool:
    """Tell whether a path still names an open file, and not one that was made after its removal."""
    try:
        return os.fstat(stream).st_ino == path.stat().st_ino
    except FileNotFoundError:
        return False
