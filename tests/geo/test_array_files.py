"""Arrays are read as written; what a damaged or hostile file states is not believed."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import psutil
import pytest
from hypothesis import given
from hypothesis import strategies as st

from subiaco_geo.array_files import read_array_file, read_arrays
from subiaco_geo.errors import InputError
from subiaco_geo.visibility import load_visibility, visibility_parts


def archive_of(path: Path, **arrays: np.ndarray) -> None:
    np.savez_compressed(path, **arrays)


@given(
    shape=st.lists(st.integers(0, 7), max_size=3),
    kind=st.sampled_from(["u1", "i8", "f4", "f8", "?"]),
    fortran=st.booleans(),
)
def test_arrays_come_back_as_written(
    tmp_path_factory: pytest.TempPathFactory, shape: list[int], kind: str, fortran: bool
) -> None:
    folder = tmp_path_factory.mktemp("arrays")
    values = np.random.default_rng(1).integers(0, 100, shape).astype(kind)
    values = np.asfortranarray(values) if fortran else values
    np.save(folder / "a.npy", values)
    archive_of(folder / "a.npz", first=values, second=values)
    back = read_arrays(folder / "a.npz", ["second"], "a test", "write it again")
    for read in (read_array_file(folder / "a.npy", "a test", "write it again"), back["second"]):
        np.testing.assert_array_equal(read, values)
        assert read.dtype == values.dtype


def header(shape: tuple[int, ...], kind: str = "<f8") -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"shape": shape, "fortran_order": False, "descr": kind})
    return stream.getvalue()


def test_a_header_that_states_more_than_the_file_holds_is_refused_before_memory_is_taken(
    tmp_path: Path,
) -> None:
    (tmp_path / "a.npy").write_bytes(header((10**12,)) + bytes(80))
    with pytest.raises(InputError, match=r"a\.npy: not a test \(.*more than it holds\); write it again"):
        read_array_file(tmp_path / "a.npy", "a test", "write it again")


def test_an_archive_that_unfolds_to_gigabytes_is_refused(tmp_path: Path) -> None:
    count = 1 << 27  # a gigabyte of zeros in one megabyte
    path = tmp_path / "visibility.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in ("origin", "voxel"):
            archive.writestr(f"{name}.npy", header((3,) if name == "origin" else ()) + bytes(24))
        for name in ("keys", "hits", "passes"):
            with archive.open(f"{name}.npy", "w", force_zip64=True) as stream:
                stream.write(header((count,), "<i8"))
                for _ in range(64):
                    stream.write(bytes(count // 8))
    before = psutil.Process().memory_info().rss
    with pytest.raises(InputError, match="far more than the file can hold"):
        load_visibility(path)
    assert psutil.Process().memory_info().rss - before < 100 << 20


def test_an_absent_array_is_named(tmp_path: Path) -> None:
    archive_of(tmp_path / "a.npz", first=np.zeros(3))
    with pytest.raises(InputError, match=r"no array .*second"):
        read_arrays(tmp_path / "a.npz", ["second"], "a test", "write it again")


def test_a_corner_that_unfolds_without_end_is_refused(tmp_path: Path) -> None:
    archive_of(tmp_path / "v.npz", origin=np.zeros(1 << 20), voxel=np.array(0.5))
    with pytest.raises(InputError, match="origin is no corner or edge"):
        next(visibility_parts(tmp_path / "v.npz"))
