"""Repair a cut recording, and say what is lost. The original is not touched unless asked for."""

from __future__ import annotations

import os
import shutil
from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path

from subiaco_geo.atomic import refuse_existing, whole_directory
from subiaco_geo.bag_files import MCAP_MAGIC, PARTIAL
from subiaco_geo.bag_metadata import METADATA_NAME, describe_segment, recorded_topic, write_bag_metadata
from subiaco_geo.bag_records import RecordWalk
from subiaco_geo.bag_segments import CHUNK_BYTES, SegmentWriter, natural_order, sole_writer
from subiaco_geo.errors import InputError

_RECOVERING = ".recovering"


@dataclass(frozen=True)
class FileRecovery:
    """What was kept of one file, and what is lost.

    Parameters
    ----------
    source, target : Path
        ``target`` is None where nothing could be kept.
    whole : bool
        The file had its end and every chunk was good.
    counts : dict of str to int
        Messages kept by topic.
    start_ns, end_ns : int
        Log times of the first and the last message kept.
    bytes_lost : int
        Bytes after the last good record, and of damaged chunks.
    damaged_chunks, unnamed : int
        Chunks left out; messages of a topic whose description was lost with one.
    messages_lost : dict of str to int, optional
        Messages lost by topic; None where the file does not tell how many it held.
    lost_s : float
        Time from the last message kept to the last write to the file [s]; 0 where the clocks differ.
    """

    source: Path
    target: Path | None
    whole: bool
    counts: dict[str, int] = field(default_factory=dict)
    start_ns: int = 0
    end_ns: int = 0
    bytes_lost: int = 0
    damaged_chunks: int = 0
    unnamed: int = 0
    messages_lost: dict[str, int] | None = field(default_factory=dict)
    lost_s: float = 0.0

    @property
    def messages(self) -> int:
        """Number of messages kept."""
        return sum(self.counts.values())


@dataclass(frozen=True)
class BagRecovery:
    """A recording made whole."""

    target: Path
    files: tuple[FileRecovery, ...]
    changed: bool

    @property
    def messages(self) -> int:
        """Number of messages kept in all files."""
        return sum(file.messages for file in self.files)

    @property
    def bytes_lost(self) -> int:
        """Bytes lost in all files."""
        return sum(file.bytes_lost for file in self.files)


def _require_mcap(path: Path) -> None:
    try:
        with path.open("rb") as stream:
            head = stream.read(len(MCAP_MAGIC))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    if head and not MCAP_MAGIC.startswith(head[: len(MCAP_MAGIC)]):
        raise InputError(f"{path}: not an mcap file (wrong first bytes); only mcap recordings are recovered")


def _copy(walk: RecordWalk, writer: SegmentWriter) -> tuple[Counter[str], int, int]:
    """Write every message that a walk yields; return the counts and the first and last log time."""
    counts: Counter[str] = Counter()
    first, last = 2**63 - 1, 0
    for channel, message in walk.messages():
        topic = recorded_topic(channel, walk.schemas)
        writer.write(topic, message.data, message.log_time, message.publish_time, message.sequence)
        counts[channel.topic] += 1
        first, last = min(first, message.log_time), max(last, message.log_time)
        if writer.pending_bytes >= CHUNK_BYTES:
            writer.flush()
    return counts, first if counts else 0, last


def _silence(source: Path, last_ns: int) -> float:
    """Return the time from the last message to the last write to a file, 0 where they share no clock [s]."""
    silence = source.stat().st_mtime_ns - last_ns
    return silence * 1e-9 if 0 < silence < 60 * 10**9 else 0.0


def is_whole(path: Path, *, thorough: bool = False) -> bool:
    """Tell whether an mcap file was closed; ``thorough``: and whether every chunk of it is good."""
    try:
        describe_segment(path)
    except InputError:
        return False
    if not thorough:
        return not path.name.endswith(PARTIAL)
    with path.open("rb") as stream:
        walk = RecordWalk(stream, path.stat().st_size)
        for _ in walk.messages():
            pass
    return walk.ended and not walk.damaged_chunks


def recover_file(source: Path, target: Path) -> FileRecovery:
    """Copy every message that can still be read into a new, whole mcap file.

    Parameters
    ----------
    source : Path
        A cut or damaged mcap file; it is only read.
    target : Path
        Must not exist; it appears only when whole.

    Raises
    ------
    InputError
        ``source`` is no mcap file, or ``target`` exists.
    """
    _require_mcap(source)
    refuse_existing(target, overwrite=False, remedy="choose another place")
    target.with_name(target.name + _RECOVERING).unlink(missing_ok=True)
    writer = SegmentWriter(target, _RECOVERING)
    size = source.stat().st_size
    try:
        with source.open("rb") as stream:
            walk = RecordWalk(stream, size)
            walk.learn_summary()
            counts, first, last = _copy(walk, writer)
        writer.close()
    except BaseException:
        writer.abandon()
        writer.partial.unlink(missing_ok=True)
        raise
    lost = walk.damaged_bytes + (0 if walk.ended else max(0, size - walk.good_end))
    return FileRecovery(
        source=source,
        target=target if counts else None,
        whole=walk.ended and not walk.damaged_chunks,
        counts=dict(counts),
        start_ns=first,
        end_ns=last,
        bytes_lost=lost,
        damaged_chunks=walk.damaged_chunks,
        unnamed=walk.unnamed,
        messages_lost=walk.lost(counts),
        lost_s=0.0 if walk.ended else _silence(source, last),
    )


