"""The labelled clouds of a change directory, as PLY and as LAZ."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from subiaco_change.records import CHANGE_COLOURS
from subiaco_geo.cloud_fields import brightest
from subiaco_geo.cloud_io import read_cloud
from subiaco_geo.cloud_parts import cloud_parts
from subiaco_geo.cloud_windows import CloudFile
from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import ASPRS_CODES, Change, Semantic
from subiaco_geo.errors import InputError
from subiaco_geo.las_writing import las_stream
from subiaco_geo.ply_io import write_ply_parts

#: Fields of every labelled point, and their types on disk.
POINT_FIELDS: dict[str, type[np.generic]] = {
    "change": np.uint8,
    "semantic": np.uint8,
    "instance": np.int32,
    "confidence": np.float32,
    "lod95": np.float32,
}


#: Further fields of points that a run gives, and their types on disk.
MEASURED_FIELDS: dict[str, type[np.generic]] = {"m3c2_distance": np.float32, "m3c2_significant": np.uint8}


def change_palette() -> NDArray[np.uint8]:
    """Return the colour (256, 3) of every change code; codes without a meaning are black."""
    palette = np.zeros((256, 3), dtype=np.uint8)
    for change, rgb in CHANGE_COLOURS.items():
        palette[int(change)] = rgb
    return palette


def asprs_lookup() -> NDArray[np.uint8]:
    """Return the ASPRS code (256,) of every class code, 1 (unclassified) by default."""
    table = np.ones(256, dtype=np.uint8)
    for semantic, code in ASPRS_CODES.items():
        table[int(semantic)] = code
    return table


def labelled_cloud(cloud: PointCloud) -> PointCloud:
    """Return the points with the fields of the contract and measured ones that they have, in colours.

    Raises
    ------
    InputError
        A field is missing, or a code has no meaning.
    """
    for name in POINT_FIELDS:
        if name not in cloud.fields:
            raise InputError(f"labelled cloud: field {name} is missing; every stage must fill it")
    fields = {name: np.asarray(cloud.fields[name]).astype(kind) for name, kind in POINT_FIELDS.items()}
    _check_codes(fields["change"], "change", [int(c) for c in Change])
    _check_codes(fields["semantic"], "semantic", [int(s) for s in Semantic])
    colours = change_palette()[fields["change"].astype(np.int64)]
    for column, name in enumerate(("red", "green", "blue")):
        fields[name] = np.ascontiguousarray(colours[:, column])
    fields |= {
        name: np.asarray(cloud.fields[name]).astype(kind)
        for name, kind in MEASURED_FIELDS.items()
        if name in cloud.fields
    }
    if "intensity" in cloud.fields:
        fields["intensity"] = np.asarray(cloud.fields["intensity"], dtype=np.float32)
    return PointCloud(cloud.xyz, cloud.origin, cloud.crs, fields)


def with_asprs_codes(cloud: PointCloud) -> PointCloud:
    """Return a labelled cloud with its ASPRS code in the field ``classification``."""
    codes = asprs_lookup()[np.asarray(cloud.fields["semantic"]).astype(np.int64)]
    return cloud.with_fields(classification=codes)


def _check_codes(values: NDArray[np.generic], name: str, allowed: list[int]) -> None:
    strange = np.setdiff1d(values, allowed)
    if len(strange):
        raise InputError(f"labelled cloud: {name} holds code {strange[0]}; allowed are {allowed}")


def write_labelled(
    directory: Path, epoch: str, parts: Callable[[], Iterator[PointCloud]], ellipsoidal: bool = False
) -> int:
    """Write ``<epoch>_labelled.ply`` and ``.laz``; the LAZ adds ASPRS ``classification``.

    Parameters
    ----------
    directory : Path
    epoch : str
        ``before`` or ``after``.
    parts : callable
        Yields the cloud part by part, every time it is called.
    ellipsoidal : bool
        Lets the LAZ state its heights as ellipsoidal: only where that is known.

    Returns
    -------
    int
        Points written.

    Raises
    ------
    InputError
        A field is missing, a code has no meaning, or there is no point.
    """
    count, bright = 0, 0.0
    for part in parts():
        count += len(part)
        bright = max(bright, brightest(part))
    path = directory / f"{epoch}_labelled.laz"
    with las_stream(path, ellipsoidal=ellipsoidal, unit_intensity=bright <= 1.0) as stream:

        def labelled() -> Iterator[PointCloud]:
            for part in parts():
                cloud = labelled_cloud(part)
                stream.append(with_asprs_codes(cloud))
                yield cloud

        write_ply_parts(directory / f"{epoch}_labelled.ply", labelled(), count)
    return count


def labelled_path(directory: Path, epoch: str) -> Path:
    """Return ``<epoch>_labelled.ply``, or the LAZ where only that is there."""
    for suffix in (".ply", ".laz"):
        path = directory / f"{epoch}_labelled{suffix}"
        if path.is_file():
            return path
    raise InputError(f"{directory}: {epoch}_labelled.ply is missing; run 'subiaco change' again")


def read_labelled(directory: Path, epoch: str) -> PointCloud:
    """Read a labelled cloud whole."""
    path = labelled_path(directory, epoch)
    return _complete(path, read_cloud(path))


def open_labelled(directory: Path, epoch: str) -> CloudFile:
    """Open a labelled cloud, whose points then are read by windows."""
    path = labelled_path(directory, epoch)
    fields = (*POINT_FIELDS, "intensity")
    _complete(path, next(cloud_parts(path, fields, 1)))
    return CloudFile(path, fields)


def _complete(path: Path, cloud: PointCloud) -> PointCloud:
    missing = [name for name in POINT_FIELDS if name not in cloud.fields]
    if missing:
        raise InputError(f"{path}: field {missing[0]} is missing; run 'subiaco change' again")
    return cloud
