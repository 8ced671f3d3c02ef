"""Work in pieces: kept by what it rests on, done once, whoever does it."""

import importlib
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from threadpoolctl import threadpool_info, threadpool_limits

from subiaco_geo.errors import InputError, SubiacoError
from subiaco_geo.work.executors import Dask, InProcess, LocalPool, make_executor, work_beside
from subiaco_geo.work.object_store import ObjectStore
from subiaco_geo.work.source_code import source_fingerprint
from subiaco_geo.work.store import DiskStore, MemoryStore
from subiaco_geo.work.task_runner import TaskRunner, stages_from
from subiaco_geo.work.tasks import Task, fingerprint

WAIT = 60.0


@dataclass(frozen=True)
class Values:
    """What the tasks of these tests leave."""

    values: NDArray[np.float64]


def add_up(inputs, params):
    """Sum of everything a task rests on, times a factor."""
    total = sum(float(inputs.of(Values, alias).values.sum()) for alias in inputs.keys)
    return Values(np.array([params["factor"] * total]))


def die_once(inputs, params):
    """Kill the worker the first time, as a machine short of memory would."""
    del inputs
    mark = Path(params["mark"])
    if not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return Values(np.array([1.0]))


def die(inputs, params):
    """Kill the worker every time."""
    del inputs, params
    os.kill(os.getpid(), signal.SIGKILL)


def fail(inputs, params):
    """Refuse, as bad input would."""
    del inputs
    raise InputError(f"tile {params['tile']}: no points")


def count_blas_threads(inputs, params):
    """Most threads of any BLAS library while the task runs."""
    del inputs, params
    threads = [lib["num_threads"] for lib in threadpool_info() if lib["user_api"] == "blas"]
    return Values(np.array([float(max(threads))]))


def tasks_of(runner, factor=2.0):
    sources = {f"{k}_0": runner.put("cut", f"{k}_0", Values(np.arange(k + 3.0))) for k in range(6)}
    return [Task("sum", name, add_up, {"own": key}, {"factor": factor}) for name, key in sources.items()]


@pytest.mark.parametrize("workers", [1, 2])
def test_a_task_takes_one_thread_of_the_linear_algebra_wherever_it_runs(tmp_path, workers):
    runner = TaskRunner(DiskStore(tmp_path / "stages"), make_executor(workers))
    with threadpool_limits(2, user_api="blas"):
        key = runner.one(Task("count", "all", count_blas_threads, {}, {}))
        after = max(lib["num_threads"] for lib in threadpool_info() if lib["user_api"] == "blas")
    runner.executor.close()
    assert runner.load(Values, key).values == [1.0]
    assert after == 2


@pytest.mark.parametrize("make", [lambda path: MemoryStore(), lambda path: DiskStore(path / "stages")])
def test_what_is_kept_comes_back_the_same(tmp_path, make):
    store = make(tmp_path)
    arrays = {
        "xyz": np.random.default_rng(1).normal(size=(5, 3)),
        "names": np.array(["a", "bc"]),
        "flag": np.array(True),
    }
    assert not store.has("cut/0_0-x")
    store.save("cut/0_0-x", arrays)
    assert store.has("cut/0_0-x")
    for name, values in arrays.items():
        assert np.array_equal(store.load("cut/0_0-x")[name], values)


def test_a_damaged_piece_is_named_with_its_file(tmp_path):
    store = DiskStore(tmp_path)
    store.save("cut/0_0-x", {"values": np.arange(1000.0)})
    path = tmp_path / "cut" / "0_0-x.npz"
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(InputError, match=r"0_0-x\.npz.*remove it"):
        store.load("cut/0_0-x")


@given(st.floats(allow_nan=False), st.text(max_size=5), st.integers())
def test_a_fingerprint_is_the_same_for_the_same_and_another_for_anything_else(number, text, count):
    value = {"number": number, "names": [text, count], "array": np.array([number, 1.0])}
    again = {"array": np.array([number, 1.0]), "names": [text, count], "number": number}
    assert fingerprint(value) == fingerprint(again)
    assert fingerprint(value) != fingerprint({**value, "names": [text, count + 1]})
    assert fingerprint(value) != fingerprint({**value, "array": np.array([number, 2.0])})


