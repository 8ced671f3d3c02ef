"""Read LAS, LAZ and COPC point clouds through laspy; nothing of a damaged file is believed."""

from __future__ import annotations

import logging
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import laspy
import lazrs
import numpy as np
from laspy.vlrs.known import WktCoordinateSystemVlr
from pyproj import CRS

from subiaco_geo.cloud_fields import Column, cloud_from_columns
from subiaco_geo.clouds import PointCloud
from subiaco_geo.crs import crs_text
from subiaco_geo.errors import InputError
from subiaco_geo.las_writing import COLOURS, STANDARD

logger = logging.getLogger(__name__)

_DEGREES = 360.0  # no longitude or latitude is larger
_EARTH, _ALTITUDES = 6_370_000.0, 50_000.0  # radius, and how far a survey can lie off it [m]
_BLANK = "\0 \t\r\n'\""
_HEADER_SIZE = 227  # of LAS 1.0-1.2, the smallest
_RECORD_HEAD, _EXTENDED_HEAD = 54, 60  # bytes
_LAYERS = {6: 9, 7: 10, 8: 11, 9: 10, 10: 12}  # of each point format, and one a byte of extra dimensions
_MOST_POINTS_A_BYTE = 1000  # of LAZ; a million equal points take 10 kB
_FAULTS = (
    laspy.LaspyException, lazrs.LazrsError, ValueError, OSError, EOFError, struct.error, LookupError,
    ArithmeticError, MemoryError,
)  # fmt: skip


def read_las(path: Path) -> PointCloud:
    """Read a LAS, LAZ or COPC file.

    Standard dimensions that say something and every extra dimension become
    fields; colours are 8 bit; ``nx ny nz`` become ``normals``.

    Raises
    ------
    InputError
        Not a LAS file, cut or damaged, empty, NaN coordinates, or an unknown CRS.
    """
    with _faults_named(path):
        _refuse_impossible(path)
        with laspy.open(path) as reader:
            expected = int(reader.header.point_count)
            if reader.header.are_points_compressed:
                _refuse_impossible_chunks(path, reader.header)
            las = reader.read()
    _check_whole(path, len(las.points), expected)
    columns: dict[str, Column] = {axis: np.asarray(getattr(las, axis), np.float64) for axis in "xyz"}
    columns |= _fields(las)
    return cloud_from_columns(path, columns, _crs(path, las.header))


@contextmanager
def _faults_named(path: Path) -> Iterator[None]:
    """Turn whatever a damaged file may do to the libraries into one line that names it."""
    try:
        yield
    except _FAULTS as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{path}: cut or not a LAS/LAZ file ({reason}); copy or export it again") from error


def las_parts(path: Path, fields: tuple[str, ...], size: int, first: int = 0) -> Iterator[PointCloud]:
    """Read a LAS, LAZ or COPC file from point ``first`` on in parts of up to ``size``.

    Of its fields, those of ``fields`` are read.

    Raises
    ------
    InputError
        As :func:`read_las`; what is cut is found when its end is reached.
    """
    found = first
    with _faults_named(path):
        _refuse_impossible(path)
        with laspy.open(path) as reader:
            expected, crs = int(reader.header.point_count), _crs(path, reader.header)
            if reader.header.are_points_compressed:
                _refuse_impossible_chunks(path, reader.header)
            if first:
                reader.seek(first)
            present = [name for name in fields if name in set(reader.header.point_format.dimension_names)]
            for points in reader.chunk_iterator(size):
                columns: dict[str, Column] = {axis: np.asarray(points[axis], np.float64) for axis in "xyz"}
                columns |= {name: np.asarray(points[name]) for name in present}
                found += len(points)
                part = None if len(points) == expected else found - len(points)
                yield cloud_from_columns(path, columns, crs, part)
    _check_whole(path, found, expected)


def _check_whole(path: Path, found: int, expected: int) -> None:
    if found < expected:
        raise InputError(f"{path}: cut: {found} of {expected} points are there; copy or export it again")


def _refuse_impossible(path: Path) -> None:
    """Refuse sizes that the file cannot hold, before memory is allocated or points are read."""
    size = path.stat().st_size
    with path.open("rb") as stream:
        head = stream.read(375).ljust(375, b"\0")
    if size < _HEADER_SIZE or head[:4] != b"LASF":
        raise ValueError("the header is not whole")
    header_size, offset, records, form, length, count = struct.unpack_from("<HIIBHI", head, 94)
    extended_at, extended = 0, 0
    if head[25] >= 4:
        extended_at, extended, count = struct.unpack_from("<QIQ", head, 235)
    most = _MOST_POINTS_A_BYTE * size if form & 0x80 else (size - offset) // max(1, length)
    if not header_size + records * _RECORD_HEAD <= offset <= size:
        raise ValueError("the header is not whole")
    if extended and extended_at + extended * _EXTENDED_HEAD > size:
        raise ValueError("its extended records are not whole")
    if count > most:
        raise ValueError(f"it says {count} points and holds {most} at most")


