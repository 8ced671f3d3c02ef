"""Point clouds read part by part, so that memory holds a million points of a file of any size."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from subiaco_geo.cloud_io import read_cloud
from subiaco_geo.clouds import PointCloud
from subiaco_geo.las_io import las_parts
from subiaco_geo.ply_io import ply_parts

#: Points in memory at a time.
PART = 1 << 20


def cloud_parts(
    path: Path, fields: tuple[str, ...] | None = (), size: int = PART, first: int = 0
) -> Iterator[PointCloud]:
    """Read a cloud file from point ``first`` on in parts of up to ``size`` points.

    Binary PLY, LAS and LAZ are never whole in memory; other forms are read whole, and are one part.

    Parameters
    ----------
    path : Path
    fields : tuple of str, optional
        Fields wanted; those that the file lacks are left out. None: all; a LAS or LAZ is one part then,
        as only its end shows which of its many fields say anything.
    size, first : int

    Yields
    ------
    PointCloud
        Each about an origin of its own, with the CRS that the file names.

    Raises
    ------
    InputError
        As :func:`subiaco_geo.cloud_io.read_cloud`, when the faulty part is reached.
    """
    suffix = path.suffix.lower()
    if suffix in (".las", ".laz") and fields is not None and path.is_file() and path.stat().st_size:
        yield from las_parts(path, fields, size, first)
    elif suffix == ".ply" and path.is_file() and path.stat().st_size:
        for part in ply_parts(path, size, first):
            yield with_only(part, fields)
    else:
        whole = with_only(read_cloud(path), fields)
        yield whole.select(np.arange(first, len(whole))) if first else whole


def with_only(cloud: PointCloud, fields: tuple[str, ...] | None) -> PointCloud:
    """Return a cloud with those of some fields that it has; None: all."""
    if fields is None:
        return cloud
    return replace(cloud, fields={name: cloud.fields[name] for name in fields if name in cloud.fields})
