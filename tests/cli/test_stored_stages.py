"""Stages of a change run: kept, taken up, done again; and who does them."""

import json

import pytest
from small_clouds import write_street

REGISTERED = ("--registration", "identity")


@pytest.fixture(scope="module")
def streets(tmp_path_factory):
    folder = tmp_path_factory.mktemp("streets")
    return write_street(folder / "before.laz", seed=1), write_street(folder / "after.laz", seed=2)


def hash_in(directory):
    return json.loads((directory / "run.json").read_text())["table_hash"]


def test_stages_are_kept_taken_up_and_done_again_with_the_same_table(command, streets, tmp_path):
    stages = tmp_path / "stages"
    first = command(
        "change", *streets, "-o", tmp_path / "a", *REGISTERED, "--keep-stages", stages, "--workers", "1"
    )
    assert first.code == 0, first.err
    pieces = {path: path.stat().st_mtime_ns for path in stages.rglob("*.npz")}
    assert {path.parent.name for path in pieces} >= {"cut", "semantics", "compare", "labels"}
    named = json.loads((stages / "stages.json").read_text())
    assert (stages / f"{next(iter(named['labels'].values()))}.npz").is_file()
    assert not (tmp_path / "a.stages").exists()
    again = command(
        "change", *streets, "-o", tmp_path / "b", *REGISTERED, "--keep-stages", stages, "--from", "compare",
        "--workers", "2",
    )  # fmt: skip
    assert again.code == 0, again.err
    assert hash_in(tmp_path / "b") == hash_in(tmp_path / "a")
    renewed = {path.parent.name for path, time in pieces.items() if path.stat().st_mtime_ns != time}
    again = {"compare", "vegetation_null", "decide", "ground", "threshold_components", "labels"}
    assert renewed == again  # the streets have no patch of ground


def test_strange_options_are_refused(refused, streets, tmp_path):
    run = ["change", *streets, "-o", tmp_path / "out", *REGISTERED]
    refused([*run, "--from", "association"], "--from association", "compare")
    refused([*run, "--workers", "0"], "--workers", "greater than or equal to 1")
    refused([*run, "--semantics", "mine"], "--semantics mine", "given")
    refused([*run, "--instances", "given"], "--semantics given")
    refused([*run, "--semantics", "given"], "before", "'semantic'")
