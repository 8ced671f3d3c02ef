"""Room and rights on a disk are tested before work begins; a full disk has an error of its own."""

from __future__ import annotations

import errno
import shutil
from collections import namedtuple
from pathlib import Path

import laspy
import lazrs
import numpy as np
import pytest

from subiaco_geo import disk
from subiaco_geo.atomic import refuse_existing
from subiaco_geo.errors import InputError

Usage = namedtuple("Usage", "total used free")


def test_room_is_asked_of_the_nearest_folder_that_exists(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def usage(path: Path) -> Usage:
        asked.append(path)
        return Usage(10**10, 0, 5_000_000)

    monkeypatch.setattr(shutil, "disk_usage", usage)
    disk.require_room(tmp_path / "a" / "b", 4_000_000, "the run")
    with pytest.raises(InputError, match=r"the run needs about 6 MB, and the disk has 5 MB left; make room"):
        disk.require_room(tmp_path / "a" / "b", 6_000_000, "the run")
    assert set(asked) == {tmp_path}


@pytest.mark.parametrize(
    ("number", "words"), [(errno.ENOSPC, "the disk is full"), (errno.EROFS, "may not be written to")]
)
def test_a_place_that_takes_no_file_is_refused_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, words: str
) -> None:
    def refuse(**_: object) -> None:
        raise OSError(number, "refused")

    monkeypatch.setattr(disk.tempfile, "NamedTemporaryFile", refuse)
    with pytest.raises(InputError, match=words):
        refuse_existing(tmp_path / "out", overwrite=False)
    assert not list(tmp_path.iterdir())


def test_a_place_that_takes_files_keeps_none_of_the_test(tmp_path: Path) -> None:
    refuse_existing(tmp_path / "new" / "out", overwrite=False)
    assert not list(tmp_path.iterdir())


def caused(error: Exception, cause: Exception) -> Exception:
    error.__cause__ = cause
    return error


@pytest.mark.parametrize(
    ("error", "full"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), True),
        (OSError(errno.EDQUOT, "Disk quota exceeded"), True),
        (OSError("262144 requested and 0 written"), True),
        (RuntimeError("database or disk is full"), True),
        (lazrs.LazrsError("IoError: Failed to call write"), True),
        (caused(RuntimeError("a worker ended"), OSError(errno.ENOSPC, "x")), True),
        (OSError(errno.ENOENT, "No such file"), False),
        (ValueError("the level is full of holes"), False),
    ],
)
def test_a_full_disk_is_told_from_other_errors(error: Exception, full: bool) -> None:
    assert disk.is_disk_full(error) is full


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_what_numpy_says_on_a_full_disk_is_known() -> None:
    with pytest.raises(OSError) as caught, Path("/dev/full").open("wb") as stream:  # noqa: PT011
        np.save(stream, np.zeros(1_000_000))
    assert disk.is_disk_full(caught.value)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_what_the_writer_of_laz_says_on_a_full_disk_is_known() -> None:
    header = laspy.LasHeader(version="1.4", point_format=6)
    points = laspy.ScaleAwarePointRecord.zeros(400_000, header=header)
    points.X = np.random.default_rng(1).integers(0, 2**30, 400_000)

    def write() -> None:
        with Path("/dev/full").open("wb", buffering=0) as stream:
            laspy.LasWriter(stream, header, do_compress=True, closefd=False).write_points(points)

    with pytest.raises((lazrs.LazrsError, OSError)) as caught:
        write()
    assert disk.is_disk_full(caught.value)
