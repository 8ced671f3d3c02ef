"""Checkpoint of a mapping run: finished recordings are kept and not read again."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from subiaco_geo.atomic import whole_file
from subiaco_geo.errors import InputError
from subiaco_geo.locks import locked
from subiaco_geo.work.source_code import source_fingerprint
from subiaco_geo.work.tasks import fingerprint
from subiaco_mapping.backend import MappingBackend, sequence_folder
from subiaco_mapping.checkpoint.sequence_files import pack, unpack
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.fusion.map_builder import FUSION_FOLDER
from subiaco_mapping.measurements import Extrinsics
from subiaco_mapping.sequences import SequenceRecord

logger = logging.getLogger(__name__)

_INDEX = "checkpoint.json"
_RECORD = "sequence.npz"
_LATER = {"crs", "graph", "fusion", "manifest", "quality", "calibration"}  # what only later stages ask


def checkpoint_folder(output: Path) -> Path:
    """Return where the run that makes ``output`` keeps its work."""
    output = output.absolute()
    return output.with_name(f".{output.name}.checkpoint")


@contextmanager
def opened(folder: Path | None, config: MappingConfig, *, resume: bool) -> Iterator[Checkpoint]:
    """Give the checkpoint of a run; one without a folder lasts as long as the run.

    One with a folder is this run's alone: InputError where another run works on it. That of a run that failed
    stays where it spares work; :func:`remove` it once the map is written.
    """
    if folder is None:
        with tempfile.TemporaryDirectory(prefix="subiaco-spool-") as work:
            yield Checkpoint(Path(work), config, resume=False)
        return
    with locked(folder):
        checkpoint = Checkpoint(folder, config, resume=resume)
        try:
            yield checkpoint
        except BaseException as error:
            if checkpoint.finished == 0 or isinstance(error, InputError):  # the same would fail again
                remove(folder)
            else:
                logger.warning(
                    "%d recordings are finished; the same command goes on from there", checkpoint.finished
                )
            raise


def remove(folder: Path) -> None:
    """Remove a checkpoint, if it is there."""
    shutil.rmtree(folder, ignore_errors=True)


def _size(folder: Path) -> int:
    """Return the bytes of all files under a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def reading_hash(config: MappingConfig) -> str:
    """Hash the settings that reading a recording rests on; where others change, none is read again."""
    settings = config.model_dump(mode="json", exclude=_LATER)
    settings["fusion"] = config.fusion.model_dump(mode="json", include={"full_density"})
    return fingerprint(settings)


class Checkpoint:
    """What is done of one run.

    Parameters
    ----------
    folder : Path
        Of this run alone.
    config : MappingConfig
    resume : bool
        Continue with finished work if program and settings for reading are unchanged; else start over.
    """

    def __init__(self, folder: Path, config: MappingConfig, *, resume: bool) -> None:
        self.folder, self._config = folder, config
        run = {"config": reading_hash(config), "program": source_fingerprint(__name__)}
        found = self._read() if resume else {}
        if found and found.get("run") != run:
            logger.warning("%s: begun by another configuration or version; mapping from the start", folder)
        elif found.get("sequences"):
            logger.warning(
                "%d finished recordings of a run that was stopped are used", len(found["sequences"])
            )
        if found.get("run") != run:
            shutil.rmtree(folder, ignore_errors=True)
            found = {}
        self._state: dict[str, Any] = {"run": run, "sequences": found.get("sequences", {})}
        folder.mkdir(parents=True, exist_ok=True)
        self._write()

    def _read(self) -> dict[str, Any]:
        try:
            return dict(json.loads((self.folder / _INDEX).read_text(encoding="utf-8")))
        except (OSError, ValueError, TypeError):
            return {}

    def _write(self) -> None:
        with whole_file(self.folder / _INDEX) as temporary:
            temporary.write_text(json.dumps(self._state), encoding="utf-8")

    def record_of(self, number: int, name: str, bag_hash: str) -> SequenceRecord | None:
        """Return what the bag of that number, name and content brought, None where that is not known."""
        noted = self._state["sequences"].get(str(number), {})
        path = self._place(number) / _RECORD
        if noted.get("bag") != [name, bag_hash] or not path.is_file():
            return None
        packed = path.read_bytes()
        for leftover in path.parent.rglob(f"{FUSION_FOLDER}*"):  # of a run killed while it fused
            shutil.rmtree(leftover, ignore_errors=True)
        try:
            if hashlib.sha256(packed).hexdigest() != noted["record"]:
                raise InputError("its hash is not the one noted")
            if _size(path.parent) != noted["bytes"]:
                raise InputError("its scans are not whole, as after a power cut")
            return unpack(packed, path.parent, self._config)
        except (InputError, KeyError) as error:
            logger.warning("%s: damaged (%s); the recording is read again", path, error)
            return None

    def forget(self, number: int) -> None:
        """Remove what an unfinished sequence left."""
        shutil.rmtree(self._place(number), ignore_errors=True)

    def keep(self, number: int, name: str, bag_hash: str, packed: bytes) -> None:
        """Note a finished sequence (see :func:`pack`), whose scans are on disk."""
        with whole_file(self._place(number) / _RECORD) as temporary, temporary.open("wb") as stream:
            stream.write(packed)
            stream.flush()
            os.fsync(stream.fileno())
        digest = hashlib.sha256(packed).hexdigest()
        noted = {"bag": [name, bag_hash], "record": digest, "bytes": _size(self._place(number))}
        self._state["sequences"][str(number)] = noted
        self._write()

    @property
    def finished(self) -> int:
        """Sequences that need not be read again."""
        return len(self._state["sequences"])

    def _place(self, number: int) -> Path:
        return sequence_folder(self.folder, number)


class CheckpointedBackend(MappingBackend):
    """A back end that keeps its finished sequences in a checkpoint."""

    def __init__(self, config: MappingConfig, checkpoint: Checkpoint) -> None:
        super().__init__(config, Extrinsics(), checkpoint.folder)
        self._checkpoint = checkpoint

    def restore(self, name: str, bag_hash: str) -> bool:
        """Take the next sequence from the checkpoint; False where it must be read from its bag."""
        number = len(self._sequences)
        record = self._checkpoint.record_of(number, name, bag_hash)
        if record is None:
            self._checkpoint.forget(number)
            return False
        logger.info("%s: odometry taken from the checkpoint (%d scans)", record.name, len(record.poses))
        self._sequences.append(record)
        return True

    def keep(self, bag_hash: str) -> None:
        """Note the newest sequence as finished."""
        record = self._sequences[-1]
        self._checkpoint.keep(len(self._sequences) - 1, record.name, bag_hash, pack(record))
