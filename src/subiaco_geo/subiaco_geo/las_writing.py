"""Write LAS and LAZ point clouds through laspy, part by part, with a CRS that other readers accept."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import laspy
import numpy as np
from laspy.vlrs.known import WktCoordinateSystemVlr

from subiaco_geo.atomic import whole_file
from subiaco_geo.cloud_fields import Column, check_coordinates, read_crs, scalar_columns
from subiaco_geo.clouds import PointCloud
from subiaco_geo.crs import las_wkt, require_map_crs
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats

#: Coordinate step of the files that we write [m].
SCALE = 0.001
COLOURS = ("red", "green", "blue")
STANDARD = (
    "intensity", "classification", "return_number", "number_of_returns",
    "user_data", "point_source_id", "gps_time",
)  # fmt: skip
_LIMITS = {
    "classification": 255, "return_number": 15, "number_of_returns": 15,
    "user_data": 255, "point_source_id": 65535,
}  # fmt: skip
#: Descriptions of extra dimensions in the file, 32 characters at most as LAS has it.
DESCRIPTIONS = {
    "change": "0add1rem2inc3dec4same 254no 255?",
    "semantic": "0grnd 1bldg 2veg 3mobile 4other",
    "instance": "object_id of the table, -1 none",
    "confidence": "of the label, 0 to 1",
    "lod95": "level of detection m, NaN none",
    "m3c2_distance": "after - before on up normal, m",
    "m3c2_significant": "1: distance exceeds lod95",
    "nx": "surface normal, east",
    "ny": "surface normal, north",
    "nz": "surface normal, up",
    "n": "measurements fused in this point",
    "spread": "scatter along the normal, m",
    "moving": "probability of having moved",
}
_PART = 1 << 19  # points turned into records at a time


def write_las(path: Path, cloud: PointCloud, *, ellipsoidal: bool = True) -> None:
    """Write LAS 1.4, compressed when the name ends in ``.laz``.

    Coordinates step by 1 mm. Point format 7 with ``red green blue``, else 6;
    fields that LAS has no place for become extra bytes with a description; an infinite value of one becomes
    NaN. Floating intensity is
    rounded to 16 bits, after scaling by 65535 if it lies within 0-1. Memory
    holds half a million points of it; the cloud's arrays may be mapped from disk.

    Parameters
    ----------
    path : Path
    cloud : PointCloud
    ellipsoidal : bool
        State the height as ellipsoidal in the CRS; False for data of unknown height.

    Raises
    ------
    InputError
        Empty cloud, NaN coordinates, unknown CRS, or a field that does not fit.
    """
    with las_stream(path, ellipsoidal=ellipsoidal) as stream:
        stream.append(cloud)


@contextmanager
def las_stream(
    path: Path,
    *,
    ellipsoidal: bool = True,
    unit_intensity: bool | None = None,
    standard_gps_time: bool = False,
) -> Iterator[LasStream]:
    """Write clouds one after another to one file, which appears whole at the end; see :func:`write_las`.

    ``unit_intensity`` tells whether intensity runs from 0 to 1; None lets the first cloud tell.
    ``standard_gps_time`` tells that ``gps_time`` is adjusted standard GPS time, not seconds of the week.

    Raises
    ------
    InputError
        Nothing was appended.
    """
    with whole_file(path) as temporary:
        stream = LasStream(path, temporary, ellipsoidal, unit_intensity, standard_gps_time=standard_gps_time)
        try:
            yield stream
        finally:
            stream.close()
        if not temporary.exists():
            raise InputError(f"{path}: the cloud is empty; give a cloud with points")


@dataclass(frozen=True)
class _Form:
    """What all parts of a file share: header, CRS, types of the columns, and whether intensity is 0-1."""

    header: laspy.LasHeader
    crs: str | None
    types: dict[str, np.dtype[Any]]
    unit_intensity: bool


class LasRecords:
    """Turns clouds into records of one file; the first says CRS, fields and coordinate offset.

    Parameters
    ----------
    path : Path
        For errors.
    ellipsoidal, unit_intensity, standard_gps_time
        As for :func:`las_stream`.
    """

    def __init__(
        self,
        path: Path,
        ellipsoidal: bool,
        unit_intensity: bool | None = None,
        *,
        standard_gps_time: bool = False,
    ) -> None:
        self._path, self._ellipsoidal, self._unit = path, ellipsoidal, unit_intensity
        self._standard_gps_time = standard_gps_time
        self._form: _Form | None = None

    @property
    def header(self) -> laspy.LasHeader:
        """Header of the file, once there was a cloud.

        Raises
        ------
        InputError
            There was none.
        """
        if self._form is None:
            raise InputError(f"{self._path}: the cloud is empty; give a cloud with points")
        return self._form.header

    def of(self, cloud: PointCloud) -> Iterator[laspy.ScaleAwarePointRecord]:
        """Yield the records of a cloud, half a million at a time.

        Raises
        ------
        InputError
            No points, NaN coordinates, unknown CRS, a field that does not fit, or other fields or
            another CRS than the first.
        """
        check_coordinates(self._path, cloud.xyz)
        columns = scalar_columns(self._path, cloud)
        if self._form is None:
            form = _form(self._path, cloud, columns, self._ellipsoidal)
            if self._standard_gps_time:
                form.header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
            self._form = form if self._unit is None else replace(form, unit_intensity=self._unit)
        form = self._form
        if cloud.crs != form.crs or _types(columns) != form.types:
            raise InputError(f"{self._path}: its parts differ in CRS or fields; write them apart")
        for start in range(0, len(cloud), _PART):
            chosen = slice(start, start + _PART)
            part = PointCloud(cloud.xyz[chosen], cloud.origin)
            own = {name: values[chosen] for name, values in columns.items()}
            yield _records(self._path, form, part, own).points


class LasStream:
    """Takes the clouds of :func:`las_stream`."""

    def __init__(
        self,
        path: Path,
        temporary: Path,
        ellipsoidal: bool,
        unit: bool | None = None,
        *,
        standard_gps_time: bool = False,
    ) -> None:
        self._records = LasRecords(path, ellipsoidal, unit, standard_gps_time=standard_gps_time)
        self._temporary, self._compressed = temporary, path.suffix.lower() == ".laz"
        self._writer: laspy.LasWriter | None = None

    def append(self, cloud: PointCloud) -> None:
        """Write a cloud; errors as for :meth:`LasRecords.of`."""
        for records in self._records.of(cloud):
            if self._writer is None:
                header = self._records.header
                self._writer = laspy.open(self._temporary, "w", header=header, do_compress=self._compressed)
            self._writer.write_points(records)

    def close(self) -> None:
        """Finish the file."""
        if self._writer is not None:
            self._writer.close()


def _types(columns: dict[str, Column]) -> dict[str, np.dtype[Any]]:
    return {name: values.dtype for name, values in columns.items()}


def _form(path: Path, cloud: PointCloud, columns: dict[str, Column], ellipsoidal: bool) -> _Form:
    crs = read_crs(path, cloud.crs)
    header = _header(path, cloud, columns)
    if crs is not None:
        header.vlrs.append(WktCoordinateSystemVlr(las_wkt(require_map_crs(crs), ellipsoidal=ellipsoidal)))
    bright = columns.get("intensity")
    unit = bright is not None and bright.dtype.kind == "f" and float(np.nanmax(bright)) <= 1.0
    return _Form(header, cloud.crs, _types(columns), unit)


def _records(path: Path, form: _Form, cloud: PointCloud, columns: dict[str, Column]) -> laspy.LasData:
    las = laspy.LasData(form.header)
    las.points = laspy.ScaleAwarePointRecord.zeros(len(cloud), header=form.header)
    _set_coordinates(path, las, cloud, form.header.offsets)
    _set_fields(path, las, columns, form.unit_intensity)
    return las


def _header(path: Path, cloud: PointCloud, columns: dict[str, Column]) -> laspy.LasHeader:
    coloured = all(name in columns for name in COLOURS)
    header = laspy.LasHeader(version="1.4", point_format=7 if coloured else 6)
    header.scales = np.full(3, SCALE)
    header.offsets = np.floor(cloud.origin)
    header.global_encoding.wkt = True
    header.system_identifier = "subiaco"
    header.generating_software = "subiaco"
    places = {*STANDARD, *(COLOURS if coloured else ())}
    extra = {name: values for name, values in columns.items() if name not in places}
    header.add_extra_dims(
        [
            laspy.ExtraBytesParams(name, _extra_type(path, name, values), DESCRIPTIONS.get(name, ""))
            for name, values in extra.items()
        ]
    )
    for record in header.vlrs.get("ExtraBytesVlr"):
        for field in record.extra_bytes_structs:  # laspy 2.7 takes the first point of a part for its range
            field.options &= ~(field.MIN_BIT_MASK | field.MAX_BIT_MASK)
    return header


def _extra_type(path: Path, name: str, values: Column) -> np.dtype[Any]:
    if len(name) > 32:
        raise InputError(f"{path}: field name {name!r} is longer than the 32 characters of LAS; rename it")
    if values.dtype == np.bool_:
        return np.dtype(np.uint8)
    if values.dtype.kind not in "iuf" or values.dtype.itemsize > 8:
        raise InputError(
            f"{path}: field {name} has type {values.dtype}, which LAS cannot hold; convert it first"
        )
    return np.dtype(np.float32) if values.dtype == np.float16 else values.dtype


def _set_coordinates(path: Path, las: laspy.LasData, cloud: PointCloud, offsets: Floats) -> None:
    steps = np.round((cloud.xyz + (cloud.origin - offsets)) / SCALE)
    if np.abs(steps).max() >= 2**31:
        raise InputError(f"{path}: the cloud spans more than 2,000 km, too much for LAS; split it")
    whole = steps.astype(np.int32)
    las.X, las.Y, las.Z = whole[:, 0], whole[:, 1], whole[:, 2]


def _set_fields(path: Path, las: laspy.LasData, columns: dict[str, Column], unit_intensity: bool) -> None:
    if "return_number" not in columns:
        las["return_number"] = np.ones(len(las.points), np.uint8)
        las["number_of_returns"] = np.ones(len(las.points), np.uint8)
    for name, values in columns.items():
        if name in COLOURS and las.point_format.id == 7:
            las[name] = _whole(path, name, values, 255).astype(np.uint16) * 257
        elif name == "intensity":
            las[name] = _intensity(path, values, unit_intensity)
        elif name in _LIMITS:
            las[name] = _whole(path, name, values, _LIMITS[name]).astype(np.uint16)
        else:  # readers take an infinite value into the range of a dimension; NaN says that there is none
            las[name] = np.where(np.isinf(values), np.nan, values) if values.dtype.kind == "f" else values


def _whole(path: Path, name: str, values: Column, limit: int) -> Column:
    numbers = np.asarray(values, dtype=np.float64)
    if not ((numbers >= 0) & (numbers <= limit)).all():
        raise InputError(f"{path}: field {name} must lie within 0-{limit} for LAS; rename or rescale it")
    return np.round(numbers)


def _intensity(path: Path, values: Column, unit: bool) -> Column:
    numbers = np.asarray(values, dtype=np.float64) * (65535.0 if unit else 1.0)
    return np.asarray(_whole(path, "intensity", np.minimum(numbers, 65535.0), 65535).astype(np.uint16))
