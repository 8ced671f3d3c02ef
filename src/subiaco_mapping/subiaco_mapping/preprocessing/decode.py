"""Ouster UDP packets to scans: columns keyed by frame and measurement id, not by arrival."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray
from ouster.sdk import core

from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, Ints
from subiaco_mapping.measurements import Returns, Scan
from subiaco_mapping.preprocessing.config import DecodeConfig
from subiaco_mapping.preprocessing.frame_numbers import FrameUnwrapper
from subiaco_mapping.preprocessing.packet_contents import PacketContents
from subiaco_mapping.preprocessing.sky import sky_mask, thinned

logger = logging.getLogger(__name__)

GPS_MINUS_TAI_S = -19
_MAX_PIXELS, _MAX_COLUMNS = 1024, 16384
_BEYOND, _SEEN = -1, -2  # packets that are not entered into their frame
_FIELDS = ("RANGE", "REFLECTIVITY", "RANGE2", "REFLECTIVITY2")


@dataclass
class DecodeCounts:
    """What came in and what did not.

    ``lost`` counts packets that a closed frame lacked, whole frames included; ``late`` packets
    came after their frame was closed, ``duplicate`` ones twice, ``reordered`` ones after a packet of
    later columns, ``malformed`` ones had the wrong size.
    """

    packets: int = 0
    lost: int = 0
    late: int = 0
    duplicate: int = 0
    reordered: int = 0
    malformed: int = 0
    scans: int = 0
    empty_scans: int = 0
    bad_stamps: int = 0
    restarts: int = 0


@dataclass
class _Frame:
    """One open frame: staggered fields (F, H, W), column times, what was seen, columns that are missing."""

    number: int
    fields: NDArray[np.uint32]
    times_ns: Ints
    seen: NDArray[np.bool_]
    valid: NDArray[np.bool_]
    missing: int
    newer_packets: int = 0


@dataclass(frozen=True)
class _Layout:
    """What the metadata says about a packet and a frame."""

    info: Any
    packets: Any
    names: tuple[str, ...]
    height: int
    width: int
    direction: Floats = field(repr=False)
    offset: Floats = field(repr=False)
    expected: NDArray[np.bool_] = field(repr=False)
    azimuth_column: Ints = field(repr=False)
    column_ns: float = 0.0


def parse_metadata(text: str) -> Any:
    """Return the SDK's ``SensorInfo`` of a metadata text.

    Raises
    ------
    InputError
        The text is not Ouster metadata.
    """
    try:
        return core.SensorInfo(text)
    except (RuntimeError, ValueError) as error:
        first = str(error).splitlines()[0]
        raise InputError(
            f"/ouster/metadata: not Ouster sensor metadata ({first}); "
            "record the sensor's JSON with the packets or pass the right one"
        ) from error


def expected_columns(info: Any) -> NDArray[np.bool_]:
    """Mark (W,) the columns that the sensor sends: packets that touch its azimuth window."""
    width, per_packet = info.format.columns_per_frame, info.format.columns_per_packet
    start, end = info.format.column_window
    column = np.arange(width)
    inside = (column >= start) & (column <= end) if start <= end else (column >= start) | (column <= end)
    return np.asarray(np.repeat(inside.reshape(-1, per_packet).any(axis=1), per_packet))


def _refuse_impossible(form: Any) -> None:
    """Refuse sizes of no sensor, before tables of that size are made."""
    height, width, per_packet = form.pixels_per_column, form.columns_per_frame, form.columns_per_packet
    sound = (
        0 < height <= _MAX_PIXELS
        and 0 < per_packet <= width <= _MAX_COLUMNS
        and width % per_packet == 0
        and len(form.pixel_shift_by_row) == height
        and form.fps > 0
    )
    if not sound:
        raise InputError(
            f"/ouster/metadata: {height} x {width} pixels in packets of {per_packet} columns "
            "make no sense; record the sensor's JSON with the packets or pass the right one"
        )


def _layout(text: str) -> _Layout:
    try:
        return _layout_of(parse_metadata(text))
    except (RuntimeError, ValueError, IndexError, TypeError) as error:
        first = " ".join(str(error).split())
        raise InputError(
            f"/ouster/metadata: contradicts itself ({first}); "
            "record the sensor's JSON with the packets or pass the right one"
        ) from error


def _layout_of(info: Any) -> _Layout:
    _refuse_impossible(info.format)
    height, width = info.format.pixels_per_column, info.format.columns_per_frame
    lut, packets = core.XYZLut(info, use_extrinsics=False), core.PacketFormat(info)
    return _Layout(
        info=info,
        packets=packets,
        names=tuple(name for name in _FIELDS if name in packets.fields),
        height=height,
        width=width,
        direction=np.ascontiguousarray(lut.direction, dtype=np.float64).reshape(-1, 3),
        offset=np.ascontiguousarray(lut.offset, dtype=np.float64).reshape(-1, 3),
        expected=expected_columns(info),
        azimuth_column=(np.arange(width) - np.array(info.format.pixel_shift_by_row)[:, None]) % width,
        column_ns=1e9 / (info.format.fps * width),
    )


def complete_times(
    times_ns: Ints, known: NDArray[np.bool_], column_ns: float, tolerance_ns: int
) -> tuple[Ints, int]:
    """Fill in the column times of a frame from the measurement ids.

    Parameters
    ----------
    times_ns : (W,) int64
    known : (W,) bool
        Columns that carry a time; at least one.
    column_ns : float
        Nominal time from one column to the next [ns].
    tolerance_ns : int
        A known time farther from the frame's line (zeroed, jumped) is treated as missing [ns].

    Returns
    -------
    times_ns : (W,) int64
        Linear between known columns, nominal spacing beyond them.
    bad : int
        Known times that were replaced.
    """
    column = np.arange(len(times_ns))
    usable = known & (times_ns > 0)
    if not usable.any():
        raise ValueError("no column carries a time")
    base = int(times_ns[usable][0])
    relative = (times_ns - base).astype(np.float64)
    residual = relative - column * column_ns
    # a median that is one of the values: where the clock steps in the very middle, half of them stay
    middle = np.quantile(residual[usable], 0.5, method="lower")
    usable &= np.abs(residual - middle) <= tolerance_ns
    index = np.flatnonzero(usable)
    filled = np.interp(column, index, relative[index])
    before, after = column < index[0], column > index[-1]
    filled[before] = relative[index[0]] - (index[0] - column[before]) * column_ns
    filled[after] = relative[index[-1]] + (column[after] - index[-1]) * column_ns
    exact = np.where(usable, times_ns, base + np.round(filled).astype(np.int64))
    return exact.astype(np.int64), int(known.sum() - usable.sum())


def utc_shift_ns(config: DecodeConfig) -> int:
    """Return what makes UTC of the sensor's time [ns]."""
    shift_s = {"utc": 0, "tai": -config.leap_seconds}
    shift_s["gps"] = shift_s["tai"] - GPS_MINUS_TAI_S
    return shift_s[config.time_base] * 10**9 + config.time_offset_ns