def test_what_cannot_be_told_apart_has_no_fingerprint():
    with pytest.raises(TypeError, match="object"):
        fingerprint([object()])


def test_finished_tasks_are_not_done_again_and_a_new_parameter_does_them_anew(tmp_path):
    runner = TaskRunner(DiskStore(tmp_path))
    first = runner.run(tasks_of(runner))
    assert len(runner.spent) == 6
    resumed = TaskRunner(DiskStore(tmp_path))
    assert resumed.run(tasks_of(resumed)) == first
    assert resumed.spent == []
    assert resumed.kept == 6
    changed = resumed.run(tasks_of(resumed, factor=3.0))
    assert len(resumed.spent) == 6
    assert set(changed.values()).isdisjoint(first.values())


def test_stages_are_done_again_from_the_one_asked_for_and_once_only(tmp_path):
    runner = TaskRunner(DiskStore(tmp_path))
    runner.run(tasks_of(runner))
    again = TaskRunner(DiskStore(tmp_path), redo=stages_from(("cut", "sum", "table"), "sum"))
    again.run(tasks_of(again))
    again.run(tasks_of(again))
    assert len(again.spent) == 6
    with pytest.raises(InputError, match="--from summ: no such stage; choose from cut, sum"):
        stages_from(("cut", "sum"), "summ")


def test_what_stages_cost_is_added_up(tmp_path):
    runner = TaskRunner(DiskStore(tmp_path))
    runner.run(tasks_of(runner))
    costs = runner.costs()
    assert set(costs) == {"sum"}
    assert costs["sum"]["tasks"] == 6
    assert costs["sum"]["wall_s"] >= 0.0
    assert costs["sum"]["peak_mib"] > 10.0
    assert runner.seconds() == {"sum": costs["sum"]["cpu_s"]}


def test_progress_goes_from_the_beginning_of_a_stage_to_its_end():
    told = []
    runner = TaskRunner(progress=lambda stage, fraction: told.append((stage, fraction)))
    runner.run(tasks_of(runner), (0.2, 0.5))
    assert told[0] == ("sum", 0.2)
    assert told[-1] == ("sum", pytest.approx(0.5))
    assert [f for _, f in told] == sorted(f for _, f in told)


class LastFirst(InProcess):
    """Does the tasks from the last to the first."""

    def run(self, store, tasks):
        """Do the tasks from the last to the first."""
        yield from super().run(store, tasks[::-1])


def test_stages_beside_each_other_are_each_keyed_and_told_of_once_and_in_order():
    told = []
    runner = TaskRunner(executor=LastFirst(), progress=lambda stage, fraction: told.append((stage, fraction)))
    first = tasks_of(runner)
    second = [replace(task, stage="other") for task in first]
    keys = runner.together([first, second], (0.2, 0.4))
    assert keys == [{task.name: task.key for task in stage} for stage in (first, second)]
    assert [stage for stage, _ in told] == ["sum"] * len(told)
    assert told[-1] == ("sum", pytest.approx(0.4))
    assert runner.together([first, second]) == keys
    assert len(runner.spent) == 2 * len(first)


def test_worker_processes_leave_what_one_process_leaves(tmp_path):
    results = []
    for name, executor in (("one", InProcess()), ("two", LocalPool(2))):
        store = DiskStore(tmp_path / name)
        runner = TaskRunner(store, executor)
        keys = runner.run(tasks_of(runner))
        results.append({tile: (key, float(store.load(key)["values"][0])) for tile, key in keys.items()})
        executor.close()
    assert results[0] == results[1]


