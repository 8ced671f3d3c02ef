"""A finished recording as one npz file; its scans stay in their own files."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.errors import InputError
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.measurements import Extrinsics, GnssFix, HeadingSample, OdometryPose
from subiaco_mapping.sequences import SequenceRecord, begin_sequence

Arrays = Mapping[str, NDArray[Any]]
Columns = dict[str, tuple[str, tuple[int, ...]]]

#: Lists of a record, one array a field: type and shape of one value.
TABLES: Final[dict[str, tuple[type, Columns]]] = {
    "poses": (
        OdometryPose,
        {
            "stamp_ns": ("<i8", ()),
            "T_odom_lidar": ("<f8", (4, 4)),
            "covariance": ("<f8", (6, 6)),
            "inliers": ("<i8", ()),
            "residual_rmse": ("<f8", ()),
            "degenerate": ("?", ()),
            "segment": ("<i8", ()),
            "predicted": ("?", ()),
        },
    ),
    "fixes": (
        GnssFix,
        {
            "time_ns": ("<i8", ()),
            "latitude": ("<f8", ()),
            "longitude": ("<f8", ()),
            "altitude": ("<f8", ()),
            "covariance": ("<f8", (3, 3)),
            "status": ("<i8", ()),
        },
    ),
    "headings": (HeadingSample, {"time_ns": ("<i8", ()), "yaw": ("<f8", ()), "sigma": ("<f8", ())}),
}
_PLACES: Final[Columns] = {
    "T_base_lidar": ("<f8", (4, 4)),
    "T_base_imu": ("<f8", (4, 4)),
    "t_base_gnss": ("<f8", (3,)),
}
_PLAIN = ("name", "modes", "dropped_points", "refused_fixes", "refused_headings", "facts")


def pack(record: SequenceRecord) -> bytes:
    """Return a record as an npz file: arrays, and the rest as JSON in ``rest``."""
    arrays: dict[str, NDArray[Any]] = {
        "accel": _column(record.accel, "<f8", (3,)),
        "columns": _column(record.columns, "<i8", (2,)),
    }
    for table, (_, columns) in TABLES.items():
        rows = getattr(record, table)
        for name, (kind, shape) in columns.items():
            arrays[f"{table}.{name}"] = _column([getattr(row, name) for row in rows], kind, shape)
    for name, (kind, shape) in _PLACES.items():
        place = getattr(record.extrinsics, name)
        arrays[f"extrinsics.{name}"] = _column([] if place is None else [place], kind, shape)
    submaps = [] if record.submaps is None else record.submaps.done
    arrays["submaps.anchor"] = _column([submap.anchor for submap in submaps], "<i8", ())
    arrays["submaps.way"] = _column([submap.way for submap in submaps], "<f8", ())
    rest = json.dumps({name: getattr(record, name) for name in _PLAIN})
    arrays["rest"] = np.frombuffer(rest.encode(), dtype=np.uint8)
    stream = io.BytesIO()
    np.savez(stream, allow_pickle=False, **arrays)
    return stream.getvalue()


def unpack(packed: bytes, folder: Path, config: MappingConfig) -> SequenceRecord:
    """Return what :func:`pack` wrote.

    Parameters
    ----------
    packed : bytes
    folder : Path
        Where the scans and submaps of the sequence lie.
    config : MappingConfig
        Of the run that wrote them.

    Raises
    ------
    InputError
        The bytes are no file of this kind.
    """
    try:
        with np.load(io.BytesIO(packed), allow_pickle=False) as file:
            return _record({name: file[name] for name in file.files}, folder, config)
    except (OSError, ValueError, TypeError, KeyError, AttributeError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{folder}: the file of the finished recording cannot be read ({error})") from error


def _record(arrays: Arrays, folder: Path, config: MappingConfig) -> SequenceRecord:
    rest = json.loads(arrays["rest"].tobytes().decode())
    places = {name: _checked(arrays, f"extrinsics.{name}", *of) for name, of in _PLACES.items()}
    extrinsics = Extrinsics(**{name: found[0] for name, found in places.items() if len(found)})
    record = begin_sequence(rest["name"], extrinsics, folder, config)
    for name in _PLAIN:
        setattr(record, name, rest[name])
    for table, (row, columns) in TABLES.items():
        values = [_values(_checked(arrays, f"{table}.{name}", *of)) for name, of in columns.items()]
        rows = zip(*values, strict=True)
        setattr(record, table, [row(**dict(zip(columns, one, strict=True))) for one in rows])
    record.accel = list(_checked(arrays, "accel", "<f8", (3,)))
    record.columns = [(lost, sent) for lost, sent in _checked(arrays, "columns", "<i8", (2,)).tolist()]
    record.spool.restore(len(record.poses))
    if record.submaps is not None:
        anchors = _checked(arrays, "submaps.anchor", "<i8", ())
        record.submaps.restore(anchors.tolist(), _checked(arrays, "submaps.way", "<f8", ()).tolist())
    return record


def _column(values: Sequence[Any], kind: str, shape: tuple[int, ...]) -> NDArray[Any]:
    """Return values as one array (N, ``*shape``); 64-bit integers are exact."""
    return np.array(values, dtype=kind).reshape(len(values), *shape)


def _checked(arrays: Arrays, name: str, kind: str, shape: tuple[int, ...]) -> NDArray[Any]:
    array = arrays[name]
    if array.dtype != np.dtype(kind) or array.shape[1:] != shape or array.ndim != 1 + len(shape):
        raise ValueError(f"{name}: {array.dtype} {array.shape}")
    return array


def _values(column: NDArray[Any]) -> list[Any]:
    """Return numbers as Python's own, matrices as arrays."""
    return column.tolist() if column.ndim == 1 else list(column)
