"""Cloud-optimised point clouds (COPC 1.0): LAZ that viewers open at any zoom, without reading it all."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Iterator
from copy import deepcopy
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, BinaryIO

import laspy
import lazrs
import numpy as np
from laspy.vlrs.known import LasZipVlr
from numpy.typing import NDArray

from subiaco_geo.atomic import whole_file
from subiaco_geo.cloud_fields import brightest
from subiaco_geo.clouds import PointCloud, unpack_voxel_keys, voxel_keys
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.las_writing import SCALE, LasRecords

_CELLS = 128  # cells along the edge of a node, with at most one point each
_SMALL = 20_000  # a node with no more points than this has no children
_DEEPEST = 12
_HELD = 2_000_000  # points of a piece, which is sorted in memory
_FINEST = 7  # level of the smallest pieces: finer ones than the cells of level 0 would choose too many
_EVLR_HEADER = 60  # bytes

Key = tuple[int, int, int, int]  # level, x, y, z
Records = NDArray[Any]


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
    """
    write_copc_parts(path, lambda: [cloud], ellipsoidal=ellipsoidal)


def write_copc_parts(
    path: Path, parts: Callable[[], Iterable[PointCloud]], *, ellipsoidal: bool = True
) -> None:
    """Write clouds together to one ``.copc.laz``; see :func:`write_copc`.

    Parameters
    ----------
    path : Path
    parts : callable
        Yields the clouds, the same every time (three times); all have the same CRS and fields.
    ellipsoidal : bool

    Notes
    -----
    The layout is that of the COPC 1.0 specification (copc.io): the LAZ chunks
    are the nodes of an octree in which every level adds points between those
    of the level above. Memory holds a piece of its cube, up to two million points: the pieces go to
    disk, then each is sorted and gives its share of the nodes above it, which come last.
    """
    box = _Box(parts())
    counts = _count(parts(), box)
    level = next(n for n, own in enumerate(counts) if n == _FINEST or max(own.values(), default=0) <= _HELD)
    maker = LasRecords(path, ellipsoidal, box.brightest <= 1.0)
    with TemporaryDirectory(prefix="subiaco_") as folder:
        pieces = _Pieces(Path(folder), box)
        for part in parts():
            for records in maker.of(part):
                pieces.take(records, level)
        header = pieces.headed(maker.header)
        with whole_file(path) as temporary, temporary.open("w+b") as stream:
            writer = _Writer(stream, header, box, pieces.times)
            for key in pieces.nodes():
                _write_piece(writer, pieces, key, counts)
            for key in pieces.nodes():  # what they gave to the nodes above them
                writer.node(key, pieces.pop(key))
            writer.close()


class _Box:
    """The cube around clouds: its lower corner and side [m], and how bright its brightest point is."""

    def __init__(self, parts: Iterable[PointCloud]) -> None:
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        self.brightest = 0.0
        for part in parts:
            world = part.world()
            low = np.minimum(low, world.min(axis=0, initial=np.inf))
            high = np.maximum(high, world.max(axis=0, initial=-np.inf))
            self.brightest = max(self.brightest, brightest(part))
        self.low: Floats = low - SCALE  # coordinates are rounded to it
        self.side = float((high - low).max(initial=0.0)) + 2.0 * SCALE

    def nodes(self, world: Floats, level: int) -> Ints:
        """Return the nodes (N, 3) of a level in which points lie."""
        return np.floor((world - self.low) * (2**level / self.side)).astype(np.int64)


def _count(parts: Iterable[PointCloud], box: _Box) -> list[dict[Key, int]]:
    """Count the points of every node of every level down to the smallest pieces."""
    found: list[dict[Key, int]] = [{} for _ in range(_FINEST + 1)]
    for part in parts:
        nodes, times = np.unique(voxel_keys(box.nodes(part.world(), _FINEST)), return_counts=True)
        for node, count in zip(unpack_voxel_keys(nodes).tolist(), times.tolist(), strict=True):
            for level, own in enumerate(found):
                key = _above((_FINEST, *node), level)
                own[key] = own.get(key, 0) + count
    return found


