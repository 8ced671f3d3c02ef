"""What is fuzzed: whole small inputs, how they are damaged, and readers that may only refuse.

A case is a seed file and a list of edits. A reader may return, or raise :class:`SubiacoError` with one line
that names the file; anything else, more than :data:`CPU_SECONDS` of processor time or more than
:data:`MEMORY` bytes above what the process held before is a fault.
"""

from __future__ import annotations

import re
import resource
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import psutil
from fork_server import ask

from subiaco_geo.errors import SubiacoError

CPU_SECONDS = 10.0
MEMORY = 1 << 30
_WHOLE_NUMBERS = (0, 1, 0x7F, 0xFF, 0xFFFF, 2**31 - 1, 2**32 - 1, 10**9, 10**12, 2**63 - 1, 2**64 - 1)
_WORDS = (
    b"0", b"-1", b"1000000000000", b"99999999999999999999999", b"1e999", b"nan", b"-inf", b"1e-320", b"",
    b"\x00", b"\xff\xfe", b"[[[[", b"{", b"~", b"!!python/object/apply:os.getcwd []", b"&a [*a, *a]",
    b"2025-13-45", b"0x", b"1_0", b'"', b"\n", b"\r", b"null", b"true", b"[]", b"{}", b'"text"', b"f4", b"i8",
    b"O", b"U4", b"c16", b"M8[ns]", b"V8", b"2", b"65535", b"4294967296",
)  # fmt: skip
Edit = tuple[int, int, int]
KINDS = 10


def damaged(data: bytes, edits: Sequence[Edit]) -> bytes:
    """Apply edits ``(kind, where, what)``; half of them fall into the first 400 bytes, where headers are."""
    for kind, where, what in edits:
        reach = len(data) if where & 1 else min(len(data), 400)
        at = (where >> 1) % (reach + 1)
        data = _EDITS[kind % KINDS](data, at, what)
    return data


def _put(data: bytes, at: int, piece: bytes) -> bytes:
    return data[:at] + piece + data[at + len(piece) :]


def _number(data: bytes, at: int, what: int) -> bytes:
    """Write an awkward whole number of 1, 2, 4 or 8 bytes."""
    size = (1, 2, 4, 8)[what % 4]
    value = _WHOLE_NUMBERS[what // 4 % len(_WHOLE_NUMBERS)] % (1 << 8 * size)
    return _put(data, at, value.to_bytes(size, "little"))


def _word(data: bytes, at: int, what: int) -> bytes:
    """Replace the next word or number of a text by an awkward one."""
    found = re.compile(rb"[\w.+-]+").search(data, at)
    start, end = found.span() if found else (at, at)
    return data[:start] + _WORDS[what % len(_WORDS)] + data[end:]


def _line(data: bytes, at: int, what: int) -> bytes:
    """Drop, double or move a line."""
    lines = data.split(b"\n")
    index = data[:at].count(b"\n")
    line = lines.pop(index)
    if what % 3:
        lines[index:index] = [line] * 2 if what % 3 == 1 else []
        lines[what // 3 % (len(lines) + 1) :][:0] = [line]
    return b"\n".join(lines)


_EDITS: tuple[Callable[[bytes, int, int], bytes], ...] = (
    lambda data, at, what: _put(data, at, bytes([data[at] ^ (1 << what % 8)])) if at < len(data) else data,
    lambda data, at, what: _put(data, at, bytes([what % 256])),
    _number,
    _number,
    _word,
    _word,
    _line,
    lambda data, at, what: data[:at],
    lambda data, at, what: data[:at] + data[at + what % 64 :],
    lambda data, at, what: data[:at] + data[at : at + what % 64] + data[at:],
)


class Fault(AssertionError):  # noqa: N818
    """A reader did what it must not."""


def _too_long(_signal: int, _frame: object) -> None:
    raise Fault(f"more than {CPU_SECONDS:g} s of processor time")


@contextmanager
def bounds() -> Iterator[None]:
    """Bound processor time and memory of what runs inside, native code too."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (psutil.Process().memory_info().vms + MEMORY, hard))
    before = signal.signal(signal.SIGPROF, _too_long)
    signal.setitimer(signal.ITIMER_PROF, CPU_SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


Damage = Callable[[bytes, Sequence[Edit]], bytes]


@dataclass(frozen=True)
class Target:
    """A reader and the whole inputs that are damaged for it.

    ``named`` is what a refusal must name, the case or the folder that it is a part of; empty where the reader
    is given no file. ``damage`` makes a case of an input.
    """

    name: str
    suffix: str
    read: Callable[[Path], object]
    seeds: Callable[[Path], list[bytes]]
    named: str = "case"
    damage: Damage = damaged


def part(
    name: str,
    file: str,
    make: Callable[[Path], object],
    read: Callable[[Path], object],
    damage: Damage = damaged,
) -> Target:
    """Return a target that damages one file of a folder, whole otherwise.

    Parameters
    ----------
    file : str
        Path in the folder.
    make, read : callable
        Write the whole folder; read it.
    """

    def seeds(folder: Path) -> list[bytes]:
        if not (folder / "whole").is_dir():
            make(folder / "whole")
        return [(folder / "whole" / file).read_bytes()]

    def read_part(path: Path) -> object:
        folder = path.parent / "whole"
        if not folder.is_dir():
            make(folder)
        (folder / file).write_bytes(path.read_bytes())
        return read(folder)

    return Target(name, Path(file).suffix, read_part, seeds, "whole", damage)


def isolated(module: str, function: str) -> Callable[[Path], object]:
    """Return a reader of a native library that reads in a process of its own, as subiaco lets it."""

    def read(path: Path) -> None:
        kind, said = ask(module, function, path, int(CPU_SECONDS), MEMORY)
        if kind == "fault":
            raise Fault(said)
        if kind == "refused":
            raise SubiacoError(said)

    return read


def run(target: Target, data: bytes, folder: Path) -> bool:
    """Read data within bounds and tell whether they were accepted.

    Raises
    ------
    Fault
        It crashed, hung, or took the memory.
    """
    path = folder / f"case{target.suffix}"
    path.write_bytes(data)
    try:
        with bounds():
            target.read(path)
    except SubiacoError as error:
        if "\n" in str(error) or len(str(error)) > 2000:
            raise Fault(f"the refusal is no single line: {str(error)[:300]!r}") from error
        if target.named not in str(error):
            raise Fault(f"the refusal names no file: {str(error)[:300]!r}") from error
        return False
    except Fault:
        raise
    except Exception as error:
        raise Fault(f"{target.name}: {type(error).__name__}: {str(error)[:300]}") from error
    return True
