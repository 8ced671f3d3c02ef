"""What a network learns from prepared surveys: batches of an epoch, loss, and score on other surveys."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Protocol

import numpy as np
import torch
from torch import Tensor, nn

from subiaco_evaluation.learned.batches import PairBatch, collate
from subiaco_evaluation.learned.config import TrainingConfig
from subiaco_evaluation.learned.labels import CLASSES, IGNORED, class_shares
from subiaco_evaluation.learned.point_networks import POINT_NETWORKS
from subiaco_evaluation.learned.raster_networks import RASTER_NETWORKS
from subiaco_evaluation.learned.sampling import CylinderSampler, PatchSampler, clipped_noise
from subiaco_evaluation.learned.surveys import PointPair, RasterPair
from subiaco_evaluation.scores import confusion
from subiaco_geo.frames import Ints

Output = tuple[Tensor, Tensor]  # log probabilities (N, classes), true classes (N,)


class Task(Protocol):
    """What the training loop needs of a method."""

    model: nn.Module
    weights: Tensor
    classes: int

    def optimiser(self) -> torch.optim.Optimizer:
        """Return a new optimiser of the model."""

    def steps(self, rng: np.random.Generator) -> Iterator[Output]:
        """Yield what the model says of the batches of one epoch."""

    def validation(self) -> Iterator[Output]:
        """Yield what the model says of the validation surveys; the same places every time."""


def task_loss(output: Output, weights: Tensor) -> Tensor:
    """Return the negative log likelihood, weighed by class; labels of -1 do not count."""
    return nn.functional.nll_loss(output[0], output[1], weight=weights, ignore_index=IGNORED)


def _weights(labels: Sequence[Ints], count: int, device: str) -> Tensor:
    """Return one less the share of every class (count,)."""
    shares = class_shares(np.concatenate([part.ravel() for part in labels]), count)
    return torch.from_numpy(1.0 - shares).float().to(device)


@dataclass
class PointTask:
    """Classes of the points of cylinders."""

    method: str
    config: TrainingConfig
    training: Sequence[PointPair]
    held_out: Sequence[PointPair]
    device: str = "cpu"
    classes: int = len(CLASSES)

    def __post_init__(self) -> None:
        network = self.config.point_network
        self.model = POINT_NETWORKS[self.method](network).to(self.device)
        self.weights = _weights([c for p in self.training for c in p.classes], self.classes, self.device)
        self._sampler = CylinderSampler(self.training, network.radius)
        self._held_out = CylinderSampler(self.held_out, network.radius)

    def optimiser(self) -> torch.optim.Optimizer:
        """Return stochastic gradient descent with momentum."""
        settings = self.config.point_training
        return torch.optim.SGD(
            self.model.parameters(),
            lr=settings.learning_rate,
            momentum=settings.momentum,
            weight_decay=settings.weight_decay,
        )

    def steps(self, rng: np.random.Generator) -> Iterator[Output]:
        """Yield what the model says of random cylinders, turned and with noise."""
        settings = self.config.point_training
        for _ in range(max(settings.samples // settings.batch, 1)):
            batch = self._batch(rng, settings.batch)
            yield self.model(batch), batch.classes

    def _batch(self, rng: np.random.Generator, count: int) -> PairBatch:
        settings = self.config.point_training
        cut = (self._sampler.cut(place) for place in self._sampler.draw(rng, 4 * count))
        cylinders = list(islice((c for c in cut if c is not None), count))
        turns = rng.uniform(0.0, 2.0 * np.pi, len(cylinders)).tolist()
        sizes = [(len(c.reference.picked), len(c.compared.picked)) for c in cylinders]
        noises = [
            (clipped_noise(rng, a, settings.noise, settings.noise_limit),
             clipped_noise(rng, b, settings.noise, settings.noise_limit))
            for a, b in sizes
        ]  # fmt: skip
        return collate(cylinders, self.config.point_network, turns, noises, self.device)

    def validation(self) -> Iterator[Output]:
        """Yield what the model says of fixed cylinders as they are."""
        rng = np.random.default_rng(self.config.seed)
        for place in self._held_out.draw(rng, self.config.validation_samples):
            cylinder = self._held_out.cut(place)
            if cylinder is not None:
                batch = collate([cylinder], self.config.point_network, device=self.device)
                yield self.model(batch), batch.classes


@dataclass
class RasterTask:
    """Labels of the cells of patches."""

    method: str
    config: TrainingConfig
    training: Sequence[RasterPair]
    held_out: Sequence[RasterPair]
    device: str = "cpu"
    classes: int = 5

    def __post_init__(self) -> None:
        network = self.config.raster_network
        self.model = RASTER_NETWORKS[self.method](network).to(self.device)
        self.weights = _weights([pair.codes for pair in self.training], self.classes, self.device)
        size = (network.patch, network.height_scale)
        self._sampler = PatchSampler(self.training, *size, exchange=self.config.swap_epochs)
        self._held_out = PatchSampler(self.held_out, *size, exchange=False)

    def optimiser(self) -> torch.optim.Optimizer:
        """Return Adam."""
        settings = self.config.raster_training
        return torch.optim.Adam(
            self.model.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay
        )

    def steps(self, rng: np.random.Generator) -> Iterator[Output]:
        """Yield what the model says of random patches, turned and mirrored."""
        settings = self.config.raster_training
        for _ in range(max(settings.samples // settings.batch, 1)):
            yield self._said(self._sampler, rng, settings.batch, varied=True)

    def validation(self) -> Iterator[Output]:
        """Yield what the model says of fixed patches as they are."""
        rng = np.random.default_rng(self.config.seed)
        yield self._said(self._held_out, rng, self.config.validation_samples, varied=False)

    def _said(self, sampler: PatchSampler, rng: np.random.Generator, count: int, *, varied: bool) -> Output:
        heights, codes = zip(*(sampler.draw(rng, varied=varied) for _ in range(count)), strict=True)
        said = self.model(torch.from_numpy(np.stack(heights)).to(self.device))
        flat = said.permute(0, 2, 3, 1).reshape(-1, self.classes)
        return flat, torch.from_numpy(np.stack(codes)).to(self.device).reshape(-1)


def score_validation(task: Task) -> tuple[float, Ints]:
    """Return the mean loss and the confusion matrix (classes, classes + 1) of the validation surveys."""
    task.model.train(False)
    losses, matrix = [], np.zeros((task.classes, task.classes + 1), dtype=np.int64)
    with torch.no_grad():
        for output in task.validation():
            losses.append(float(task_loss(output, task.weights).detach()))
            matrix += confusion(output[1].cpu().numpy(), output[0].argmax(dim=1).cpu().numpy(), task.classes)
    task.model.train()
    return float(np.nanmean(losses)), matrix
