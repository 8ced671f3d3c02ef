"""Hand-made input features of the points of both epochs (de Gélis et al. 2024)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import get_args

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from subiaco_evaluation.baselines.cells import Pair
from subiaco_evaluation.learned.config import Feature, PointNetworkConfig
from subiaco_evaluation.learned.pyramids import Level, Pyramid, build_pyramid
from subiaco_geo.frames import Floats

#: Columns of :func:`point_features`.
FEATURES: tuple[str, ...] = get_args(Feature)
_AROUND = 10  # points of a neighbourhood whose shape is described (published)
_STABILITY_RADIUS = 1.0  # of the neighbourhood in the other epoch [m] (published)


def describe_pair(pair: Pair, network: PointNetworkConfig) -> tuple[Pyramid, Pyramid]:
    """Build the pyramids of both epochs with all features of their finest points."""
    sides = (pair.before, pair.after)
    first, second = (build_pyramid(side.cloud.xyz, network) for side in sides)
    ground = np.fmin(pair.before.ground, pair.after.ground).ravel()
    heights = [side.cloud.xyz[:, 2] - ground[side.cell] for side in sides]
    return (
        replace(first, features=point_features(first, second, heights[0])),
        replace(second, features=point_features(second, first, heights[1])),
    )


def point_features(own: Pyramid, other: Pyramid, heights: Floats) -> NDArray[np.float32]:
    """Return the features (N, 8) of the finest points of an epoch.

    Parameters
    ----------
    own, other : Pyramid
    heights : (M,) float64
        Heights of the input points above a ground that both epochs share [m]. The difference of two epochs
        is then the change of height, also where the ground itself rose.

    Returns
    -------
    (N, 8) float32
        In the order of :data:`FEATURES`: height [m]; stability 0..1, the share of the points of the other
        epoch within a vertical cylinder of 1 m that are within 1 m; of the ten nearest neighbours: vertical
        component of the normal, linearity, planarity, omnivariance, rank of the height in it 0..1, and
        range of the heights [m].
    """
    level = own.levels[0]
    height = np.bincount(own.member, heights) / np.bincount(own.member)
    columns = [height, stability(level.xyz, other.levels[0].xyz), *_shape(level)]
    return np.column_stack(columns).astype(np.float32)


def stability(xyz: Floats, other: Floats) -> Floats:
    """Return the share (N,) of the points of ``other`` below and above a point that are near it."""
    spheres = cKDTree(other).query_ball_point(xyz, _STABILITY_RADIUS, return_length=True)
    columns = cKDTree(other[:, :2]).query_ball_point(xyz[:, :2], _STABILITY_RADIUS, return_length=True)
    return np.asarray(spheres / np.maximum(columns, 1))


def _shape(level: Level) -> list[Floats]:
    """Return verticality, linearity, planarity, omnivariance, height rank and height range (N,) each."""
    index = level.neighbours[:, :_AROUND]
    known = index >= 0
    count = np.maximum(known.sum(axis=1), 1)
    offset = np.where(known[:, :, None], level.xyz[index] - level.xyz[:, None], 0.0)
    mean = offset.sum(axis=1) / count[:, None]
    centred = np.where(known[:, :, None], offset - mean[:, None], 0.0)
    values, vectors = np.linalg.eigh(np.einsum("npi,npj->nij", centred, centred) / count[:, None, None])
    small, middle, large = np.maximum(values, 0.0).T
    scale = np.maximum(large, 1e-12)
    up = np.where(known, offset[:, :, 2], 0.0)
    rank = ((up < 0) & known).sum(axis=1) / count
    return [
        np.abs(vectors[:, 2, 0]),
        (large - middle) / scale,
        (middle - small) / scale,
        np.cbrt(small * middle * large),
        rank,
        up.max(axis=1) - up.min(axis=1),
    ]


def chosen_features(pyramid: Pyramid, names: Sequence[str]) -> Pyramid:
    """Return a pyramid with the named features alone."""
    columns = [FEATURES.index(name) for name in names]
    return replace(pyramid, features=pyramid.features[:, columns])
