"""A disk that is full, or will be, ends a command with 2 and one line that names the place."""

from __future__ import annotations

import errno
import shutil
from collections import namedtuple

import numpy as np
import pytest
from small_clouds import write_street

from subiaco_mapping.preprocessing.scan_spool import Spool

Usage = namedtuple("Usage", "total used free")


@pytest.fixture
def clouds(tmp_path):
    return write_street(tmp_path / "a.ply"), write_street(tmp_path / "b.ply", seed=2)


def test_a_change_run_that_would_fill_the_disk_is_refused_once_the_points_are_known(
    refused, tmp_path, clouds, monkeypatch
):
    monkeypatch.setattr(shutil, "disk_usage", lambda _path: Usage(10**9, 0, 1_000_000))
    arguments = ["change", *clouds, "-o", tmp_path / "out", "--registration", "identity", "--workers", "1"]
    refused(arguments, "out: the run needs about", "the disk has 1 MB left", "make room")


def test_a_map_on_a_disk_without_room_is_refused_before_a_bag_is_read(refused, tmp_path, monkeypatch, survey):
    monkeypatch.setattr(shutil, "disk_usage", lambda _path: Usage(10**9, 0, 1_000_000))
    refused(["map", survey / "before", "-o", tmp_path / "map"], "map: the map needs about", "1 MB left")


def test_a_map_of_which_no_scan_found_room_on_the_disk_names_the_disk(refused, tmp_path, monkeypatch, survey):
    write = Spool._write

    def full(spool: Spool, parts: tuple[np.ndarray, ...]) -> None:
        if any(len(part) for part in parts):
            raise OSError(errno.ENOSPC, "No space left on device")
        write(spool, parts)

    monkeypatch.setattr(Spool, "_write", full)
    refused(
        ["map", survey / "before", "-o", tmp_path / "map"], "the disk was full while all", "make room on it"
    )


def test_a_disk_that_fills_during_a_run_is_no_fault_of_ours(command, tmp_path, clouds, monkeypatch):
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    options = ["--registration", "identity", "--workers", "1"]
    ran = command("change", *clouds, "-o", tmp_path / "out", *options)
    assert ran.code == 2
    assert f"subiaco: {tmp_path / 'out'}: the disk is full; make room" in ran.err
    assert "fault" not in ran.err
    assert not (tmp_path / "out").exists()


def test_a_table_that_cannot_be_read_back_is_refused_before_the_work(command, tmp_path, clouds, monkeypatch):
    from subiaco_change import job

    options = ["--registration", "identity", "--workers", "1", "-q", "--set", "leaf=0.5"]
    arguments = ["change", *clouds, "-o", tmp_path / "out", *options]
    assert command(*arguments).code == 0
    (tmp_path / "out" / "changes.csv").write_text("object_id\n1\n")
    monkeypatch.setattr(job, "detect_in_tiles", lambda *_, **__: pytest.fail("the work was begun"))
    ran = command(*arguments, "--overwrite")
    assert ran.code == 2
    assert "changes.csv: column class is missing" in ran.err
