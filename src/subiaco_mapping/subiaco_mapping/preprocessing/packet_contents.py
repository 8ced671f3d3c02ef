"""Contents of a LiDAR packet: column numbers, times, validity and pixels, read in one step.

The SDK of Ouster reads one field a call, and a packet needs five calls. One loop over the words of a packet
takes a tenth of that time. So the SDK is asked once, with random packets, in which word and bits each value
lies. If the place of a value is not found, the SDK reads every packet.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray
from ouster.sdk import core

from subiaco_geo.frames import Ints

_TRIALS = 4  # random packets: 64 columns or more tell the places of a header apart
_SHIFTS = range(-7, 32)  # bits to the right; to the left where a profile leaves out low bits of a range
_WORD = 4  # [bytes]
_ID, _STATUS, _TIME = core.ColHeader.MEASUREMENT_ID, core.ColHeader.STATUS, core.ColHeader.TIMESTAMP

Words = NDArray[np.uint32]
Flags = NDArray[np.bool_]


class PacketContents:
    """Reads the packets of one sensor.

    Parameters
    ----------
    packets : PacketFormat
        Of the SDK.
    names : sequence of str
        Fields of the pixels that are wanted.
    """

    def __init__(self, packets: Any, names: Sequence[str]) -> None:
        self._packets, self._names = packets, tuple(names)
        self.places = _found_places(packets, self._names)
        columns, height = packets.columns_per_packet, packets.pixels_per_column
        self._ids, self._times_ns = np.zeros((2, columns), dtype=np.int64)
        self._valid = np.zeros(columns, dtype=np.bool_)
        self._values: Words = np.zeros((len(self._names), height, columns), dtype=np.uint32)
        self._words: Words = np.zeros(-(-packets.lidar_packet_size // _WORD), dtype=np.uint32)
        self._bytes = self._words.view(np.uint8)[: packets.lidar_packet_size]
        sizes = packets.packet_header_size, packets.col_size, packets.col_header_size, _pixel_size(packets)
        self._sizes = tuple(size // _WORD for size in sizes)

    def read(self, data: NDArray[np.uint8]) -> tuple[Ints, Ints, Flags, Words]:
        """Return column numbers, times [ns] and validity (C,), and pixels (F, H, C).

        The next packet overwrites the arrays.
        """
        if self.places is not None:
            self._bytes[:] = data
            _read(
                self._words, *self._sizes, self.places, self._ids, self._times_ns, self._valid, self._values
            )
        else:
            number, status, time = (self._packets.packet_header(h, data) for h in (_ID, _STATUS, _TIME))
            self._ids[:], self._times_ns[:] = number.astype(np.int64), time.astype(np.int64)
            self._valid[:] = status.astype(np.int64) & 1
            for k, name in enumerate(self._names):
                self._values[k] = self._packets.packet_field(name, data)
        return self._ids, self._times_ns, self._valid, self._values


def _pixel_size(packets: Any) -> int:
    inside = packets.col_size - packets.col_header_size - packets.col_footer_size
    return int(inside // packets.pixels_per_column)


def _found_places(packets: Any, names: tuple[str, ...]) -> Words | None:
    """Return word, shift to the right, shift to the left and mask of every value (4 + F, 4).

    Number, validity and both halves of the time come first, in words from the column on; fields follow, in
    words from the pixel on. None if a value is not found.
    """
    first, size, head = packets.packet_header_size, packets.col_size, packets.col_header_size
    wide = _pixel_size(packets)
    sizes = first, size, head, wide, packets.lidar_packet_size
    if sys.byteorder != "little" or wide == 0 or any(s % _WORD for s in sizes):
        return None
    generator = np.random.default_rng(0)
    trials = generator.integers(0, 256, (_TRIALS, packets.lidar_packet_size), dtype=np.uint8)
    columns = trials[:, first : first + packets.columns_per_packet * size].reshape(-1, size).view("<u4")
    inside = columns[:, head // _WORD : (head + packets.pixels_per_column * wide) // _WORD]
    ends = [k for k in range(size // _WORD) if not head // _WORD <= k < head // _WORD + inside.shape[1]]
    number, status, time = (
        np.concatenate([packets.packet_header(h, trial) for trial in trials]) for h in (_ID, _STATUS, _TIME)
    )
    halves = (time.astype(np.uint64) >> np.uint64(half) & np.uint64(2**32 - 1) for half in (0, 32))
    headers = [(number, 0xFFFF), (status.astype(np.int64) & 1, 1), *((half, 2**32 - 1) for half in halves)]
    found = [_place(columns, values, mask, ends) for values, mask in headers]
    pixels = inside.reshape(-1, wide // _WORD)
    for name in names:
        values = np.concatenate([packets.packet_field(name, trial).T.ravel() for trial in trials])
        found.append(_place(pixels, values, packets.field_value_mask(name), range(wide // _WORD)))
    return None if any(place is None for place in found) else np.array(found, dtype=np.uint32)


def _place(
    rows: Words, values: NDArray[Any], mask: int, candidates: Iterable[int]
) -> tuple[int, int, int, int] | None:
    """Return where in rows (N, W) of words values (N,) lie: word, both shifts and mask; None for nowhere."""
    wanted = values.astype(np.uint64)
    for word in candidates:
        for shift in _SHIFTS:
            right, left = max(shift, 0), max(-shift, 0)
            shifted = (rows[:, word].astype(np.uint64) >> np.uint64(right)) << np.uint64(left)
            if mask < 2**32 and np.array_equal(shifted & np.uint64(mask), wanted):
                return word, right, left, mask
    return None


@numba.njit(cache=True, inline="always")
def _value(words, at, place):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Return the value at a place, in words from ``at`` on."""
    return ((words[np.uint64(at + place[0])] >> place[1]) << place[2]) & place[3]


@numba.njit(cache=True)
def _read(
    words: Words, first: int, size: int, head: int, wide: int, places: Words,
    ids: Ints, times_ns: Ints, valid: Flags, values: Words,
) -> None:  # fmt: skip
    """Fill column numbers, times and validity (C,), and pixels (F, H, C), from a packet; sizes in words."""
    fields, height, columns = values.shape
    for column in range(columns):
        at = first + column * size
        ids[column] = _value(words, at, places[0])
        valid[column] = _value(words, at, places[1]) == 1
        low, high = np.int64(_value(words, at, places[2])), np.int64(_value(words, at, places[3]))
        times_ns[column] = (high << 32) | low
    for k in range(fields):
        place = places[4 + k]
        for row in range(height):
            for column in range(columns):
                values[k, row, column] = _value(words, first + column * size + head + row * wide, place)
