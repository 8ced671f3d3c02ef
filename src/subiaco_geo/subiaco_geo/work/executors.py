"""Executors of tasks: this process, local worker processes, or a dask cluster."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing import forkserver, resource_tracker
from typing import Any, Protocol

import numpy as np
from threadpoolctl import ThreadpoolController

from subiaco_geo.errors import InputError, SubiacoError
from subiaco_geo.signals import interrupt_blocked
from subiaco_geo.work.store import DiskStore, Store
from subiaco_geo.work.tasks import WHOLE, Task, TaskCost, execute

_LOG = logging.getLogger(__name__)
_ATTEMPTS = 3  # pools started before lost workers are taken for a lasting fault
_POLL = 0.1  # between two looks at a cluster whose tasks run [s]
_PROBE = "probe/all"  # piece by which workers show that they see the store
_KILLED = 5.0  # how long a worker that was killed may take to end [s]
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


#: Begins work: given a function and its arguments, it returns what waits for the result.
Start = Callable[..., Callable[[], Any]]


class Executor(Protocol):
    """Does independent tasks in any order and tells what each cost as it ends.

    ``spare`` tells whether workers would stand idle while a single task is done. ``beside``: processor
    seconds that workers spent on work that was started (:meth:`start`), and whose result was asked for.
    """

    spare: bool
    beside: float

    def run(self, store: Store, tasks: Sequence[Task[Any]]) -> Iterator[TaskCost]:
        """Do the tasks; the first that fails ends the run with its error."""
        ...

    def start(self, function: Callable[..., Any], *args: Any) -> Callable[[], Any]:
        """Begin work on files that only this machine sees; call what is returned to get its result.

        Workers on this machine do the work meanwhile. Without such workers it is done in that call.
        """
        ...

    def close(self) -> None:
        """Let the workers go when their tasks have ended."""
        ...

    def stop(self) -> None:
        """End the workers at once, in the middle of their tasks."""
        ...


class InProcess:
    """One task after the other in this process, with one thread, as worker processes do them.

    Products of many points with a 3x3 matrix are too small for the threads of a BLAS library: these gain
    nothing, and wait for each other at full load.
    """

    spare, beside = False, 0.0

    def run(self, store: Store, tasks: Sequence[Task[Any]]) -> Iterator[TaskCost]:
        """Do the tasks in the order given."""
        threads = ThreadpoolController()
        for task in tasks:
            with threads.limit(limits=1, user_api="blas"):
                done = execute(store, task)
            yield done

    def start(self, function: Callable[..., Any], *args: Any) -> Callable[[], Any]:
        """Put the work off until its result is asked for."""
        return partial(function, *args)

    def close(self) -> None:
        """Do nothing."""

    def stop(self) -> None:
        """Do nothing."""


class LocalPool:
    """Worker processes on this machine, one thread each, which take the longest tasks first.

    Parameters
    ----------
    workers : int
    preload : sequence of str
        Modules that workers need; loaded once for all of them, from now on.
    """

    spare = True

    def __init__(self, workers: int, preload: Sequence[str] = ()) -> None:
        self.workers, self.beside = workers, 0.0
        self._pool: ProcessPoolExecutor | None = None
        self._context = load_for_workers(preload)

    def run(self, store: Store, tasks: Sequence[Task[Any]]) -> Iterator[TaskCost]:
        """Do the tasks; what a killed worker left undone is done by a fresh one."""
        if not store.shared:
            raise InputError("worker processes need stages that they see; use a DiskStore")
        left = {task.key: task for task in sorted(tasks, key=partial(_order, store))}
        for attempt in range(_ATTEMPTS):
            try:
                yield from self._drain(store, left)
            except BrokenProcessPool:
                self.close()
                _LOG.warning("a worker process died (attempt %d); %d tasks left", attempt + 1, len(left))
            if not left:
                return
        raise SubiacoError(
            f"worker processes died {_ATTEMPTS} times, last with {len(left)} tasks left, "
            f"{next(iter(left.values())).name} among them; if memory is short, use fewer workers"
        )

    def _drain(self, store: Store, left: dict[str, Task[Any]]) -> Iterator[TaskCost]:
        with _one_thread(), _signals_deferred():  # workers start with the tasks
            pool = self._started()
            futures = {pool.submit(execute, store, task): key for key, task in left.items()}
        try:
            for future in as_completed(futures):
                spent = future.result()
                del left[futures[future]]
                yield spent
        finally:
            for future in futures:
                future.cancel()

    def start(self, function: Callable[..., Any], *args: Any) -> Callable[[], Any]:
        """Let a worker do the work; function and arguments are pickled."""
        with _one_thread(), _signals_deferred():
            future = self._started().submit(_timed, function, *args)

        def result() -> Any:
            try:
                found, spent = future.result()
            except BrokenProcessPool as error:
                raise SubiacoError(
                    "a worker process died; if memory is short, use fewer workers, then the same command "
                    "goes on from what is finished"
                ) from error
            self.beside += spent
            return found

        return result

    def _started(self) -> ProcessPoolExecutor:
        if self._pool is None:
            self._pool = ProcessPoolExecutor(self.workers, self._context, _end_with_parent)
        return self._pool

    def close(self) -> None:
        """End the worker processes when their tasks have ended."""
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)
            self._pool = None

    def stop(self) -> None:
        """Kill the worker processes."""
        if self._pool is None:
            return
        pool, self._pool = self._pool, None
        workers = list((pool._processes or {}).values())  # noqa: SLF001 - Python 3.14 has kill_workers
        for worker in workers:
            worker.kill()
        pool.shutdown(wait=False, cancel_futures=True)
        for worker in workers:  # until then they may write where files are removed next
            worker.join(_KILLED)


@contextmanager
def running(executor: Executor) -> Iterator[Executor]:
    """Close an executor at the end, or stop it where Ctrl-C or SIGTERM ended the run."""
    try:
        yield executor
    except KeyboardInterrupt:
        executor.stop()
        raise
    finally:
        executor.close()


def _timed(function: Callable[..., Any], *args: Any) -> tuple[Any, float]:
    """Return a result and the processor seconds that it took."""
    begun = time.process_time()
    return function(*args), time.process_time() - begun


@contextmanager
def work_beside(executor: Executor) -> Iterator[Start]:
    """Yield ``executor.start``; an error ends the workers, so that none writes into a folder that goes."""
    try:
        yield executor.start
    except BaseException:
        executor.stop()
        raise


def load_for_workers(modules: Sequence[str]) -> Any:
    """Begin to load the modules that workers need, once for all of them; return their context.

    Called early, it lets another core load them while this process loads the same. Only the first call
    counts.
    """
    context = multiprocessing.get_context("forkserver")  # this process may hold threads and locks
    context.set_forkserver_preload(list(modules))
    resource_tracker.ensure_running()  # unblocks SIGINT, so it starts first
    with _one_thread(), interrupt_blocked(), _signals_deferred():
        forkserver.ensure_running()
    return context


def _end_with_parent() -> None:
    """Let a worker ignore Ctrl-C, which its parent handles, and end when its parent has ended."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, name="parent", daemon=True).start()


