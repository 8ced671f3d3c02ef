"""Kernel point convolution and the blocks made of it (Thomas et al. 2019), in plain PyTorch."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from subiaco_evaluation.learned.batches import Neighbourhood

_SLOPE = 0.1  # of the leaky rectifier


def gather(features: Tensor, index: Tensor) -> Tensor:
    """Return the features (N, P, C) of neighbours (N, P); a missing neighbour has zeros."""
    padded = torch.cat([features, features.new_zeros((1, features.shape[1]))])
    return padded.index_select(0, index.reshape(-1)).reshape(*index.shape, features.shape[1])


class KernelPointConvolution(nn.Module):
    """Rigid convolution: features of neighbours, weighed by kernel points, times their matrices."""

    def __init__(self, kernel: int, inputs: int, outputs: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(kernel * inputs, outputs))
        bound = 1.0 / math.sqrt(inputs * outputs)  # as the original's uniform initialisation
        nn.init.uniform_(self.weight, -bound, bound)

    def forward(self, features: Tensor, near: Neighbourhood) -> Tensor:
        """Return features (N, outputs) of the query points."""
        weighed = torch.bmm(near.influence, gather(features, near.index))
        return weighed.flatten(1) @ self.weight


class Unary(nn.Module):
    """Linear layer on single points, batch normalisation, and a leaky rectifier where it is active."""

    def __init__(self, inputs: int, outputs: int, momentum: float, *, active: bool = True) -> None:
        super().__init__()
        self.linear = nn.Linear(inputs, outputs, bias=False)
        self.norm = nn.BatchNorm1d(outputs, momentum=momentum)
        self.active = active

    def forward(self, features: Tensor) -> Tensor:
        """Return features (N, outputs)."""
        normed = self.norm(self.linear(features))
        return nn.functional.leaky_relu(normed, _SLOPE) if self.active else normed


class Simple(nn.Module):
    """Kernel point convolution, batch normalisation, leaky rectifier."""

    def __init__(self, kernel: int, inputs: int, outputs: int, momentum: float) -> None:
        super().__init__()
        self.convolution = KernelPointConvolution(kernel, inputs, outputs)
        self.norm = nn.BatchNorm1d(outputs, momentum=momentum)

    def forward(self, features: Tensor, near: Neighbourhood) -> Tensor:
        """Return features (N, outputs) of the query points."""
        return nn.functional.leaky_relu(self.norm(self.convolution(features, near)), _SLOPE)


class Bottleneck(nn.Module):
    """Residual block that convolves a quarter of the features; where strided, its shortcut is max-pooled."""

    def __init__(
        self, kernel: int, inputs: int, outputs: int, momentum: float, *, strided: bool = False
    ) -> None:
        super().__init__()
        inner = max(outputs // 4, 1)
        self.strided = strided
        self.enter = Unary(inputs, inner, momentum) if inputs != inner else nn.Identity()
        self.convolution = Simple(kernel, inner, inner, momentum)
        self.leave = Unary(inner, outputs, momentum)
        self.shortcut = Unary(inputs, outputs, momentum, active=False) if inputs != outputs else nn.Identity()

    def forward(self, features: Tensor, near: Neighbourhood) -> Tensor:
        """Return features (N, outputs) of the query points."""
        straight = gather(features, near.index).amax(dim=1) if self.strided else features
        bent = self.leave(self.convolution(self.enter(features), near))
        return bent + self.shortcut(straight)
