"""Training of a learned method: epochs, early stopping, checkpoints that a killed training goes on from."""

from __future__ import annotations

import logging
import shutil
import subprocess
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from subiaco_evaluation.learned.config import TrainingConfig
from subiaco_evaluation.learned.curve import write_curve
from subiaco_evaluation.learned.deep_clustering import ClusterTask
from subiaco_evaluation.learned.jobs import TrainingJob
from subiaco_evaluation.learned.labels import MOVING_OBJECTS
from subiaco_evaluation.learned.methods import POINT_METHODS
from subiaco_evaluation.learned.surveys import Prepared
from subiaco_evaluation.learned.tasks import (
    PointTask,
    RasterTask,
    Task,
    prior_factors,
    score_validation,
    task_loss,
)
from subiaco_evaluation.learned.weights_file import array_text, read_weights, text_array, write_weights
from subiaco_geo import __version__
from subiaco_geo.atomic import whole_file
from subiaco_geo.errors import InputError

_LOG = logging.getLogger(__name__)
#: What the record of a training keeps of the one whose weights it began with.
_EARLIER = (
    "config",
    "surveys",
    "validation_surveys",
    "epochs",
    "validation_miou_percent",
    "hours",
    "revision",
)
Arrays = dict[str, NDArray[Any]]
Say = Callable[[str, float], None]


@dataclass
class State:
    """Where a training is: what a checkpoint holds beside weights and optimiser."""

    epoch: int = 0
    seconds: float = 0.0
    best_score: float = -1.0
    best_epoch: int = -1
    best_power: float = 0.0
    rows: list[dict[str, float]] = field(default_factory=list)
    earlier: list[dict[str, Any]] = field(default_factory=list)
    best: Arrays = field(default_factory=dict)


def make_task(job: TrainingJob, config: TrainingConfig, say: Say) -> Task:
    """Prepare the surveys and build the untrained network."""
    prepared = Prepared(job.prepared or job.folder / "prepared", config.point_network)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    torch.manual_seed(config.seed)
    if job.method in POINT_METHODS:
        kind = ClusterTask if job.method == "dc3dcd" else PointTask
        clouds = prepared.points(job.surveys, say), prepared.points(job.held_out, say)
        return kind(job.method, config, *clouds, device)
    rasters = prepared.rasters(job.surveys, say), prepared.rasters(job.held_out, say)
    return RasterTask(job.method, config, *rasters, device)


def train(job: TrainingJob, config: TrainingConfig, say: Say) -> dict[str, Any]:
    """Train a network and write its best weights, its record and its learning curve.

    Returns
    -------
    dict
        The record: method, settings, surveys, epochs, hours, parameters, versions, best score.

    Raises
    ------
    InputError
    """
    task = make_task(job, config, say)
    settings = config.point_training if isinstance(task, PointTask) else config.raster_training
    optimiser = task.optimiser()
    checkpoint = job.folder / "checkpoint.npz"
    key = job.key(config)
    if checkpoint.is_file():
        state = read_checkpoint(checkpoint, key, task, optimiser)
    else:
        state = begin(task, config, job.start)
    while state.epoch < settings.epochs and state.epoch - state.best_epoch <= config.patience:
        rate = settings.learning_rate * settings.final_rate ** (state.epoch / max(settings.epochs - 1, 1))
        started = time.perf_counter()
        loss = run_epoch(task, optimiser, rate, settings.clip, (config.seed, state.epoch))
        validation = score_validation(task)
        score = 100.0 * validation.score
        state.seconds += time.perf_counter() - started
        state.rows.append(
            {"epoch": state.epoch, "seconds": state.seconds, "learning_rate": rate, "training_loss": loss,
             "validation_loss": validation.loss, "validation_miou_percent": score,
             "prior_power": validation.power}
        )  # fmt: skip
        if score > state.best_score:
            state.best_score, state.best_epoch, state.best = score, state.epoch, model_arrays(task)
            state.best_power = validation.power
        state.epoch += 1
        write_checkpoint(checkpoint, key, task, optimiser, state)
        write_curve(job.folder / job.output.stem, state.rows)
        say(f"{job.method} loss {loss:.3f}, mIoU {score:.1f} %", state.epoch / settings.epochs)
    record = describe_training(job, config, task, state)
    write_curve(job.output.with_suffix(""), state.rows)
    write_weights(job.output, state.best, record)
    shutil.rmtree(job.folder, ignore_errors=True)
    return record


def begin(task: Task, config: TrainingConfig, start: Path | None) -> State:
    """Return the state before the first epoch; weights to start with are scored, and are the best so far.

    Raises
    ------
    InputError
        The weights to start with are of a network of other sizes.
    """
    if start is None:
        return State()
    arrays, record = read_weights(start, task.method)
    part = "point_network" if isinstance(task, PointTask) else "raster_network"
    if record["config"][part] != config.model_dump(mode="json")[part]:
        raise InputError(f"{start}: weights of other settings of {part}; give the --set or --config they had")
    load_arrays(task.model, arrays)
    found = score_validation(task)
    score = 100.0 * found.score
    last = {name: record[name] for name in _EARLIER} | {"score_at_the_start": round(score, 2)}
    earlier = [*record.get("earlier", []), last]
    return State(best_score=score, best_power=found.power, best=model_arrays(task), earlier=earlier)


