"""Loss counters: between publisher and recorder, and between sensor and driver."""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from subiaco_geo.bags import packet_from_cdr
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Ints
from subiaco_geo.topics import FIX, IMU, MESSAGE_TYPES, POINTS
from subiaco_mapping.preprocessing.frame_numbers import FrameUnwrapper

_STAMP = struct.Struct("<iI")
_CDR_HEAD = 4
_REMEMBERED = 4096
_AROUND = 20  # messages on either side of a step that tell whether some are missing
_FEWEST = 5
_FIRST = 100  # messages until the rate is known
_SURE = 0.6  # share of a period by which messages are late from which one is missing
_STEP_NS = 500_000_000  # a clock that is off by more at once was set
_HEAD = 64  # bytes at the start of a packet that hold its ids, in every Ouster format
_HELD = 1 << 15  # packets of which these are kept until the metadata come; 25 s at 1,280 packets a second
#: Types of sensors with a steady rate; all begin with a header.
PERIODIC_TYPES = frozenset(MESSAGE_TYPES[topic] for topic in (IMU, FIX, POINTS))


class SequenceCounter:
    """Losses between publishers and us, from the numbers that the middleware gives to messages.

    Every publisher counts from 1; several on one topic are distinguished by continuity, and by
    ``newcomers``: publishers known to have come up of which nothing was heard yet.
    """

    def __init__(self) -> None:
        self.lost = 0
        self.before = 0
        self.newcomers = 0
        self._next: list[int] = []

    def expects(self, number: int) -> bool:
        """Whether this is the next message of a publisher heard before."""
        return number in self._next

    def take(self, number: int) -> int:
        """Note one message; return how many were lost just before it."""
        if number in self._next:
            self._next[self._next.index(number)] = number + 1
            return 0
        behind = [expected for expected in self._next if expected < number]
        if number == 1 or not behind or self.newcomers:  # a publisher not seen so far
            self.newcomers = max(0, self.newcomers - 1)
            self.before += number - 1
            self._next.append(number + 1)
            self._next = self._next[-16:]
            return 0
        expected = max(behind)
        self._next[self._next.index(expected)] = number + 1
        self.lost += number - expected
        return number - expected


class StampCounter:
    """Losses of a periodic sensor, where its header stamps fall short of its usual rate.

    A long step alone proves nothing: stamps jitter, and samples that cross a bus together have theirs in
    pairs. Messages are missing where those after the step are later, on the mean, than the rate allows. A
    clock that is set forward leaves the same gap as an outage; then stamps are ahead of the arrivals.
    """

    def __init__(self) -> None:
        self.backward = 0
        self.repeated = 0
        self.stepped = 0
        self.uneven = 0
        self._lost = 0
        self._last: int | None = None
        self._stamps: deque[int] = deque(maxlen=_AROUND + 1)
        self._closed: list[int] = []  # the same, with the gaps that were counted closed up
        self._shift = 0
        self._started = False
        self._periods: deque[float] = deque(maxlen=101)
        self._delays: deque[int] = deque(maxlen=100)

    @property
    def period_ns(self) -> int | None:
        """Usual time between messages [ns], once enough are known."""
        # below the median: windows with a gap are longer, and under many losses they are half of all
        return int(np.quantile(self._periods, 0.4)) if self._periods else None

    @property
    def lost(self) -> int:
        """Messages that are missing so far; the newest gaps as far as can be told yet."""
        closed = np.array(self._closed, dtype=np.int64)
        found = self._lost
        for at in range(len(closed) - _AROUND + 1 if self._started else 1, len(closed)):
            missing = self._missing(closed, at) or 0
            closed[at:] -= missing * (self.period_ns or 0)
            found += missing
        return found

    def take(self, stamp_ns: int, received_ns: int | None = None) -> None:
        """Note one stamp, and when its message came by the host's clock."""
        last, self._last = self._last, stamp_ns
        if last is not None and stamp_ns <= last:
            self.backward += stamp_ns < last
            self.repeated += stamp_ns == last
            if last - stamp_ns > _STEP_NS:
                self._begin()
            return
        if received_ns is not None:
            if self._delays and received_ns - stamp_ns < min(self._delays) - _STEP_NS:
                self.stepped += 1
                self._begin()
            self._delays.append(received_ns - stamp_ns)
        self._stamps.append(stamp_ns)
        if len(self._stamps) > _AROUND:
            self._periods.append((self._stamps[-1] - self._stamps[0]) / _AROUND)
        self._closed.append(stamp_ns - self._shift)
        if len(self._closed) >= (2 * _AROUND if self._started else _FIRST):
            self._judge()

    def _begin(self) -> None:
        """Forget what stood before a step of the clock, but for the rate."""
        self._lost = self.lost
        self._stamps.clear()
        self._closed.clear()
        self._delays.clear()
        self._shift, self._started = 0, False

    def _judge(self) -> None:
        """Count what is missing before the message that has enough others on both sides; drop the oldest."""
        at = len(self._closed) - _AROUND
        closed = np.array(self._closed, dtype=np.int64)
        for k in (at,) if self._started else range(1, at + 1):
            missing = self._missing(closed, k)
            if missing is not None:
                self._lost += missing
                self.uneven += missing == 0
                move = missing * (self.period_ns or 0)
                self._shift += move
                closed[k:] -= move
        self._closed, self._started = closed[1:].tolist(), True

    def _missing(self, closed: Ints, at: int) -> int | None:
        """Return how many messages are missing before one; None where the step to it is as usual."""
        period = self.period_ns
        step = int(closed[at] - closed[at - 1])
        if period is None or step < 1.5 * period:
            return None
        count = min(at, len(closed) - at, _AROUND)
        if count < _FEWEST:
            return None
        late = float(closed[at : at + count].mean() - closed[at - count : at].mean()) / period - count
        return min(max(int(late + 1.0 - _SURE), 0), round(step / period) - 1)


