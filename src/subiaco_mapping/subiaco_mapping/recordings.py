"""Recordings of one survey, read in parallel by worker processes."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.bag_files import sequence_name
from subiaco_geo.errors import InputError
from subiaco_geo.work.executors import make_executor, running
from subiaco_geo.work.results import unpack
from subiaco_geo.work.store import DiskStore
from subiaco_geo.work.tasks import Inputs, Task
from subiaco_mapping.backend import sequence_folder
from subiaco_mapping.checkpoint.checkpoint import Checkpoint
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.fusion.map_builder import ProgressCallback
from subiaco_mapping.measurements import DeskewedScan, Extrinsics, GnssFix, HeadingSample, OdometryPose
from subiaco_mapping.sequences import SequenceRecord, begin_sequence


@dataclass(frozen=True)
class Recording:
    """A bag, its place in the survey, and the hash of its content."""

    number: int
    bag: Path
    content: str

    @property
    def name(self) -> str:
        """Return the name of its sequence."""
        return sequence_name(self.bag)


@dataclass(frozen=True)
class ReadParams:
    """What the reading of one recording depends on; its scans go to ``folder``."""

    bag: str
    content: str
    folder: str
    config: MappingConfig


@dataclass(frozen=True)
class PackedRecord:
    """The record of a sequence, packed into bytes."""

    record: NDArray[np.uint8]


ReadFunction = Callable[[Inputs, ReadParams], PackedRecord]


def name_all(recordings: Sequence[Recording]) -> dict[str, str]:
    """Return the content hash of every recording by its name.

    Raises
    ------
    InputError
        Two have one name.
    """
    found: dict[str, str] = {}
    for recording in recordings:
        if recording.name in found:
            raise InputError(f"sequence {recording.name!r}: two bags have this name; rename one")
        found[recording.name] = recording.content
    return found


def read_beside(
    recordings: Sequence[Recording],
    checkpoint: Checkpoint,
    config: MappingConfig,
    read: ReadFunction,
    workers: int,
    report: ProgressCallback,
) -> None:
    """Read the recordings that the checkpoint lacks, each by one worker; each is noted as it ends.

    Parameters
    ----------
    recordings : sequence of Recording
    checkpoint : Checkpoint
    config : MappingConfig
    read : callable
        The task.
    workers : int
    report : callable
        Told stage and fraction.
    """
    left = [r for r in recordings if checkpoint.record_of(r.number, r.name, r.content) is None]
    if len(left) < 2:
        return
    tasks = [_task(recording, checkpoint, config, read) for recording in left]
    by_name = {task.name: (task, recording) for task, recording in zip(tasks, left, strict=True)}
    store = DiskStore(checkpoint.folder / "read")
    report("odometry", 0.0)
    with running(make_executor(min(workers, len(left)), preload=[read.__module__])) as executor:
        for done, spent in enumerate(executor.run(store, tasks), 1):
            task, recording = by_name[spent.name]
            packed = unpack(PackedRecord, store.load(task.key)).record.tobytes()
            checkpoint.keep(recording.number, recording.name, recording.content, packed)
            report("odometry", done / len(left))


def _task(
    recording: Recording, checkpoint: Checkpoint, config: MappingConfig, read: ReadFunction
) -> Task[ReadParams]:
    folder = sequence_folder(checkpoint.folder, recording.number)
    params = ReadParams(str(recording.bag), recording.content, str(folder), config)
    return Task("odometry", folder.name, read, {}, params)


class OneSequence:
    """Takes what the front end and the receiver give of one recording, into a folder.

    Parameters
    ----------
    folder : Path
        What an unfinished attempt left there is removed.
    config : MappingConfig
    """

    def __init__(self, folder: Path, config: MappingConfig) -> None:
        shutil.rmtree(folder, ignore_errors=True)
        self._folder, self._config = folder, config
        self._record: SequenceRecord | None = None

    @property
    def record(self) -> SequenceRecord:
        """What it has brought; there must be some."""
        assert self._record is not None
        return self._record

    def start_sequence(self, name: str, extrinsics: Extrinsics | None = None) -> None:
        """Begin the recording."""
        self._record = begin_sequence(name, extrinsics or Extrinsics(), self._folder, self._config)

    def add_facts(self, **facts: Any) -> None:
        """Note facts about it."""
        self.record.facts.update(facts)

    def on_odometry(self, pose: OdometryPose, scan: DeskewedScan) -> None:
        """Take one registered scan."""
        self.record.add(pose, scan)

    def on_fix(self, fix: GnssFix) -> None:
        """Take one fix."""
        self.record.add_fix(fix)

    def on_heading(self, heading: HeadingSample) -> None:
        """Take one heading."""
        self.record.add_heading(heading)