def run_epoch(
    task: Task, optimiser: torch.optim.Optimizer, rate: float, clip: float, seed: tuple[int, int]
) -> float:
    """Train one epoch, which its seed decides wholly; return the mean loss."""
    torch.manual_seed(seed[0] * 100_003 + seed[1])
    for group in optimiser.param_groups:
        group["lr"] = rate
    task.model.train()
    losses = []
    for output in task.steps(np.random.default_rng(seed)):
        loss = task_loss(output, task.weights)
        if not torch.isfinite(loss):
            continue  # a batch without any label
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_value_(task.model.parameters(), clip)
        optimiser.step()
        losses.append(float(loss.detach()))
    return float(np.mean(losses)) if losses else float("nan")


def model_arrays(task: Task) -> Arrays:
    """Return weights and batch statistics as arrays of their own."""
    return {name: value.detach().cpu().numpy().copy() for name, value in task.model.state_dict().items()}


def load_arrays(model: torch.nn.Module, arrays: Arrays) -> None:
    """Put weights and batch statistics into a network."""
    model.load_state_dict({name: torch.from_numpy(np.array(value)) for name, value in arrays.items()})


def write_checkpoint(
    path: Path, key: str, task: Task, optimiser: torch.optim.Optimizer, state: State
) -> None:
    """Write everything that the next epoch depends on, whole or not at all."""
    facts = {"key": key, "epoch": state.epoch, "seconds": state.seconds, "rows": state.rows,
             "best_score": state.best_score, "best_epoch": state.best_epoch,
             "best_power": state.best_power, "earlier": state.earlier}  # fmt: skip
    arrays: Arrays = {"state": text_array(facts)}
    arrays |= {f"model/{name}": value for name, value in model_arrays(task).items()}
    arrays |= {f"best/{name}": value for name, value in state.best.items()}
    for index, values in optimiser.state_dict()["state"].items():
        for name, value in values.items():
            if isinstance(value, torch.Tensor):
                arrays[f"optimiser/{index}/{name}"] = value.cpu().numpy()
    with whole_file(path) as temporary:
        np.savez(temporary, **arrays)  # type: ignore[arg-type]


def read_checkpoint(path: Path, key: str, task: Task, optimiser: torch.optim.Optimizer) -> State:
    """Take up a training where it stopped.

    Raises
    ------
    InputError
        The checkpoint is of other settings or surveys.
    """
    with np.load(path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    facts = array_text(arrays["state"])
    if facts.pop("key") != key:
        raise InputError(f"{path}: begun with other settings or surveys; remove it or choose another -o")
    load_arrays(task.model, _part(arrays, "model/"))
    known = optimiser.state_dict()
    for name, value in _part(arrays, "optimiser/").items():
        index, field_name = name.split("/")
        known["state"].setdefault(int(index), {})[field_name] = torch.from_numpy(value)
    optimiser.load_state_dict(known)
    _LOG.warning("%s: the training goes on after epoch %d", path.parent, facts["epoch"])
    return State(**facts, best=_part(arrays, "best/"))


def _part(arrays: Arrays, prefix: str) -> Arrays:
    return {name.removeprefix(prefix): v for name, v in arrays.items() if name.startswith(prefix)}


def describe_training(job: TrainingJob, config: TrainingConfig, task: Task, state: State) -> dict[str, Any]:
    """Return the training record that lies in the file of weights."""
    return {
        "method": job.method,
        "config": config.model_dump(mode="json"),
        "surveys": names_of(job.surveys),
        "validation_surveys": names_of(job.held_out),
        "earlier": state.earlier,
        "epochs": state.epoch,
        "best_epoch": state.best_epoch,
        "validation_miou_percent": round(state.best_score, 2),
        "moving_objects": MOVING_OBJECTS,
        "prior_power": state.best_power,
        "class_factors": prior_factors(task.shares, state.best_power).tolist(),
        "hours": round(state.seconds / 3600.0, 3),
        "threads": torch.get_num_threads(),
        "parameters": sum(p.numel() for p in task.model.parameters()),
        "version": __version__,
        "revision": revision(),
        "torch": str(torch.__version__),
    }


def revision() -> str:
    """Return the revision of the sources where they are a checkout of git, else the version."""
    words = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short=12", "HEAD"]
    try:
        return subprocess.run(words, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return __version__


def names_of(surveys: Sequence[Path]) -> list[str]:
    """Return the names of surveys without the folders that they lie in."""
    return [survey.absolute().name for survey in surveys]
