"""Import of raw packets: pcap with its JSON, OSF, ROS 1 bags, with CSV logs beside them.

Packets of pcap and ROS 1 are copied bit for bit, those of OSF built again from its scans. A packet
carries no stamp of its own, so the log time is the capture time; messages of CSV logs are merged by
their UTC stamps.
"""

from __future__ import annotations

import heapq
import logging
import struct
import tempfile
import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from ouster.sdk import core, osf, pcap
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag1 import ReaderError

from subiaco_geo.atomic import refuse_existing, refuse_foreign
from subiaco_geo.bags import TYPESTORE, BagWriter, packet_to_cdr
from subiaco_geo.errors import InputError, reason_of
from subiaco_geo.topics import IMU_PACKETS, LATCHED, LIDAR_PACKETS, MESSAGE_TYPES, METADATA, POINTS, types_of
from subiaco_mapping.importers.bag_messages import LogMessage
from subiaco_mapping.importers.isolated_reader import read_isolated
from subiaco_mapping.importers.kitti_raw import kitti_messages
from subiaco_mapping.preprocessing.decode import parse_metadata

logger = logging.getLogger(__name__)

_ROS1_TAILS = {"lidar_packets": LIDAR_PACKETS, "imu_packets": IMU_PACKETS}
#: What the reader of ROS 1 bags raises where one is damaged; sizes in it may exceed any memory.
_ROS1_FAULTS = (
    ReaderError, OSError, ValueError, LookupError, AssertionError, EOFError, MemoryError, OverflowError,
    struct.error, RuntimeError, TypeError, zlib.error,
)  # fmt: skip
#: What the libraries of the sensor raise where a file is damaged; sizes in it may exceed any memory.
_SDK_FAULTS = (RuntimeError, ValueError, MemoryError, OverflowError, LookupError)
_CLOCKS_AGREE_NS = 10**9  # of the LiDAR and of the logs
_PCAP_SUFFIXES = (".pcap", ".pcapng")
_ROS2_SUFFIXES = (".mcap", ".db3")
_LOG_OPTIONS = {".pos": "--gnss", ".csv": "--gnss or --imu"}


@dataclass(frozen=True)
class RecordedPacket:
    """One raw packet: where it goes and when it was captured."""

    topic: str
    time_ns: int
    buf: bytes


def find_metadata(recording: Path) -> Path:
    """Return the sensor JSON that belongs to a recording by its name.

    ``drive.json`` for ``drive.pcap``, else the one whose stem begins the recording's stem, else
    the only JSON beside it.

    Raises
    ------
    InputError
        None, or several that fit.
    """
    beside = sorted(recording.parent.glob("*.json"))
    same = [p for p in beside if p.stem == recording.stem]
    begins = [p for p in beside if recording.stem.startswith(p.stem)]
    found = same or begins or beside
    if len(found) != 1:
        raise InputError(f"{recording}: {len(found)} metadata JSON files fit beside it; pass --metadata FILE")
    return found[0]


def _read_text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"{path}: cannot be read as metadata JSON ({reason_of(error)}); pass --metadata FILE"
        ) from error


def _first_line(error: Exception) -> str:
    """Return the first line of an error of a library, or its kind where it says nothing."""
    return (str(error).splitlines() or [type(error).__name__])[0]


def pcap_packets(recording: Path, metadata: str) -> Iterator[RecordedPacket]:
    """Yield the LiDAR and IMU packets of a pcap, in the order of capture.

    Raises
    ------
    InputError
        Not a pcap.
    """
    info = parse_metadata(metadata)
    try:
        source = pcap.PcapPacketSource(str(recording), sensor_info=[info])
        for _, packet in source:
            topic = LIDAR_PACKETS if isinstance(packet, core.LidarPacket) else IMU_PACKETS
            if isinstance(packet, core.LidarPacket | core.ImuPacket):
                yield RecordedPacket(topic, int(packet.host_timestamp), bytes(packet.buf))
    except _SDK_FAULTS as error:
        first = _first_line(error)
        raise InputError(
            f"{recording}: not a pcap of this sensor ({first}); check file and metadata"
        ) from error


def osf_recording(recording: Path) -> Iterator[str | RecordedPacket]:
    """Yield the metadata of the first sensor of an OSF file, then its LiDAR packets.

    Raises
    ------
    InputError
        Not an OSF file, or no sensor in it.
    """
    try:
        reader = osf.Reader(str(recording))
        sensors = dict(reader.meta_store.find(osf.LidarSensor))
        streams = dict(reader.meta_store.find(osf.LidarFrameStream))
    except _SDK_FAULTS as error:
        first = _first_line(error)
        raise InputError(f"{recording}: not a whole OSF file ({first}); check it") from error
    if not sensors:
        raise InputError(f"{recording}: no LiDAR sensor in it; check the recording")
    chosen = min(sensors)
    if len(sensors) > 1:
        logger.warning("%s: %d sensors in it; the first is taken", recording, len(sensors))
    wanted = {number for number, stream in streams.items() if stream.sensor_meta_id == chosen}
    info = sensors[chosen].info
    yield info.to_json_string()
    yield from _osf_packets(recording, reader, wanted, info)


