"""Walk over the records of an mcap file that may be cut or damaged, as far as they can be read."""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from io import BytesIO
from typing import BinaryIO

from backports import zstd
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, Message, MessageIndex, Schema
from mcap.stream_reader import breakup_chunk
from mcap.summary import Summary

from subiaco_geo.bag_chunks import most_unfolded, unfold
from subiaco_geo.bag_files import MCAP_MAGIC

_RECORD_HEAD = struct.Struct("<BQ")
#: No recorder writes a larger record; a larger number is damage.
_MAX_RECORD = 1 << 30
_DAMAGE = (
    McapError, ValueError, KeyError, TypeError, AssertionError, EOFError, struct.error, zlib.error,
    zstd.ZstdError, RuntimeError, MemoryError, OverflowError, UnicodeDecodeError,
)  # fmt: skip


class RecordWalk:
    """Walk over the records of an mcap file up to the first that is not whole.

    Attributes
    ----------
    good_end : int
        Where the last whole record ends [bytes].
    ended : bool
        The file's own end was reached.
    damaged_chunks, damaged_bytes, unnamed : int
        Records left out, their size, and messages of a topic whose description was lost with one.
    promised : dict of str to int, optional
        Messages that the file held by topic, as its summary says; None where it has none.
    indexed : Counter of int
        Messages by channel that the indexes behind damaged chunks name.
    """

    def __init__(self, stream: BinaryIO, size: int) -> None:
        self._stream = stream
        self._size = size
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.good_end = len(MCAP_MAGIC)
        self.ended = False
        self.damaged_chunks = 0
        self.damaged_bytes = 0
        self.unnamed = 0
        self.promised: dict[str, int] | None = None
        self.indexed: Counter[int] = Counter()
        self._behind_damage = False
        self._room = most_unfolded(size)

    def messages(self) -> Iterator[tuple[Channel, Message]]:
        """Yield what can be read."""
        self._stream.seek(self.good_end)
        while not self.ended:
            record = self._next_record()
            if record is None:
                return
            opcode, body = record
            if opcode == Opcode.FOOTER:
                self.ended = self._stream.read(len(MCAP_MAGIC)) == MCAP_MAGIC
                return
            yield from self._unpack(opcode, body)

    def _next_record(self) -> tuple[int, bytes] | None:
        """Return the next whole record, None at a cut."""
        head = self._stream.read(_RECORD_HEAD.size)
        if len(head) < _RECORD_HEAD.size:
            return None
        opcode, length = _RECORD_HEAD.unpack(head)
        end = self.good_end + _RECORD_HEAD.size + length
        if opcode == 0 or length > _MAX_RECORD or end > self._size:
            return None
        body = self._stream.read(length)
        self.good_end = end
        return opcode, body

    def _unpack(self, opcode: int, body: bytes) -> Iterator[tuple[Channel, Message]]:
        try:
            records = list(self._contents(opcode, body))
        except _DAMAGE:
            self.damaged_chunks += 1
            self.damaged_bytes += len(body) + _RECORD_HEAD.size
            self._behind_damage = opcode == Opcode.CHUNK
            return
        if opcode == Opcode.CHUNK:
            self._behind_damage = False
        for record in records:
            if isinstance(record, Schema):
                self.schemas[record.id] = record
            elif isinstance(record, Channel):
                self.channels[record.id] = record
            elif record.channel_id in self.channels:
                yield self.channels[record.channel_id], record
            else:
                self.unnamed += 1

    def _contents(self, opcode: int, body: bytes) -> Iterator[Schema | Channel | Message]:
        """Yield schemas, channels and messages in one record; raise where it is damaged."""
        stream = ReadDataStream(BytesIO(body))
        if opcode == Opcode.CHUNK:
            for record in breakup_chunk(self._unfolded(Chunk.read(stream)), validate_crc=True):
                if isinstance(record, (Schema, Channel, Message)):
                    yield record
        elif opcode == Opcode.SCHEMA:
            yield Schema.read(stream)
        elif opcode == Opcode.CHANNEL:
            yield Channel.read(stream)
        elif opcode == Opcode.MESSAGE:
            yield Message.read(stream, len(body))
        elif opcode == Opcode.MESSAGE_INDEX and self._behind_damage:
            index = MessageIndex.read(stream)
            self.indexed[index.channel_id] += len(index.records)

    def _unfolded(self, chunk: Chunk) -> Chunk:
        """Unfold a chunk, as long as the file as a whole stays within bounds."""
        if chunk.uncompressed_size > self._room:
            raise ValueError("the file unfolds to far more than any recording does")
        data = unfold(chunk.compression, chunk.data, chunk.uncompressed_size)
        self._room -= len(data)
        return replace(chunk, compression="", data=data)

    def learn_summary(self) -> None:
        """Take the topics from the summary, where there is one: a damaged chunk may have held them."""
        try:
            summary = make_reader(self._stream).get_summary()
        except (*_DAMAGE, OSError):
            return
        if summary is not None:
            self.schemas.update(summary.schemas)
            self.channels.update(summary.channels)
            self._learn_counts(summary)

    def _learn_counts(self, summary: Summary) -> None:
        if summary.statistics is None:
            return
        counts: Counter[str] = Counter()
        for number, count in summary.statistics.channel_message_counts.items():
            if number in self.channels:
                counts[self.channels[number].topic] += count
        self.promised = dict(counts)

    def lost(self, kept: Mapping[str, int]) -> dict[str, int] | None:
        """Return the messages that are lost by topic; None where the file does not tell how many it held."""
        if self.promised is not None:
            return {t: n - kept.get(t, 0) for t, n in self.promised.items() if n > kept.get(t, 0)}
        if not self.ended or sum(self.indexed.values()) == 0 < self.damaged_chunks:
            return None
        counts: Counter[str] = Counter()
        for number, count in self.indexed.items():
            counts[self.channels[number].topic if number in self.channels else f"channel {number}"] += count
        return dict(counts)
