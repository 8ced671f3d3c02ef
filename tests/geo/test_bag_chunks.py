"""Chunks made to unfold to far more than their file holds are refused before the memory is taken."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from pathlib import Path

import lz4.frame
import pytest
from backports import zstd
from mcap.writer import CompressionType
from mcap.writer import Writer as RawMcapWriter

from subiaco_geo import bag_chunks
from subiaco_geo.bag_chunks import MOST_CHUNK, SMALL, unfold
from subiaco_geo.bag_recovery import recover_bag
from subiaco_geo.bags import BagReader, packet_to_cdr
from subiaco_geo.errors import InputError
from subiaco_geo.topics import LIDAR_PACKETS, PACKET_TYPE

MB = 1 << 20
PACKERS: dict[str, Callable[[bytes], bytes]] = {"zstd": zstd.compress, "lz4": lz4.frame.compress}


def streamed(data: bytes) -> bytes:
    """Return a zstd frame that does not state its size, as streaming writers make them."""
    packer = zstd.ZstdCompressor()
    return packer.compress(data[:1]) + packer.compress(data[1:]) + packer.flush()


def peak(work: Callable[[], object]) -> int:
    """Return the most memory that work held at a time [bytes]; what it raises is let pass."""
    tracemalloc.start()
    try:
        with pytest.raises((ValueError, InputError)):
            work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def bag(path: Path, chunks: int, chunk_bytes: int) -> Path:
    """Write messages of zeros, one a chunk, all at the same time."""
    with path.open("wb") as stream:
        writer = RawMcapWriter(stream, chunk_size=chunk_bytes // 2, compression=CompressionType.ZSTD)
        writer.start(profile="ros2", library="test")
        schema = writer.register_schema(PACKET_TYPE, "ros2msg", b"uint8[] buf")
        channel = writer.register_channel(LIDAR_PACKETS, "cdr", schema)
        for _ in range(chunks):
            writer.add_message(channel, 1, packet_to_cdr(bytes(chunk_bytes)), 1)
        writer.finish()
    return path


@pytest.mark.parametrize("pack", [zstd.compress, streamed, lambda d: zstd.compress(d[:7]) + streamed(d[7:])])
def test_a_chunk_comes_back_whole_whether_or_not_its_frame_states_the_size(
    pack: Callable[[bytes], bytes],
) -> None:
    data = b"street" * 1000
    assert unfold("zstd", pack(data), len(data)) == data
    assert unfold("lz4", lz4.frame.compress(data), len(data)) == data


@pytest.mark.parametrize("said", [0, 16 * MB + 1])
@pytest.mark.parametrize("kind", ["zstd", "lz4", "streamed"])
def test_a_chunk_that_holds_more_or_less_than_it_says_is_refused_for_the_memory_that_it_says(
    kind: str, said: int
) -> None:
    packed = streamed(bytes(16 * MB)) if kind == "streamed" else PACKERS[kind](bytes(16 * MB))
    assert peak(lambda: unfold("lz4" if kind == "lz4" else "zstd", packed, said)) < 2 * said + 4 * MB


def test_a_chunk_larger_than_any_recorder_writes_is_refused() -> None:
    with pytest.raises(ValueError, match="larger than any recorder writes"):
        unfold("zstd", zstd.compress(b"x"), MOST_CHUNK + 1)


def test_a_file_that_unfolds_to_a_hundred_times_its_size_is_refused_in_one_line(tmp_path: Path) -> None:
    bomb = bag(tmp_path / "bomb.mcap", 20, 4 * MB)
    assert bomb.stat().st_size < SMALL / 100
    with pytest.raises(InputError, match=r"bomb\.mcap: would unfold to 0\.1 GB.*trust"), BagReader(bomb):
        pass


def test_a_small_file_of_zeros_is_read(tmp_path: Path) -> None:
    with BagReader(bag(tmp_path / "black.mcap", 3, 4 * MB)) as reader:
        assert sum(len(message.raw) for message in reader.messages()) > 12 * MB


def test_recovery_leaves_out_what_goes_beyond_the_bounds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bag_chunks, "SMALL", 10 * MB)
    cut = bag(tmp_path / "bomb.mcap", 20, 4 * MB)
    cut.write_bytes(cut.read_bytes()[:-20])
    result = recover_bag(cut)
    (file,) = result.files
    assert file.messages == 2
    assert file.damaged_chunks == 18