@numba.njit(cache=True)
def _enter(
    column: Ints, times_ns: Ints, valid: NDArray[np.bool_], values: NDArray[np.uint32],
    frame_fields: NDArray[np.uint32], frame_times: Ints, frame_seen: NDArray[np.bool_],
    frame_valid: NDArray[np.bool_], expected: NDArray[np.bool_],
) -> int:  # fmt: skip
    """Write a packet into its frame; return how many columns are new that the sensor is expected to send.

    -1 for a packet with columns beyond the frame, -2 for one whose columns were all seen before.
    """
    if column.max() >= len(frame_seen):
        return -1
    known, fresh = 0, 0
    for at in column:
        known += frame_seen[at]
    if known == len(column):
        return -2
    for k, at in enumerate(column):
        fresh += expected[at] and not frame_seen[at]
        frame_seen[at], frame_valid[at], frame_times[at] = True, valid[k], times_ns[k]
    whole = valid.all() and column[-1] - column[0] == len(column) - 1  # the rule: one block of columns
    for name in range(len(values)):
        for row in range(values.shape[1]):
            for k in range(len(column)):
                if valid[k]:
                    at = column[0] + k if whole else column[k]
                    frame_fields[name, row, at] = values[name, row, k]
    return fresh


@numba.njit(cache=True)
def _measured(
    distance: NDArray[np.uint32], intensity: NDArray[np.uint32], times_ns: Ints,
    near: float, far: float, direction: Floats, offset: Floats,
) -> tuple[Floats, Ints, NDArray[np.float32], NDArray[np.uint16], Ints]:  # fmt: skip
    """Return place (N, 3) [m], time, intensity, row and column (N,) of the pixels whose range [mm] counts."""
    height, width = distance.shape
    count = 0
    for i in range(height):
        for j in range(width):
            count += distance[i, j] > 0 and near <= distance[i, j] <= far
    xyz, when = np.empty((count, 3)), np.empty(count, np.int64)
    value, row = np.empty(count, np.float32), np.empty(count, np.uint16)
    column, n = np.empty(count, np.int64), 0
    for i in range(height):
        for j in range(width):
            if distance[i, j] > 0 and near <= distance[i, j] <= far:
                row[n], column[n], when[n], value[n] = i, j, times_ns[j], intensity[i, j]
                for axis in range(3):
                    pixel = i * width + j
                    xyz[n, axis] = direction[pixel, axis] * distance[i, j] + offset[pixel, axis]
                n += 1
    return xyz, when, value, row, column


