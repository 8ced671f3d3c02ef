"""PCD files: doubles kept in every form, the LZF kernel against its plain twin, and refusals."""

from __future__ import annotations

import gzip
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from subiaco_geo.cloud_io import read_cloud
from subiaco_geo.clouds import from_world
from subiaco_geo.errors import InputError
from subiaco_geo.pcd_io import lzf_decompress

PERTH = np.array([389_000.0, 6_463_000.0, 10.0])


def assert_refused(path: Path, match: str) -> None:
    """Check that a file is refused in one line that names it."""
    with pytest.raises(InputError, match=match) as caught:
        read_cloud(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def pcd_header(
    form: str, points: int, fields: str = "x y z", size: str = "8 8 8", kind: str = "F F F"
) -> str:
    ones = " ".join("1" for _ in fields.split())
    return (
        f"# .PCD v0.7\nVERSION 0.7\nFIELDS {fields}\nSIZE {size}\nTYPE {kind}\nCOUNT {ones}\n"
        f"WIDTH {points}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA {form}\n"
    )


def lzf_literals(data: bytes) -> bytes:
    """Pack bytes as LZF runs of literals only."""
    runs = [data[i : i + 32] for i in range(0, len(data), 32)]
    return b"".join(bytes([len(run) - 1]) + run for run in runs)


@pytest.mark.parametrize("form", ["ascii", "binary", "binary_compressed"])
def test_pcd_keeps_doubles(tmp_path: Path, form: str) -> None:
    xyz = PERTH + np.random.default_rng(2).uniform(0, 50, (40, 3))
    if form == "ascii":
        body = "\n".join(" ".join(repr(float(v)) for v in row) for row in xyz).encode()
    elif form == "binary":
        body = xyz.tobytes()
    else:
        packed = lzf_literals(np.ascontiguousarray(xyz.T).tobytes())
        body = struct.pack("<II", len(packed), xyz.nbytes) + packed
    path = tmp_path / "a.pcd"
    path.write_bytes(pcd_header(form, 40).encode() + body)
    np.testing.assert_array_equal(read_cloud(path).world(), from_world(xyz).world())


def test_pcd_colours_normals_and_padding(tmp_path: Path) -> None:
    fields = "x y z rgb normal_x normal_y normal_z _"
    header = pcd_header("binary", 1, fields, "4 4 4 4 4 4 4 1", "F F F F F F F U")
    body = struct.pack("<3fI3fB", 1, 2, 3, 0x0A141E, 0, 0, 1, 9)
    path = tmp_path / "a.pcd"
    path.write_bytes(header.encode() + body)
    cloud = read_cloud(path)
    assert {k: v.tolist() for k, v in cloud.fields.items()} == {
        "red": [10], "green": [20], "blue": [30], "normals": [[0, 0, 1]],
    }  # fmt: skip


def lzf_twin(packed: bytes) -> bytes:
    """LZF in plain Python."""
    out = bytearray()
    i = 0
    while i < len(packed):
        control = packed[i]
        i += 1
        if control < 32:
            out += packed[i : i + control + 1]
            i += control + 1
            continue
        run = control >> 5
        if run == 7:
            run += packed[i]
            i += 1
        back = ((control & 31) << 8) + packed[i] + 1
        i += 1
        for _ in range(run + 2):
            out.append(out[-back])
    return bytes(out)


@st.composite
def lzf_streams(draw: st.DrawFn) -> bytes:
    """Valid streams of literals and back references, short, long and overlapping."""
    packed, size = bytearray(), 0
    for _ in range(draw(st.integers(1, 12))):
        if size == 0 or draw(st.booleans()):
            run = draw(st.binary(min_size=1, max_size=32))
            packed += bytes([len(run) - 1]) + run
            size += len(run)
            continue
        back = draw(st.integers(1, min(size, 8192))) - 1
        length = draw(st.integers(1, 262))
        if length < 7:
            packed += bytes([(length << 5) | (back >> 8), back & 255])
        else:
            packed += bytes([(7 << 5) | (back >> 8), length - 7, back & 255])
        size += length + 2
    return bytes(packed)


@given(lzf_streams())
def test_lzf_kernel_agrees_with_its_plain_twin(packed: bytes) -> None:
    expected = lzf_twin(packed)
    body = np.zeros(len(expected), np.uint8)
    assert lzf_decompress(np.frombuffer(packed, np.uint8), body) == len(expected)
    assert body.tobytes() == expected


@given(st.binary(max_size=60))
def test_lzf_kernel_never_leaves_its_buffers(packed: bytes) -> None:
    body = np.zeros(20, np.uint8)
    assert -1 <= lzf_decompress(np.frombuffer(packed, np.uint8), body) <= 20


@pytest.mark.parametrize("form", ["ascii", "binary", "binary_compressed"])
def test_a_truncated_pcd_is_refused(tmp_path: Path, form: str) -> None:
    path = tmp_path / "a.pcd"
    path.write_bytes(pcd_header(form, 40).encode() + b"1 2 3\n")
    assert_refused(path, "cut or damaged|cannot be read")


@pytest.mark.parametrize("header", ["hello\n", "FIELDS x y z\nDATA ascii\n", "FIELDS x\nDATA morse\n"])
def test_a_pcd_header_that_makes_no_sense_is_refused(tmp_path: Path, header: str) -> None:
    path = tmp_path / "a.pcd"
    path.write_text(header)
    assert_refused(path, "header")


def test_real_compressed_pcd_in_float32_utm_is_refused(shared_data: Path, tmp_path: Path) -> None:
    path = tmp_path / "samp11.pcd"
    path.write_bytes(gzip.decompress((shared_data / "isprs_filter" / "samp11-utm.pcd.gz").read_bytes()))
    assert_refused(path, r"x holds projected coordinates as float32, which steps by 0\.03125 m")


def test_a_pcd_without_points_is_refused(tmp_path: Path) -> None:
    (tmp_path / "b.pcd").write_text(pcd_header("binary", 0))
    assert_refused(tmp_path / "b.pcd", "the cloud is empty")
