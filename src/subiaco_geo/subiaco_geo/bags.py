"""Survey recordings: rosbag2 folders and mcap files, read and written without ROS.

Payloads stay raw CDR bytes until somebody asks for a message, so that a bag of
packets is read at the speed of the disk.
"""

from __future__ import annotations

import logging
import shutil
import struct
from collections.abc import Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass
from os import getpid
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from rosbags.interfaces import (
    Connection,
    MessageDefinitionFormat,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.base import TypesysError
from rosbags.typesys.store import Typestore

from subiaco_geo.atomic import refuse_existing
from subiaco_geo.bag_chunks import bound_library, require_bounded
from subiaco_geo.bag_files import PARTIAL, READ_FAULTS, find_storage, hash_bag, reading, storage_files
from subiaco_geo.errors import InputError
from subiaco_geo.topics import PACKET_TYPE

__all__ = [
    "TYPESTORE", "BagMessage", "BagReader", "BagWriter", "TopicInfo", "find_storage", "hash_bag",
    "make_typestore", "packet_from_cdr", "packet_to_cdr", "require_topic", "storage_files",
]  # fmt: skip

LOGGER = logging.getLogger(__name__)

bound_library()

_CDR_LITTLE_ENDIAN = b"\x00\x01\x00\x00"


def make_typestore() -> Typestore:
    """Return a store of the types of ROS 2 Jazzy and the Ouster packet, to learn more into."""
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg("uint8[] buf", PACKET_TYPE))
    return store


#: Message types of ROS 2 Jazzy, with the raw Ouster packet.
TYPESTORE: Typestore = make_typestore()


def _qos(latched: bool) -> Qos:
    forever = QosTime(9223372036, 854775807)
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=1 if latched else 10,
        reliability=QosReliability.RELIABLE,
        durability=QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        deadline=forever,
        lifespan=forever,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=forever,
        avoid_ros_namespace_conventions=False,
    )


def packet_to_cdr(buf: bytes | memoryview) -> bytes:
    """Serialise one packet as an ``ouster_sensor_msgs/msg/PacketMsg``."""
    return b"".join((_CDR_LITTLE_ENDIAN, struct.pack("<I", len(buf)), buf))


def packet_from_cdr(raw: bytes | memoryview) -> memoryview:
    """Return the packet of a serialised ``PacketMsg`` without copying it.

    Raises
    ------
    InputError
        The bytes are not a little-endian PacketMsg, or the packet is cut.
    """
    view = memoryview(raw)
    if len(view) < 8 or bytes(view[:2]) != _CDR_LITTLE_ENDIAN[:2]:
        raise InputError("packet message: not little-endian CDR; record it again with a current driver")
    size = int(struct.unpack_from("<I", view, 4)[0])
    if len(view) < 8 + size:
        raise InputError(
            f"packet message: says {size} bytes, holds {len(view) - 8}; the recording is damaged"
        )
    return view[8 : 8 + size]


class BagWriter:
    """Write a rosbag2 folder with one mcap file; it appears only when whole.

    Parameters
    ----------
    path : Path
        The folder to make; must not exist.
    compress : bool
        Compress the mcap chunks with zstd.
    """

    def __init__(self, path: Path, *, compress: bool = True) -> None:
        self.path = Path(path)
        refuse_existing(self.path, overwrite=False, remedy="choose another place")
        self._partial = self.path.with_name(f".{self.path.name}.{getpid()}.partial")
        self._compress = compress
        self._connections: dict[tuple[str, str], Connection] = {}
        self._writer: Writer | None = None

    def __enter__(self) -> Self:
        shutil.rmtree(self._partial, ignore_errors=True)
        self._partial.mkdir(parents=True)
        inner = self._partial / self.path.name
        self._writer = Writer(inner, version=Writer.VERSION_LATEST, storage_plugin=StoragePlugin.MCAP)
        if self._compress:
            self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        self._writer.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        writer, self._writer = self._writer, None
        assert writer is not None
        try:
            writer.__exit__(kind, error, trace)
            if kind is None:
                refuse_existing(self.path, overwrite=False, remedy="choose another place")
                writer.path.rename(self.path)
        finally:
            shutil.rmtree(self._partial, ignore_errors=True)

    def _connection(self, topic: str, msg_type: str, latched: bool) -> Connection:
        known = self._connections.get((topic, msg_type))
        if known is not None:
            return known
        if self._writer is None:
            raise InputError(f"{self.path}: the bag is not open; use it in a with statement")
        if msg_type not in TYPESTORE.fielddefs:
            raise InputError(f"{topic}: unknown message type {msg_type}; use a type of ROS 2 Jazzy")
        connection = self._writer.add_connection(
            topic, msg_type, typestore=TYPESTORE, offered_qos_profiles=[_qos(latched)]
        )
        self._connections[topic, msg_type] = connection
        return connection

    def write_raw(
        self, topic: str, msg_type: str, cdr: bytes | memoryview, log_time_ns: int, *, latched: bool = False
    ) -> None:
        """Write one serialised message; ``latched`` counts at a topic's first message."""
        connection = self._connection(topic, msg_type, latched)
        assert self._writer is not None
        self._writer.write(connection, int(log_time_ns), cdr)

    def write(
        self, topic: str, msg_type: str, message: object, log_time_ns: int, *, latched: bool = False
    ) -> None:
        """Write one message object of :data:`TYPESTORE`."""
        self._connection(topic, msg_type, latched)
        cdr = TYPESTORE.serialize_cdr(message, msg_type)
        self.write_raw(topic, msg_type, cdr, log_time_ns, latched=latched)