@numba.njit(cache=True)
def _destaggered(
    distance: NDArray[np.uint32], valid: NDArray[np.bool_], column: Ints
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which beams (H, W) returned something, and which arrived, from the column of each azimuth."""
    returned, received = np.empty(column.shape, np.bool_), np.empty(column.shape, np.bool_)
    for i in range(column.shape[0]):
        for j in range(column.shape[1]):
            returned[i, j], received[i, j] = distance[i, column[i, j]] > 0, valid[column[i, j]]
    return returned, received


class PacketDecoder:
    """Collect packets into scans in ``lidar_link``, the frame of the SDK's XYZ tables.

    Parameters
    ----------
    metadata_json : str
        Sensor metadata as the SDK writes it.
    config : DecodeConfig
    """

    def __init__(self, metadata_json: str, config: DecodeConfig) -> None:
        self._config = config
        self._layout = _layout(metadata_json)
        self._contents = PacketContents(self._layout.packets, self._layout.names)
        self._open: dict[int, _Frame] = {}
        self._frames = FrameUnwrapper(int(self._layout.packets.max_frame_id) + 1)
        self._closed: int | None = None
        self._init_id: int | None = None
        self._latest = (-1, -1)  # frame and column
        self.counts = DecodeCounts()

    @property
    def packet_size(self) -> int:
        """Bytes of one packet."""
        return int(self._layout.packets.lidar_packet_size)

    def push(self, buf: bytes | memoryview) -> list[Scan]:
        """Take one packet; return the scans that it completes, oldest first."""
        self.counts.packets += 1
        data = np.frombuffer(buf, dtype=np.uint8)
        if len(data) != self.packet_size:
            self.counts.malformed += 1
            return []
        frame_id = int(self._layout.packets.frame_id(data))
        scans = self._restart_if_new_session(data, frame_id)
        number = self._frames.number_of(frame_id)
        if number is None:
            scans += self._restart(frame_id)
            number = frame_id
        if self._closed is not None and number <= self._closed:
            self.counts.late += 1
            return scans
        if number not in self._open:
            self._open[number] = self._new_frame(number)
        self._store(self._open[number], data)
        return scans + self._close_ready(number)

    def flush(self) -> list[Scan]:
        """Close every open frame; return their scans, oldest first."""
        scans = [self._close(number) for number in sorted(self._open)]
        return [scan for scan in scans if scan is not None]

    def _restart(self, frame_id: int) -> list[Scan]:
        scans = self.flush()
        self._frames.restart(frame_id)
        self._closed = None
        self._latest = (-1, -1)
        self.counts.restarts += 1
        logger.warning("the sensor restarted its frame count; a new run of frames begins")
        return scans

    def _restart_if_new_session(self, data: NDArray[np.uint8], frame_id: int) -> list[Scan]:
        init_id = int(self._layout.packets.init_id(data))
        changed = self._init_id is not None and init_id != self._init_id
        self._init_id = init_id
        return self._restart(frame_id) if changed else []

    def _new_frame(self, number: int) -> _Frame:
        layout = self._layout
        return _Frame(
            number=number,
            fields=np.zeros((len(layout.names), layout.height, layout.width), dtype=np.uint32),
            times_ns=np.zeros(layout.width, dtype=np.int64),
            seen=np.zeros(layout.width, dtype=np.bool_),
            valid=np.zeros(layout.width, dtype=np.bool_),
            missing=int(layout.expected.sum()),
        )

    def _store(self, frame: _Frame, data: NDArray[np.uint8]) -> None:
        column, times_ns, valid, values = self._contents.read(data)
        fresh = _enter(
            column, times_ns, valid, values, frame.fields, frame.times_ns, frame.seen, frame.valid,
            self._layout.expected,
        )  # fmt: skip
        if fresh < 0:
            self.counts.malformed += fresh == _BEYOND
            self.counts.duplicate += fresh == _SEEN
            return
        frame.missing -= fresh
        place = (frame.number, int(column[0]))
        self.counts.reordered += place < self._latest
        self._latest = max(place, self._latest)

    def _close_ready(self, number: int) -> list[Scan]:
        """Close frames that are complete, or that newer packets have left behind."""
        scans = []
        for older in sorted(n for n in self._open if n < number):
            self._open[older].newer_packets += 1
        for candidate in sorted(self._open):
            frame = self._open[candidate]
            if frame.missing and frame.newer_packets <= self._config.reorder_packets:
                break
            scans.append(self._close(candidate))
        return [scan for scan in scans if scan is not None]

    def _close(self, number: int) -> Scan | None:
        frame = self._open.pop(number)
        per_packet = self._layout.info.format.columns_per_packet
        self.counts.lost += frame.missing // per_packet
        if self._closed is not None and number > self._closed + 1:
            whole = int(self._layout.expected.sum()) // per_packet
            self.counts.lost += (number - self._closed - 1) * whole
        self._closed = number
        if not (frame.valid & (frame.times_ns > 0)).any():
            self.counts.empty_scans += 1
            logger.warning("frame %d has no valid column; dropped", number)
            return None
        self.counts.scans += 1
        return self._scan(frame)

    def _utc(self, times_ns: Ints) -> Ints:
        return np.asarray(times_ns + utc_shift_ns(self._config))

    def _scan(self, frame: _Frame) -> Scan:
        times_ns, bad = complete_times(
            frame.times_ns, frame.valid, self._layout.column_ns, self._config.stamp_tolerance_ns
        )
        self.counts.bad_stamps += bad
        utc_ns = self._utc(times_ns)
        sent = np.flatnonzero(self._layout.expected)
        two = "RANGE2" in self._layout.names
        second = self._returns(frame, "RANGE2", "REFLECTIVITY2", utc_ns) if two else None
        return Scan(
            start_ns=int(utc_ns[sent[0]]),
            end_ns=int(utc_ns[sent[-1]]),
            first=self._returns(frame, "RANGE", "REFLECTIVITY", utc_ns),
            last=second,
            sky=self._sky(frame, utc_ns) if self._config.sky_range > 0 else None,
            columns=len(sent),
            lost_columns=frame.missing,
            frame_id=frame.number,
        )

    def _returns(self, frame: _Frame, range_name: str, intensity_name: str, times_ns: Ints) -> Returns:
        """Return the points of one return; ranges are in millimetres in the packet."""
        distance, intensity = self._field(frame, range_name), self._field(frame, intensity_name)
        near, far = self._config.min_range * 1e3, self._config.max_range * 1e3
        xyz, when, value, ring, column = _measured(
            distance, intensity, times_ns, near, far, self._layout.direction, self._layout.offset
        )
        return Returns(xyz, when, value, ring, column, times_ns)

    def _field(self, frame: _Frame, name: str) -> NDArray[np.uint32]:
        """Return a field (H, W), zeros where the sensor does not send it."""
        if name not in self._layout.names:
            return np.zeros((self._layout.height, self._layout.width), dtype=np.uint32)
        return frame.fields[self._layout.names.index(name)]

    def _points(self, row: Ints, column: Ints, reach_mm: Floats | float) -> Floats:
        """Return where beams (N,) are at a range [mm], (N, 3) [m]."""
        pixel = row * self._layout.width + column
        along = np.broadcast_to(reach_mm, row.shape)[:, None]
        xyz = self._layout.direction.take(pixel, axis=0)
        xyz *= along
        xyz += self._layout.offset.take(pixel, axis=0)
        return xyz

    def _sky(self, frame: _Frame, times_ns: Ints) -> Returns:
        """Return where a lattice of the beams that met nothing would be at ``sky_range``."""
        staggered = self._layout.azimuth_column
        mask = sky_mask(*_destaggered(self._field(frame, "RANGE"), frame.valid, staggered))
        row, azimuth = thinned(mask, frame.number)
        column = staggered[row, azimuth]
        xyz = self._points(row, column, self._config.sky_range * 1e3)
        nothing = np.zeros(len(row), np.float32)
        return Returns(xyz, times_ns[column], nothing, row.astype(np.uint16), column, times_ns)
