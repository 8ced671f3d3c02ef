"""Deskewed scans on disk until the pose graph is solved, so that memory stays bounded."""

from __future__ import annotations

import errno
import logging
import shutil
from dataclasses import dataclass
from pathlib import Path

import numba
import numpy as np
from numpy.typing import NDArray

from subiaco_geo.frames import Floats
from subiaco_mapping.measurements import DeskewedScan, Returns

logger = logging.getLogger(__name__)

_CHECK_EVERY = 20  # scans between two looks at the free space: two seconds, at most 40 MB
_POINT = np.dtype([("xyz", "<i2", 3), ("intensity", "<u2")])
#: Time of a point before the stamp [ns], and its number among the returns of its beam and their number.
PULSE = np.dtype([("before_ns", "<u4"), ("number", "u1"), ("of", "u1")])
_FULL_SCALE = 32767
_BEAM_OFFSET = 5.0  # of a beam's start from the sensor at the stamp, the motion in a scan included [m]


@dataclass(frozen=True)
class SpooledScan:
    """Both returns of a scan, xyz (N, 3) [m] in ``lidar_link`` and intensity (N,), and its sky.

    ``pulses`` and ``last_pulses`` (:data:`PULSE`) hold times and return numbers where the spool keeps them.
    """

    xyz: Floats
    intensity: NDArray[np.float32]
    last_xyz: Floats
    last_intensity: NDArray[np.float32]
    sky_xyz: Floats
    pulses: NDArray[np.void] | None = None
    last_pulses: NDArray[np.void] | None = None


def pulses_of(
    stamp_ns: int, first: Returns, last: Returns | None
) -> tuple[NDArray[np.void], NDArray[np.void]]:
    """Return times before the stamp and return numbers of both returns (:data:`PULSE`).

    Returns of one beam have the same time and ring; the nearer one is number 1.
    """
    found = []
    for returns in (first, last):
        count = 0 if returns is None else len(returns)
        pulses = np.zeros(count, dtype=PULSE)
        pulses["number"] = pulses["of"] = 1
        if returns is not None:
            pulses["before_ns"] = np.clip(stamp_ns - returns.times_ns, 0, 2**32 - 1)
        found.append(pulses)
    if last is None or len(last) == 0 or len(first) == 0:
        return found[0], found[1]
    beams = [np.asarray(r.times_ns - first.times_ns.min()) << 16 | r.ring for r in (first, last)]
    _, one, two = np.intersect1d(beams[0], beams[1], return_indices=True)
    farther = np.linalg.norm(first.xyz[one], axis=1) > np.linalg.norm(last.xyz[two], axis=1)
    found[0]["of"][one] = found[1]["of"][two] = 2
    found[0]["number"][one] = 1 + farther
    found[1]["number"][two] = 2 - farther
    return found[0], found[1]


