"""Places of one epoch that the other epoch observed free, although it has points near them.

A sparse cloud occupies its surroundings: the nearest of its points may be a metre away although nothing
changed. Beams that crossed the place tell more than the distance of a point, except on a smooth surface:
beams graze a wall between its points.
"""

from __future__ import annotations

import numpy as np

from subiaco_change.geometry import tree_for_few
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import none_of_them, switchable
from subiaco_change.objects.known_space import Free
from subiaco_change.objects.vehicle_bodies import inside_vehicles
from subiaco_change.objects.voxel_objects import (
    EpochView,
    Reach,
    Voxels,
    is_standing,
    occupied_by_ground,
)
from subiaco_change.segmentation.ground_model import Mask
from subiaco_geo.codes import Semantic
from subiaco_geo.frames import Floats

_FREE = NUMBERS.places_seen_free.free_probability
_NEAR = NUMBERS.places_seen_free.neighbours
_SMOOTH = NUMBERS.places_seen_free.smooth_normals


@switchable("places_seen_free", none_of_them)
def places_seen_free(voxels: Voxels, other: EpochView, reach: Reach, free: Free | None) -> Mask:
    """Tell which voxels (M,) lie in places that the other epoch observed free.

    Parameters
    ----------
    voxels : Voxels
        Of the objects of one epoch.
    other : EpochView
        The other epoch, in the same frame.
    reach : Reach
        When points of the other epoch occupy a place.
    free : callable, optional
        How probable it is that the other epoch found places (N, 3) free; None where nothing tells.
    """
    found = np.zeros(len(voxels), dtype=bool)
    if free is None or len(voxels) == 0:
        return found
    found |= voxels.height > reach.standing
    found[found] = free(voxels.xyz[found]) >= _FREE
    standing = is_standing(other)
    found[found] = ~_lies_on_surface(voxels.xyz[found], other.xyz[standing], other.normals[standing], reach)
    ground = other.xyz[other.semantic == Semantic.GROUND]
    found[found] = ~occupied_by_ground(voxels.xyz[found], ground, reach)
    found[found] = ~inside_vehicles(voxels.xyz[found], other)
    return found


def _lies_on_surface(places: Floats, points: Floats, normals: Floats, reach: Reach) -> Mask:
    """Tell which places (M, 3) are near points (N, 3), or on a smooth surface that continues from points.

    A surface is smooth where the normals (N, 3) of the nearest points agree.
    """
    if len(points) < _NEAR or len(places) == 0:
        return np.zeros(len(places), dtype=bool)
    distance, slot = tree_for_few(points).query(places, k=_NEAR)
    around = normals[slot]
    agree = np.abs(np.einsum("mkj,mj->mk", around, around[:, 0])).mean(axis=1) >= _SMOOTH
    off = np.abs(np.einsum("mj,mj->m", places - points[slot[:, 0]], around[:, 0]))
    beyond = distance[:, 0] > reach.high
    return np.asarray((distance[:, 0] <= reach.low) | (agree & (off <= reach.low) & ~beyond))
