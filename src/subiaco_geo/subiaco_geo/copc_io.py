"""Cloud-optimised point clouds (COPC 1.0): LAZ that viewers open at any zoom, without reading it all."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from typing import BinaryIO

import laspy
import lazrs
import numpy as np
from laspy.vlrs.known import LasZipVlr

from subiaco_geo.atomic import whole_file
from subiaco_geo.clouds import PointCloud, voxel_keys
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.las_writing import las_data

_CELLS = 128  # cells along the edge of a node, with at most one point each
_SMALL = 20_000  # a node with no more points than this has no children
_DEEPEST = 12
_EVLR_HEADER = 60  # bytes

Key = tuple[int, int, int, int]  # level, x, y, z


def write_copc(path: Path, cloud: PointCloud, *, ellipsoidal: bool = True) -> None:
    """Write a ``.copc.laz`` file with the fields and the CRS of :func:`subiaco_geo.las_writing.write_las`.

    Parameters
    ----------
    path : Path
    cloud : PointCloud
    ellipsoidal : bool
        State the height as ellipsoidal in the CRS.

    Raises
    ------
    InputError
        As for :func:`subiaco_geo.las_writing.write_las`.

    Notes
    -----
    The layout is that of the COPC 1.0 specification (copc.io): the LAZ chunks
    are the nodes of an octree in which every level adds points between those
    of the level above.
    """
    las = las_data(path, cloud, ellipsoidal=ellipsoidal)
    xyz = np.asarray(las.xyz)
    low = xyz.min(axis=0)
    side = float(np.ptp(xyz, axis=0).max()) * (1 + 1e-9) + 1e-6
    with whole_file(path) as temporary, temporary.open("w+b") as stream:
        _write(stream, las, list(octree(xyz - low, side)), low + side / 2, side / 2)


def _write(
    stream: BinaryIO, las: laspy.LasData, nodes: list[tuple[Key, Ints]], centre: Floats, half: float
) -> None:
    laz = lazrs.LazVlr.new_for_compression(
        las.point_format.id, las.point_format.num_extra_bytes, use_variable_size_chunks=True
    )
    header = deepcopy(las.header)
    header.update(las.points)
    header.are_points_compressed = True
    times = np.asarray(las.gps_time)
    info = [*centre, half, 2 * half / _CELLS, 0, 0, times.min(), times.max()]
    header.vlrs.insert(0, laspy.VLR("copc", 1, "COPC info", _info(info)))
    header.vlrs.append(LasZipVlr(laz.record_data()))
    header.write_to(stream)
    entries = _write_nodes(stream, laz, las, nodes)
    header.start_of_first_evlr, header.number_of_evlrs = stream.tell(), 1
    hierarchy = b"".join(struct.pack("<4iQ2i", *entry) for entry in entries)
    stream.write(struct.pack("<H16sHQ32s", 0, b"copc", 1000, len(hierarchy), b"EPT hierarchy") + hierarchy)
    info[5:7] = header.start_of_first_evlr + _EVLR_HEADER, len(hierarchy)
    header.vlrs[0] = laspy.VLR("copc", 1, "COPC info", _info(info))
    stream.seek(0)
    header.write_to(stream, ensure_same_size=True)


def _info(values: list[float]) -> bytes:
    """Record of the info VLR: centre, half size, spacing, where the hierarchy is, GPS times, 11 reserved."""
    return struct.pack("<5d2Q2d", *values) + bytes(88)


def _write_nodes(
    stream: BinaryIO, laz: lazrs.LazVlr, las: laspy.LasData, nodes: list[tuple[Key, Ints]]
) -> list[tuple[int, ...]]:
    """Write a chunk a node; return key, offset, bytes and points of each."""
    records = las.points.array
    compressor = lazrs.LasZipCompressor(stream, laz)
    compressor.reserve_offset_to_chunk_table()
    entries: list[tuple[int, ...]] = []
    for key, members in nodes:
        start = stream.tell()
        compressor.compress_many(np.frombuffer(records[members].tobytes(), np.uint8))
        compressor.finish_current_chunk()
        entries.append((*key, start, stream.tell() - start, len(members)))
    compressor.done()
    stream.seek(0, 2)
    return entries


def octree(local: Floats, side: float) -> Iterator[tuple[Key, Ints]]:
    """Yield nodes and the indices of their points: one point a cell a level, the rest further down.

    Parameters
    ----------
    local : (N, 3) float64
        Points in the cube [0, side)^3 [m].
    side : float
        [m]
    """
    rest = np.arange(len(local))
    for level in range(_DEEPEST + 1):
        nodes = np.floor(local[rest] * (2**level / side)).astype(np.int64)
        order = np.argsort(voxel_keys(nodes), kind="stable")
        rest, nodes = rest[order], nodes[order]
        keys = voxel_keys(nodes)
        starts = np.flatnonzero(np.r_[True, np.diff(keys) != 0]) if len(keys) else np.empty(0, np.int64)
        left = []
        for start, end in zip(starts, [*starts[1:], len(rest)], strict=True):
            members = rest[start:end]
            x, y, z = nodes[start].tolist()
            chosen = np.arange(len(members))
            if len(members) > _SMALL and level < _DEEPEST:
                cells = np.floor(local[members] * (2**level * _CELLS / side)).astype(np.int64) % _CELLS
                chosen = np.unique(voxel_keys(cells), return_index=True)[1]
            yield (level, x, y, z), members[np.sort(chosen)]
            left.append(np.delete(members, chosen))
        rest = np.concatenate(left) if left else rest[:0]
        if len(rest) == 0:
            return
