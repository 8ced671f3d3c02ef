"""A reader in a process of its own: its items, its errors and its death arrive here."""

from __future__ import annotations

import itertools
import signal
from pathlib import Path

import pytest

from subiaco_geo.errors import InputError
from subiaco_mapping.importers.isolated_reader import read_isolated
from subiaco_mapping.importers.packets import import_recording, osf_recording


def test_items_arrive_in_order_and_complete() -> None:
    assert list(read_isolated(Path("numbers"), itertools.repeat, 7, 1000)) == [7] * 1000


def test_the_end_of_the_process_is_an_input_error_that_names_the_file_and_the_signal() -> None:
    with pytest.raises(InputError, match=r"drive\.pcap: damaged: .*\(SIGSEGV\)"):
        list(read_isolated(Path("drive.pcap"), signal.raise_signal, signal.SIGSEGV))


def test_an_input_error_of_the_reader_arrives_as_it_was_raised(tmp_path: Path) -> None:
    (tmp_path / "a.osf").write_bytes(b"no osf")
    with pytest.raises(InputError, match=r"a\.osf: not a whole OSF file"):
        list(read_isolated(tmp_path / "a.osf", osf_recording, tmp_path / "a.osf"))


@pytest.mark.parametrize("name", ["crash_import.pcap", "crash_import.osf"])
def test_recordings_that_end_the_reader_leave_no_bag(shared_data: Path, tmp_path: Path, name: str) -> None:
    recording = shared_data / "ouster" / "negative" / name
    if not recording.is_file():
        pytest.skip(f"no {recording}")
    with pytest.raises(InputError, match="damaged"):
        import_recording(recording, tmp_path / "bag")
    assert list(tmp_path.iterdir()) == []
