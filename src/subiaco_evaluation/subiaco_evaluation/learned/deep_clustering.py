"""DC3DCD (de Gélis et al. 2024): an EFSKPConv that learns clusters of its own features, without labels."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import islice

import numpy as np
import torch
from torch import Tensor

from subiaco_evaluation.learned.batches import collate
from subiaco_evaluation.learned.labels import CLASSES
from subiaco_evaluation.learned.point_networks import DeepClusteringKpconv
from subiaco_evaluation.learned.sampling import CylinderPair, Place
from subiaco_evaluation.learned.tasks import Output, PointTask
from subiaco_geo.frames import Ints


class ClusterTask(PointTask):
    """Pseudo-labels by k-means at the start of every epoch; labels only name the clusters."""

    model: DeepClusteringKpconv

    def __post_init__(self) -> None:
        super().__post_init__()
        self._class_weights = self.weights

    def steps(self, rng: np.random.Generator) -> Iterator[Output]:
        """Yield what the model says of the clusters of evenly drawn cylinders."""
        settings = self.config.point_training
        cylinders = self._cut(self._sampler.draw_evenly(rng, 2 * settings.samples), settings.samples)
        features = [self._described(cylinder) for cylinder in cylinders]
        centres, labels = spherical_k_means(
            torch.cat(features), self.config.point_network.clusters, settings.cluster_iterations, rng
        )
        with torch.no_grad():
            self.model.prototypes.weight.copy_(centres)
        share = torch.bincount(labels, minlength=len(centres)) / len(labels)
        self.weights = 1.0 - share
        own = list(zip(cylinders, labels.split([len(f) for f in features]), strict=True))
        order = [own[index] for index in rng.permutation(len(own))]
        for start in range(0, len(order), settings.batch):
            few = order[start : start + settings.batch]
            batch = self._varied(rng, [cylinder for cylinder, _ in few])
            yield self.model.clusters(batch), torch.cat([label for _, label in few])

    def validation(self) -> Iterator[Output]:
        """Name the clusters by labelled cylinders, then yield what the model says of fixed cylinders."""
        self._name_clusters()
        self.weights = self._class_weights
        yield from super().validation()

    def _name_clusters(self) -> None:
        """Give every cluster the class of most of its labelled points; unchanged where there are none."""
        size = self.config.point_network.clusters
        labelled = self.config.point_training.labelled
        rng = np.random.default_rng(self.config.seed)
        votes = torch.zeros((size, len(CLASSES)), device=self.device)
        for cylinder in self._cut(self._sampler.draw_evenly(rng, 2 * labelled), labelled):
            batch = collate([cylinder], self.config.point_network, device=self.device)
            known = batch.classes >= 0
            cluster = self.model.clusters(batch).argmax(dim=1)[known]
            flat = cluster * len(CLASSES) + batch.classes[known]
            votes += torch.bincount(flat, minlength=votes.numel()).reshape(votes.shape)
        self.model.class_of.copy_(torch.nn.functional.one_hot(votes.argmax(dim=1), len(CLASSES)))

    def _cut(self, places: Sequence[Place], count: int) -> list[CylinderPair]:
        cut = (self._sampler.cut(place) for place in places)
        return list(islice((cylinder for cylinder in cut if cylinder is not None), count))

    def _described(self, cylinder: CylinderPair) -> Tensor:
        """Return the features (N, width) of the compared points as they are."""
        self.model.train(False)
        with torch.no_grad():
            found = self.model.describe(collate([cylinder], self.config.point_network, device=self.device))
        self.model.train()
        return found


def spherical_k_means(
    features: Tensor, count: int, iterations: int, rng: np.random.Generator
) -> tuple[Tensor, Tensor]:
    """Return centres (count, C) of length 1, and the cluster (N,) of features (N, C) of length 1.

    A cluster that loses all its points gets a random point.
    """
    centres = features[torch.from_numpy(rng.permutation(len(features))[:count]).to(features.device)].clone()
    labels = (features @ centres.T).argmax(dim=1)
    for _ in range(iterations):
        total = torch.zeros_like(centres).index_add_(0, labels, features)
        empty = torch.bincount(labels, minlength=len(centres)) == 0
        spare: Ints = rng.integers(len(features), size=int(empty.sum()))
        total[empty] = features[torch.from_numpy(spare).to(features.device)]
        centres = torch.nn.functional.normalize(total, dim=1)
        labels = (features @ centres.T).argmax(dim=1)
    return centres, labels
