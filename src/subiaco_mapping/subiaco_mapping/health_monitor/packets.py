"""Headers of Ouster packets: time, revolutions and loss, without decoding ranges."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from ouster.sdk import core

from subiaco_geo.bags import packet_from_cdr
from subiaco_mapping.preprocessing.config import DecodeConfig
from subiaco_mapping.preprocessing.decode import parse_metadata, utc_shift_ns
from subiaco_mapping.recording.losses import PacketCounter, PacketHeaders

_SECOND_NS = 1_000_000_000


class LossWindow:
    """Share of what was lost within the last second."""

    def __init__(self) -> None:
        self._items: deque[tuple[int, float, float]] = deque()
        self._received = self._lost = 0.0

    def take(self, now_ns: int, received: float, lost: float) -> None:
        """Note what came and what is missing."""
        self._items.append((now_ns, received, lost))
        self._received += received
        self._lost += lost
        self._forget(now_ns)

    def _forget(self, now_ns: int) -> None:
        while self._items and self._items[0][0] < now_ns - _SECOND_NS:
            _, received, lost = self._items.popleft()
            self._received -= received
            self._lost -= lost

    def share(self, now_ns: int) -> float:
        """Return lost / sent, 0 where nothing was sent."""
        self._forget(now_ns)
        sent = self._lost + self._received
        return max(self._lost, 0.0) / sent if sent > 0 else 0.0


@dataclass(frozen=True)
class PacketNote:
    """What the header of one packet says: time (0 where it has none) [ns], packets lost, a new turn."""

    stamp_ns: int
    lost: int
    new_turn: bool


class PacketWatch:
    """Follow the packets of one sensor.

    Parameters
    ----------
    metadata : str
        Sensor JSON.
    config : DecodeConfig
        For the clock that the sensor counts.
    before : PacketHeaders, optional
        Of packets that came before the metadata.
    """

    def __init__(self, metadata: str, config: DecodeConfig, before: PacketHeaders | None = None) -> None:
        info = parse_metadata(metadata)
        self._format: Any = core.PacketFormat(info)
        self._shift_ns = utc_shift_ns(config)
        self._turn: int | None = None
        self.counter = PacketCounter(metadata)
        self.received = 0 if before is None else self.counter.take_headers(before)
        self.timestamp_mode = str(info.config.timestamp_mode or "").rpartition(".")[2]

    def take(self, raw: bytes | memoryview) -> PacketNote | None:
        """Look at one serialised packet message; None where it is none of this sensor's."""
        counts = self.counter.counts
        malformed, before = counts.malformed, counts.lost_at_sensor
        self.counter.take(raw)
        if counts.malformed > malformed:
            return None
        self.received += 1
        data = np.frombuffer(packet_from_cdr(raw), dtype=np.uint8)
        stamp_ns = int(self._format.packet_header(core.ColHeader.TIMESTAMP, data)[-1])
        turn = int(self._format.frame_id(data))
        new_turn, self._turn = turn != self._turn, turn
        lost = counts.lost_at_sensor - before
        return PacketNote(stamp_ns + self._shift_ns if stamp_ns > 0 else 0, lost, new_turn)

    @property
    def lost(self) -> int:
        """Packets that never arrived."""
        return self.counter.counts.lost_at_sensor

    def facts(self) -> dict[str, int]:
        """Return the counts in the words of the manifest."""
        counts = self.counter.counts
        return {
            "packets": self.received,
            "lost": counts.lost_at_sensor,
            "late": counts.late,
            "duplicate": counts.duplicate,
            "malformed": counts.malformed,
        }