def _refuse_impossible_chunks(path: Path, header: laspy.LasHeader) -> None:
    """Refuse a table of chunks that the file cannot hold: the decoder ends the process when memory fails."""
    size, offset = path.stat().st_size, int(header.offset_to_point_data)
    records = header.vlrs.get("LasZipVlr")
    if not records:
        raise ValueError("the record of the compression is missing")
    with path.open("rb") as stream:
        stream.seek(offset)
        (table,) = struct.unpack("<q", stream.read(8))
        if table <= offset:  # written by a program that could not go back: it stands at the end
            stream.seek(size - 8)
            (table,) = struct.unpack("<q", stream.read(8))
        if not offset < table <= size - 8:
            raise ValueError("the table of chunks is missing")
        stream.seek(table + 4)
        (chunks,) = struct.unpack("<I", stream.read(4))
        if chunks > size - offset:
            raise ValueError(f"it says {chunks} chunks")
        stream.seek(offset)
        parts = lazrs.read_chunk_table(stream, lazrs.LazVlr(records[0].record_data))
    if sum(held for _, held in parts) > size - offset:
        raise ValueError("its chunks are larger than the file")
    _refuse_impossible_layers(path, header, [held for _, held in parts])


def _refuse_impossible_layers(path: Path, header: laspy.LasHeader, chunks: list[int]) -> None:
    """Refuse layers (point formats 6 and on) that are larger than the chunk that holds them."""
    form = header.point_format
    if form.id not in _LAYERS:
        return
    count = _LAYERS[form.id] + form.num_extra_bytes
    start = int(header.offset_to_point_data) + 8
    with path.open("rb") as stream:
        for held in chunks:
            if held == 0:  # an empty chunk closes files of chunks of any length, COPC among them
                continue
            stream.seek(start + form.size + 4)  # its first point, and the number of its points
            sizes = struct.unpack(f"<{count}I", stream.read(4 * count))
            if sum(sizes) > held:
                raise ValueError("the layers of a chunk are larger than it")
            start += held


def _fields(las: laspy.LasData) -> dict[str, Column]:
    present = set(las.point_format.dimension_names)
    columns: dict[str, Column] = {}
    for name in STANDARD:
        blank = 1 if name in ("return_number", "number_of_returns") else 0
        if name in present and np.any((values := np.asarray(las[name])) > blank):
            columns[name] = values
    if present.issuperset(COLOURS):
        columns |= _eight_bit({name: np.asarray(las[name]) for name in COLOURS})
    for name in las.point_format.extra_dimension_names:
        values = np.asarray(las[name])
        if values.ndim == 1:
            columns[name] = values
        else:
            columns |= {f"{name}_{i}": values[:, i] for i in range(values.shape[1])}
    return columns


def _eight_bit(colours: dict[str, Column]) -> dict[str, Column]:
    """Bring colours to 8 bit: LAS asks for 16, many writers put 8 there."""
    sixteen = {name: np.asarray(values, np.uint16) for name, values in colours.items()}
    shift = 8 if any(np.any(values > 255) for values in sixteen.values()) else 0
    return {name: (values >> shift).astype(np.uint8) for name, values in sixteen.items()}


def _crs(path: Path, header: laspy.LasHeader) -> str | None:
    """Return the CRS of a file; None without one, and where its coordinates cannot be those of its CRS."""
    for record in [*header.vlrs, *(header.evlrs or ())]:
        if isinstance(record, WktCoordinateSystemVlr) and not record.string.strip(_BLANK):
            record.string = ""  # some writers leave a pair of quotes where they know no CRS
    try:
        crs = header.parse_crs()
    except Exception as error:  # pyproj and laspy raise many kinds here
        said = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: its CRS record cannot be understood ({said}); assign it again") from error
    if crs is None:
        return None
    doubt = _contradiction(crs, header)
    if doubt:
        logger.warning(
            "%s: its CRS %r %s. The CRS is ignored; assign the CRS of the data to the file",
            path,
            crs.name,
            doubt,
        )
        return None
    return crs_text(crs)


def _contradiction(crs: CRS, header: laspy.LasHeader) -> str:
    """Say why the coordinates of a file cannot be those of its CRS; nothing if they can."""
    bounds = np.abs([header.mins, header.maxs])
    if crs.is_geographic and bounds[:, :2].max() > _DEGREES:
        return f"has coordinates in degrees, but coordinates of the file reach {bounds[:, :2].max():.0f}"
    radius = float(np.linalg.norm(bounds.mean(axis=0)))
    if crs.is_geocentric and abs(radius - _EARTH) > _ALTITUDES:
        return f"counts from the centre of the Earth, but the points lie {radius / 1000:.0f} km from there"
    return ""
