"""Planar patches: connected points that share a tangent plane (method, parts C3 and C4)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from subiaco_change.segmentation.clustering import connect
from subiaco_change.segmentation.features import Features
from subiaco_change.segmentation.ground_model import Mask
from subiaco_geo.frames import Floats, Ints

_HALF_PLANE = 1 << 14  # cells on either side of a patch's centre


@dataclass(frozen=True)
class Patches:
    """Planar patches of a cloud.

    ``label`` (N,) is -1 for points of none; ``normal`` (P, 3), ``centre``
    (P, 3) [m], ``area`` (P,) [m2] of occupied cells in the plane, ``inner``
    (P,) [m2] of those whose four neighbours are occupied too (none in a bundle of wires), and
    ``residual`` (P,) the root mean square distance to the plane [m]. ``rise`` (P,) is the standard
    deviation of the heights once their slope along the patch is taken out [m]: little for a bundle of
    wires, however steep or long; ``width`` (P,) that along the horizontal of the plane [m].
    """

    label: Ints
    normal: Floats
    centre: Floats
    area: Floats
    inner: Floats
    residual: Floats
    rise: Floats
    width: Floats


def planar_patches(
    xyz: Floats, features: Features, candidate: Mask, angle_deg: float, offset: float, cell: float
) -> Patches:
    """Join neighbouring candidate points whose normals agree and that lie in each other's plane.

    Parameters
    ----------
    xyz : (N, 3) float64 [m]
    features : Features
    candidate : (N,) bool
    angle_deg : float
        Largest angle between the normals of neighbours [deg].
    offset : float
        Largest distance of a neighbour from the tangent plane [m].
    cell : float
        Edge of the cells in which areas are counted [m].
    """
    edges = _smooth_edges(xyz, features, candidate, angle_deg, offset)
    component = connect(len(xyz), edges)
    sizes = np.bincount(component)
    keep = candidate & (sizes[component] >= 4)
    label = np.full(len(xyz), -1, dtype=np.int64)
    _, label[keep] = np.unique(component[keep], return_inverse=True)
    return _measure(xyz, label, cell)


def _smooth_edges(xyz: Floats, features: Features, candidate: Mask, angle_deg: float, offset: float) -> Ints:
    columns = features.neighbours[:, 1:9]
    source = np.repeat(np.flatnonzero(candidate), columns.shape[1])
    target = columns[candidate].ravel().astype(np.int64)
    inside = candidate[target]
    source, target = source[inside], target[inside]
    normals = features.normals
    aligned = np.abs(np.einsum("ij,ij->i", normals[source], normals[target])) > np.cos(np.radians(angle_deg))
    source, target = source[aligned], target[aligned]
    step = np.abs(np.einsum("ij,ij->i", normals[source], xyz[target] - xyz[source]))
    near = step < offset
    return np.stack([source[near], target[near]], axis=1)


def _measure(xyz: Floats, label: Ints, cell: float) -> Patches:
    inside = label >= 0
    points, own = xyz[inside], label[inside]
    count = int(own.max(initial=-1)) + 1
    sizes = np.maximum(np.bincount(own, minlength=count), 1)
    centre = np.stack([np.bincount(own, points[:, i], count) / sizes for i in range(3)], axis=1)
    delta = points - centre[own]
    covariance = np.empty((count, 3, 3))
    for i in range(3):
        for j in range(3):
            covariance[:, i, j] = np.bincount(own, delta[:, i] * delta[:, j], count) / sizes
    values, vectors = np.linalg.eigh(covariance)
    normal = vectors[:, :, 0]
    residual = np.sqrt(np.maximum(values[:, 0], 0.0))
    area, inner = _plane_area(delta, own, normal, cell)
    return Patches(label, normal, centre, area, inner, residual, *_rise_and_width(covariance, normal))


def _rise_and_width(covariance: Floats, normal: Floats) -> tuple[Floats, Floats]:
    """Return the standard deviations (P,) of heights about a line along each plane, and along that line."""
    along = np.stack([-normal[:, 1], normal[:, 0]], axis=1)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    spread = np.einsum("pi,pij,pj->p", along, covariance[:, :2, :2], along)
    slope = np.einsum("pi,pi->p", along, covariance[:, :2, 2])
    rise = np.sqrt(np.maximum(covariance[:, 2, 2] - slope**2 / np.maximum(spread, 1e-12), 0.0))
    return rise, np.sqrt(np.maximum(spread, 0.0))


def _plane_area(delta: Floats, own: Ints, normal: Floats, cell: float) -> tuple[Floats, Floats]:
    """Area [m2] of the occupied cells of every patch in its own plane, and of those inside it."""
    flat = np.abs(normal[:, 2]) > 0.95
    reference = np.where(flat[:, None], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    u = np.cross(reference, normal)
    u /= np.maximum(np.linalg.norm(u, axis=1, keepdims=True), 1e-12)
    v = np.cross(normal, u)
    column, row = (
        np.floor(np.einsum("ij,ij->i", delta, axis[own]) / cell).astype(np.int64) for axis in (u, v)
    )
    half = _HALF_PLANE
    keys = np.unique(
        (own * 2 * half + np.clip(column, 1 - half, half - 2) + half) * 2 * half
        + np.clip(row, 1 - half, half - 2)
        + half
    )
    inside = np.ones(len(keys), dtype=bool)
    for step in (1, -1, 2 * half, -2 * half):
        slot = np.minimum(np.searchsorted(keys, keys + step), len(keys) - 1)
        inside &= keys[slot] == keys + step
    patch = keys // (4 * half * half)
    count = len(normal)
    return (
        np.asarray(np.bincount(patch, minlength=count) * cell**2, dtype=np.float64),
        np.asarray(np.bincount(patch, inside, minlength=count) * cell**2, dtype=np.float64),
    )
