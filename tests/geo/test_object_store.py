"""Finished tasks in object storage: the same as on disk, for one process, for workers, and after a fault."""

import os
import signal
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from subiaco_geo.errors import InputError
from subiaco_geo.work.executors import LocalPool
from subiaco_geo.work.object_store import _HELD, ObjectStore, _Held, is_url
from subiaco_geo.work.store import DiskStore
from subiaco_geo.work.task_runner import TaskRunner
from subiaco_geo.work.tasks import Task


@dataclass(frozen=True)
class Values:
    """What the tasks of these tests leave."""

    values: NDArray[np.float64]


@dataclass(frozen=True)
class Params:
    """Whether the first worker that takes the task dies."""

    mark: str | None


def doubled(inputs, params):
    """Twice what the task rests on; a worker dies where there is no mark yet."""
    if params.mark is not None and not Path(params.mark).exists():
        Path(params.mark).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return Values(2.0 * inputs.of(Values, "own").values)


@pytest.fixture(autouse=True)
def nothing_held():
    """Every test starts with a process that has read nothing."""
    _HELD.pieces.clear()


def stores(web_storage):
    """Name the storages that this machine can offer."""
    yield ObjectStore(f"{web_storage.url}/a bucket/stages")
    yield ObjectStore("memory://bucket/stages")


def test_what_is_kept_in_object_storage_comes_back_the_same_and_only_when_it_is_whole(web_storage):
    pytest.importorskip("fsspec")
    arrays = {"xyz": np.random.default_rng(1).normal(size=(7, 3)), "names": np.array(["a", "b"])}
    for store in stores(web_storage):
        assert not store.has("cut/0_0-abc")
        store.save("cut/0_0-abc", arrays)
        _HELD.pieces.clear()
        assert store.has("cut/0_0-abc")
        found = store.load("cut/0_0-abc")
        assert set(found) == set(arrays)
        assert "xyz" in found
        for name, values in arrays.items():
            np.testing.assert_array_equal(found[name], values)
        with pytest.raises(InputError, match="cut/0_0-other"):
            store.load("cut/0_0-other")


def test_s3_takes_address_and_rights_from_the_environment(s3_storage):
    pytest.importorskip("s3fs", reason="s3:// needs s3fs (subiaco-geo[s3])")
    store = ObjectStore("s3://bucket/a folder/stages")
    assert not store.has("cut/0_0-abc")
    store.save("cut/0_0-abc", {"xyz": np.arange(5.0)})
    assert list(s3_storage.files) == ["/bucket/a folder/stages/cut/0_0-abc.npz"]
    _HELD.pieces.clear()
    assert store.has("cut/0_0-abc")
    np.testing.assert_array_equal(store.load("cut/0_0-abc")["xyz"], np.arange(5.0))
    with pytest.raises(InputError, match="cut/0_0-other"):
        store.load("cut/0_0-other")


def test_a_piece_is_fetched_once_by_a_process_that_reads_it_again(web_storage):
    store = ObjectStore(web_storage.url)
    store.save("cut/0_0-abc", {"xyz": np.arange(5.0)})
    for _ in range(3):
        np.testing.assert_array_equal(store.load("cut/0_0-abc")["xyz"], np.arange(5.0))
    assert [method for method, _ in web_storage.asked] == ["PUT", "GET"]


def test_the_memory_of_a_process_holds_the_pieces_read_last_and_no_more_than_its_limit():
    held = _Held(10)
    for name in ("a", "b"):
        held.add(name, bytes(4))
    assert held.get("a") == bytes(4)
    held.add("c", bytes(4))
    assert list(held.pieces) == ["a", "c"]
    held.add("large", bytes(11))
    assert list(held.pieces) == ["a", "c"]


def test_workers_over_a_web_server_leave_what_they_leave_on_disk_though_one_is_killed(tmp_path, web_storage):
    results = []
    for store, mark in (
        (DiskStore(tmp_path / "stages"), None),
        (ObjectStore(web_storage.url), str(tmp_path / "mark")),
    ):
        executor = LocalPool(2)
        runner = TaskRunner(store, executor)
        sources = {f"{k}_0": runner.put("cut", f"{k}_0", Values(np.arange(k + 3.0))) for k in range(4)}
        tasks = [Task("sum", name, doubled, {"own": key}, Params(mark)) for name, key in sources.items()]
        keys = runner.run(tasks)
        executor.close()
        results.append({name: runner.load(Values, key).values.tolist() for name, key in keys.items()})
    assert (tmp_path / "mark").exists()
    assert results[0] == results[1]


def test_a_run_that_was_stopped_finds_in_object_storage_what_it_finished(web_storage):
    runner = TaskRunner(ObjectStore(web_storage.url))
    key = runner.put("cut", "0_0", Values(np.arange(3.0)))
    tasks = [Task("sum", "0_0", doubled, {"own": key}, Params(None))]
    runner.run(tasks)
    again = TaskRunner(ObjectStore(web_storage.url))
    again.run(tasks)
    assert (len(runner.spent), again.kept, len(again.spent)) == (1, 1, 0)


def test_storage_that_cannot_be_reached_is_named_with_a_remedy():
    with pytest.raises(InputError, match=r"http://127\.0\.0\.1:9.*check address and rights"):
        ObjectStore("http://127.0.0.1:9/stages").has("cut/0_0-abc")
    with pytest.raises(InputError, match=r"file:///tmp.*give its path"):
        ObjectStore("file:///tmp").has("cut/0_0-abc")
    with pytest.raises(InputError, match="install its package"):
        ObjectStore("nothing-of-this-kind://bucket").has("cut/0_0-abc")


@pytest.mark.parametrize(
    ("place", "url"), [("s3://bucket/stages", True), ("out/stages", False), ("/data/stages", False)]
)
def test_a_place_with_a_scheme_is_a_url(place, url):
    assert is_url(place) is url
