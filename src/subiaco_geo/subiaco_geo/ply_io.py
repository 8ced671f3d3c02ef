"""PLY point clouds with numpy: any property types, doubles kept, ``comment crs`` understood."""

from __future__ import annotations

import io
import os
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.atomic import whole_file
from subiaco_geo.cloud_fields import (
    Column,
    check_coordinates,
    cloud_from_columns,
    read_crs,
    scalar_columns,
)
from subiaco_geo.clouds import PointCloud
from subiaco_geo.errors import InputError

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
_NAMES = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint",
          "f4": "float", "f8": "double"}  # fmt: skip
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_MAX_HEADER_LINES = 10_000
_PART = 1 << 19  # points written at a time


@dataclass
class _Element:
    name: str
    count: int
    properties: list[tuple[str, str]] = field(default_factory=list)
    has_list: bool = False

    def dtype(self, order: str) -> np.dtype[np.void]:
        return np.dtype([(name, order + kind) for name, kind in self.properties])


@dataclass
class _Header:
    form: str = ""
    crs: str | None = None
    elements: list[_Element] = field(default_factory=list)


def read_ply(path: Path) -> PointCloud:
    """Read the vertices of a PLY file; other elements, such as faces, are left out.

    A CloudCompare prefix ``scalar_`` is dropped from property names.

    Raises
    ------
    InputError
        Not a PLY, cut, empty, NaN coordinates, float32 projected coordinates,
        list properties on vertices, or an unknown CRS.
    """
    with path.open("rb") as stream:
        header = _read_header(path, stream)
        vertex = _skip_to_vertices(path, stream, header)
        table = _read_ascii(path, stream, vertex) if header.form == "ascii" else None
        if table is None:
            table = _read_binary(path, stream, vertex, _ORDERS[header.form])
    return _cloud(path, table, header)


def ply_parts(path: Path, size: int, first: int = 0) -> Iterator[PointCloud]:
    """Read a PLY from vertex ``first`` on in parts of up to ``size``; an ASCII one is one part.

    See :func:`read_ply`.
    """
    with path.open("rb") as stream:
        header = _read_header(path, stream)
        vertex = _skip_to_vertices(path, stream, header)
        if header.form == "ascii":
            yield _cloud(path, _read_ascii(path, stream, vertex)[first:], header)
            return
        stream.seek(first * vertex.dtype(_ORDERS[header.form]).itemsize, os.SEEK_CUR)
        for start in range(first, vertex.count, size):
            rest = replace(vertex, count=min(size, vertex.count - start))
            part = None if rest.count == vertex.count else start
            yield _cloud(path, _read_binary(path, stream, rest, _ORDERS[header.form]), header, part)


def _cloud(path: Path, table: NDArray[np.void], header: _Header, first: int | None = None) -> PointCloud:
    columns = {_plain_name(name): table[name] for name in table.dtype.names or ()}
    return cloud_from_columns(path, columns, header.crs, first)


def _plain_name(name: str) -> str:
    return name.removeprefix("scalar_") or name


def _read_header(path: Path, stream: BinaryIO) -> _Header:
    if stream.readline(80).strip() != b"ply":
        raise InputError(f"{path}: not a PLY file (does not begin with 'ply'); export the cloud again")
    header = _Header()
    for _ in range(_MAX_HEADER_LINES):
        line = stream.readline(65_536)
        if not line.endswith(b"\n"):
            break
        words = line.decode("utf-8", errors="replace").split()
        if words[:1] == ["end_header"]:
            return header
        try:
            _read_header_line(path, header, words)
        except (IndexError, ValueError) as error:
            raise InputError(
                f"{path}: PLY header line {' '.join(words)!r} makes no sense; export again"
            ) from error
    raise InputError(f"{path}: the PLY header has no end_header, the file is cut; copy or export it again")


