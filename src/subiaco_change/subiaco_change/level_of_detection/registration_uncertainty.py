"""Uncertainty of the registration as a field over the map (method, Decision 2)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import Field
from scipy.spatial import cKDTree
from scipy.special import ndtri

from subiaco_change.level_of_detection.common_frame import BlockGrid
from subiaco_change.level_of_detection.displacement_lod import Displacements
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.quantiles import quantile_of
from subiaco_change.records import Registration
from subiaco_change.segmentation.ground_model import Mask
from subiaco_geo.clouds import PointCloud, stable_order
from subiaco_geo.config import StrictModel
from subiaco_geo.frames import Floats, Ints

_STEEP = NUMBERS.registration_uncertainty.level_normal


class UncertaintyConfig(StrictModel):
    """Uncertainty of the registration over the city."""

    block: float = Field(
        20.0, gt=0, description="Edge of the blocks in which registration residuals share a bias [m]"
    )
    spacing: float = Field(
        2.0, gt=0, description="Distance between residuals on one surface that count as independent [m]"
    )
    min_residuals: int = Field(
        40,
        ge=5,
        description="Number of residuals that a block needs; blocks with fewer use those of their neighbours",
    )
    roughness: float = Field(
        0.08,
        gt=0,
        description="Largest roughness in either epoch of surfaces whose residuals enter sigma_reg [m]",
    )
    quantile: float = Field(
        0.7,
        gt=0.3,
        lt=1,
        description="Quantile of the absolute residuals that determines the bias of a block, as a "
        "fraction; larger residuals may be change",
    )
    floor: float = Field(0.003, ge=0, description="Smallest value of sigma_reg [m]")
    pose_covariance: bool = Field(
        True,
        description="Add the pose covariances of the maps to sigma_reg, and unstated_pose for epochs "
        "without them",
    )
    unstated_pose: float = Field(
        0.04,
        ge=0,
        description="Position standard deviation of an epoch without pose covariances (a bare cloud) [m], "
        "never less than that of the other epoch; raise it for surveys without RTK",
    )


@dataclass(frozen=True)
class EpochPoseErrors:
    """Covariances of the poses of one epoch in the common frame.

    ``positions`` (M, 3) [m]; ``covariances`` (M, 6, 6), rotation first [rad, m].
    """

    positions: Floats
    covariances: Floats

    def variance(self, xyz: Floats, normals: Floats) -> Floats:
        """Return the variance (N,) along normals [m2] that the nearest pose gives points (N, 3)."""
        _, pose = cKDTree(self.positions).query(xyz)
        return _along(xyz - self.positions[pose], normals, self.covariances[pose])


@dataclass(frozen=True)
class UnstatedPoses:
    """Standard deviation ``sigma`` [m] of the positions of an epoch whose poses are not known."""

    sigma: float

    def variance(self, xyz: Floats, normals: Floats) -> Floats:
        """Return the variance (N,) along unit normals [m2] at points (N, 3): the same everywhere."""
        return np.asarray(self.sigma**2 * np.ones(len(xyz)) * np.einsum("ni,ni->n", normals, normals))


Poses = EpochPoseErrors | UnstatedPoses


def unstated_poses(stated: Sequence[EpochPoseErrors], default: float) -> UnstatedPoses:
    """Return what holds of an epoch without covariances: a default [m], or what the other epoch states."""
    spread = [float(np.median(np.trace(p.covariances[:, 3:, 3:], axis1=1, axis2=2)) / 3.0) for p in stated]
    return UnstatedPoses(float(np.sqrt(max([default**2, *spread]))))


def pose_errors(positions: Floats, covariances: Floats, T_frame_map: Floats) -> EpochPoseErrors:
    """Bring the pose covariances of a map into the common frame.

    Parameters
    ----------
    positions : (M, 3) float64
        In the world of the map [m].
    covariances : (M, 6, 6) float64
        Rotation first [rad, m].
    T_frame_map : (4, 4) float64
        From world coordinates of the map to the common frame.
    """
    rotation = T_frame_map[:3, :3]
    turn = np.kron(np.eye(2), rotation)
    return EpochPoseErrors(positions @ rotation.T + T_frame_map[:3, 3], turn @ covariances @ turn.T)


def _along(lever: Floats, normals: Floats, covariance: Floats) -> Floats:
    """Variance (N,) along normals at levers (N, 3) from covariances (6, 6) or (N, 6, 6)."""
    rows = np.hstack([np.cross(lever, normals), normals])
    each = np.broadcast_to(covariance, (len(rows), 6, 6))
    return np.maximum(np.einsum("ni,nij,nj->n", rows, each, rows), 0.0)


@dataclass(frozen=True)
class SigmaField:
    """sigma_reg at every place and along every normal.

    Parameters
    ----------
    grid : BlockGrid
    bias : (blocks, 2) float64
        What the epochs lie apart, block by block, on surfaces that stand and
        that lie, beyond the noise of their points: standard deviation [m].
    count : (blocks, 2) int64
        Residuals of the block itself.
    covariance : (6, 6) float64
        Of the rigid transform about ``centre`` (3,), rotation first [rad, m].
    poses : tuple of Poses
        Of both epochs; of one that states none, a default.
    floor : float
        [m].
    """

    grid: BlockGrid
    bias: Floats
    count: Ints
    covariance: Floats
    centre: Floats
    poses: tuple[Poses, ...]
    floor: float

    def at(self, xyz: Floats, normals: Floats) -> Floats:
        """Return sigma_reg (N,) [m] at points (N, 3) along normals (N, 3).

        The larger of what the transform is known to and what the block shows,
        not below the floor; pose covariances join in quadrature.
        """
        block = self.grid.block_of(xyz)
        up = normals[:, 2] ** 2
        shown = (1.0 - up) * self.bias[block, 0] ** 2 + up * self.bias[block, 1] ** 2
        rigid = _along(xyz - self.centre, normals, self.covariance)
        variance = np.maximum(np.maximum(shown, rigid), self.floor**2)
        for poses in self.poses:
            variance = variance + poses.variance(xyz, normals)
        return np.asarray(np.sqrt(variance))


@dataclass(frozen=True)
class BiasSamples:
    """Residuals that tell what the epochs lie apart.

    Places (N, 3), whether the surface lies (N,), distance (N,) [m], variance of its noise (N,) [m2].
    """

    xyz: Floats
    lies: Mask
    distance: Floats
    variance: Floats


def bias_samples(
    cloud: PointCloud, found: Displacements, config: UncertaintyConfig, exclude: Mask | None = None
) -> BiasSamples:
    """Choose the residuals of one epoch that tell of the registration."""
    chosen = spread_residuals(cloud, found, config, exclude)
    lies = _lies(np.asarray(cloud.fields["normals"])[chosen])
    return BiasSamples(cloud.xyz[chosen], lies, found.distance[chosen], found.variance[chosen])


def join_samples(samples: Sequence[BiasSamples]) -> BiasSamples:
    """Concatenate samples."""
    names = BiasSamples.__dataclass_fields__
    return BiasSamples(*(np.concatenate([getattr(s, name) for s in samples]) for name in names))


def sigma_of(
    samples: BiasSamples,
    grid: BlockGrid,
    origin: Floats,
    registration: Registration,
    config: UncertaintyConfig,
    poses: tuple[Poses, ...] = (),
) -> SigmaField:
    """Estimate sigma_reg on a grid from samples of both epochs; ``origin`` (3,) of the common frame.

    Residuals nearby are correlated: a drift, a shear or a doubled facade
    moves them together, and no pose covariance knows. What blocks show beyond
    the noise of the cylinder means is taken as the standard deviation of the
    registration there. It rests on a quantile, so that real change in a
    smaller share of a block does not widen it.
    """
    block = grid.block_of(samples.xyz)
    per_kind = [
        _block_bias(block[of], samples.distance[of], samples.variance[of], grid, config)
        for of in (~samples.lies, samples.lies)
    ]
    bias = np.column_stack([kind[0] for kind in per_kind])
    count = np.column_stack([kind[1] for kind in per_kind])
    return SigmaField(
        grid, bias, count, np.diag(registration.pose_std**2),
        registration.origin - origin, poses, config.floor,
    )  # fmt: skip


def spread_residuals(
    cloud: PointCloud, found: Displacements, config: UncertaintyConfig, exclude: Mask | None = None
) -> Ints:
    """Choose points (K,) whose displacements tell of the registration: smooth surfaces, well spread."""
    keep = np.isfinite(found.distance) & (np.maximum(found.own.std, found.other.std) <= config.roughness)
    if exclude is not None:
        keep &= ~exclude
    chosen = np.flatnonzero(keep)
    lies = _lies(np.asarray(cloud.fields["normals"])[chosen])
    cell = np.floor(cloud.xyz[chosen] / config.spacing).astype(np.int64)
    cell[lies, 2] = 0
    order = np.lexsort((lies, *cell.T))
    rows = np.column_stack([cell, lies])[order]
    fresh = np.flatnonzero(np.concatenate([[True], (rows[1:] != rows[:-1]).any(axis=1)])[: len(rows)])
    middle = (fresh + np.append(fresh[1:], len(rows))) // 2 if len(rows) else fresh
    return np.asarray(chosen[order[middle]])


def _lies(normals: Floats) -> Mask:
    return np.asarray(np.abs(normals[:, 2]) > _STEEP)


def _block_bias(
    block: Ints, distance: Floats, variance: Floats, grid: BlockGrid, config: UncertaintyConfig
) -> tuple[Floats, Ints]:
    """Bias (blocks,) [m] and residuals (blocks,); thin blocks borrow from neighbours, then from all."""
    size = grid.shape[0] * grid.shape[1]
    count: Ints = np.bincount(block, minlength=size)
    overall = _excess(distance, variance, config.quantile)
    bias = np.full(size, overall)
    order = stable_order(block)
    starts = np.searchsorted(block[order], np.arange(size + 1))
    for b in range(size):
        members = order[starts[b] : starts[b + 1]]
        if len(members) < config.min_residuals:
            near = _neighbours(b, grid.shape)
            members = np.concatenate([order[starts[n] : starts[n + 1]] for n in near])
        if len(members) >= config.min_residuals:
            bias[b] = _excess(distance[members], variance[members], config.quantile)
    return bias, count


def _neighbours(block: int, shape: tuple[int, int]) -> list[int]:
    row, column = divmod(block, shape[1])
    return [
        r * shape[1] + c
        for r in range(max(row - 1, 0), min(row + 2, shape[0]))
        for c in range(max(column - 1, 0), min(column + 2, shape[1]))
    ]


def _excess(distance: Floats, variance: Floats, quantile: float) -> float:
    """Return tau [m] so that ``quantile`` of |d| / sqrt(variance + tau^2) is that of a normal variable."""
    if len(distance) == 0:
        return 0.0
    target = float(ndtri(0.5 + 0.5 * quantile))
    size = np.abs(distance)
    low, high = 0.0, float(size.max()) + 1e-6
    for _ in range(24):
        middle = 0.5 * (low + high)
        wide = quantile_of(size / np.sqrt(variance + middle**2 + 1e-12), quantile) > target
        low, high = (middle, high) if wide else (low, middle)
    return high if low > 0.0 else 0.0
