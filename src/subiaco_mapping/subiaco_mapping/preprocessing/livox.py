"""Clouds of Livox drivers (``CustomMsg``), read from their bytes.

A message is a header, the time of its first point (uint64 ns), the number of points, the device and three
reserved bytes, then the points: uint32 nanoseconds since the header, three float32 coordinates [m],
reflectivity, tag and line (uint8 each). The serialised points lie 20 bytes apart, so that numpy reads them
without one object for each; the bag needs no definition of the type.
"""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.errors import InputError
from subiaco_geo.topics import POINTS
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.measurements import Scan
from subiaco_mapping.preprocessing.conversions import scan_from_array

_NAMES = ("offset_time", "x", "y", "z", "reflectivity", "tag", "line")
_FORMATS = ("u4", "f4", "f4", "f4", "u1", "u1", "u1")
_OFFSETS = (0, 4, 8, 12, 16, 17, 18)
_STEP, _LAST = 20, 19  # between points, and of the last point, which nothing pads [byte]
_HEAD = 4  # encapsulation in front of a serialised message; alignment counts from its end [byte]


def livox_points(raw: bytes | memoryview) -> tuple[NDArray[np.void], int]:
    """Return the points of a serialised ``CustomMsg`` and its time.

    Parameters
    ----------
    raw : bytes
        CDR of either byte order.

    Returns
    -------
    points : (N,) structured
        ``offset_time`` [ns], ``x``, ``y``, ``z`` [m], ``reflectivity``, ``tag``, ``line``.
    header_ns : int
        Stamp of the header; the time of the first point where the header has none.

    Raises
    ------
    InputError
        The bytes are fewer than the message says, or no CDR.
    """
    view = memoryview(raw)
    try:
        if view[0] != 0 or view[1] not in (0, 1):
            raise InputError(f"{POINTS}: a Livox cloud is not plain CDR; record it again")
        order = "<" if view[1] == 1 else ">"
        seconds, nanoseconds, frame = struct.unpack_from(f"{order}iII", view, _HEAD)
        at = _HEAD + _aligned(12 + frame, 8)
        first_ns, _, count = struct.unpack_from(f"{order}QI4xI", view, at)
    except (struct.error, IndexError) as error:
        raise InputError(f"{POINTS}: a Livox cloud is cut ({error}); the recording is damaged") from error
    begins = at + 20
    needs = begins + (_STEP * (count - 1) + _LAST if count else 0)
    if len(view) < needs:
        raise InputError(
            f"{POINTS}: a Livox cloud says {count} points and holds {max(len(view) - begins, 0)} bytes; "
            "the recording is damaged"
        )
    dtype = np.dtype(
        {"names": _NAMES, "formats": [order + f for f in _FORMATS], "offsets": _OFFSETS, "itemsize": _STEP}
    )
    block = bytes(view[begins:needs]) + bytes(_STEP - _LAST) * bool(count)
    header_ns = int(seconds) * 10**9 + int(nanoseconds)
    return np.frombuffer(block, dtype=dtype), header_ns or int(first_ns)


def _aligned(offset: int, step: int) -> int:
    return -(-offset // step) * step


def scan_from_livox(raw: bytes | memoryview, config: MappingConfig) -> Scan:
    """Convert a serialised ``CustomMsg``; directions without a return lie at the origin and are left out.

    Raises
    ------
    InputError
        The message is damaged, or its times are no times of one sweep.
    """
    points, header_ns = livox_points(raw)
    return scan_from_array(points, header_ns, config)