def _osf_packets(
    recording: Path, reader: osf.Reader, streams: set[int], info: core.SensorInfo
) -> Iterator[RecordedPacket]:
    """Yield the packets that the scans of some streams came in."""
    layout = core.PacketFormat(info)
    try:
        for message in reader.messages():
            frame = message.decode() if message.id in streams else None
            if not isinstance(frame, core.LidarFrame):
                continue
            packets = core.frame_to_packets(frame, layout, info.init_id, int(info.sn or 0))
            packets = [p for p in packets if isinstance(p, core.LidarPacket)]
            for packet in packets:
                captured = int(packet.host_timestamp) or int(message.ts)
                yield RecordedPacket(LIDAR_PACKETS, captured, bytes(packet.buf))
    except _SDK_FAULTS as error:
        first = _first_line(error)
        raise InputError(f"{recording}: its scans cannot be read ({first}); check it") from error


def ros1_recording(recording: Path) -> tuple[str | None, list[RecordedPacket]]:
    """Return metadata (None where it has none) and packets of a ROS 1 bag.

    Topics are known by their last name: ``.../lidar_packets``, ``.../imu_packets``,
    ``.../metadata``. Drivers before 2024 put one byte more behind a packet: it is kept out.

    Raises
    ------
    InputError
        Not a ROS 1 bag.
    """
    metadata, packets = None, []
    topics: dict[str, str] = {}
    try:
        with Ros1Reader(recording) as reader:
            topics = {connection.topic: connection.msgtype for connection in reader.connections}
            for connection, time_ns, raw in reader.messages():
                tail = connection.topic.rsplit("/", 1)[-1]
                size = int.from_bytes(raw[:4], "little")
                if tail == "metadata" and metadata is None:
                    metadata = bytes(raw[4 : 4 + size]).decode()
                elif tail in _ROS1_TAILS and connection.msgtype.endswith("/PacketMsg"):
                    packets.append(RecordedPacket(_ROS1_TAILS[tail], time_ns, bytes(raw[4 : 4 + size])))
    except _ROS1_FAULTS as error:
        said = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{recording}: not a whole ROS 1 bag ({said}); run 'rosbag reindex'") from error
    if not packets:
        raise InputError(_without_packets(recording, topics))
    return metadata, packets


def _without_packets(recording: Path, topics: dict[str, str]) -> str:
    """Say how a ROS 1 bag without packets can be mapped: its clouds, converted to a ROS 2 bag."""
    readable = types_of(POINTS)
    clouds = sorted(name for name, msg_type in topics.items() if msg_type in readable)
    if not clouds:
        present = ", ".join(sorted(topics)) or "no topic"
        return f"{recording}: no Ouster packets and no clouds in it (it has {present}); record them"
    target = recording.with_suffix("")
    return (
        f"{recording}: clouds on {', '.join(clouds)} and no Ouster packets; run 'rosbags-convert --src "
        f"{recording} --dst {target}' and map {target} with --set topics.points={clouds[0]}"
    )


def _trimmed(packets: Iterable[RecordedPacket], metadata: str) -> Iterator[RecordedPacket]:
    """Cut LiDAR and IMU packets to the size that the metadata says."""
    layout = core.PacketFormat(parse_metadata(metadata))
    sizes = {LIDAR_PACKETS: layout.lidar_packet_size, IMU_PACKETS: layout.imu_packet_size}
    for packet in packets:
        size = sizes[packet.topic]
        yield RecordedPacket(packet.topic, packet.time_ns, packet.buf[:size] if size else packet.buf)


def _write_bag(
    recording: Path,
    bag: Path,
    metadata: str | None,
    packets: Iterable[RecordedPacket | LogMessage],
    logged: Iterable[LogMessage],
) -> dict[str, int]:
    counts: dict[str, int] = {}
    spans: dict[str, tuple[int, int]] = {}
    streams: list[Iterable[RecordedPacket | LogMessage]] = [packets, logged]
    with BagWriter(bag) as writer:
        for packet in heapq.merge(*streams, key=lambda item: item.time_ns):
            if not counts and metadata is not None:
                string_type = TYPESTORE.types[MESSAGE_TYPES[METADATA]]
                writer.write(
                    METADATA,
                    MESSAGE_TYPES[METADATA],
                    string_type(data=metadata),
                    packet.time_ns,
                    latched=True,
                )
                counts[METADATA] = 1
            cdr = packet.cdr if isinstance(packet, LogMessage) else packet_to_cdr(packet.buf)
            writer.write_raw(
                packet.topic,
                MESSAGE_TYPES[packet.topic],
                cdr,
                packet.time_ns,
                latched=packet.topic in LATCHED,
            )
            counts[packet.topic] = counts.get(packet.topic, 0) + 1
            spans[packet.topic] = spans.get(packet.topic, (packet.time_ns, 0))[0], packet.time_ns
        if LIDAR_PACKETS not in counts and POINTS not in counts:
            raise InputError(
                f"{recording}: no LiDAR packet of this sensor in it; check recording and metadata"
            )
        _refuse_other_times(recording, spans)
    return counts


