"""PCD point clouds (ascii, binary, binary_compressed), doubles kept."""

from __future__ import annotations

import io
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numba
import numpy as np
from numpy.typing import NDArray

from subiaco_geo.cloud_fields import Column, cloud_from_columns
from subiaco_geo.clouds import PointCloud
from subiaco_geo.errors import InputError

_KINDS = {"I": "i", "U": "u", "F": "f"}
_NORMALS = {"normal_x": "nx", "normal_y": "ny", "normal_z": "nz"}


@dataclass(frozen=True)
class _Layout:
    names: list[str]
    dtype: np.dtype[np.void]
    points: int
    form: str


def read_pcd(path: Path) -> PointCloud:
    """Read a PCD file; ``rgb`` is unpacked, ``normal_x ...`` become ``normals``, padding is dropped.

    Raises
    ------
    InputError
        Not a PCD, cut or damaged, empty, NaN coordinates, or float32 projected coordinates.
    """
    with path.open("rb") as stream:
        layout = _read_header(path, stream)
        if layout.points == 0:
            raise InputError(f"{path}: the cloud is empty; give a cloud with points")
        if layout.form == "ascii":
            table = _read_ascii(path, stream, layout)
        elif layout.form == "binary":
            table = _table(path, stream.read(), layout)
        else:
            table = _table(path, _decompress(path, stream, layout), layout)
    return cloud_from_columns(path, _columns(table), None)


def _read_header(path: Path, stream: BinaryIO) -> _Layout:
    entries: dict[str, list[str]] = {}
    while "DATA" not in entries:
        line = stream.readline(65_536)
        words = line.decode("ascii", errors="replace").split("#")[0].split()
        if not line.endswith(b"\n") or len(entries) > 50:
            raise InputError(f"{path}: not a PCD file, or its header is cut; export the cloud again")
        if words:
            entries[words[0]] = words[1:]
    try:
        return _layout(entries)
    except (KeyError, IndexError, ValueError, TypeError) as error:
        raise InputError(
            f"{path}: the PCD header makes no sense ({error}); export the cloud again"
        ) from error


def _layout(entries: dict[str, list[str]]) -> _Layout:
    fields, form = entries["FIELDS"], entries["DATA"][0]
    if form not in ("ascii", "binary", "binary_compressed"):
        raise ValueError(f"DATA {form} is not known")
    counts = [int(c) for c in entries.get("COUNT", ["1"] * len(fields))]
    kinds = [_KINDS[t] + s for t, s in zip(entries["TYPE"], entries["SIZE"], strict=True)]
    names = [f"{name}{i}" if name == "_" else name for i, name in enumerate(fields)]
    parts = [
        (n, f"<{k}") if c == 1 else (n, f"<{k}", (c,)) for n, k, c in zip(names, kinds, counts, strict=True)
    ]
    points = int(entries["POINTS"][0]) if "POINTS" in entries else int(entries["WIDTH"][0])
    if points < 0:
        raise ValueError("negative number of points")
    return _Layout(names, np.dtype(parts), points, form)


def _cut(path: Path) -> InputError:
    return InputError(f"{path}: the PCD is cut or damaged; copy or export it again")


def _table(path: Path, body: bytes | memoryview, layout: _Layout) -> NDArray[np.void]:
    """Make the table from rows (binary) or from columns (binary_compressed)."""
    if len(body) < layout.points * layout.dtype.itemsize:
        raise _cut(path)
    if layout.form == "binary":
        return np.frombuffer(body, dtype=layout.dtype, count=layout.points)
    table = np.empty(layout.points, dtype=layout.dtype)
    start = 0
    for name in layout.names:
        part = table.dtype[name]
        size = part.itemsize * layout.points
        values = np.frombuffer(body[start : start + size], dtype=part.base)
        table[name] = values.reshape(layout.points, *part.shape)
        start += size
    return table


def _read_ascii(path: Path, stream: BinaryIO, layout: _Layout) -> NDArray[np.void]:
    if layout.points > path.stat().st_size:  # before numpy takes memory for so many rows
        raise _cut(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # numpy warns of missing rows; refused below
            text = io.TextIOWrapper(stream, encoding="ascii")
            table = np.loadtxt(text, dtype=layout.dtype, max_rows=layout.points, ndmin=1)
    except ValueError as error:
        reason = str(error).split(";")[0]
        raise InputError(f"{path}: PCD rows cannot be read ({reason}); copy or export it again") from error
    if len(table) < layout.points:
        raise _cut(path)
    return table


def _decompress(path: Path, stream: BinaryIO, layout: _Layout) -> memoryview:
    head = stream.read(8)
    if len(head) < 8:
        raise _cut(path)
    sizes = np.frombuffer(head, dtype="<u4")
    if int(sizes[0]) > path.stat().st_size:
        raise _cut(path)
    expected = layout.points * layout.dtype.itemsize
    if int(sizes[1]) != expected:
        raise _cut(path)
    packed = np.frombuffer(stream.read(int(sizes[0])), dtype=np.uint8)
    body = np.empty(int(sizes[1]), dtype=np.uint8)
    if len(packed) < int(sizes[0]) or lzf_decompress(packed, body) != len(body):
        raise _cut(path)
    return body.data


@numba.njit(cache=True)
def lzf_decompress(packed: NDArray[np.uint8], body: NDArray[np.uint8]) -> int:
    """Unpack LZF data; return the number of bytes written, -1 when the data are damaged."""
    read = written = 0
    while read < len(packed):
        control = int(packed[read])
        read += 1
        if control < 32:  # literal run
            run = control + 1
            if read + run > len(packed) or written + run > len(body):
                return -1
            body[written : written + run] = packed[read : read + run]
            read += run
            written += run
            continue
        run = control >> 5
        if run == 7:
            if read >= len(packed):
                return -1
            run += int(packed[read])
            read += 1
        if read >= len(packed):
            return -1
        source = written - ((control & 31) << 8) - int(packed[read]) - 1
        read += 1
        run += 2
        if source < 0 or written + run > len(body):
            return -1
        for i in range(run):  # may overlap: byte by byte
            body[written + i] = body[source + i]
        written += run
    return written


def _columns(table: NDArray[np.void]) -> dict[str, Column]:
    columns: dict[str, Column] = {}
    for name in table.dtype.names or ():
        values = np.ascontiguousarray(table[name])
        if name.startswith("_"):
            continue
        if name in ("rgb", "rgba") and values.dtype.itemsize == 4:
            packed = values.view(np.uint32)
            for shift, colour in ((16, "red"), (8, "green"), (0, "blue")):
                columns[colour] = (packed >> shift).astype(np.uint8)
        else:
            columns[_NORMALS.get(name, name)] = values
    return columns