def _above(key: Key, level: int) -> Key:
    """Return the node of a level above that holds a node."""
    up = key[0] - level
    return level, key[1] >> up, key[2] >> up, key[3] >> up


class _Pieces:
    """Records on disk, by node."""

    def __init__(self, folder: Path, box: _Box) -> None:
        self._folder, self._box = folder, box
        self._kind: np.dtype[Any] | None = None
        self._grown: Any = None  # a header that counts
        self._held: set[Key] = set()
        self.times = (np.inf, -np.inf)

    def take(self, records: laspy.ScaleAwarePointRecord, level: int) -> None:
        """Take records of a part, each to its node of a level."""
        if self._grown is None:
            self._grown = laspy.LasHeader(version="1.4", point_format=records.point_format)
            self._grown.scales, self._grown.offsets = records.scales, records.offsets
            self._grown.mins, self._grown.maxs = np.full(3, np.inf), np.full(3, -np.inf)
        self._grown.grow(records)
        time = np.asarray(records["gps_time"])
        self.times = (min(self.times[0], float(time.min())), max(self.times[1], float(time.max())))
        rows = records.array
        keys = voxel_keys(self._box.nodes(self.world(rows), level))
        order = np.argsort(keys, kind="stable")
        fresh = np.flatnonzero(np.diff(keys[order], prepend=-1))
        nodes = unpack_voxel_keys(keys[order][fresh]).tolist()
        for (x, y, z), members in zip(nodes, np.split(order, fresh[1:]), strict=True):
            self.add((level, x, y, z), rows[members])

    def add(self, key: Key, rows: Records) -> None:
        """Keep records of a node."""
        self._kind = rows.dtype
        self._held.add(key)
        with self._path(key).open("ab") as stream:
            stream.write(rows.tobytes())

    def nodes(self) -> list[Key]:
        """Return the nodes that hold records now."""
        return sorted(self._held)

    def pop(self, key: Key) -> Records:
        """Return the records of a node and forget them."""
        self._held.remove(key)
        assert self._kind is not None
        rows: Records = np.fromfile(self._path(key), dtype=self._kind)
        self._path(key).unlink()
        return rows

    def _path(self, key: Key) -> Path:
        return self._folder / "-".join(map(str, key))

    def world(self, rows: Records) -> Floats:
        """Coordinates (N, 3) of records [m]."""
        assert self._grown is not None
        steps = np.stack([rows[axis] for axis in "XYZ"], axis=1)
        return np.asarray(steps * self._grown.scales + self._grown.offsets)

    def headed(self, header: laspy.LasHeader) -> laspy.LasHeader:
        """Return a header that counts what was taken."""
        assert self._grown is not None
        whole = deepcopy(header)
        for name in ("point_count", "mins", "maxs", "number_of_points_by_return"):
            setattr(whole, name, getattr(self._grown, name))
        return whole

    def local(self, rows: Records) -> tuple[Floats, float]:
        """Coordinates (N, 3) of records from the corner of the cube, and its side [m]."""
        return self.world(rows) - self._box.low, self._box.side


def _write_piece(writer: _Writer, pieces: _Pieces, key: Key, counts: list[dict[Key, int]]) -> None:
    """Write the nodes of a piece, and keep its share of the nodes above it."""
    rows = pieces.pop(key)
    local, side = pieces.local(rows)
    rest = np.arange(len(rows))
    for level in range(key[0]):
        node = _above(key, level)
        chosen = np.arange(len(rest))
        if counts[level].get(node, 0) > _SMALL:
            chosen = _one_a_cell(local[rest], level, side)
        if len(chosen):
            pieces.add(node, rows[rest[chosen]])
        rest = np.delete(rest, chosen)
    for node, members in octree(local[rest], side, key[0]):
        writer.node(node, rows[rest[members]])


