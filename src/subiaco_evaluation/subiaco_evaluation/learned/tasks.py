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
from subiaco_evaluation.learned.sampling import (
    CylinderPair,
    CylinderSampler,
    PatchSampler,
    Singles,
    clipped_noise,
)
from subiaco_evaluation.learned.surveys import PointPair, RasterPair
from subiaco_evaluation.scores import class_iou, confusion, nanmean
from subiaco_geo.frames import Floats, Ints

#: Powers of the true shares of the classes among which the validation surveys choose.
POWERS = (0.0, 0.25, 0.5, 0.75, 1.0)
Output = tuple[Tensor, Tensor]  # log probabilities (N, classes), true classes (N,)


class Task(Protocol):
    """What the training loop needs of a method."""

    method: str
    model: nn.Module
    weights: Tensor
    shares: Floats
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


def _shares(labels: Sequence[Ints], count: int) -> Floats:
    """Return the share of every class (count,) in the surveys."""
    return class_shares(np.concatenate([part.ravel() for part in labels]), count)


def _weights(shares: Floats, device: str) -> Tensor:
    """Return one less the share of every class (count,)."""
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
        self.shares = _shares([c for p in self.training for c in p.classes], self.classes)
        self.weights = _weights(self.shares, self.device)
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
        cut = (self._sampler.cut(place) for place in self._sampler.draw(rng, 4 * count))
        return self._varied(rng, list(islice((c for c in cut if c is not None), count)))

    def _varied(self, rng: np.random.Generator, cylinders: Sequence[CylinderPair]) -> PairBatch:
        """Return cylinders, turned and with noise."""
        settings = self.config.point_training
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
        for place in self._held_out.spread(rng, self.config.validation_samples):
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
        self.shares = _shares([pair.codes for pair in self.training], self.classes)
        self.weights = _weights(self.shares, self.device)
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
            yield self._said([self._sampler.draw(rng) for _ in range(settings.batch)])

    def validation(self) -> Iterator[Output]:
        """Yield what the model says of fixed patches as they are."""
        rng = np.random.default_rng(self.config.seed)
        yield self._said(self._held_out.spread(rng, self.config.validation_samples))

    def _said(self, patches: Sequence[tuple[Singles, Ints]]) -> Output:
        heights, codes = zip(*patches, strict=True)
        said = self.model(torch.from_numpy(np.stack(heights)).to(self.device))
        flat = said.permute(0, 2, 3, 1).reshape(-1, self.classes)
        return flat, torch.from_numpy(np.stack(codes)).to(self.device).reshape(-1)


def prior_factors(shares: Floats, power: float) -> Floats:
    """Return the factors (classes,) by which probabilities are multiplied before the largest one is taken.

    Cylinders and patches are drawn, and losses weighed, so that rare classes count like common ones. A
    network therefore claims rare classes too often. The factors are powers of the true shares: 0 leaves the
    probabilities as they are, 1 is Bayes' rule for perfect probabilities.
    """
    return np.asarray(np.maximum(shares / shares.max(), 1e-4) ** power)


@dataclass(frozen=True)
class Validation:
    """Mean loss, highest mean IoU 0..1, and the power of :func:`prior_factors` that reaches it."""

    loss: float
    score: float
    power: float


def score_validation(task: Task) -> Validation:
    """Score the validation surveys for every power in :data:`POWERS`."""
    task.model.train(False)
    losses = []
    matrices = np.zeros((len(POWERS), task.classes, task.classes + 1), dtype=np.int64)
    factors = [np.log(prior_factors(task.shares, power)) for power in POWERS]
    with torch.no_grad():
        for output in task.validation():
            losses.append(float(task_loss(output, task.weights).detach()))
            said, true = (tensor.cpu().numpy() for tensor in output)
            for index, factor in enumerate(factors):
                matrices[index] += confusion(true, (said + factor).argmax(axis=1), task.classes)
    task.model.train()
    scores = [nanmean(class_iou(matrix)) for matrix in matrices]
    best = int(np.argmax(scores))
    return Validation(nanmean(np.array(losses)), scores[best], POWERS[best])
