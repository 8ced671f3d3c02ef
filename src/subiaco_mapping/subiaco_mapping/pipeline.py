"""The mapping pipeline: bags of one epoch to one survey map, in one process."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from subiaco_geo.bag_files import sequence_name
from subiaco_geo.bags import BagMessage, BagReader, hash_bag, packet_from_cdr, require_topic
from subiaco_geo.crs_area import require_usable
from subiaco_geo.disk import free_bytes, require_room
from subiaco_geo.errors import InputError, errors_name
from subiaco_geo.simulated import mark_simulated
from subiaco_geo.survey_map import SurveyMap
from subiaco_geo.topics import (
    FIX,
    HEADING,
    IMU,
    LIDAR_PACKETS,
    LIVOX_TYPES,
    MESSAGE_TYPES,
    METADATA,
    POINTS,
    TF_STATIC,
    types_of,
)
from subiaco_geo.work.tasks import Inputs
from subiaco_mapping.checkpoint.checkpoint import CheckpointedBackend, opened
from subiaco_mapping.checkpoint.sequence_files import pack
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.fusion.full_density import FullDensity
from subiaco_mapping.fusion.map_builder import ProgressCallback, silent
from subiaco_mapping.health_monitor.files import with_watched
from subiaco_mapping.measurements import (
    DeskewedScan,
    Extrinsics,
    GnssFix,
    HeadingSample,
    OdometryPose,
    Scan,
)
from subiaco_mapping.named_bags import open_bag
from subiaco_mapping.odometry.frontend import FrontendOutput, OdometryFrontend
from subiaco_mapping.pose_graph.gnss import PlaceCheck
from subiaco_mapping.preprocessing.cloud_sky import SkyOfClouds
from subiaco_mapping.preprocessing.conversions import (
    extrinsics_from_tf,
    fix_from_msg,
    heading_from_msg,
    imu_from_msg,
    scan_from_points,
)
from subiaco_mapping.preprocessing.livox import scan_from_livox
from subiaco_mapping.recordings import (
    OneSequence,
    PackedRecord,
    ReadParams,
    Recording,
    name_all,
    read_beside,
)

logger = logging.getLogger(__name__)
_LEAST_ROOM = 100_000_000  # without which no map is begun [byte]


def lidar_topic(reader: BagReader) -> str:
    """Return the topic of a bag that holds the scans; packets win over clouds.

    Raises
    ------
    InputError
        Neither is there, one has a wrong type, or packets come without metadata.
    """
    for topic in (LIDAR_PACKETS, POINTS):
        if topic in reader.topics:
            require_topic(reader, topic, types_of(topic))
            if topic == LIDAR_PACKETS:
                require_topic(reader, METADATA, MESSAGE_TYPES[METADATA])
            return topic
    present = ", ".join(sorted(reader.topics)) or "none"
    raise InputError(
        f"{reader.path}: no LiDAR topic, {LIDAR_PACKETS} or {POINTS} (it has {present}); remap yours"
    )


def read_extrinsics(reader: BagReader, config: MappingConfig) -> Extrinsics:
    """Return the extrinsics of a bag, from ``/tf_static`` and configuration."""
    needs = [name for name, topic in (("imu", IMU), ("gnss", FIX)) if topic in reader.topics]
    if TF_STATIC in reader.topics:
        require_topic(reader, TF_STATIC, MESSAGE_TYPES[TF_STATIC])
    messages = [reader.deserialize(message) for message in reader.messages({TF_STATIC})]
    transforms = [item for message in messages for item in message.transforms]
    return extrinsics_from_tf(transforms, config.sensors, needs)


def read_metadata(reader: BagReader) -> str | None:
    """Return the sensor metadata of a bag, None where it has none."""
    first = next(reader.messages({METADATA}), None) if METADATA in reader.topics else None
    return None if first is None else str(reader.deserialize(first).data)


def read_cloud(
    reader: BagReader, message: BagMessage, config: MappingConfig, sky: SkyOfClouds | None = None
) -> Scan:
    """Return the scan of a recorded cloud: a PointCloud2, or a ``CustomMsg`` of Livox."""
    if message.msg_type in LIVOX_TYPES:
        return scan_from_livox(message.raw, config)
    return scan_from_points(reader.deserialize(message), config, sky)


class SequenceSink(Protocol):
    """What takes the registered scans and fixes of a bag: the back end, or who looks at odometry alone."""

    def start_sequence(self, name: str, extrinsics: Extrinsics | None = None) -> None:
        """Begin a recording."""

    def add_facts(self, **facts: Any) -> None:
        """Note facts about it."""

    def on_odometry(self, pose: OdometryPose, scan: DeskewedScan) -> None:
        """Take one registered scan."""

    def on_fix(self, fix: GnssFix) -> None:
        """Take one fix."""

    def on_heading(self, heading: HeadingSample) -> None:
        """Take one heading."""


def run_sequence(
    reader: BagReader,
    backend: SequenceSink,
    config: MappingConfig,
    progress: ProgressCallback,
    place: PlaceCheck | None = None,
) -> None:
    """Feed one bag through the front end into the back end; ``place`` refuses a CRS made for elsewhere."""
    lidar = lidar_topic(reader)
    for topic in (IMU, FIX, HEADING):
        if topic in reader.topics:
            require_topic(reader, topic, MESSAGE_TYPES[topic])
    with errors_name(reader.path):
        extrinsics = read_extrinsics(reader, config)
        metadata = read_metadata(reader) if lidar == LIDAR_PACKETS else None
        frontend = OdometryFrontend(config, extrinsics, metadata)
    name = sequence_name(reader.path)
    backend.start_sequence(name, extrinsics)

    scans, sky = 0, SkyOfClouds()

    def feed(outputs: list[FrontendOutput]) -> None:
        nonlocal scans
        scans += len(outputs)
        for output in outputs:
            backend.on_odometry(output.pose, output.scan)

    def take(fix: GnssFix) -> None:
        if place is not None:
            place.take(fix)
        backend.on_fix(fix)

    steps: dict[str, Callable[..., None]] = {
        LIDAR_PACKETS: lambda m: feed(frontend.on_packet(packet_from_cdr(m.raw))),
        POINTS: lambda m: feed(frontend.on_points(read_cloud(reader, m, config, sky))),
        IMU: lambda m: feed(frontend.on_imu(imu_from_msg(reader.deserialize(m)))),
        FIX: lambda m: take(fix_from_msg(reader.deserialize(m), config.gnss)),
        HEADING: lambda m: backend.on_heading(heading_from_msg(reader.deserialize(m))),
    }
    span_ns = max(reader.end_ns - reader.start_ns, 1)
    shown = -1
    for message in reader.messages({lidar, IMU, FIX, HEADING}):
        steps[message.topic](message)
        percent = 100 * (message.log_time_ns - reader.start_ns) // span_ns
        if percent > shown:
            shown = percent
            progress(f"odometry {name}", percent / 100)
    feed(frontend.finish())
    if scans == 0:
        raise InputError(
            f"{reader.path}: no scan with points came out of {lidar}; check the sensor's recording, "
            "its metadata and decode.min_range, decode.max_range"
        )
    backend.add_facts(**frontend.facts())


def read_recording(_: Inputs, params: ReadParams) -> PackedRecord:
    """Read one recording as a task: its scans go to the folder, all else is returned."""
    config = params.config
    sink = OneSequence(Path(params.folder), config)
    with open_bag(Path(params.bag), config.topics) as reader:
        run_sequence(reader, sink, config, silent, PlaceCheck(config.crs))
    return PackedRecord(np.frombuffer(pack(sink.record), dtype=np.uint8))


def require_room_for(bags: Sequence[Path], output: Path) -> None:
    """Refuse an output on a disk without room for the map, and warn where scans may find no room.

    Parameters
    ----------
    bags : sequence of Path
    output : Path
        Map directory; the deskewed scans lie beside it while the run lasts.

    Raises
    ------
    InputError
        The disk has less than a twentieth of the bags' size, or less than 100 MB.
    """
    size = sum(file.stat().st_size for bag in bags for file in _files_of(bag))
    require_room(output, max(size // 20, _LEAST_ROOM), "the map")
    free = free_bytes(output)
    if free < size:
        logger.warning(
            "%s: the disk has %.1f GB left and the bags hold %.1f GB; points of later scans may find no room",
            output, free / 1e9, size / 1e9,
        )  # fmt: skip


def _files_of(bag: Path) -> list[Path]:
    return [file for file in bag.rglob("*") if file.is_file()] if bag.is_dir() else [bag] * bag.is_file()


def map_survey(
    bags: Sequence[Path],
    config: MappingConfig,
    progress: ProgressCallback | None = None,
    *,
    checkpoint: Path | None = None,
    resume: bool = False,
    workers: int = 1,
    density: FullDensity | None = None,
) -> SurveyMap:
    """Map the bags of one epoch, each a sequence.

    Parameters
    ----------
    bags : sequence of Path
        rosbag2 folders, mcap files or simulated epoch folders.
    config : MappingConfig
    progress : callable, optional
        Told stage and fraction.
    checkpoint : Path, optional
        Folder for the checkpoint of this run (:mod:`subiaco_mapping.checkpoint.checkpoint`); it stays
        there, so that a run that is killed can go on. Without one, work goes to a temporary folder.
    resume : bool
        Go on with what the checkpoint holds; recordings that are done are not read again.
    workers : int
        Number of processes that read recordings in parallel; does not change the map.
    density : FullDensity, optional
        Where every return is written too, with ``fusion.full_density``.

    Returns
    -------
    SurveyMap

    Raises
    ------
    InputError
        Bad input: see :mod:`subiaco_geo.bags`, :func:`lidar_topic`, :func:`read_extrinsics`.
    """
    if not bags:
        raise InputError("no bag given; name at least one rosbag2 folder, .mcap or simulated epoch folder")
    require_usable(config.crs)
    report = progress or silent
    with opened(checkpoint, config, resume=resume) as work:
        backend = CheckpointedBackend(config, work)
        recordings = [Recording(k, bag, hash_bag(bag)) for k, bag in enumerate(map(Path, bags))]
        inputs = name_all(recordings)
        if workers > 1:
            read_beside(recordings, work, config, read_recording, workers, report)
        for bag, (name, content) in zip(map(Path, bags), inputs.items(), strict=True):
            if not backend.restore(name, content):
                with open_bag(bag, config.topics) as reader:
                    run_sequence(reader, backend, config, report, PlaceCheck(config.crs))
                backend.keep(content)
        survey = mark_simulated(backend.build_map(report, inputs, density), [Path(bag) for bag in bags])
        return backend.with_quality(with_watched(survey, bags), report)
