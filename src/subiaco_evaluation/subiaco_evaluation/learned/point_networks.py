"""Siamese KPConv, Triplet KPConv and EFSKPConv (de Gélis et al. 2023 and 2024)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from subiaco_evaluation.learned.batches import LevelBatch, PairBatch
from subiaco_evaluation.learned.config import PointNetworkConfig
from subiaco_evaluation.learned.kpconv import Bottleneck, Simple, Unary
from subiaco_evaluation.learned.labels import CLASSES

Features = list[Tensor]


def difference(reference: Tensor, compared: Tensor, nearest: Tensor) -> Tensor:
    """Return compared features (N, C) less those of the nearest reference point (N,)."""
    return compared - reference.index_select(0, nearest)


class Stage(nn.Module):
    """Two blocks of one level; the first one goes from the finer to this level, but at the finest level."""

    def __init__(
        self, config: PointNetworkConfig, inputs: int, inner: int, outputs: int, *, first: bool
    ) -> None:
        super().__init__()
        momentum, kernel = config.batch_norm_momentum, config.kernel_points
        self.enter: nn.Module = (
            Simple(kernel, inputs, inner, momentum)
            if first
            else Bottleneck(kernel, inputs, inner, momentum, strided=True)
        )
        self.stay = Bottleneck(kernel, inner, outputs, momentum)

    def forward(self, features: Tensor, level: LevelBatch) -> Tensor:
        """Return features of the points of this level."""
        entered = self.enter(features, level.own if level.pooled is None else level.pooled)
        return self.stay(entered, level.own)


def widths(config: PointNetworkConfig) -> list[int]:
    """Return the number of features after every level of an encoder."""
    return [config.width * 2 ** (index + 1) for index in range(config.levels)]


def encoder(config: PointNetworkConfig, carried: Sequence[int] | None = None) -> nn.ModuleList:
    """Return the stages of an encoder; ``carried`` is the number of features that enter every stage."""
    outputs = widths(config)
    inputs = list(carried or [1 + len(config.features), *outputs[:-1]])
    inner = [config.width, *outputs[:-1]]
    rows = zip(inputs, inner, outputs, strict=True)
    return nn.ModuleList(Stage(config, *row, first=index == 0) for index, row in enumerate(rows))


class Decoder(nn.Module):
    """Nearest upsampling with skip connections, then the classes of every point as log probabilities."""

    def __init__(self, config: PointNetworkConfig, bottom: int, skips: Sequence[int]) -> None:
        super().__init__()
        momentum = config.batch_norm_momentum
        outputs = [config.width * 2**index for index in range(config.levels - 1)]
        layers, current = [], bottom
        for skip, output in zip(reversed(skips), reversed(outputs), strict=True):
            layers.append(Unary(current + skip, output, momentum))
            current = output
        self.layers = nn.ModuleList(layers)
        self.head = nn.Sequential(
            Unary(current, config.width, momentum),
            nn.Dropout(config.dropout),
            nn.Linear(config.width, len(CLASSES)),
        )

    def describe(self, features: Tensor, skips: Features, levels: Sequence[LevelBatch]) -> Tensor:
        """Return the last features (N, width) of the finest points."""
        for layer, skip, level in zip(self.layers, reversed(skips), reversed(levels[:-1]), strict=True):
            assert level.coarser is not None
            features = layer(torch.cat([features.index_select(0, level.coarser), skip], dim=1))
        return torch.as_tensor(self.head[0](features))

    def forward(self, features: Tensor, skips: Features, levels: Sequence[LevelBatch]) -> Tensor:
        """Return log probabilities (N, classes) of the finest points."""
        return torch.log_softmax(self.head[1:](self.describe(features, skips, levels)), dim=1)


class SiameseKpconv(nn.Module):
    """One encoder for both clouds; skips and bottom are differences to the nearest reference point."""

    def __init__(self, config: PointNetworkConfig) -> None:
        super().__init__()
        self.encoder = encoder(config)
        *skips, bottom = widths(config)
        self.decoder = Decoder(config, bottom, skips)

    def forward(self, batch: PairBatch) -> Tensor:
        """Return log probabilities (N, classes) of the compared points."""
        differences = siamese_differences(self.encoder, batch)
        return self.decoder(differences[-1], differences[:-1], batch.compared)


def siamese_differences(stages: nn.ModuleList, batch: PairBatch) -> Features:
    """Return the feature differences of every level of an encoder that both clouds share."""
    sides = []
    for levels, inputs in zip((batch.reference, batch.compared), batch.inputs, strict=True):
        features, found = inputs, []
        for stage, level in zip(stages, levels, strict=True):
            features = stage(features, level)
            found.append(features)
        sides.append(found)
    return [difference(a, b, n) for a, b, n in zip(*sides, batch.nearest, strict=True)]


class TripletKpconv(nn.Module):
    """A shared encoder for both clouds, and a third one that encodes their differences level by level."""

    def __init__(self, config: PointNetworkConfig) -> None:
        super().__init__()
        self.encoder = encoder(config)
        outputs = widths(config)
        self.changes = nn.ModuleList(
            Stage(config, inputs, outputs[index], outputs[index + 1], first=False)
            for index, inputs in enumerate([outputs[0], *(2 * width for width in outputs[1:-1])])
        )
        *skips, bottom = outputs
        self.decoder = Decoder(config, 2 * bottom, skips)

    def forward(self, batch: PairBatch) -> Tensor:
        """Return log probabilities (N, classes) of the compared points."""
        differences = siamese_differences(self.encoder, batch)
        features = differences[0]
        for stage, level, new in zip(self.changes, batch.compared[1:], differences[1:], strict=True):
            features = torch.cat([stage(features, level), new], dim=1)
        return self.decoder(features, differences[:-1], batch.compared)


class EfsKpconv(nn.Module):
    """Own encoders for both clouds; that of the compared cloud takes in the difference after every level."""

    def __init__(self, config: PointNetworkConfig) -> None:
        super().__init__()
        outputs = widths(config)
        self.encoder = encoder(config)
        self.fused = encoder(config, [1 + len(config.features), *(2 * width for width in outputs[:-1])])
        *skips, bottom = (2 * width for width in outputs)
        self.decoder = Decoder(config, bottom, skips)

    def encode(self, batch: PairBatch) -> Features:
        """Return the features of the compared points of every level, fused with their differences."""
        old, new = batch.inputs
        found = []
        for index, near in enumerate(batch.nearest):
            old = self.encoder[index](old, batch.reference[index])
            own = self.fused[index](new, batch.compared[index])
            new = torch.cat([own, difference(old, own, near)], dim=1)
            found.append(new)
        return found

    def forward(self, batch: PairBatch) -> Tensor:
        """Return log probabilities (N, classes) of the compared points."""
        *skips, bottom = self.encode(batch)
        return self.decoder(bottom, skips, batch.compared)


class DeepClusteringKpconv(EfsKpconv):
    """DC3DCD: an EFSKPConv that predicts clusters of its own features; every cluster has one class.

    The last layer holds the prototypes of the clusters, which the training sets and no gradient moves.
    ``class_of`` (clusters, classes) is 1 at the class of a cluster.
    """

    class_of: Tensor

    def __init__(self, config: PointNetworkConfig) -> None:
        super().__init__(config)
        self.prototypes = nn.Linear(config.width, config.clusters, bias=False).requires_grad_(False)
        self.decoder.head = nn.Sequential(self.decoder.head[0])
        self.temperature = config.temperature
        self.register_buffer("class_of", torch.eye(len(CLASSES))[torch.zeros(config.clusters).long()])

    def describe(self, batch: PairBatch) -> Tensor:
        """Return the last features (N, width), of length 1."""
        *skips, bottom = self.encode(batch)
        return nn.functional.normalize(self.decoder.describe(bottom, skips, batch.compared), dim=1)

    def clusters(self, batch: PairBatch) -> Tensor:
        """Return log probabilities (N, clusters) of the compared points."""
        return torch.log_softmax(self.prototypes(self.describe(batch)) / self.temperature, dim=1)

    def forward(self, batch: PairBatch) -> Tensor:
        """Return log probabilities (N, classes) of the compared points."""
        return (self.clusters(batch).exp() @ self.class_of).clamp_min(1e-9).log()


#: Networks by the name of the method.
POINT_NETWORKS: dict[str, Callable[[PointNetworkConfig], nn.Module]] = {
    "siamese-kpconv": SiameseKpconv,
    "triplet-kpconv": TripletKpconv,
    "efs-kpconv": EfsKpconv,
    "dc3dcd": DeepClusteringKpconv,
}