@dataclass
class PacketCounts:
    """Packets that are missing, and other oddities of their order.

    ``late`` ones had been counted as lost and came after all.
    """

    lost_at_sensor: int = 0
    late: int = 0
    duplicate: int = 0
    malformed: int = 0
    restarts: int = 0


class PacketCounter:
    """Losses between the LiDAR and its driver, from the frame and measurement ids of its packets.

    Parameters
    ----------
    metadata_json : str
        The sensor's metadata.
    counts : PacketCounts, optional
        Counts to go on with, where the sensor changed its mode.
    """

    def __init__(self, metadata_json: str, counts: PacketCounts | None = None) -> None:
        from ouster.sdk import core

        from subiaco_mapping.preprocessing.decode import expected_columns, parse_metadata

        info = parse_metadata(metadata_json)
        self.metadata = metadata_json
        self.counts = counts or PacketCounts()
        self._column_id = core.ColHeader.MEASUREMENT_ID
        self._format: Any = core.PacketFormat(info)
        self._frames = FrameUnwrapper(int(self._format.max_frame_id) + 1)
        self._per_packet = int(info.format.columns_per_packet)
        sent = expected_columns(info).reshape(-1, self._per_packet).any(axis=1)
        self._place: list[int] = np.where(sent, np.cumsum(sent) - 1, -1).tolist()
        self._in_frame = int(sent.sum())
        self._newest: int | None = None
        self._init_id: int | None = None
        self._missing: dict[int, None] = {}

    def take(self, raw: bytes | memoryview) -> None:
        """Note one serialised packet message."""
        try:
            data = np.frombuffer(packet_from_cdr(raw), dtype=np.uint8)
        except InputError:
            self.counts.malformed += 1
            return
        self._count(data)

    def take_headers(self, headers: PacketHeaders) -> int:
        """Note packets that came before the metadata; return how many are of this sensor."""
        self.counts.malformed += headers.malformed
        counted, data = 0, np.zeros(0, np.uint8)
        for size, head in headers:
            if len(data) != size:
                data = np.zeros(size, np.uint8)
            data[: len(head)] = np.frombuffer(head, np.uint8)
            counted += self._count(data)
        return counted

    def _count(self, data: Any) -> bool:
        """Note one packet; return whether it is of this sensor."""
        place = self._placed(data) if len(data) == self._format.lidar_packet_size else -1
        if place < 0:
            self.counts.malformed += 1
            return False
        frame_id, init_id = int(self._format.frame_id(data)), int(self._format.init_id(data))
        if self._newest is None or init_id != self._init_id:
            self._begin(frame_id, place, restarted=self._newest is not None)
        else:
            self._follow(self._newest, frame_id, place)
        self._init_id = init_id
        return True

    def _placed(self, data: Any) -> int:
        """Return which packet of its frame this is, -1 where it cannot be one."""
        index = int(self._format.packet_header(self._column_id, data)[0]) // self._per_packet
        return self._place[index] if index < len(self._place) else -1

    def _begin(self, frame_id: int, place: int, *, restarted: bool) -> None:
        self.counts.restarts += restarted
        self._newest = self._frames.restart(frame_id) * self._in_frame + place
        self._missing.clear()

    def _follow(self, newest: int, frame_id: int, place: int) -> None:
        frame = self._frames.number_of(frame_id)
        if frame is None:
            self._begin(frame_id, place, restarted=True)
            return
        number = frame * self._in_frame + place
        if number > newest:
            self._advance(newest, number)
        elif number in self._missing:
            del self._missing[number]
            self.counts.lost_at_sensor -= 1
            self.counts.late += 1
        else:
            self.counts.duplicate += 1

    def _advance(self, newest: int, number: int) -> None:
        self._newest = number
        if number == newest + 1:
            return
        self.counts.lost_at_sensor += number - newest - 1
        self._missing.update(dict.fromkeys(range(max(newest + 1, number - _REMEMBERED), number)))
        for old in list(self._missing)[:-_REMEMBERED]:
            del self._missing[old]