def test_workers_begin_with_the_task_that_answers_for_all_tiles_though_it_reads_less(tmp_path):
    executor = LocalPool(1)
    runner = TaskRunner(DiskStore(tmp_path), executor)
    small, large = (runner.put("cut", f"{size}_0", Values(np.arange(size))) for size in (10.0, 1e5))
    tiles = [Task("sum", "0_0", add_up, {"own": small}, {"factor": 1.0})]
    tiles.append(Task("sum", "1_0", add_up, {"own": large}, {"factor": 1.0}))
    whole = Task("fit", "all", add_up, {"own": small}, {"factor": 1.0})
    runner.together([tiles, [whole]])
    executor.close()
    assert [spent.name for spent in runner.spent] == ["all", "1_0", "0_0"]


def test_a_killed_worker_is_replaced_and_its_task_done(tmp_path, caplog):
    executor = LocalPool(2)
    runner = TaskRunner(DiskStore(tmp_path / "stages"), executor)
    mark = str(tmp_path / "mark")
    key = runner.one(Task("sum", "0_0", die_once, {}, {"mark": mark}))
    executor.close()
    assert runner.store.load(key)["values"] == [1.0]


def test_workers_that_always_die_end_the_run_with_a_reason(tmp_path):
    executor = LocalPool(1)
    runner = TaskRunner(DiskStore(tmp_path), executor)
    with pytest.raises(SubiacoError, match=r"died 3 times.*0_0.*fewer workers"):
        runner.one(Task("sum", "0_0", die, {}, None))
    executor.close()


def test_the_error_of_a_task_ends_the_run_as_it_is(tmp_path):
    executor = LocalPool(1)
    runner = TaskRunner(DiskStore(tmp_path), executor)
    with pytest.raises(InputError, match="tile 3_4: no points"):
        runner.one(Task("sum", "3_4", fail, {}, {"tile": "3_4"}))
    executor.close()


def write_slowly(path):
    """Write what a folder that is removed must not keep."""
    path.touch()
    time.sleep(WAIT)


@pytest.mark.parametrize("workers", [1, 2])
def test_work_beside_the_tasks_gives_its_result_and_its_error(workers):
    executor = make_executor(workers)
    with work_beside(executor) as start:
        first, second = start(sorted, [3, 1, 2]), start(divmod, 7, 0)
        assert first() == [1, 2, 3]
        with pytest.raises(ZeroDivisionError):
            second()
    executor.close()


def test_an_error_ends_the_work_beside_before_its_folder_is_removed(tmp_path):
    executor, mark = LocalPool(1), tmp_path / "mark"
    ends = time.monotonic() + WAIT

    def work():
        with work_beside(executor) as start:
            start(write_slowly, mark)
            while not mark.exists() and time.monotonic() < ends:
                time.sleep(0.05)
            raise InputError("stop")

    with pytest.raises(InputError, match="stop"):
        work()
    assert mark.exists()
    assert executor._pool is None
    assert time.monotonic() < ends


def test_a_worker_that_dies_beside_the_tasks_is_named():
    executor = LocalPool(1)
    waiting = executor.start(os._exit, 1)
    with pytest.raises(SubiacoError, match=r"died.*fewer workers"):
        waiting()
    executor.close()


def test_workers_need_files_and_must_be_one_at_least():
    with pytest.raises(InputError, match="DiskStore"):
        list(LocalPool(2).run(MemoryStore(), []))
    with pytest.raises(InputError, match="--workers 0"):
        make_executor(0)


def slow_sum(inputs, params):
    """Sum, but late enough for a worker to be killed meanwhile."""
    time.sleep(params["seconds"])
    return add_up(inputs, params)


class Workers(list):
    """Worker processes, and the scheduler's."""

    scheduler: list


