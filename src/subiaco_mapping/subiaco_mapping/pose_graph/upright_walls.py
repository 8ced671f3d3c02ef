"""Walls as plumb lines: what the facades of submaps say about the vertical.

A biased accelerometer tilts a map by a constant angle, and on a straight street fixes correct its pitch
alone. Facades run along streets, so that they hold the roll.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from subiaco_geo.frames import Floats, Ints
from subiaco_mapping.method_numbers import NUMBERS
from subiaco_mapping.planes_in_cubes import planes_in_cubes
from subiaco_mapping.pose_graph.records import NO_WALLS, WallPriors

_EDGE = NUMBERS.upright_walls.edge
_FEWEST = NUMBERS.upright_walls.fewest
_GUESS_WEIGHT = NUMBERS.upright_walls.guess_weight
_KERNEL = NUMBERS.upright_walls.kernel
_NARROWEST = NUMBERS.upright_walls.narrowest
_REACH = NUMBERS.upright_walls.reach
_ROUNDS = NUMBERS.upright_walls.rounds
_SAME_AZIMUTH = NUMBERS.upright_walls.same_azimuth
_SAME_OFFSET = NUMBERS.upright_walls.same_offset
_THICKEST = NUMBERS.upright_walls.thickest


@dataclass(frozen=True)
class WallPieces:
    """Flat pieces of a submap, in ``lidar_link`` of its anchor.

    Unit normals and means (W, 3) [m], and standard deviations (W,) of the normals [rad].
    """

    normal: Floats
    mean: Floats
    sigma: Floats


def wall_pieces(points: Floats) -> WallPieces:
    """Find flat pieces of the size of a wall in a submap (N, 3) [m], upright or not.

    The cubes of a second grid lie half an edge higher: a scanner that looks upwards by few degrees sees a
    strip of a wall about its own height, where the first grid has a limit.
    """
    found = []
    for shift in (0.0, _EDGE / 2):
        offset = np.array([0.0, 0.0, shift])
        planes = planes_in_cubes(points + offset, _EDGE, _FEWEST)
        flat = (planes.thickness < _THICKEST) & (planes.width > _NARROWEST)
        sigma = planes.thickness[flat] / (np.sqrt(planes.count[flat]) * planes.width[flat])
        found.append((planes.normal[flat], planes.mean[flat] - offset, sigma))
    return WallPieces(*map(np.concatenate, zip(*found, strict=True)))


def wall_priors(
    pieces: Sequence[WallPieces], index: Ints, R_odom_lidar: Floats, up_odom: Floats, sigma: float
) -> WallPriors:
    """Find what the walls of a recording say about the vertical.

    Parameters
    ----------
    pieces : sequence of WallPieces
        Of each submap.
    index : (M,) int64
        Anchors of the submaps.
    R_odom_lidar : (M, 3, 3) float64
        Of the anchors.
    up_odom : (3,) float64
        First guess of *up*, a unit vector.
    sigma : float
        Standard deviation of the lean of one wall [rad].

    Returns
    -------
    WallPriors
        One for each submap. All pieces in one plane of a submap count as one wall.
    """
    if len(pieces) == 0:
        return NO_WALLS
    owner = np.repeat(np.arange(len(pieces)), [len(own.normal) for own in pieces])
    normal = np.concatenate([own.normal for own in pieces])
    in_odom = np.einsum("nij,nj->ni", R_odom_lidar[owner], normal)
    upright = np.abs(in_odom @ up_odom) < _REACH
    owner, normal, in_odom = owner[upright], normal[upright], in_odom[upright]
    mean = np.concatenate([own.mean for own in pieces])[upright]
    noise = np.concatenate([own.sigma for own in pieces])[upright]
    share = 1.0 / (_pieces_of_same_wall(owner, normal, mean) * (1.0 + (noise / sigma) ** 2))
    up, kept = up_odom, share
    for _ in range(_ROUNDS):
        lean = in_odom @ up
        kept = share / (1.0 + (lean / _KERNEL) ** 2)
        up = _levelled(up, up_odom, in_odom, lean, kept)
    information = np.zeros((len(pieces), 3, 3))
    np.add.at(information, owner, np.einsum("n,ni,nj->nij", kept / sigma**2, normal, normal))
    values, vectors = np.linalg.eigh(information)
    roots = np.sqrt(np.maximum(values, 0.0))[:, :, None] * np.swapaxes(vectors, 1, 2)
    return WallPriors(index, roots)


def _pieces_of_same_wall(owner: Ints, normal: Floats, mean: Floats) -> Ints:
    """Return how many pieces of the same submap lie in the plane of each piece (W,)."""
    side = np.where(normal[:, :1] + 1e-3 * normal[:, 1:2] < 0, -1.0, 1.0)
    facing = side * normal
    azimuth = np.round(np.arctan2(facing[:, 1], facing[:, 0]) / _SAME_AZIMUTH)
    offset = np.round(np.einsum("ni,ni->n", facing, mean) / _SAME_OFFSET)
    _, same, counts = np.unique(
        np.column_stack([owner, azimuth, offset]), axis=0, return_inverse=True, return_counts=True
    )
    return np.asarray(counts[same.ravel()])


def _levelled(up: Floats, first: Floats, normal: Floats, lean: Floats, weight: Floats) -> Floats:
    """Return the unit vector near ``up`` to which the weighted normals are most nearly perpendicular."""
    across = np.linalg.svd(up[None])[2][1:]
    design = normal @ across.T
    information = (design * weight[:, None]).T @ design + np.eye(2) * _GUESS_WEIGHT
    step = np.linalg.solve(information, _GUESS_WEIGHT * across @ (first - up) - design.T @ (weight * lean))
    turned = up + step @ across
    return np.asarray(turned / np.linalg.norm(turned))
