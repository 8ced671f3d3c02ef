"""One file of a recording: mcap in small chunks, under a temporary name until it is whole.

A recording is a rosbag2 folder of such files, ``NAME_0000.mcap`` and so on, with the
``metadata.yaml`` that ``ros2 bag play`` reads. What is not closed yet, or was cut, is
called ``NAME_0000.mcap.partial``.
"""

from __future__ import annotations

import fcntl
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import yaml
from mcap.writer import Writer
from rosbags.interfaces import Qos
from rosbags.rosbag2.metadata import dump_qos_v9

from subiaco_geo.bag_files import PARTIAL
from subiaco_geo.errors import InputError

CHUNK_BYTES = 1 << 20
_NEVER_BY_SIZE = 1 << 62
QOS_KEY = "offered_qos_profiles"
HASH_KEY = "topic_type_hash"


@dataclass(frozen=True)
class RecordedTopic:
    """A topic as a bag describes it.

    Parameters
    ----------
    name, msg_type : str
    definition : str
        Text of the message definition, with those that it needs.
    type_hash : str
        ``RIHS01_...``; empty where unknown.
    qos : str
        Offered profiles as YAML, in the form of rosbag2; empty where unknown.
    encoding : str
        Schema encoding, ``ros2msg`` or ``ros2idl``.
    """

    name: str
    msg_type: str
    definition: str
    type_hash: str = ""
    qos: str = ""
    encoding: str = "ros2msg"

    @property
    def channel_metadata(self) -> dict[str, str]:
        """What rosbag2 keeps with an mcap channel."""
        return {QOS_KEY: self.qos, HASH_KEY: self.type_hash}


def qos_text(profiles: Sequence[Qos]) -> str:
    """Return offered profiles as rosbag2 (metadata version 9) writes them."""
    return yaml.safe_dump(dump_qos_v9(list(profiles)), sort_keys=False).strip() if profiles else ""


def segment_path(folder: Path, index: int) -> Path:
    """Return the final name of the file of a number, as rosbag2 numbers them."""
    return folder / f"{folder.absolute().name}_{index:04d}.mcap"


def natural_order(path: Path) -> list[tuple[int, str]]:
    """Return a sort key under which ``_10`` comes after ``_9``."""
    return [(int(word), "") if word.isdigit() else (-1, word) for word in re.split(r"(\d+)", path.name)]


def sync_directory(folder: Path) -> None:
    """Have the names in a folder survive a loss of power."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def sole_writer(folder: Path) -> Iterator[None]:
    """Hold a folder, so that nobody else records into it or recovers it meanwhile.

    Raises
    ------
    InputError
        Somebody does already.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(descriptor)
        raise InputError(f"{folder}: is being recorded into; stop that recording first") from error
    try:
        yield
    finally:
        os.close(descriptor)


class _Output:
    """The stream under the mcap writer: what is flushed reaches the file whole or not at all."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("xb", buffering=0)
        self._parts: list[bytes] = []
        self._size = 0
        self._on_disk = 0

    def write(self, data: bytes) -> None:
        self._parts.append(data)
        self._size += len(data)

    def tell(self) -> int:
        return self._size

    def flush(self) -> None:
        """Hand everything to the system; what a full disk took of it is taken back."""
        left = memoryview(b"".join(self._parts))
        self._parts = []
        try:
            while left:
                left = left[self._file.write(left) :]
        except OSError:
            os.ftruncate(self._file.fileno(), self._on_disk)
            raise
        self._on_disk = self._size

    def sync(self) -> None:
        os.fsync(self._file.fileno())

    def close(self) -> None:
        self._file.close()


class SegmentWriter:
    """Write one file of a recording.

    Nothing reaches the disk before :meth:`flush`, and everything given before it does:
    the caller decides how much a kill can cost.

    Parameters
    ----------
    path : Path
        Final name.
    suffix : str
        Suffix of the name until :meth:`close`.
    """

    def __init__(self, path: Path, suffix: str = PARTIAL) -> None:
        self.path = path
        self.partial = path.with_name(path.name + suffix)
        self.messages = 0
        self.pending_messages = 0
        self.pending_bytes = 0
        self._output = _Output(self.partial)
        self._writer = Writer(self._output, chunk_size=_NEVER_BY_SIZE)  # type: ignore[arg-type]
        self._writer.start(profile="ros2", library="subiaco")
        self._schemas: dict[tuple[str, str], int] = {}
        self._channels: dict[RecordedTopic, int] = {}

    @property
    def size(self) -> int:
        """Bytes on the disk so far."""
        return self._output.tell()

    def write(
        self,
        topic: RecordedTopic,
        data: bytes | memoryview,
        log_time_ns: int,
        publish_time_ns: int,
        sequence: int = 0,
    ) -> None:
        """Add one serialised message to the chunk in memory."""
        channel = self._channels.get(topic)
        if channel is None:
            channel = self._register(topic)
        self._writer.add_message(channel, log_time_ns, data, publish_time_ns, sequence)  # type: ignore[arg-type]
        self.messages += 1
        self.pending_messages += 1
        self.pending_bytes += len(data) + 31

    def _register(self, topic: RecordedTopic) -> int:
        key = (topic.msg_type, topic.definition)
        if key not in self._schemas:
            schema = (topic.msg_type, topic.encoding, topic.definition.encode())
            self._schemas[key] = self._writer.register_schema(*schema)
        channel = self._writer.register_channel(topic.name, "cdr", self._schemas[key], topic.channel_metadata)
        self._channels[topic] = channel
        return channel

    def flush(self, *, sync: bool = False) -> None:
        """Close the chunk and hand it to the system; ``sync``: wait until the disk has it."""
        self._writer.flush()  # type: ignore[no-untyped-call]
        self.pending_bytes = self.pending_messages = 0
        if sync:
            self.sync()

    def sync(self) -> None:
        """Wait until the disk has what was flushed."""
        self._output.sync()

    def close(self) -> None:
        """Finish the file and give it its name; a file without messages is removed."""
        if not self.messages:
            self.abandon()
            self.partial.unlink()
            return
        self.finish()
        self.settle()

    def finish(self) -> None:
        """Hand the rest and the file's end to the system; nothing may be written any more."""
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._output.flush()

    def settle(self) -> None:
        """Wait until the disk has a finished file, and give it its name."""
        self.sync()
        self._output.close()
        self.partial.rename(self.path)
        sync_directory(self.path.parent)

    def abandon(self) -> None:
        """Let go of a file that cannot be finished; what was flushed stays in it."""
        self._output.close()