@pytest.fixture
def cluster(tmp_path):
    """A scheduler and two workers, each a process of its own, on the loopback."""
    pytest.importorskip("distributed")
    here = str(Path(__file__).parent)
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([here, os.environ.get("PYTHONPATH", "")])}
    file = tmp_path / "scheduler.json"

    def start(*args):
        command = [sys.executable, "-m", "distributed.cli." + args[0], *args[1:]]
        return subprocess.Popen(command, env=env, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    processes = [
        start(
            "dask_scheduler",
            "--host",
            "127.0.0.1",
            "--port",
            "0",
            "--no-dashboard",
            "--scheduler-file",
            str(file),
        )
    ]
    end = time.monotonic() + WAIT
    while not file.exists() and time.monotonic() < end:
        time.sleep(0.1)
    worker = ("dask_worker", "--scheduler-file", str(file), "--nthreads", "1", "--no-nanny", "--no-dashboard")
    processes += [start(*worker), start(*worker)]
    workers = Workers(processes[1:])
    workers.scheduler = processes[:1]
    yield json.loads(file.read_text())["address"], workers
    for process in processes:
        process.kill()
        process.wait(WAIT)


@pytest.mark.parametrize("place", ["disk", "web server"])
def test_a_cluster_that_loses_a_worker_in_the_middle_leaves_the_same(tmp_path, cluster, web_storage, place):
    address, workers = cluster
    store = DiskStore(tmp_path / "cluster") if place == "disk" else ObjectStore(f"{web_storage.url}/cluster")
    alone = TaskRunner(DiskStore(tmp_path / "alone"))
    expected = {n: float(alone.store.load(k)["values"][0]) for n, k in alone.run(tasks_of(alone)).items()}
    executor = make_executor(scheduler=address)
    runner = TaskRunner(store, executor)
    executor._client.wait_for_workers(2, timeout=WAIT)
    tasks = [
        Task(t.stage, t.name, slow_sum, t.inputs, {**t.params, "seconds": 0.3}) for t in tasks_of(runner)
    ]
    runner.progress = lambda stage, fraction: workers[0].kill() if fraction > 0.1 else None
    keys = runner.run(tasks)
    executor.close()
    assert workers[0].wait(WAIT) != 0
    assert {n: float(runner.store.load(k)["values"][0]) for n, k in keys.items()} == expected


@pytest.mark.parametrize(
    ("victims", "said"), [("workers", "no worker is left"), ("scheduler", "the scheduler is gone")]
)
def test_a_cluster_without_workers_or_scheduler_ends_the_run_and_says_so(tmp_path, cluster, victims, said):
    address, workers = cluster
    executor = Dask(address, patience=1.0)
    executor._client.wait_for_workers(2, timeout=WAIT)
    runner = TaskRunner(DiskStore(tmp_path / "cluster"), executor)
    tasks = [
        Task(t.stage, t.name, slow_sum, t.inputs, {**t.params, "seconds": 0.3}) for t in tasks_of(runner)
    ]
    ended = []

    def end(stage, fraction):
        if fraction > 0.1 and not ended:
            ended.extend(workers if victims == "workers" else workers.scheduler)
            for process in ended:
                process.kill()

    runner.progress = end
    with pytest.raises(SubiacoError, match=rf"--scheduler tcp.*: {said}; what is finished stays"):
        runner.run(tasks)
    executor.close()


def test_a_scheduler_that_is_not_there_is_named():
    pytest.importorskip("distributed")
    with pytest.raises(InputError, match=r"tcp://127\.0\.0\.1:9: no scheduler answers"):
        Dask("tcp://127.0.0.1:9", timeout=0.5)


@pytest.mark.parametrize("as_package", [True, False], ids=["package", "script"])
def test_changed_source_code_changes_the_key_of_a_stage_and_of_no_other(tmp_path, monkeypatch, as_package):
    name = f"stage_of_a_test_{'package' if as_package else 'script'}"
    file = tmp_path / name / "stages" / "one.py" if as_package else tmp_path / f"{name}.py"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("def stage(inputs, params):\n    return {}\n")
    monkeypatch.syspath_prepend(tmp_path)
    dotted = f"{name}.stages.one" if as_package else name

    def key():
        source_fingerprint.cache_clear()
        return Task("stage", "tile", importlib.import_module(dotted).stage, {}, None).key

    own = Task("stage", "tile", fingerprint, {}, None).key
    first = key()
    assert key() == first
    file.write_text("def stage(inputs, params):\n    return {'more': 1}\n")
    assert key() != first
    source_fingerprint.cache_clear()
    assert Task("stage", "tile", fingerprint, {}, None).key == own
    source_fingerprint.cache_clear()
