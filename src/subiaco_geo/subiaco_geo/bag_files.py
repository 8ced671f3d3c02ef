"""Which files a bag is made of, and what to say when they are damaged."""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from backports import zstd
from rosbags.rosbag2 import ReaderError

from subiaco_geo.errors import InputError

MCAP_MAGIC = b"\x89MCAP0\r\n"
#: Suffix of the name of a file that is being written, or was cut.
PARTIAL = ".partial"
_STORAGE_SUFFIXES = (".mcap", ".db3")
_RECORDINGS = {".bag": "a ROS 1 bag", ".pcap": "a packet capture", ".pcapng": "a packet capture"}
#: What reading a damaged bag raises.
READ_FAULTS = (
    ReaderError, OSError, EOFError, struct.error, zstd.ZstdError,
    TypeError, ValueError, LookupError, ArithmeticError, AttributeError, AssertionError, RuntimeError,
    MemoryError,
)  # fmt: skip


def _is_bag_folder(path: Path) -> bool:
    return (
        (path / "metadata.yaml").is_file() or any(path.glob("*.mcap")) or any(path.glob(f"*.mcap{PARTIAL}"))
    )


def find_storage(path: Path) -> Path:
    """Return the rosbag2 folder or storage file that a user's path means.

    Parameters
    ----------
    path : Path
        A rosbag2 folder, a folder with one mcap and no metadata.yaml, an mcap
        (or db3) file, or a simulated epoch folder, which holds ``bag/``.

    Raises
    ------
    InputError
        Nothing there, or not a bag.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: no such bag; give a rosbag2 folder, an .mcap or a simulated epoch folder")
    if path.is_dir():
        if not _is_bag_folder(path) and _is_bag_folder(path / "bag"):
            path = path / "bag"
        if (path / "metadata.yaml").is_file():
            return path
        files = sorted(path.glob("*.mcap"))
        if len(files) == 1:
            return files[0]
        if files:
            raise InputError(
                f"{path}: {len(files)} mcap files but no metadata.yaml; run 'subiaco recover {path}'"
            )
        if any(path.glob(f"*.mcap{PARTIAL}")):
            raise InputError(
                f"{path}: the recording was cut before its first file was whole; run 'subiaco recover {path}'"
            )
        raise InputError(f"{path}: not a bag (no metadata.yaml, no .mcap); give a rosbag2 folder or an .mcap")
    if path.suffix in _RECORDINGS:
        kind = _RECORDINGS[path.suffix]
        raise InputError(f"{path}: {kind}, not a bag; convert it first with 'subiaco import {path} -o BAG'")
    if path.suffix not in _STORAGE_SUFFIXES:
        raise InputError(f"{path}: not a bag; give a rosbag2 folder, an .mcap or a simulated epoch folder")
    return path


def sequence_name(path: Path) -> str:
    """Return the name of a bag's sequence: its own without ``.mcap``, or the folder's around ``bag/``."""
    path = Path(path).resolve()
    return path.parent.name if path.name == "bag" else path.name.removesuffix(".mcap")


def storage_files(path: Path) -> list[Path]:
    """Return the files that hold a bag's messages, in name order."""
    storage = find_storage(path)
    if storage.is_file():
        return [storage]
    return sorted(p for p in storage.iterdir() if p.suffix in _STORAGE_SUFFIXES)


def hash_bag(path: Path) -> str:
    """Return the SHA-256 (hex) of a bag's messages files, whatever the folder is called."""
    digest = hashlib.sha256()
    for file in storage_files(path):
        with file.open("rb") as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()


def _complaint(path: Path, error: BaseException) -> str:
    """Say what is wrong with a bag that could not be read, and what to do."""
    for file in storage_files(path):
        if file.suffix != ".mcap":
            continue
        with file.open("rb") as stream:
            head = stream.read(8)
            stream.seek(max(0, file.stat().st_size - 8))
            tail = stream.read(8)
        if head != MCAP_MAGIC:
            return f"{file}: not an mcap file (wrong first bytes); give the bag that the recorder wrote"
        if tail != MCAP_MAGIC or file.stat().st_size < 45:
            return f"{file}: the recording is cut (no end record); run 'subiaco recover {file}'"
    reason = " ".join(str(error).split()) or type(error).__name__
    return f"{path}: the bag is damaged ({reason}); run 'subiaco recover {path}', or record again"


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn what reading a damaged bag raises into one line with the remedy."""
    try:
        yield
    except InputError:
        raise
    except READ_FAULTS as error:
        raise InputError(_complaint(path, error)) from error