def _read_header_line(path: Path, header: _Header, words: list[str]) -> None:
    match words:
        case ["format", form, *_]:
            if form not in _ORDERS:
                raise InputError(f"{path}: PLY format {form!r} is not known; export as binary_little_endian")
            header.form = form
        case ["comment", "crs", *text]:
            header.crs = " ".join(text)
        case ["element", name, count]:
            header.elements.append(_Element(name, _count(count)))
        case ["property", "list", *_]:
            header.elements[-1].has_list = True
        case ["property", kind, name]:
            if kind not in _TYPES:
                raise InputError(
                    f"{path}: PLY property {name} has unknown type {kind!r}; export as float or double"
                )
            header.elements[-1].properties.append((name, _TYPES[kind]))


def _count(text: str) -> int:
    if not 0 <= (count := int(text)) < 2**63:
        raise ValueError(f"{text} elements")
    return count


def _skip_to_vertices(path: Path, stream: BinaryIO, header: _Header) -> _Element:
    """Move the stream to the first vertex and return the vertex element."""
    if not header.form:
        raise InputError(f"{path}: the PLY header has no format line; export the cloud again")
    for element in header.elements:
        if element.name == "vertex":
            _check_vertex(path, element)
            return element
        if element.count > _bytes_left(path, stream):
            raise _cut(path, element.count, 0)
        if header.form == "ascii":
            for _ in range(element.count):
                stream.readline()
        elif element.has_list:
            raise InputError(
                f"{path}: lists in element {element.name} before the vertices; export points alone"
            )
        else:
            stream.seek(element.count * sum(int(kind[1]) for _, kind in element.properties), io.SEEK_CUR)
    raise InputError(f"{path}: the PLY has no vertices; export it as a point cloud")


def _check_vertex(path: Path, element: _Element) -> None:
    if element.has_list:
        raise InputError(f"{path}: vertices with list properties cannot be read; export without them")
    names = [_plain_name(name) for name, _ in element.properties]
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise InputError(f"{path}: property {', '.join(sorted(twice))} is there twice; export it once")
    if element.count <= 0 or not names:
        raise InputError(f"{path}: the cloud is empty; give a cloud with points")


def _bytes_left(path: Path, stream: BinaryIO) -> int:
    return max(0, path.stat().st_size - stream.tell())


def _cut(path: Path, expected: int, found: int) -> InputError:
    return InputError(f"{path}: cut: {found} of {expected} points are there; copy or export it again")