@dataclass(frozen=True)
class TopicInfo:
    """Type and number of messages of one recorded topic."""

    msg_type: str
    count: int


@dataclass(frozen=True, slots=True)
class BagMessage:
    """One recorded message, still serialised (CDR)."""

    topic: str
    msg_type: str
    log_time_ns: int
    raw: bytes


class BagReader:
    """Read a bag in log-time order, payloads raw.

    Parameters
    ----------
    path : Path
        See :func:`find_storage`.

    Attributes
    ----------
    topics : dict of str to TopicInfo
    start_ns, end_ns : int
        Log times of the first and the last message.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self._storage = find_storage(self.path)
        self._reader: Reader | None = None
        self._own_types: Typestore | None = None
        self.topics: dict[str, TopicInfo] = {}
        self.start_ns = 0
        self.end_ns = 0

    def __enter__(self) -> Self:
        if self._storage.is_dir() and any(self._storage.glob(f"*.mcap{PARTIAL}")):
            LOGGER.warning(
                "%s: one of its files is cut or still being written, and left out; "
                "run 'subiaco recover %s'", self.path, self.path
            )  # fmt: skip
        with reading(self.path):
            self._reader = Reader(self._storage)
            self._reader.open()
        try:
            storage: Any = self._reader.storage
            require_bounded(getattr(storage, "storages", [storage]))
            if self._reader.message_count == 0:
                raise InputError(f"{self.path}: the bag is empty; record again")
            self._read_summary(self._reader)
        except BaseException:
            self._close()
            raise
        return self

    def _close(self) -> None:
        reader, self._reader = self._reader, None
        if reader is not None:
            with suppress(*READ_FAULTS):
                reader.close()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close()

    def _read_summary(self, reader: Reader) -> None:
        self.start_ns, self.end_ns = reader.start_time, reader.end_time - 1
        for connection in reader.connections:
            known = self.topics.get(connection.topic, TopicInfo(connection.msgtype, 0))
            kinds = dict.fromkeys([*known.msg_type.split(" and "), connection.msgtype])
            self.topics[connection.topic] = TopicInfo(" and ".join(kinds), known.count + connection.msgcount)

    def _opened(self) -> Reader:
        if self._reader is None:
            raise InputError(f"{self.path}: the bag is not open; use it in a with statement")
        return self._reader

    def messages(self, topics: Collection[str] | None = None) -> Iterator[BagMessage]:
        """Iterate over the messages of some topics (default all) in log-time order."""
        reader = self._opened()
        wanted = [c for c in reader.connections if topics is None or c.topic in topics]
        if not wanted:
            return
        stream = reader.messages(connections=wanted)
        while True:
            with reading(self.path):
                item = next(stream, None)
            if item is None:
                return
            connection, log_time_ns, raw = item
            yield BagMessage(connection.topic, connection.msgtype, log_time_ns, raw)

    def deserialize(self, message: BagMessage) -> Any:
        """Turn a message into an object with the attributes of its ROS type.

        Raises
        ------
        InputError
            A type that neither we nor the bag define, or a damaged payload.
        """
        store = self._types_for(message)
        try:
            return store.deserialize_cdr(message.raw, message.msg_type)
        except Exception as error:
            said = " ".join(str(error).split())[:300]
            raise InputError(
                f"{self.path}: {message.topic}: a {message.msg_type} that cannot be decoded ({said}); "
                "record again"
            ) from error

    def _types_for(self, message: BagMessage) -> Typestore:
        if message.msg_type in TYPESTORE.fielddefs:
            return TYPESTORE
        if self._own_types is None:
            self._own_types = make_typestore()
            for connection in self._opened().connections:
                self._learn(self._own_types, connection)
        if message.msg_type not in self._own_types.fielddefs:
            raise InputError(
                f"{self.path}: {message.topic}: unknown message type {message.msg_type}, "
                "and the bag has no whole definition of it; record with its message package installed"
            )
        return self._own_types

    @staticmethod
    def _learn(store: Typestore, connection: Connection) -> None:
        """Register the definition that a bag carries for one of its types."""
        known = connection.msgtype in store.fielddefs
        if known or connection.msgdef.format != MessageDefinitionFormat.MSG:
            return
        with suppress(TypesysError, *READ_FAULTS):  # a damaged definition defines nothing
            types = get_types_from_msg(connection.msgdef.data, connection.msgtype)
            store.register({name: fields for name, fields in types.items() if name not in store.fielddefs})


def require_topic(reader: BagReader, topic: str, msg_types: str | Collection[str]) -> TopicInfo:
    """Return the info of a topic that must be there, with a type that we read.

    Raises
    ------
    InputError
        The topic is missing or has another type.
    """
    info = reader.topics.get(topic)
    if info is None:
        present = ", ".join(sorted(reader.topics)) or "none"
        raise InputError(f"{reader.path}: no topic {topic} (it has {present}); record it or remap it")
    accepted = [msg_types] if isinstance(msg_types, str) else sorted(msg_types, reverse=True)
    if info.msg_type not in accepted:
        raise InputError(
            f"{reader.path}: {topic} is {info.msg_type}, expected {' or '.join(accepted)}; "
            "remap the right topic to this name"
        )
    return info
