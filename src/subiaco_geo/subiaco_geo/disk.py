"""Room and rights on the disk of an output: tested before the work begins, named when room ends."""

from __future__ import annotations

import errno
import re
import shutil
import tempfile
from pathlib import Path

from subiaco_geo.errors import InputError

_NO_ROOM = frozenset({errno.ENOSPC, errno.EDQUOT})
#: Libraries that write files by themselves hand on a text instead of a number.
_NO_ROOM_TEXT = re.compile(
    r"no space left|disk is full|disk quota|requested and \d+ written|failed to call write", re.IGNORECASE
)
_PROBE = 4096  # bytes that a disk must take before work begins


def ground_of(path: Path) -> Path:
    """Return the nearest folder above a path that exists."""
    return next(place for place in (path.absolute(), *path.absolute().parents) if place.exists())


def free_bytes(path: Path) -> int:
    """Return the free space of the disk on which a path lies or will lie [byte]."""
    return shutil.disk_usage(ground_of(path)).free


def require_writable(folder: Path) -> None:
    """Write a small file into a folder and remove it.

    Raises
    ------
    InputError
        The folder takes no file: rights, a read-only disk, or no room.
    """
    try:
        with tempfile.NamedTemporaryFile(dir=folder, prefix=".subiaco-probe-") as probe:
            probe.write(bytes(_PROBE))
            probe.flush()
    except OSError as error:
        if error.errno in _NO_ROOM:
            raise InputError(f"{folder}: the disk is full; make room or choose another place") from error
        raise InputError(
            f"{folder}: may not be written to; choose another place or ask for the rights"
        ) from error


def require_room(path: Path, needed: int, what: str) -> None:
    """Compare the free space of a disk with an estimate.

    Parameters
    ----------
    path : Path
        Where the output goes.
    needed : int
        Estimate [byte].
    what : str
        What takes the room, for the message.

    Raises
    ------
    InputError
        The disk has less.
    """
    free = free_bytes(path)
    if free < needed:
        raise InputError(
            f"{path}: {what} needs about {_megabytes(needed)}, and the disk has {_megabytes(free)} left; "
            "make room or choose another place"
        )


def _megabytes(size: int) -> str:
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{size / 1e6:.0f} MB"


def is_disk_full(error: BaseException | None) -> bool:
    """Tell whether an error, or one that led to it, says that a disk has no room."""
    seen: set[int] = set()
    while error is not None and id(error) not in seen:
        seen.add(id(error))
        number = error.errno if isinstance(error, OSError) else None
        if number in _NO_ROOM or (number is None and _NO_ROOM_TEXT.search(str(error))):
            return True
        error = error.__cause__ or error.__context__
    return False
