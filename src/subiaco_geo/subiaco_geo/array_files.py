"""Read arrays from ``.npy`` and ``.npz`` files; no memory is taken for more than the file can hold."""

from __future__ import annotations

import io
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.errors import InputError

#: Arrays up to this size together are read whatever the file says [bytes].
_ALWAYS = 64 << 20
#: Largest ratio of the arrays to the compressed file that holds them; deflate itself reaches 1030.
_RATIO = 200
#: Longest header of an array that numpy reads [bytes].
_HEADER = 10_000
#: What damaged archives and headers raise.
ARRAY_FAULTS = (KeyError, ValueError, OSError, EOFError, zipfile.BadZipFile, zlib.error, NotImplementedError)


def read_array_file(path: Path, what: str, remedy: str) -> NDArray[Any]:
    """Read a plain ``.npy`` array.

    Parameters
    ----------
    path : Path
    what, remedy : str
        What the file should be, with an article, and what to do if it is not, for the message.

    Raises
    ------
    InputError
        Missing, damaged, or its header states more values than the file holds.
    """
    try:
        with path.open("rb") as stream:
            return read_array(stream, path.stat().st_size)
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"{path}: not {what} ({_said(error)}); {remedy}") from error


def read_arrays(path: Path, names: Iterable[str], what: str, remedy: str) -> dict[str, NDArray[Any]]:
    """Read named arrays of an ``.npz`` archive.

    Parameters
    ----------
    path : Path
    names : iterable of str
        Arrays that must be there; others are not read.
    what, remedy : str
        What the file should be, with an article, and what to do if it is not, for the message.

    Raises
    ------
    InputError
        Missing or damaged, an array is absent, or the arrays are implausibly large for the file.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            members = {name: archive.getinfo(f"{name}.npy") for name in names}
            total = sum(member.file_size for member in members.values())
            if total > max(_ALWAYS, _RATIO * path.stat().st_size):
                raise ValueError(f"its arrays state {total >> 20} MiB, far more than the file can hold")
            arrays = {}
            for name, member in members.items():
                with archive.open(member) as stream:
                    arrays[name] = read_array(stream, member.file_size)
            return arrays
    except ARRAY_FAULTS as error:
        raise InputError(f"{path}: not {what} ({_said(error)}); {remedy}") from error


def read_array_head(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Read shape, whether it is in Fortran's order, and type from the header of an array.

    Raises
    ------
    ValueError, EOFError
        The header is damaged, or longer than headers are.
    """
    major, _ = np.lib.format.read_magic(stream)
    form = "<H" if major == 1 else "<I"
    prefix = stream.read(struct.calcsize(form))
    if len(prefix) < struct.calcsize(form):
        raise EOFError("its header is cut")
    (length,) = struct.unpack(form, prefix)
    if length > _HEADER:
        raise ValueError(f"its header states a length of {length} bytes")
    return _parsed_head(major, prefix + stream.read(length))


@lru_cache(maxsize=4096)  # arrays of one tile, and arrays read again, have the same header
def _parsed_head(major: int, header: bytes) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    read = np.lib.format.read_array_header_1_0 if major == 1 else np.lib.format.read_array_header_2_0
    try:
        shape, fortran, kind = read(io.BytesIO(header))
    except (tokenize.TokenError, SyntaxError, TypeError) as error:
        raise ValueError("its header cannot be read") from error
    return shape, fortran, kind


def read_array(stream: IO[bytes], size: int) -> NDArray[Any]:
    """Read an array after its header was compared with the size of the stream [bytes]."""
    shape, fortran, kind = read_array_head(stream)
    count = 1
    for extent in shape:
        count *= int(extent)
    if kind.hasobject:
        raise ValueError("it holds Python objects")
    if count * kind.itemsize > size or min(shape, default=0) < 0:
        raise ValueError(f"its header states {count} values, more than it holds")
    values = np.empty(count, dtype=kind)
    data = values.view(np.uint8)
    if stream.readinto(data) < len(data):  # type: ignore[attr-defined]
        raise EOFError("it is cut")
    return values.reshape(shape, order="F" if fortran else "C")


def _said(error: BaseException) -> str:
    said = f"no array {error}" if isinstance(error, KeyError) else str(error)
    return " ".join(said.split())[:300]