class Spool:
    """Scans of one sequence in a folder, 8 bytes a point.

    Coordinates are stored in steps of the longest range / 32767 (3 mm at 100 m, a mean error under
    a millimetre, far under the noise of the sensor); points beyond ``max_range`` are left out.

    Parameters
    ----------
    folder : Path
    max_range, sky_range : float
        Longest ranges of points and of beams that met nothing [m].
    reserve_bytes : int
        Free space of the disk, a twentieth of it at most, below which scans are kept without their points, so
        that what was mapped until then can still be fused and written.
    keep_pulses : bool
        Keep times and return numbers of the points too, 6 bytes a point.
    """

    def __init__(
        self,
        folder: Path,
        max_range: float,
        sky_range: float = 0.0,
        reserve_bytes: int = 0,
        *,
        keep_pulses: bool = False,
    ) -> None:
        self._keep_pulses = keep_pulses
        self._folder = folder
        self._longest = max(max_range, sky_range + _BEAM_OFFSET)
        self._step = self._longest / _FULL_SCALE
        self._max_range = max_range
        self._count = 0
        self._reserve_bytes = reserve_bytes
        self._full = False
        self.left_out = 0  # scans whose points found no room
        folder.mkdir(parents=True, exist_ok=True)

    def __len__(self) -> int:
        return self._count

    @property
    def folder(self) -> Path:
        """Where the scans lie."""
        return self._folder

    def restore(self, count: int) -> None:
        """Take that many scans as written already."""
        self._count = count

    def append(self, scan: DeskewedScan) -> None:
        """Write the next scan; without its points where the disk is full (counted in ``left_out``)."""
        if self._reserve_bytes and self._count % _CHECK_EVERY == 0:
            disk = shutil.disk_usage(self._folder)
            self._note_room(disk.free >= min(self._reserve_bytes, disk.total // 20))
        parts = (
            self._pack(scan.xyz, scan.intensity, self._max_range),
            self._pack(scan.last_xyz, scan.last_intensity, self._max_range),
            self._pack(scan.sky_xyz, np.zeros(len(scan.sky_xyz), np.float32), self._longest),
            *(self._pulses(scan) if self._keep_pulses else ()),
        )
        if not self._full:
            try:
                self._write(parts)
            except OSError as error:
                if error.errno not in (errno.ENOSPC, errno.EDQUOT):
                    raise
                self._note_room(room=False)
        if self._full:
            self._write(tuple(part[:0] for part in parts))
            self.left_out += 1
        self._count += 1

    def _pulses(self, scan: DeskewedScan) -> tuple[NDArray[np.void], NDArray[np.void]]:
        """Return the pulses of the points that are kept; of a scan without times, its stamp is theirs."""
        if scan.raw is None:
            found = np.zeros(len(scan.xyz), PULSE), np.zeros(len(scan.last_xyz), PULSE)
            for pulses in found:
                pulses["number"] = pulses["of"] = 1
        else:
            found = pulses_of(scan.stamp_ns, *scan.raw)
        first, last = (
            pulses[_within(xyz, self._max_range)]
            for pulses, xyz in zip(found, (scan.xyz, scan.last_xyz), strict=True)
        )
        return first, last

    def _write(self, parts: tuple[NDArray[np.void], ...]) -> None:
        with self._path(self._count).open("wb") as stream:
            stream.write(np.array([len(part) for part in parts], dtype=np.int64).data)
            for part in parts:
                stream.write(part.view(np.uint8).data)

    def _note_room(self, room: bool) -> None:
        if not room and not self._full:
            logger.error(
                "%s: the disk is full; further scans are left out of the map: make room on it", self._folder
            )
        self._full = not room

    def read(self, index: int) -> SpooledScan:
        """Read a scan back."""
        kinds = [_POINT] * 3 + [PULSE] * (2 if self._keep_pulses else 0)
        data = np.fromfile(self._path(index), dtype=np.uint8)
        begin, parts = 8 * len(kinds), []
        for kind, count in zip(kinds, data[:begin].view(np.int64).tolist(), strict=True):
            end = begin + count * kind.itemsize
            parts.append(data[begin:end].view(kind))
            begin = end
        first, last, sky, *pulses = parts
        return SpooledScan(*self._unpack(first), *self._unpack(last), self._unpack(sky)[0], *pulses)

    def _path(self, index: int) -> Path:
        return self._folder / f"{index:06d}.scan"

    def _pack(self, xyz: Floats, intensity: NDArray[np.float32], limit: float) -> NDArray[np.void]:
        return _packed(xyz, intensity, _within(xyz, limit), self._step).view(_POINT)[:, 0]

    def _unpack(self, points: NDArray[np.void]) -> tuple[Floats, NDArray[np.float32]]:
        return _unpacked(points.view(np.int16).reshape(-1, 4), self._step)


def _within(xyz: Floats, limit: float) -> NDArray[np.bool_]:
    return np.asarray(np.einsum("ij,ij->i", xyz, xyz) <= limit**2)


@numba.njit(cache=True)
def _packed(
    xyz: Floats, intensity: NDArray[np.float32], keep: NDArray[np.bool_], step: float
) -> NDArray[np.int16]:
    """Return the kept points as rows (M, 4) of 16 bits: coordinates in steps, intensity unsigned."""
    packed, n = np.empty((keep.sum(), 4), np.int16), 0
    for i in range(len(xyz)):
        if keep[i]:
            for axis in range(3):
                packed[n, axis] = np.int16(np.rint(xyz[i, axis] / step))
            value = intensity[i] if intensity[i] > 0 else np.float32(0.0)  # NaN neither
            packed[n, 3] = np.int16(np.uint16(min(value, np.float32(65535.0))))
            n += 1
    return packed


@numba.njit(cache=True)
def _unpacked(packed: NDArray[np.int16], step: float) -> tuple[Floats, NDArray[np.float32]]:
    """Return coordinates (N, 3) [m] and intensity (N,) of packed points."""
    xyz, intensity = np.empty((len(packed), 3)), np.empty(len(packed), np.float32)
    for i in range(len(packed)):
        for axis in range(3):
            xyz[i, axis] = packed[i, axis] * step
        intensity[i] = np.uint16(packed[i, 3])
    return xyz, intensity