class PacketHeaders:
    """The headers of packets whose layout is not known yet, since the metadata have not come.

    Of the newest 32,768 packets, so that what is missing among them can still be counted.
    """

    def __init__(self) -> None:
        self.malformed = 0
        self._held: deque[tuple[int, bytes]] = deque(maxlen=_HELD)

    def __len__(self) -> int:
        return len(self._held)

    def __iter__(self) -> Iterator[tuple[int, bytes]]:
        """Yield size and first bytes of each packet."""
        return iter(self._held)

    def take(self, raw: bytes | memoryview) -> None:
        """Keep what tells the place of one serialised packet in its stream."""
        try:
            data = packet_from_cdr(raw)
        except InputError:
            self.malformed += 1
            return
        self._held.append((len(data), bytes(data[:_HEAD])))


def header_stamp_ns(raw: bytes | memoryview) -> int | None:
    """Return the header stamp of a serialised message [ns], None where the bytes are too few."""
    if len(raw) < _CDR_HEAD + _STAMP.size or raw[1] != 1:
        return None
    seconds, nanoseconds = _STAMP.unpack_from(raw, _CDR_HEAD)
    return int(seconds) * 10**9 + int(nanoseconds)


@dataclass
class TopicCounter:
    """Everything counted on one topic.

    Parameters
    ----------
    stamped : bool
        The messages begin with a header and come at a steady rate.
    headers : PacketHeaders, optional
        Of LiDAR packets, until their layout is known.
    """

    stamped: bool = False
    received: int = 0
    dropped: int = 0
    last_ns: int = 0
    transport: SequenceCounter = field(default_factory=SequenceCounter)
    stamps: StampCounter = field(default_factory=StampCounter)
    packets: PacketCounter | None = None
    headers: PacketHeaders | None = None

    def know_packets(self, metadata_json: str) -> None:
        """Count packets from now on by their ids, and those that came before the metadata.

        Raises
        ------
        InputError
            The metadata cannot be read.
        """
        if self.packets is not None and self.packets.metadata == metadata_json:
            return
        self.packets = PacketCounter(metadata_json, None if self.packets is None else self.packets.counts)
        if self.headers is not None:
            self.packets.take_headers(self.headers)
            self.headers = None

    def take(self, raw: bytes | memoryview, received_ns: int, sequence: int | None) -> None:
        """Note one message."""
        self.received += 1
        self.last_ns = received_ns
        if sequence is not None:
            self.transport.take(sequence)
        if self.stamped:
            stamp = header_stamp_ns(raw)
            if stamp is not None:
                self.stamps.take(stamp, received_ns)
        if self.packets is not None:
            self.packets.take(raw)
        elif self.headers is not None:
            self.headers.take(raw)

    @property
    def lost(self) -> int:
        """Messages known to be missing from the recording, whatever the cause."""
        sensor = self.stamps.lost if self.packets is None else self.packets.counts.lost_at_sensor
        return max(self.transport.lost, sensor) + self.dropped

    def facts(self) -> dict[str, int]:
        """Return the counts by name."""
        facts = {
            "received": self.received,
            "lost": self.lost,
            "lost_in_transport": self.transport.lost,
            "before_start": self.transport.before,
            "dropped_disk_slow": self.dropped,
        }
        if self.stamped:
            stamps = self.stamps
            facts |= {
                "lost_by_stamp": stamps.lost,
                "stamps_backward": stamps.backward,
                "stamps_repeated": stamps.repeated,
                "stamps_stepped": stamps.stepped,
                "stamps_uneven": stamps.uneven,
            }
        if self.headers is not None:
            facts["without_metadata"] = len(self.headers)
        return facts | (asdict(self.packets.counts) if self.packets is not None else {})
