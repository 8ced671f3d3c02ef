"""Chunks of mcap files unfolded within bounds: what a file says of them is not believed."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from pathlib import Path

from backports import zstd
from lz4.frame import LZ4FrameDecompressor
from rosbags.rosbag2 import storage_mcap

from subiaco_geo.errors import InputError

#: No recorder writes a larger chunk: the largest message alone decides.
MOST_CHUNK = 1 << 28
#: A file may unfold to so many times its size, small ones to so many bytes.
MOST_FOLD, SMALL = 100, 1 << 26


def most_unfolded(file_bytes: int) -> int:
    """Return how many bytes a file of some size may unfold to: surveys unfold two- to tenfold."""
    return max(SMALL, MOST_FOLD * file_bytes)


def unfold(compression: str, data: bytes, size: int) -> bytes:
    """Return the contents of a chunk, never taking memory for more than it says.

    Raises
    ------
    ValueError
        It says too much, or holds something else than it says.
    """
    if size > MOST_CHUNK:
        raise ValueError(f"a chunk of {size} bytes: larger than any recorder writes")
    found = _UNFOLDERS[compression](data, size)
    if len(found) != size:
        raise ValueError(f"a chunk that holds something else than the {size} bytes that it says")
    return found


def _unfold_zstd(data: bytes, size: int) -> bytes:
    parts, left = [], size + 1
    while data and left > 0:
        frame = zstd.ZstdDecompressor()
        parts.append(frame.decompress(data, max_length=left))
        left -= len(parts[-1])
        data = frame.unused_data
    return b"".join(parts)


def _unfold_lz4(data: bytes, size: int) -> bytes:
    return bytes(LZ4FrameDecompressor().decompress(data, max_length=size + 1))


_UNFOLDERS = {"": lambda data, _size: data, "zstd": _unfold_zstd, "lz4": _unfold_lz4}


def bound_library() -> None:
    """Have the bag library unfold chunks with :func:`unfold`; its own unfolds whatever comes."""
    for name in ("zstd", "lz4"):
        storage_mcap.DECOMPRESSORS[name] = partial(unfold, name)


def require_bounded(storages: Iterable[object]) -> None:
    """Refuse mcap files that unfold to far more than any recording does.

    Raises
    ------
    InputError
        With the file's name.
    """
    for storage in storages:
        path = Path(str(getattr(storage, "path", "")))
        unfolded = sum(chunk.uncompressed_size for chunk in getattr(storage, "chunks", ()))
        if unfolded > SMALL and unfolded > most_unfolded(path.stat().st_size):
            raise InputError(
                f"{path}: would unfold to {unfolded / 1e9:.1f} GB, over {MOST_FOLD} times its size, "
                "as no recording does; get it from somebody you trust"
            )
