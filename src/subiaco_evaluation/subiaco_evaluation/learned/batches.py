"""Several cylinders as one set of tensors: neighbours, kernel influences, nearest points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from subiaco_evaluation.learned.config import PointNetworkConfig
from subiaco_evaluation.learned.kernel_points import kernel_points
from subiaco_evaluation.learned.pyramids import Cylinder, Indices, Level
from subiaco_evaluation.learned.sampling import CylinderPair, Singles, vary
from subiaco_geo.frames import Floats

_FAR = 1e6  # a missing neighbour lies outside every kernel [m]


@dataclass(frozen=True)
class Neighbourhood:
    """Support points of query points.

    Parameters
    ----------
    index : (N, P) int64 tensor
        The number of support points stands for a missing neighbour.
    influence : (N, K, P) float32 tensor
        Weight 0..1 of every neighbour for every kernel point.
    """

    index: Tensor
    influence: Tensor


@dataclass(frozen=True)
class LevelBatch:
    """One grid: neighbours in it, neighbours in the finer grid, nearest point in the coarser grid."""

    own: Neighbourhood
    pooled: Neighbourhood | None
    coarser: Tensor | None
    count: int


@dataclass(frozen=True)
class PairBatch:
    """Cylinders of both clouds; ``nearest`` by level, ``classes`` (N,) of the compared points.

    ``inputs`` are the features (N, 1 + F) of the finest points of both clouds, the constant 1 first.
    """

    reference: tuple[LevelBatch, ...]
    compared: tuple[LevelBatch, ...]
    inputs: tuple[Tensor, Tensor]
    nearest: tuple[Tensor, ...]
    classes: Tensor


def neighbourhood(
    queries: Tensor, support: Tensor, index: Tensor, kernel: Tensor, extent: float
) -> Neighbourhood:
    """Weigh neighbours by a linear function of their distance from the kernel points.

    Parameters
    ----------
    queries, support : (N, 3), (M, 3) tensor
    index : (N, P) int64 tensor
        M where a neighbour is missing.
    kernel : (K, 3) tensor
    extent : float
        Distance at which the influence of a kernel point ends [m].
    """
    reach = torch.cat([support, support.new_full((1, 3), _FAR)])
    offset = reach[index] - queries[:, None]
    squares = (offset**2).sum(dim=2, keepdim=True) + (kernel**2).sum(dim=1)
    distance = squares.add_(offset @ kernel.T, alpha=-2.0).clamp_(min=0.0).sqrt_()
    return Neighbourhood(index, distance.mul_(-1.0 / extent).add_(1.0).clamp_(min=0.0).transpose(1, 2))


def collate(
    cylinders: Sequence[CylinderPair],
    config: PointNetworkConfig,
    turns: Sequence[float] | None = None,
    noises: Sequence[tuple[Floats, Floats]] | None = None,
    device: str = "cpu",
) -> PairBatch:
    """Join cylinders into one batch.

    Parameters
    ----------
    cylinders : sequence of CylinderPair
    config : PointNetworkConfig
    turns : sequence of float, optional
        Turn of both clouds of every cylinder about the vertical axis [rad].
    noises : sequence of (Floats, Floats), optional
        Added to the finest points of both clouds of every cylinder [m].
    device : str
    """
    turns = turns or [0.0] * len(cylinders)
    sides = []
    for side, name in enumerate(("reference", "compared")):
        parts = [getattr(c, name).levels for c in cylinders]
        moved = [
            vary([level.xyz for level in levels], turn, noises[i][side] if noises else np.zeros(3))
            for i, (levels, turn) in enumerate(zip(parts, turns, strict=True))
        ]
        sides.append(_join(parts, moved, config, device))
    counts = [[len(level.xyz) for level in c.reference.levels] for c in cylinders]
    nearest = tuple(
        _stacked([c.nearest[level] for c in cylinders], [row[level] for row in counts], device)
        for level in range(config.levels)
    )
    classes = torch.from_numpy(np.concatenate([c.classes for c in cylinders])).to(device)
    inputs = [_inputs([getattr(c, name) for c in cylinders], device) for name in ("reference", "compared")]
    return PairBatch(sides[0], sides[1], (inputs[0], inputs[1]), nearest, classes)


def _inputs(cylinders: Sequence[Cylinder], device: str) -> Tensor:
    """Return the constant 1 and the features (N, 1 + F) of the finest points."""
    features = torch.from_numpy(np.concatenate([c.features for c in cylinders])).to(device)
    return torch.cat([features.new_ones((len(features), 1)), features], dim=1)


def _stacked(parts: Sequence[Indices], sizes: Sequence[int], device: str) -> Tensor:
    """Join index arrays whose targets of the given sizes are joined too; missing ones become the total."""
    starts, total = np.cumsum([0, *sizes[:-1]]), sum(sizes)
    whole = np.concatenate(
        [np.where(p < 0, total, p.astype(np.int64) + s) for p, s in zip(parts, starts, strict=True)]
    )
    return torch.from_numpy(whole).to(device)


def _join(
    parts: Sequence[tuple[Level, ...]],
    moved: Sequence[Sequence[Singles]],
    config: PointNetworkConfig,
    device: str,
) -> tuple[LevelBatch, ...]:
    levels = []
    sizes = [[len(levels[index].xyz) for levels in parts] for index in range(config.levels)]
    xyz = [torch.from_numpy(np.concatenate([m[i] for m in moved])).to(device) for i in range(config.levels)]
    kernel = torch.from_numpy(kernel_points(config.kernel_points, config.kernel_extent)).float().to(device)
    for index in range(config.levels):
        edge = config.first_grid * 2**index
        own = _stacked([levels_[index].neighbours for levels_ in parts], sizes[index], device)
        pooled = coarser = None
        if index:
            finer = _stacked([levels_[index].pooled for levels_ in parts], sizes[index - 1], device)
            pooled = neighbourhood(xyz[index], xyz[index - 1], finer, kernel * (edge / 2), edge / 2)
        if index + 1 < config.levels:
            coarser = _stacked([levels_[index].coarser for levels_ in parts], sizes[index + 1], device)
        near = neighbourhood(xyz[index], xyz[index], own, kernel * edge, edge)
        levels.append(LevelBatch(near, pooled, coarser, sum(sizes[index])))
    return tuple(levels)