class _Writer:
    """A COPC file in the making: header, a LAZ chunk a node, then where these are."""

    def __init__(
        self, stream: BinaryIO, header: laspy.LasHeader, box: _Box, times: tuple[float, float]
    ) -> None:
        form = header.point_format
        laz = lazrs.LazVlr.new_for_compression(form.id, form.num_extra_bytes, use_variable_size_chunks=True)
        half = box.side / 2
        self._info = [*(box.low + half), half, box.side / _CELLS, 0, 0, *times]
        self._stream, self._header = stream, header
        self._entries: list[tuple[int, ...]] = []
        header.are_points_compressed = True
        header.vlrs.insert(0, laspy.VLR("copc", 1, "COPC info", _info(self._info)))
        header.vlrs.append(LasZipVlr(laz.record_data()))
        header.write_to(stream)
        self._compressor = lazrs.LasZipCompressor(stream, laz)
        self._compressor.reserve_offset_to_chunk_table()

    def node(self, key: Key, rows: Records) -> None:
        """Write the points of a node as a chunk."""
        start = self._stream.tell()
        self._compressor.compress_many(np.frombuffer(rows.tobytes(), np.uint8))
        self._compressor.finish_current_chunk()
        self._entries.append((*key, start, self._stream.tell() - start, len(rows)))

    def close(self) -> None:
        """Write where the nodes are, and the header again."""
        self._compressor.done()
        stream, header = self._stream, self._header
        stream.seek(0, 2)
        header.start_of_first_evlr, header.number_of_evlrs = stream.tell(), 1
        pages = b"".join(struct.pack("<4iQ2i", *entry) for entry in self._entries)
        stream.write(struct.pack("<H16sHQ32s", 0, b"copc", 1000, len(pages), b"EPT hierarchy") + pages)
        self._info[5:7] = header.start_of_first_evlr + _EVLR_HEADER, len(pages)
        header.vlrs[0] = laspy.VLR("copc", 1, "COPC info", _info(self._info))
        stream.seek(0)
        header.write_to(stream, ensure_same_size=True)


def _info(values: list[float]) -> bytes:
    """Record of the info VLR: centre, half size, spacing, where the hierarchy is, GPS times, 11 reserved."""
    return struct.pack("<5d2Q2d", *values) + bytes(88)


def _one_a_cell(local: Floats, level: int, side: float) -> Ints:
    """Return the first point of every cell of a level, in order."""
    cells = np.floor(local * (2**level * _CELLS / side)).astype(np.int64)
    return np.sort(np.unique(voxel_keys(cells), return_index=True)[1])


def octree(local: Floats, side: float, first: int = 0) -> Iterator[tuple[Key, Ints]]:
    """Yield nodes and the indices of their points: one point a cell a level, the rest further down.

    Parameters
    ----------
    local : (N, 3) float64
        Points in the cube [0, side)^3 [m].
    side : float
        [m]
    first : int
        Level to begin with.
    """
    rest = np.arange(len(local))
    for level in range(first, _DEEPEST + 1):
        if len(rest) == 0:
            return
        nodes = np.floor(local[rest] * (2**level / side)).astype(np.int64)
        order = np.argsort(voxel_keys(nodes), kind="stable")
        rest, nodes = rest[order], nodes[order]
        keys = voxel_keys(nodes)
        starts = np.flatnonzero(np.r_[True, np.diff(keys) != 0])
        left = []
        for start, end in zip(starts, [*starts[1:], len(rest)], strict=True):
            members = rest[start:end]
            x, y, z = nodes[start].tolist()
            chosen = np.arange(len(members))
            if len(members) > _SMALL and level < _DEEPEST:
                chosen = _one_a_cell(local[members], level, side)
            yield (level, x, y, z), members[chosen]
            left.append(np.delete(members, chosen))
        rest = np.concatenate(left)
