"""One run an output at a time; what killed runs left is removed, what living ones use is not."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from subiaco_geo.atomic import whole_directory
from subiaco_geo.errors import InputError
from subiaco_geo.locks import held_directory, locked, sweep

HOLDER = """
import sys, time
from pathlib import Path
from subiaco_geo.locks import locked
with locked(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


def test_a_second_run_on_one_output_is_refused_with_the_number_of_the_first(tmp_path: Path) -> None:
    output = tmp_path / "map"
    holder = subprocess.Popen([sys.executable, "-c", HOLDER, str(output)], stdout=subprocess.PIPE, text=True)
    assert holder.stdout is not None
    assert holder.stdout.readline() == "held\n"
    with pytest.raises(InputError, match=rf"map: another run .* \(process {holder.pid}\)"), locked(output):
        pass
    holder.kill()
    holder.wait()
    with locked(output):  # the lock of a killed process is none
        pass
    assert list(tmp_path.iterdir()) == []


def test_outputs_beside_each_other_do_not_wait_for_each_other(tmp_path: Path) -> None:
    with locked(tmp_path / "a"), locked(tmp_path / "b"):
        pass


def test_folders_of_killed_runs_are_swept_and_those_of_living_ones_stay(tmp_path: Path) -> None:
    (tmp_path / ".map.partial-1" / "deep").mkdir(parents=True)
    (tmp_path / ".mapping.partial-1").mkdir()
    with held_directory(tmp_path / ".map.partial-2") as living:
        sweep(tmp_path, ".map.partial-")
        assert living.is_dir()
        assert not (tmp_path / ".map.partial-1").exists()
    assert [p.name for p in tmp_path.iterdir()] == [".mapping.partial-1"]


def test_writing_a_directory_removes_what_a_killed_run_left_of_it(tmp_path: Path) -> None:
    (tmp_path / ".out.partial-99").mkdir()
    with whole_directory(tmp_path / "out") as folder:
        (folder / "a").write_text("whole")
    assert [p.name for p in tmp_path.iterdir()] == ["out"]
