"""What a change run will take: done on the largest tiles, and scaled from their points to all points."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

from subiaco_change.job import disk_bytes, run_change_and
from subiaco_change.outputs.directory import PageWriter
from subiaco_change.request import ChangeRequest
from subiaco_change.tiling.run import ChangeRun
from subiaco_geo.work.executors import Executor
from subiaco_geo.work.tasks import peak_mib

#: Stages that take a limited number of points of a city, however large.
_LIMITED = ("registration", "refine")


@dataclass
class Sample:
    """The tiles that a dry run takes, and what it notes once both epochs are cut.

    Parameters
    ----------
    count : int
        Tiles with the most points; their neighbours are taken too, as every tile is seen with them.
    """

    count: int
    tiles: int = 0
    taken: list[str] = field(default_factory=list)
    points: int = 0
    inputs: int = 0
    taken_points: int = 0
    cut_cpu: float = 0.0  # of this process, when both epochs were cut
    cut_beside: float = 0.0  # of workers until then, beside their tasks
    executor: Executor | None = None
    done: Mapping[str, float] = field(default_factory=dict)  # seconds of stages of all tiles

    def begin(self, run: ChangeRun) -> None:
        """Leave all other tiles out of a run whose epochs are cut."""
        self.cut_cpu = time.process_time()
        self.executor = run.runner.executor
        self.cut_beside = self.executor.beside
        self.done = run.runner.seconds()
        self.points, self.inputs = run.kept_points, run.input_points
        self.tiles = len({name for own in run.clouds.values() for name in own})
        self.taken = run.keep_largest(self.count)
        self.taken_points = run.kept_points


@dataclass(frozen=True)
class Estimate:
    """What the whole run will take.

    Parameters
    ----------
    tiles, points : int
        Of both epochs, points at the working leaf.
    taken : int
        Tiles that were done.
    cpu_s : float
        Processor seconds, of which this process alone takes ``alone_s``.
    wall_s : float
        Time by the clock with the workers of the request, none of them idle.
    memory_mib : float
        At most, of this process and all workers; a worker holds one tile, however many there are.
    disk_bytes : int
        Of the result and of the stages while the run lasts.
    """

    tiles: int
    taken: int
    points: int
    cpu_s: float
    alone_s: float
    wall_s: float
    memory_mib: float
    disk_bytes: int

    def text(self) -> str:
        """Say it in one line."""
        return (
            f"about {self.cpu_s:.0f} CPU s and {self.wall_s / 60.0:.1f} min by the clock, at most "
            f"{self.memory_mib / 1024.0:.1f} GB of memory and {self.disk_bytes / 1e9:.1f} GB of disk "
            f"for {self.tiles} tiles with {self.points / 1e6:.1f} M points (measured on {self.taken} tiles)"
        )


def dry_run(
    request: ChangeRequest,
    tiles: int,
    progress: Callable[[str, float], None] | None = None,
    write_pages: PageWriter | None = None,
) -> Estimate:
    """Do the largest tiles of a comparison, with all its outputs, and estimate the whole; nothing is left.

    Errors as for :func:`~subiaco_change.job.run_change`.
    """
    sample, begun = Sample(tiles), time.process_time()
    request.output.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix=f".{request.output.name}.dry-", dir=request.output.parent) as folder:
        small = request.model_copy(update={"output": Path(folder) / "change", "stages": _dry_stages(request)})
        costs = run_change_and(
            small, lambda result: result.costs, progress, begun=sample.begin, write_pages=write_pages
        )
    cutting = sample.cut_cpu - begun + sample.cut_beside
    beside = 0.0 if sample.executor is None else sample.executor.beside - sample.cut_beside
    return estimate(sample, costs, cutting, time.process_time() - sample.cut_cpu + beside, request)


def _dry_stages(request: ChangeRequest) -> str | None:
    """Keep stages where workers of a cluster see them, and beside the dry output otherwise."""
    return request.stages if isinstance(request.stages, str) else None


def estimate(
    sample: Sample,
    costs: Mapping[str, Mapping[str, float]],
    cutting: float,
    after: float,
    request: ChangeRequest,
) -> Estimate:
    """Scale what a sample of tiles took.

    Parameters
    ----------
    sample : Sample
    costs : mapping
        Of its stages, see :meth:`subiaco_geo.work.task_runner.TaskRunner.costs`.
    cutting, after : float
        Processor seconds of this process until both epochs were cut, and from then on, with those of
        workers beside their tasks.
    request : ChangeRequest
    """
    factor = sample.points / max(sample.taken_points, 1)
    limit = 2.0 * request.config.registration_points / max(sample.taken_points, 1)
    rest = {stage: cost["cpu_s"] - sample.done.get(stage, 0.0) for stage, cost in costs.items()}
    before = sum(sample.done.values())
    limited = sum(own * min(factor, max(limit, 1.0)) for stage, own in rest.items() if stage in _LIMITED)
    shared = before + sum(own * factor for stage, own in rest.items() if stage not in _LIMITED)
    here = request.workers == 1 and request.scheduler is None  # then this process does the tasks too
    alone = cutting - before * here + max(after - sum(rest.values()) * here, 0.0) * factor
    workers = max((cost["peak_mib"] for cost in costs.values()), default=0.0) * request.workers
    return Estimate(
        tiles=sample.tiles,
        taken=len(sample.taken),
        points=sample.points,
        cpu_s=alone + limited + shared,
        alone_s=alone,
        wall_s=alone + limited + shared / request.workers,
        memory_mib=peak_mib() + (0.0 if here else workers),
        disk_bytes=sum(disk_bytes(sample.points, sample.inputs, request.config)),
    )