def _read_binary(path: Path, stream: BinaryIO, vertex: _Element, order: str) -> NDArray[np.void]:
    dtype = vertex.dtype(order)
    left = _bytes_left(path, stream)
    if left < vertex.count * dtype.itemsize:
        raise _cut(path, vertex.count, left // dtype.itemsize)
    table = np.fromfile(stream, dtype=dtype, count=vertex.count)
    return table.astype(dtype.newbyteorder("="), copy=False)


def _read_ascii(path: Path, stream: BinaryIO, vertex: _Element) -> NDArray[np.void]:
    left = _bytes_left(path, stream)
    if left < vertex.count:  # before numpy takes memory for so many rows
        raise _cut(path, vertex.count, 0)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # numpy warns of missing rows; refused below
            values = np.loadtxt(stream, dtype=np.float64, max_rows=vertex.count, ndmin=2, comments=None)
    except ValueError as error:
        reason = str(error).split(";")[0]
        raise InputError(f"{path}: PLY rows cannot be read ({reason}); copy or export it again") from error
    if len(values) < vertex.count:
        raise _cut(path, vertex.count, len(values))
    if values.shape[1] != len(vertex.properties):
        raise InputError(
            f"{path}: rows of {values.shape[1]} numbers for {len(vertex.properties)} properties; "
            "export it again"
        )
    kinds = [
        (name, _ascii_kind(name, kind, values[:, i])) for i, (name, kind) in enumerate(vertex.properties)
    ]
    table = np.empty(vertex.count, dtype=kinds)
    for i, (name, kind) in enumerate(kinds):
        _check_whole(path, name, kind, values[:, i])
        table[name] = values[:, i]
    return table


def _ascii_kind(name: str, kind: str, values: NDArray[np.float64]) -> str:
    """Keep the digits of coordinates that are only declared float but written finer."""
    if name in ("x", "y", "z") and kind == "f4":
        with np.errstate(over="ignore"):
            rounded = values.astype(np.float32).astype(np.float64)
        return "f4" if np.array_equal(rounded, values, equal_nan=True) else "f8"
    return kind


def _check_whole(path: Path, name: str, kind: str, values: NDArray[np.float64]) -> None:
    if kind.startswith("f"):
        return
    limits = np.iinfo(kind)
    if not ((values >= limits.min) & (values <= limits.max)).all():
        raise InputError(f"{path}: property {name} has values outside {_NAMES[kind]}; export it again")


def write_ply(path: Path, cloud: PointCloud) -> None:
    """Write a binary little-endian PLY: double coordinates, fields as properties, CRS as a comment.

    Memory holds half a million points of it; the cloud's arrays may be mapped from disk.

    Raises
    ------
    InputError
        Empty cloud, NaN coordinates, unknown CRS, or a field that PLY has no type for.
    """
    write_ply_parts(path, iter([cloud]), len(cloud))


def write_ply_parts(path: Path, parts: Iterator[PointCloud], count: int) -> None:
    """Write clouds one after another to one PLY of ``count`` points; see :func:`write_ply`.

    Raises
    ------
    InputError
        No points, other points in all than said, or parts that differ in CRS or fields.
    """
    with whole_file(path) as temporary, temporary.open("wb") as stream:
        row: np.dtype[np.void] | None = None
        crs: str | None = None
        found = 0
        for cloud in parts:
            check_coordinates(path, cloud.xyz)
            columns = scalar_columns(path, cloud)
            own = _row(path, columns)
            if row is None:
                row, crs = own, cloud.crs
                stream.write(_head(read_crs(path, crs), count, row))
            if own != row or cloud.crs != crs:
                raise InputError(f"{path}: its parts differ in CRS or fields; write them apart")
            for start in range(0, len(cloud), _PART):
                _table(cloud, columns, row, slice(start, start + _PART)).tofile(stream)
            found += len(cloud)
        if row is None or found != count:
            raise InputError(f"{path}: {found} points to write, {count} said; give a cloud with points")


def _row(path: Path, columns: dict[str, Column]) -> np.dtype[np.void]:
    types = dict.fromkeys("xyz", np.dtype(np.float64))
    types |= {name: _stored_type(path, name, values) for name, values in columns.items()}
    return np.dtype([(name, kind.newbyteorder("<")) for name, kind in types.items()])


def _head(crs: str | None, count: int, row: np.dtype[np.void]) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0"]
    if crs is not None:
        lines.append(f"comment crs {crs}")
    lines.append(f"element vertex {count}")
    lines += [f"property {_NAMES[row[name].str[1:]]} {name}" for name in row.names or ()]
    return "\n".join([*lines, "end_header", ""]).encode()


def _table(
    cloud: PointCloud, columns: dict[str, Column], row: np.dtype[np.void], part: slice
) -> NDArray[np.void]:
    xyz = cloud.xyz[part] + cloud.origin
    table = np.empty(len(xyz), dtype=row)
    for i, axis in enumerate("xyz"):
        table[axis] = xyz[:, i]
    for name, values in columns.items():
        table[name] = values[part]
    return table


def _stored_type(path: Path, name: str, values: Column) -> np.dtype[Any]:
    """Return a type that PLY has, which loses nothing of the values."""
    if values.dtype == np.bool_:
        return np.dtype(np.uint8)
    if values.dtype == np.float16:
        return np.dtype(np.float32)
    if values.dtype.str[1:] in _NAMES:
        return values.dtype
    if values.dtype.kind in "iu":
        low, high = int(values.min()), int(values.max())
        if low >= -(2**31) and high < 2**31:
            return np.dtype(np.int32)
        if low >= -(2**53) and high <= 2**53:
            return np.dtype(np.float64)
        raise InputError(f"{path}: field {name} has integers that PLY cannot hold; subtract an offset first")
    raise InputError(f"{path}: field {name} has type {values.dtype}, which PLY cannot hold; convert it first")