def _refuse_other_times(recording: Path, spans: Mapping[str, tuple[int, int]]) -> None:
    """Refuse logs whose times [ns], first and last by topic, have nothing in common with the LiDAR's."""
    lidar = LIDAR_PACKETS if LIDAR_PACKETS in spans else POINTS
    begin, end = spans[lidar]
    for topic, (first, last) in spans.items():
        if first > end + _CLOCKS_AGREE_NS or last < begin - _CLOCKS_AGREE_NS:
            raise InputError(
                f"{recording}: {lidar} lasts from {_utc(begin)} to {_utc(end)}, {topic} from {_utc(first)} "
                f"to {_utc(last)}; give the log of this drive, in UTC"
            )


def _utc(time_ns: int) -> str:
    return f"{np.datetime64(time_ns, 'ns').astype('datetime64[s]')}Z"


def import_recording(
    recording: Path,
    bag: Path,
    *,
    metadata: Path | None = None,
    logged: Iterable[LogMessage] = (),
    overwrite: bool = False,
) -> dict[str, int]:
    """Turn a recording of raw Ouster packets, or a raw folder of KITTI, into an mcap bag.

    Parameters
    ----------
    recording : Path
        ``.pcap`` (with the sensor's JSON), ``.osf``, a ROS 1 ``.bag`` of PacketMsg, or a raw folder of KITTI.
    bag : Path
        rosbag2 folder to make.
    metadata : Path, optional
        Sensor JSON; default: found beside a pcap by name, or in the ROS 1 bag.
    logged : iterable of LogMessage
        Of CSV logs (:mod:`subiaco_mapping.importers.csv_logs`), in time order.
    overwrite : bool
        Replace ``bag``.

    Returns
    -------
    dict of str to int
        Messages a topic.

    Raises
    ------
    InputError
        Missing, damaged or unknown recording; no metadata; no LiDAR packet in it.
    """
    recording, bag = Path(recording), Path(bag)
    refuse_existing(bag, overwrite)
    refuse_foreign(bag, "metadata.yaml")
    _refuse_what_is_none(recording)
    if recording.is_dir():
        return _write_in_place(recording, bag, None, kitti_messages(recording), logged)
    if recording.suffix in _PCAP_SUFFIXES:
        text = _read_text(metadata or find_metadata(recording))
        packets: Iterable[RecordedPacket] = read_isolated(recording, pcap_packets, recording, text)
    elif recording.suffix == ".osf":
        whole = read_isolated(recording, osf_recording, recording)
        text, packets = str(next(whole)), (item for item in whole if isinstance(item, RecordedPacket))
    elif recording.suffix == ".bag":
        inside, listed = ros1_recording(recording)
        if metadata is None and inside is None:
            raise InputError(f"{recording}: no metadata topic in it; pass --metadata FILE")
        text = _read_text(metadata) if metadata is not None else str(inside)
        packets = _trimmed(listed, text)
    else:
        raise InputError(
            f"{recording}: a {recording.suffix or 'nameless'} recording is not supported; give a .pcap, "
            ".osf or ROS 1 .bag of raw packets"
        )
    return _write_in_place(recording, bag, text, packets, logged)


def _refuse_what_is_none(recording: Path) -> None:
    """Refuse what is absent, what needs no import, and logs given in the place of a recording."""
    if not recording.exists():
        raise InputError(
            f"{recording}: no such recording; give a .pcap, .osf, ROS 1 .bag or a raw folder of KITTI"
        )
    if recording.suffix in _ROS2_SUFFIXES or (recording / "metadata.yaml").is_file():
        raise InputError(
            f"{recording}: a ROS 2 bag needs no import; 'subiaco inspect {recording}' says what it holds, "
            "and 'subiaco map' takes it as it is"
        )
    if recording.suffix in _LOG_OPTIONS:
        raise InputError(
            f"{recording}: a log, not a recording of a LiDAR; give the recording, and the log with "
            f"{_LOG_OPTIONS[recording.suffix]} {recording}"
        )


def _write_in_place(
    recording: Path,
    bag: Path,
    metadata: str | None,
    packets: Iterable[RecordedPacket | LogMessage],
    logged: Iterable[LogMessage],
) -> dict[str, int]:
    """Write the whole bag under its own name in a folder beside, then put it in its place."""
    bag.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".import-", dir=bag.parent) as beside:
        fresh = Path(beside) / bag.name
        counts = _write_bag(recording, fresh, metadata, packets, logged)
        if bag.exists():
            bag.rename(Path(beside) / "replaced")
        fresh.rename(bag)
    return counts
