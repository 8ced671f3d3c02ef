"""A smooth residual warp over blocks: what a rigid motion leaves of drift and shear (method, Decision 2).

Off by default. It may follow what many surfaces of neighbouring blocks
agree on, never what one surface says alone: a real change is left as it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import Field
from scipy import sparse
from scipy.sparse.linalg import spsolve

from subiaco_change.level_of_detection.displacement_field import BlockGrid, SmoothField
from subiaco_change.method_numbers import NUMBERS
from subiaco_geo.config import StrictModel
from subiaco_geo.frames import Floats

_ROUNDS = NUMBERS.warp.rounds


class WarpConfig(StrictModel):
    """Residual warp."""

    enabled: bool = Field(False, description="Remove smooth residuals that remain after the rigid transform")
    block: float = Field(20.0, gt=0, description="Distance between the nodes of the warp grid [m]")
    stiffness: float = Field(
        0.02,
        gt=0,
        description="Expected difference of displacement between neighbouring nodes [m]; raise it for a "
        "more flexible warp",
    )
    noise: float = Field(
        0.03, gt=0, description="Standard deviation of a single residual of the warp estimate [m]"
    )
    reach: float = Field(
        0.08,
        gt=0,
        description="Distance of a residual from the smooth field beyond which the residual is change "
        "[m]; smaller than the change limits",
    )
    limit: float = Field(0.25, gt=0, description="Largest displacement of the warp per component [m]")


@dataclass(frozen=True)
class Residuals:
    """Places (N, 3) of surfaces, their unit normals (N, 3), after minus before along them (N,) [m]."""

    xyz: Floats
    normals: Floats
    distance: Floats


def estimate_warp(residuals: Residuals, grid: BlockGrid, config: WarpConfig) -> SmoothField:
    """Fit displacements at the nodes of a grid to residuals along normals.

    Minimises ``sum rho(n . u(p) - d) / noise^2 + sum |u_i - u_j|^2 / stiffness^2``
    over nodes and their neighbours, with ``u`` bilinear between nodes. ``rho``
    is Tukey's biweight whose width shrinks to ``reach`` from round to round,
    while the field is stiff at first: what departs from its surroundings by
    more than ``reach`` ends up without weight.

    Returns
    -------
    SmoothField
        How *before* must move [m], at most ``limit`` a component.
    """
    design = _design(residuals, grid)
    smooth = _smoothness(grid)
    count = design.shape[1]
    u = np.zeros(count)
    for step in range(_ROUNDS):
        progress = min(step / (_ROUNDS - 3), 1.0)
        width = config.reach * 4.0 ** (1.0 - progress)
        stiffness = config.stiffness * 0.25 ** (1.0 - progress)
        left = residuals.distance - design @ u
        weight = np.clip(1.0 - (left / width) ** 2, 0.0, None) ** 2 / config.noise**2
        normal = design.T @ sparse.diags_array(weight) @ design + smooth / stiffness**2
        normal = normal + sparse.eye_array(count) / (10.0 * config.limit) ** 2
        u = spsolve(normal.tocsc(), design.T @ (weight * residuals.distance))
    values = np.clip(u, -config.limit, config.limit).reshape(*grid.shape, 3)
    return SmoothField(grid, values)


def _design(residuals: Residuals, grid: BlockGrid) -> sparse.csr_array:
    """Rows of ``n . u(p)`` (N, 3 nodes): four nodes around every place, three components each."""
    rows, columns = grid.shape
    where = np.clip(grid.nodes(residuals.xyz), 0.0, np.array([[rows - 1], [columns - 1]], dtype=float))
    base = np.minimum(np.floor(where).astype(np.int64), np.array([[max(rows - 2, 0)], [max(columns - 2, 0)]]))
    part = where - base
    n = len(residuals.distance)
    entries, places = [], []
    for dr in (0, 1):
        for dc in (0, 1):
            share = (part[0] if dr else 1.0 - part[0]) * (part[1] if dc else 1.0 - part[1])
            node = np.minimum(base[0] + dr, rows - 1) * columns + np.minimum(base[1] + dc, columns - 1)
            entries.append(share[:, None] * residuals.normals)
            places.append(node[:, None] * 3 + np.arange(3))
    row = np.repeat(np.arange(n), 12)
    shape = (n, rows * columns * 3)
    return sparse.csr_array((np.hstack(entries).ravel(), (row, np.hstack(places).ravel())), shape=shape)


def _smoothness(grid: BlockGrid) -> sparse.csr_array:
    """Sum of squared differences between neighbouring nodes as a matrix (3 nodes, 3 nodes)."""
    number = np.arange(grid.shape[0] * grid.shape[1]).reshape(grid.shape)
    first = np.concatenate([number[:, :-1].ravel(), number[:-1].ravel()])
    second = np.concatenate([number[:, 1:].ravel(), number[1:].ravel()])
    edge = np.arange(len(first))
    ones = np.ones(len(first))
    shape = (len(first), number.size)
    step = sparse.csr_array((ones, (edge, first)), shape=shape) - sparse.csr_array(
        (ones, (edge, second)), shape=shape
    )
    return sparse.csr_array(sparse.kron(step.T @ step, sparse.eye_array(3)))
