"""Fully convolutional networks on two surface models: early fusion and Siamese differences (Daudt 2018)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

from subiaco_evaluation.learned.config import RasterNetworkConfig

_LABELS = 5


def _convolutions(sizes: Sequence[int], dropout: float) -> nn.Sequential:
    """Return 3x3 convolutions from the first to the last number of features."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(sizes):
        layers += [
            nn.Conv2d(inputs, outputs, 3, padding=1),
            nn.BatchNorm2d(outputs),
            nn.ReLU(),
            nn.Dropout2d(dropout),
        ]
    return nn.Sequential(*layers)


class _Encoder(nn.Module):
    """Four levels of convolutions, each followed by max-pooling."""

    def __init__(self, inputs: int, width: int, dropout: float) -> None:
        super().__init__()
        w = width
        sizes = ((inputs, w, w), (w, 2 * w, 2 * w), (2 * w, *[4 * w] * 3), (4 * w, *[8 * w] * 3))
        self.levels = nn.ModuleList(_convolutions(row, dropout) for row in sizes)

    def forward(self, raster: Tensor) -> list[Tensor]:
        """Return the features of every level, and the pooled ones of the last."""
        found = []
        for level in self.levels:
            features = level(raster)
            raster = nn.functional.max_pool2d(features, 2)
            found.append(features)
        return [*found, raster]


class _Decoder(nn.Module):
    """Transposed convolutions with skip connections, then log probabilities of the five labels."""

    def __init__(self, width: int, dropout: float) -> None:
        super().__init__()
        w = width
        depths = (8 * w, 4 * w, 2 * w, w)
        self.up = nn.ModuleList(nn.ConvTranspose2d(d, d, 3, 2, padding=1, output_padding=1) for d in depths)
        sizes = ((16 * w, 8 * w, 8 * w, 4 * w), (8 * w, 4 * w, 4 * w, 2 * w), (4 * w, 2 * w, w), (2 * w, w))
        self.levels = nn.ModuleList(_convolutions(row, dropout) for row in sizes)
        self.last = nn.Conv2d(w, _LABELS, 3, padding=1)

    def forward(self, bottom: Tensor, skips: Sequence[Tensor]) -> Tensor:
        """Return log probabilities (B, 5, rows, columns)."""
        features = bottom
        for up, level, skip in zip(self.up, self.levels, reversed(skips), strict=True):
            features = level(torch.cat([up(features), skip], dim=1))
        return torch.log_softmax(self.last(features), dim=1)


class EarlyFusion(nn.Module):
    """FC-EF: both surface models are channels of one input."""

    def __init__(self, config: RasterNetworkConfig) -> None:
        super().__init__()
        self.encoder = _Encoder(2, config.width, config.dropout)
        self.decoder = _Decoder(config.width, config.dropout)

    def forward(self, heights: Tensor) -> Tensor:
        """Return log probabilities (B, 5, rows, columns) of surface models (B, 2, rows, columns)."""
        *skips, bottom = self.encoder(heights)
        return self.decoder(bottom, skips)


class SiameseDifference(nn.Module):
    """FC-Siam-diff: one encoder for both surface models; skips are absolute or signed differences."""

    def __init__(self, config: RasterNetworkConfig) -> None:
        super().__init__()
        self.signed = config.skips == "signed"
        self.encoder = _Encoder(1, config.width, config.dropout)
        self.decoder = _Decoder(config.width, config.dropout)

    def forward(self, heights: Tensor) -> Tensor:
        """Return log probabilities (B, 5, rows, columns) of surface models (B, 2, rows, columns)."""
        sides = [self.encoder(heights[:, epoch : epoch + 1]) for epoch in (0, 1)]
        skips = [b - a for a, b in zip(sides[0][:-1], sides[1][:-1], strict=True)]
        skips = skips if self.signed else [skip.abs() for skip in skips]
        return self.decoder(sides[1][-1], skips)


#: Networks by the name of the method.
RASTER_NETWORKS: dict[str, Callable[[RasterNetworkConfig], nn.Module]] = {
    "dsm-fc-ef": EarlyFusion,
    "dsm-siamese": SiameseDifference,
}