@contextmanager
def _signals_deferred() -> Iterator[None]:
    """Handle SIGINT and SIGTERM at the end: a worker that is half started would end with a traceback."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    before = {
        number: signal.signal(number, lambda number, _frame: came.append(number))
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        if came:
            signal.raise_signal(came[0])


def _order(store: Store, task: Task[Any]) -> tuple[bool, int]:
    """Put first what probably lasts long, so that no worker ends long after the others.

    A task that answers for all tiles lasts longer than that of one tile, though it may read fewer bytes:
    registration does without the beams around a tile. Of tiles, those that read most come first.
    """
    return task.name != WHOLE, -sum(store.size(key) for key in task.inputs.values())


@contextmanager
def _one_thread() -> Iterator[None]:
    """Let processes that start meanwhile use one thread each."""
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


class Dask:
    """Workers of a dask cluster that see the same files or the same object storage.

    Parameters
    ----------
    address : str
        Of the scheduler, e.g. ``tcp://host:8786``.
    timeout : float
        How long to wait for it to answer [s].
    patience : float
        How long to go on without any worker, or without the scheduler [s].

    Raises
    ------
    InputError
        dask.distributed is not installed, or no scheduler answers.
    """

    spare, beside = True, 0.0

    def __init__(self, address: str, timeout: float = 20.0, patience: float = 120.0) -> None:
        try:
            from dask import distributed
        except ImportError as error:
            raise InputError(
                "--scheduler needs dask.distributed: run 'make setup', or install subiaco-change[dask]"
            ) from error
        try:
            self._client: Any = distributed.Client(address, timeout=timeout)
        except (OSError, TimeoutError, ValueError) as error:
            raise InputError(f"--scheduler {address}: no scheduler answers ({error})") from error
        self._completed: Any = distributed.as_completed
        self._closed: Any = distributed.comm.CommClosedError
        self._address, self._patience = address, patience
        self._checked = False
        _LOG.info("cluster %s, dashboard %s", address, self._client.dashboard_link)

    def run(self, store: Store, tasks: Sequence[Task[Any]]) -> Iterator[TaskCost]:
        """Do the tasks; the scheduler gives those of a lost worker to another."""
        if not store.shared:
            raise InputError("a cluster needs stages that it sees; use a DiskStore or an ObjectStore")
        if not self._checked:
            _check_sight(self._client, store)
            self._checked = True
        futures = [
            self._client.submit(execute, store, task, key=task.key, retries=2, pure=False) for task in tasks
        ]
        done, ready = self._completed(futures), deque[Any]()
        alone_since: float | None = None
        while ready or not done.is_empty():
            while done.has_ready():
                ready.append(next(done))
            spent = self._result(ready[0]) if ready else None
            if spent is not None:
                ready.popleft()
                alone_since = None
                yield spent
                continue
            time.sleep(_POLL)
            missing = self._missing()
            if missing is None:
                alone_since = None
            elif alone_since is None:
                alone_since = time.monotonic()
                _LOG.warning("%s: %s; waiting for %.0f s", self._address, missing, self._patience)
            elif time.monotonic() - alone_since > self._patience:
                raise self._lost(missing)

    def start(self, function: Callable[..., Any], *args: Any) -> Callable[[], Any]:
        """Put the work off until its result is asked for: a cluster may not see this machine's files."""
        return partial(function, *args)

    def _result(self, future: Any) -> TaskCost | None:
        """Return what a finished task spent; None where its worker died with the answer: it is done again.

        The task's own error is raised as it is.
        """
        try:
            spent: TaskCost = future.result(timeout=1.0)
        except TimeoutError:
            return None
        except (self._closed, CancelledError) as error:
            raise self._lost("the scheduler is gone") from error
        return spent

    def _missing(self) -> str | None:
        """Say what the cluster lacks to go on; None where nothing."""
        if self._client.status != "running":
            return "the scheduler is gone"
        try:
            workers = self._client.scheduler_info()["workers"]
        except (OSError, KeyError):
            return "the scheduler is gone"
        return None if workers else "no worker is left"

    def _lost(self, missing: str) -> SubiacoError:
        return SubiacoError(
            f"--scheduler {self._address}: {missing}; what is finished stays: start the cluster again,"
            " then the same command goes on from there"
        )

    def close(self) -> None:
        """Leave the cluster; it goes on."""
        with suppress(OSError, TimeoutError):
            self._client.close()

    def stop(self) -> None:
        """Leave the cluster; tasks that nobody waits for are cancelled by its scheduler."""
        self.close()


def _check_sight(client: Any, store: Store) -> None:
    """Refuse a cluster with a worker that does not see a piece saved here."""
    store.save(_PROBE, {"seen": np.ones(1)})
    seen: dict[str, bool] = client.run(_sees, store)
    if not seen:
        raise InputError("--scheduler: the cluster has no workers; start 'dask worker' first")
    blind = sorted(worker for worker, sees in seen.items() if not sees)
    if blind:
        place = store.root if isinstance(store, DiskStore) else store
        raise InputError(
            f"--scheduler: worker {blind[0]} does not see {place}; put it on a shared disk, or keep "
            "the stages in object storage (--keep-stages URL)"
        )


def _sees(store: Store) -> bool:
    """Tell, on a worker, whether it sees what was saved elsewhere."""
    try:
        return store.has(_PROBE)
    except SubiacoError:
        return False


def make_executor(workers: int = 1, scheduler: str | None = None, preload: Sequence[str] = ()) -> Executor:
    """Return the executor that the options ask for: a cluster, local workers, or this process."""
    if scheduler is not None:
        return Dask(scheduler)
    if workers < 1:
        raise InputError(f"--workers {workers}: give 1 or more")
    return InProcess() if workers == 1 else LocalPool(workers, preload)
