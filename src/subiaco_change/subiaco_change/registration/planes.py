"""Planes of facades and ground in both epochs, and the plane-to-plane term (method B4)."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from subiaco_change.geometry import Level
from subiaco_change.method_numbers import NUMBERS
from subiaco_geo.clouds import stable_order
from subiaco_geo.frames import Floats, Ints, transform_points

_BLOCK = NUMBERS.planes.block
_THICK = NUMBERS.planes.thickness
_ALIKE = NUMBERS.planes.parallel
_LEAST = NUMBERS.planes.fewest_points
_PLANES = NUMBERS.planes.planes
_SAMPLES = NUMBERS.planes.samples


@dataclass(frozen=True)
class Planes:
    """Planes of one epoch: unit normals (K, 3), z >= 0, and centroids (K, 3) [m]."""

    normals: Floats
    centres: Floats


@dataclass(frozen=True)
class PlanePairs:
    """Normals (M, 3) of the same planes in both epochs, each in its own frame, and the weight lambda."""

    before: Floats
    after: Floats
    weight: float


@numba.njit(cache=True)
def _label(
    points: Floats,
    normals: Floats,
    starts: Ints,
    draws: Floats,
    thickness: float,
    parallel: float,
    fewest: int,
) -> Ints:
    """Give each point the number (N,) of its plane, -1 for none; blocks are runs between starts.

    A sample is one point with its normal; the plane with most points is
    taken out and the search repeated.
    """
    label = np.full(len(points), -1, np.int64)
    planes = 0
    for block in range(len(starts) - 1):
        low, high = starts[block], starts[block + 1]
        for plane in range(draws.shape[1]):
            best, most = -1, fewest - 1
            for draw in draws[block, plane]:
                s = low + int(draw * (high - low))
                if label[s] < 0:
                    count = 0
                    for p in range(low, high):
                        count += label[p] < 0 and _lies_in(points, normals, p, s, thickness, parallel)
                    if count > most:
                        best, most = s, count
            if best < 0:
                break
            for p in range(low, high):
                if label[p] < 0 and _lies_in(points, normals, p, best, thickness, parallel):
                    label[p] = planes
            planes += 1
    return label


@numba.njit(cache=True, inline="always")
def _lies_in(points: Floats, normals: Floats, p: int, s: int, thickness: float, parallel: float) -> bool:
    """Tell whether point p lies in the plane of point s."""
    away, cosine = 0.0, 0.0
    for axis in range(3):
        away += normals[s, axis] * (points[p, axis] - points[s, axis])
        cosine += normals[s, axis] * normals[p, axis]
    return abs(away) < thickness and abs(cosine) > parallel


def extract_planes(level: Level, seed: int) -> Planes:
    """Find planes of facades and ground by RANSAC, block by block; the same seed gives the same planes."""
    steep = np.abs(level.planes.normals[:, 2])
    flat = level.planes.curvature < 0.03
    found = [_extract(level, flat & kind, seed) for kind in (steep < 0.25, steep > 0.9)]
    return Planes(np.vstack([p.normals for p in found]), np.vstack([p.centres for p in found]))


def _extract(level: Level, chosen: NDArray[np.bool_], seed: int) -> Planes:
    xyz, normals = level.xyz[chosen], level.planes.normals[chosen]
    if len(xyz) == 0:
        return Planes(np.zeros((0, 3)), np.zeros((0, 3)))
    ij = np.floor(xyz[:, :2] / _BLOCK).astype(np.int64)
    block = (ij[:, 0] << 32) + ij[:, 1]
    order = stable_order(block)
    starts = np.append(np.unique(block[order], return_index=True)[1], len(xyz))
    draws = np.random.default_rng(seed).random((len(starts) - 1, _PLANES, _SAMPLES))
    xyz = xyz[order]
    label = _label(xyz, normals[order], starts, draws, _THICK, _ALIKE, _LEAST)
    return _fit(xyz[label >= 0], label[label >= 0])


def _fit(xyz: Floats, label: Ints) -> Planes:
    """Least-squares planes of labelled points (N, 3), labels 0 to K - 1."""
    count = np.bincount(label)
    centres = np.column_stack([np.bincount(label, column) for column in xyz.T]) / count[:, None]
    offset = xyz - centres[label]
    scatter = np.stack([np.bincount(label, a * b, len(count)) for a in offset.T for b in offset.T], axis=1)
    normals = np.linalg.eigh(scatter.reshape(-1, 3, 3))[1][:, :, 0]
    return Planes(np.where(normals[:, 2:] < 0, -normals, normals), centres)


def match_planes(before: Planes, after: Planes, pose: Floats, weight: float) -> PlanePairs:
    """Pair planes that are nearly the same at a pose ``T_after_before``; ``weight`` is lambda."""
    if len(before.centres) == 0 or len(after.centres) == 0:
        return PlanePairs(np.zeros((0, 3)), np.zeros((0, 3)), weight)
    moved, turned = transform_points(pose, before.centres), before.normals @ pose[:3, :3].T
    _, near = KDTree(after.centres).query(moved, k=min(8, len(after.centres)))
    near = near.reshape(len(moved), -1)
    cosine = np.einsum("kj,knj->kn", turned, after.normals[near])
    offset = after.centres[near] - moved[:, None]
    away = np.abs(np.einsum("knj,knj->kn", offset, after.normals[near]))
    same = (np.abs(cosine) > np.cos(np.radians(5.0))) & (away < 0.3)
    same &= np.linalg.norm(offset, axis=2) < 0.5 * _BLOCK
    row = np.flatnonzero(same.any(axis=1))
    column = same[row].argmax(axis=1)
    sign = np.sign(cosine[row, column])
    return PlanePairs(before.normals[row], after.normals[near[row, column]] * sign[:, None], weight)


def normal_equations(pairs: PlanePairs, rotation: Floats) -> tuple[Floats, Floats]:
    """Hessian (3, 3) and gradient (3,) of ``weight * sum |R n_b - n_a|^2 / 2`` by a left turn [rad]."""
    turned = pairs.before @ rotation.T
    hessian = len(turned) * np.eye(3) - turned.T @ turned  # sum of -[n]x [n]x of unit normals
    gradient = -np.cross(turned, pairs.after).sum(axis=0)
    return pairs.weight * hessian, pairs.weight * gradient
