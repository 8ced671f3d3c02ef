"""A training as the command asks for it; errors are found before PyTorch is needed."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from subiaco_evaluation.learned.config import TrainingConfig
from subiaco_evaluation.learned.methods import require_torch
from subiaco_evaluation.learned.weights_file import read_weights
from subiaco_geo.atomic import refuse_existing
from subiaco_geo.errors import InputError


@dataclass(frozen=True)
class TrainingJob:
    """What to train on, and where the weights go.

    Parameters
    ----------
    method : str
    surveys, held_out : tuple of Path
        Simulated surveys to learn from, and to score after every epoch.
    output : Path
        Weights (``.npz``); checkpoint and prepared surveys lie beside it until the training ends.
    prepared : Path, optional
        Folder of prepared surveys that several trainings share.
    start : Path, optional
        Trained weights of the same network that the training begins with.
    """

    method: str
    surveys: tuple[Path, ...]
    held_out: tuple[Path, ...]
    output: Path
    prepared: Path | None = None
    start: Path | None = None

    @property
    def folder(self) -> Path:
        """Where the checkpoint lies."""
        return self.output.with_name(f"{self.output.name}.training")

    def key(self, config: TrainingConfig) -> str:
        """Name everything that a checkpoint depends on."""
        words = [self.method, config.model_dump(mode="json"), sorted(str(s.resolve()) for s in self.surveys)]
        words.append(sorted(str(s.resolve()) for s in self.held_out))
        if self.start is not None:
            words.append(hashlib.sha256(self.start.read_bytes()).hexdigest())
        return hashlib.sha256(json.dumps(words, sort_keys=True).encode()).hexdigest()[:16]


def training_job(
    method: str,
    surveys: Sequence[Path],
    held_out: Sequence[Path],
    output: Path,
    prepared: Path | None = None,
    *,
    start: Path | None = None,
    overwrite: bool = False,
) -> TrainingJob:
    """Return a job whose files are there and whose output may be written.

    Without ``held_out`` the last survey is the validation survey.

    Raises
    ------
    InputError
        A survey is missing or given twice, the output exists or is no ``.npz``, or ``start`` holds no weights
        of this method.
    """
    if output.suffix != ".npz":
        raise InputError(f"{output}: weights are written as .npz; choose a name that ends in .npz")
    refuse_existing(output, overwrite)
    learned = list(surveys)
    if not held_out:
        if len(learned) < 2:
            raise InputError("train: one survey alone; give a second one, or --validate SURVEY")
        held_out = [learned.pop()]
    every = [*learned, *held_out]
    for survey in every:
        if not (survey / "truth" / "scene.yaml").is_file():
            raise InputError(f"{survey}: no truth/scene.yaml; give the output of 'subiaco simulate'")
    if len({survey.resolve() for survey in every}) < len(every):
        raise InputError("train: a survey is given twice; surveys to learn and to validate must differ")
    if start is not None:
        read_weights(start, method)
    return TrainingJob(method, tuple(learned), tuple(held_out), output, prepared, start)


def run_training(
    job: TrainingJob, config: TrainingConfig, say: Callable[[str, float], None]
) -> dict[str, Any]:
    """Train; see :func:`subiaco_evaluation.learned.training.train`.

    Raises
    ------
    InputError
        PyTorch is not installed, or a checkpoint is of another training.
    """
    require_torch(job.method)
    from subiaco_evaluation.learned.training import train

    return train(job, config, say)
