"""What all cloud files share: grouping of scalar columns into fields, and the refusals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.clouds import PointCloud, extent_of, from_world
from subiaco_geo.crs import crs_text, require_map_crs
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats

Column = NDArray[np.generic]
_NORMALS = ("nx", "ny", "nz")
_FLOAT32_LIMIT = 1e5
_PART = 1 << 19  # points looked at at a time
_ASTRAY = 100_000.0  # from the median of a cloud: farther than any survey reaches [m]


def check_coordinates(path: Path, xyz: Floats, first: int | None = None) -> None:
    """Refuse empty clouds and coordinates that are not finite.

    ``first``: the number in the file of the first of these points; None where they are all of the file.
    """
    if len(xyz) == 0:
        raise InputError(f"{path}: the cloud is empty; give a cloud with points")
    parts = (xyz[start : start + _PART] for start in range(0, len(xyz), _PART))
    bad = sum(0 if np.isfinite(part).all() else int((~np.isfinite(part)).any(axis=1).sum()) for part in parts)
    if bad:
        of = f"{len(xyz)} points" if first is None else f"the points {first + 1} to {first + len(xyz)}"
        raise InputError(
            f"{path}: {bad} of {of} have NaN or infinite coordinates; remove them and export again"
        )


def refuse_strays(path: Path, xyz: Floats) -> None:
    """Refuse points (N, 3) so far from the others that no survey holds both."""
    if len(xyz) == 0:
        return
    low, high = extent_of(xyz)
    if (high - low).max() <= _ASTRAY:
        return
    stray = int((np.abs(xyz - np.median(xyz, axis=0)) > _ASTRAY).any(axis=1).sum())
    if stray:
        raise InputError(
            f"{path}: points farther than {_ASTRAY / 1000:.0f} km from the median of the cloud: {stray}; "
            "remove these stray points"
        )


def refuse_rounded(path: Path, columns: Mapping[str, Column]) -> None:
    """Refuse projected coordinates that went through single precision: x or y beyond 1e5 as float32."""
    for name in ("x", "y"):
        values = columns[name]
        if values.dtype != np.float32:
            continue
        largest = np.abs(values[np.isfinite(values)]).max(initial=0.0)
        if largest > _FLOAT32_LIMIT:
            step = float(np.spacing(np.float32(largest)))
            raise InputError(
                f"{path}: {name} holds projected coordinates as float32, which steps by {step:g} m; "
                "export again with double coordinates or in a local frame"
            )


def cloud_from_columns(
    path: Path, columns: Mapping[str, Column], crs: str | None, first: int | None = None
) -> PointCloud:
    """Build a cloud from scalar columns; ``nx ny nz`` become the field ``normals``.

    ``first``: the number in the file of the first of these points; None where they are all of the file.
    """
    missing = [name for name in ("x", "y", "z") if name not in columns]
    if missing:
        raise InputError(f"{path}: no coordinate {', '.join(missing)}; a cloud needs x, y and z")
    if any(columns[name].ndim != 1 for name in ("x", "y", "z")):
        raise InputError(f"{path}: x, y or z holds several numbers a point; export the cloud again")
    refuse_rounded(path, columns)
    xyz = np.stack([columns[n].astype(np.float64) for n in ("x", "y", "z")], axis=1)
    check_coordinates(path, xyz, first)
    fields = {name: values for name, values in columns.items() if name not in ("x", "y", "z")}
    if all(name in fields for name in _NORMALS):
        fields["normals"] = np.stack([fields.pop(name) for name in _NORMALS], axis=1)
    return replace(from_world(xyz, read_crs(path, crs)), fields=fields)


def read_crs(path: Path, text: str | None) -> str | None:
    """Check the CRS that a file names and return its shortest text."""
    if text is None:
        return None
    try:
        crs = require_map_crs(text)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    if len(crs.axis_info) == 3 and crs.axis_info[2].unit_conversion_factor != 1.0:
        raise InputError(
            f"{path}: its CRS gives heights in {crs.axis_info[2].unit_name}; convert the heights to"
            " metres, and name a CRS with heights in metres or one without heights"
        )
    return crs_text(crs)


def brightest(cloud: PointCloud) -> float:
    """Return the largest intensity of a cloud; 0 without any, inf for whole numbers: no shares of 1."""
    values = np.asarray(cloud.fields.get("intensity", np.zeros(0, np.float32)))
    return float(np.nanmax(values, initial=0.0)) if values.dtype.kind == "f" else np.inf


def scalar_columns(path: Path, cloud: PointCloud) -> dict[str, Column]:
    """Split the fields of a cloud into one-dimensional columns.

    ``normals`` become ``nx ny nz``; another (N, k) field ``f`` becomes
    ``f_0 ... f_{k-1}``.
    """
    columns: dict[str, Column] = {}
    for name, values in cloud.fields.items():
        if values.ndim == 1:
            parts = {name: values}
        elif values.ndim == 2 and name == "normals" and values.shape[1] == 3:
            parts = {axis: values[:, i] for i, axis in enumerate(_NORMALS)}
        elif values.ndim == 2:
            parts = {f"{name}_{i}": values[:, i] for i in range(values.shape[1])}
        else:
            raise InputError(f"{path}: field {name} has shape {values.shape}; expected (N,) or (N, k)")
        columns.update(parts)
    for name in columns:
        if name in ("x", "y", "z") or not name.isascii() or not name.strip() or len(name.split()) != 1:
            raise InputError(f"{path}: field name {name!r} cannot be written; rename the field")
    return columns