def _final_name(path: Path) -> str:
    return path.name.removesuffix(PARTIAL)


def _link(source: Path, target: Path) -> None:
    """Give a whole file a second name, or copy it where the disk has no second names."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)


def _kept(source: Path, target: Path) -> FileRecovery:
    info = describe_segment(source)
    counts: Counter[str] = Counter()
    for topic, count in info.counts.items():
        counts[topic.name] += count
    return FileRecovery(source, target, True, dict(counts), info.start_ns, info.end_ns)


def _recover_into(sources: list[Path], folder: Path, good: Collection[Path]) -> list[FileRecovery]:
    """Recover or link every file into another folder."""
    files = []
    for source in sources:
        target = folder / _final_name(source)
        if source in good:
            _link(source, target)
            files.append(_kept(source, target))
        else:
            files.append(recover_file(source, target))
    return files


def _recover_here(sources: list[Path], good: Collection[Path]) -> list[FileRecovery]:
    """Replace every cut file by a whole one."""
    files = []
    for source in sources:
        if source in good:
            files.append(_kept(source, source))
            continue
        target = source.with_name(_final_name(source))
        fresh = target.with_name(f".{target.name}.recovered")
        fresh.unlink(missing_ok=True)
        result = recover_file(source, fresh)
        if result.target is not None:
            fresh.replace(target)
            if source != target:
                source.unlink()
        elif not result.bytes_lost:  # opened, and never written to
            source.unlink()
        files.append(FileRecovery(**{**vars(result), "target": target if result.target else None}))
    return files


def _write_metadata(folder: Path, files: list[FileRecovery]) -> None:
    whole = [folder / file.target.name for file in files if file.target is not None]
    write_bag_metadata(folder, [describe_segment(path) for path in whole])


def _recover_folder(folder: Path, output: Path | None, *, in_place: bool, thorough: bool) -> BagRecovery:
    pattern = [*folder.glob("*.mcap"), *folder.glob(f"*.mcap{PARTIAL}")]
    sources = sorted((path for path in pattern if not path.name.startswith(".")), key=natural_order)
    if not sources:
        raise InputError(f"{folder}: no mcap files to recover; give the folder that the recorder wrote")
    good = {source for source in sources if is_whole(source, thorough=thorough)}
    if len(good) == len(sources) and (folder / METADATA_NAME).is_file():
        return BagRecovery(folder, tuple(_kept(source, source) for source in sources), changed=False)
    if in_place:
        files = _recover_here(sources, good)
        _write_metadata(folder, files)
        return BagRecovery(folder, tuple(files), changed=True)
    target = output or folder.with_name(f"{folder.absolute().name}.recovered")
    with whole_directory(target) as temporary:
        files = _recover_into(sources, temporary, good)
        _write_metadata(temporary, files)
    return BagRecovery(target, tuple(_moved(file, target) for file in files), changed=True)


def _moved(file: FileRecovery, folder: Path) -> FileRecovery:
    target = None if file.target is None else folder / file.target.name
    return FileRecovery(**{**vars(file), "target": target})


def recover_bag(
    path: Path, output: Path | None = None, *, in_place: bool = False, thorough: bool = False
) -> BagRecovery:
    """Make a recording whole.

    Parameters
    ----------
    path : Path
        A recording's folder, or one mcap file (``.mcap`` or ``.mcap.partial``).
    output : Path, optional
        Where the whole recording goes; ``NAME.recovered`` or ``NAME.recovered.mcap`` beside it
        where not given. Whole files of a folder are linked, not copied.
    in_place : bool
        Replace the cut files instead, and delete them.
    thorough : bool
        Read every chunk of a folder's files, not only their ends; a file alone always is.

    Returns
    -------
    BagRecovery
        ``changed`` is false where nothing had to be done; nothing is written then.

    Raises
    ------
    InputError
        Nothing there, not mcap, or the output exists.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: no such recording; give a bag folder, a .mcap or a .mcap.partial file")
    if path.is_dir():
        folder = path / "bag" if (path / "bag").is_dir() else path
        with sole_writer(folder):
            return _recover_folder(folder, output, in_place=in_place, thorough=thorough)
    if not path.name.endswith(PARTIAL) and is_whole(path, thorough=True):
        return BagRecovery(path, (_kept(path, path),), changed=False)
    if in_place:
        file = _recover_here([path], ())[0]
        return BagRecovery(file.target or path, (file,), changed=True)
    target = output or path.with_name(f"{_final_name(path).removesuffix('.mcap')}.recovered.mcap")
    file = recover_file(path, target)
    return BagRecovery(target, (file,), changed=True)
